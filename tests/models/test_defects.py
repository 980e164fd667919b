"""Defective recordings: each defect is found, counted and survived, and refused without repair."""

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from dronevio.models.defects import DefectKind, count_defects, defect_values, defects_text, refuse_defects
from dronevio.models.errors import InputError
from dronevio.models.imu import ImuSamples, Times
from dronevio.models.recordings.euroc import EurocRecording, read_euroc_segment_times, write_euroc_recording
from dronevio.models.recordings.frame_groups import ABSENT, grouped_frames
from dronevio.models.recordings.open import open_recording
from dronevio.models.recordings.repair import IMAGE_STAMPS, increasing_rows, unpaired_images
from dronevio.models.state import NO_IMAGE

FRAMES = 6
Make = Callable[..., Any]
Change = Callable[[Path], object]


@pytest.fixture
def folder(tmp_path: Path, noise_recording: Make) -> Path:
    """A recording of six frames of two cameras and 60 IMU samples, without defects."""
    write_euroc_recording(tmp_path / "flight", noise_recording("euroc-stereo", frames=FRAMES))
    return tmp_path / "flight"


def change_rows(path: Path, change: Callable[[list[str]], list[str]]) -> None:
    """Change the rows of a table after its header."""
    header, *rows = path.read_text().splitlines(keepends=True)
    path.write_text("".join([header, *change(rows)]))


def swapped(first: int) -> Callable[[list[str]], list[str]]:
    return lambda rows: [*rows[:first], rows[first + 1], rows[first], *rows[first + 2 :]]


def repeated(row: int) -> Callable[[list[str]], list[str]]:
    return lambda rows: [*rows[: row + 1], *rows[row:]]


def not_a_number(row: int) -> Callable[[list[str]], list[str]]:
    return lambda rows: [*rows[:row], re.sub(r",[^,]*", ",nan", rows[row], count=1), *rows[row + 1 :]]


def removed(start: int, end: int) -> Callable[[list[str]], list[str]]:
    return lambda rows: [*rows[:start], *rows[end:]]


def images(folder: Path, camera: int) -> list[Path]:
    return sorted((folder / "mav0" / f"cam{camera}" / "data").iterdir())


def imu_table(change: Callable[[list[str]], list[str]]) -> Change:
    return lambda folder: change_rows(folder / "mav0" / "imu0" / "data.csv", change)


def image_list(camera: int, change: Callable[[list[str]], list[str]]) -> Change:
    return lambda folder: change_rows(folder / "mav0" / f"cam{camera}" / "data.csv", change)


def moved(start: int, change_s: float) -> Callable[[list[str]], list[str]]:
    """Let the clock of a list step at a row."""

    def later(row: str) -> str:
        return re.sub(r"^-?\d+", lambda found: str(int(found[0]) + round(change_s * 1e9)), row)

    return lambda rows: [*rows[:start], *map(later, rows[start:])]


def step_all(folder: Path, change_s: float = -1.0, frame: int = 3) -> None:
    """Let all clocks step before a frame; IMU sample 10 k + 3 is at frame k."""
    imu_table(moved(10 * frame - 2, change_s))(folder)
    for camera in (0, 1):
        image_list(camera, moved(frame, change_s))(folder)


def cut(file: Path) -> None:
    file.write_bytes(file.read_bytes()[:60])


DEFECTS: dict[DefectKind, tuple[Change, int, str]] = {
    DefectKind.MISSING_IMAGE: (lambda f: images(f, 0)[2].unlink(), FRAMES, "cam0/data.csv:4: no file data/"),
    DefectKind.DAMAGED_IMAGE: (lambda f: cut(images(f, 1)[3]), FRAMES, "a truncated PNG"),
    DefectKind.UNPAIRED_IMAGE: (image_list(0, removed(4, 5)), FRAMES, "no image of cam0 at "),
    DefectKind.DUPLICATE_IMAGE_STAMP: (image_list(1, repeated(1)), FRAMES, "cam1/data.csv:4: time stamp"),
    DefectKind.UNORDERED_IMAGE_STAMP: (image_list(0, swapped(2)), FRAMES, "cam0/data.csv:5: time stamp"),
    DefectKind.DUPLICATE_IMU_STAMP: (imu_table(repeated(7)), FRAMES, "imu0/data.csv:10: sample at"),
    DefectKind.UNORDERED_IMU_STAMP: (imu_table(swapped(20)), FRAMES, "imu0/data.csv:23: sample at"),
    DefectKind.NON_FINITE_IMU_SAMPLE: (imu_table(not_a_number(9)), FRAMES, "imu0/data.csv:11: sample at"),
    DefectKind.IMU_GAP: (imu_table(removed(14, 22)), FRAMES, "no IMU sample for 0.045 s after"),
    DefectKind.FRAME_WITHOUT_IMU: (imu_table(removed(45, 60)), FRAMES, "0.045 s after the last IMU sample"),
    DefectKind.CLOCK_STEP: (
        step_all,
        3,
        "imu0/data.csv:30: 1403715272402142976 ns after 1403715273397142976 ns (-1.000 s)",
    ),
    DefectKind.LONE_CLOCK_STEP: (imu_table(moved(28, -0.12)), FRAMES, "ns (-0.120 s)"),
}
"""How a kind of defect is made, the number of frames that remain, and a part of its description."""


def test_every_kind_of_defect_is_tested() -> None:
    elsewhere = {DefectKind.IMU_BURST, DefectKind.UNSET_STAMP, DefectKind.UNUSABLE_SEGMENT}  # test_recording_clocks.py
    assert set(DEFECTS) | elsewhere == set(DefectKind)
    assert len({kind.key for kind in DefectKind}) == len(DefectKind)
    assert all(re.fullmatch("[a-z_]+", kind.key) and kind.treatment for kind in DefectKind)


@pytest.mark.parametrize("kind", DEFECTS)
def test_a_defect_is_counted_and_survived(folder: Path, kind: DefectKind) -> None:
    make, frames, description = DEFECTS[kind]
    make(folder)
    recording = open_recording(folder, repair=True)
    read = [recording.frame(k) for k in range(len(recording.frame_times_ns))]
    defects = (*recording.defects, *(defect for frame in read for defect in frame.defects))
    (found,) = count_defects(defects)
    assert (found.kind, found.count, len(read)) == (kind, 1, frames)
    assert description in found.first and description in str(found) and "\n" not in str(found)
    assert defect_values(defects) == {kind.key: {"count": 1, "first": found.first}}
    assert defects_text(defects) == f"1 × {kind}"
    with pytest.raises(InputError, match=f"1 × {kind}"):
        refuse_defects(folder, defects)
    absent = kind in (DefectKind.MISSING_IMAGE, DefectKind.DAMAGED_IMAGE, DefectKind.UNPAIRED_IMAGE)
    assert sum(image.size == 0 for frame in read for image in frame.images) == absent
    assert np.all(np.diff(recording.frame_times_ns) > 0)
    np.testing.assert_array_equal(
        read_euroc_segment_times(folder)[0], EurocRecording.open(folder, 1, True).frame_times_ns
    )


@pytest.mark.parametrize("kind", [*DEFECTS][:8])
def test_defects_are_refused_without_repair(folder: Path, kind: DefectKind) -> None:
    """Frames that not every camera has are left out."""
    DEFECTS[kind][0](folder)
    if kind is DefectKind.UNPAIRED_IMAGE:
        assert len(open_recording(folder).frame_times_ns) == FRAMES - 1
        return
    with pytest.raises(InputError):
        recording = open_recording(folder)
        for k in range(FRAMES):
            recording.frame(k)


def test_clean_recordings_are_the_same_with_repair(
    folder: Path, assert_same_recording: Make, noise_recording: Make
) -> None:
    recording = open_recording(folder, repair=True)
    assert recording.defects == () and defect_values(recording.defects) == {} and count_defects(()) == ()
    refuse_defects(folder, recording.defects)
    assert_same_recording(recording, open_recording(folder))
    assert all(recording.frame(k).defects == () for k in range(FRAMES))


def test_what_is_left_has_its_own_values(folder: Path, noise_recording: Make) -> None:
    """After repair, each image and each sample that remains is the one of its time stamp."""
    for kind in (DefectKind.UNORDERED_IMAGE_STAMP, DefectKind.DUPLICATE_IMAGE_STAMP, DefectKind.UNPAIRED_IMAGE):
        DEFECTS[kind][0](folder)
    imu_table(swapped(20))(folder)
    imu_table(repeated(30))(folder)
    imu_table(not_a_number(9))(folder)
    recording, original = open_recording(folder, repair=True), noise_recording("euroc-stereo", frames=FRAMES)
    np.testing.assert_array_equal(recording.frame_times_ns, original.frame_times_ns)
    for k in range(FRAMES):
        for image, expected in zip(recording.frame(k).images, original.frame(k).images, strict=True):
            assert image is NO_IMAGE or np.array_equal(image, expected)
    rows = np.delete(np.arange(len(original.imu)), 9)
    np.testing.assert_array_equal(recording.imu.t_ns, original.imu.t_ns[rows])
    np.testing.assert_array_equal(recording.imu.accel_m_s2, original.imu.accel_m_s2[rows])


def test_frames_without_any_image_are_left_out(folder: Path) -> None:
    for camera in (0, 1):
        images(folder, camera)[2].unlink()
    recording = open_recording(folder, repair=True)
    assert len(recording.frame_times_ns) == FRAMES - 1
    assert [(found.kind, found.count) for found in count_defects(recording.defects)] == [(DefectKind.MISSING_IMAGE, 2)]


def shifted_camera(rows: list[str]) -> list[str]:
    """Return an image list whose time stamps are one hour later."""
    return [re.sub(r"^(\d+)", lambda found: str(int(found[1]) + 3600 * 10**9), row) for row in rows]


@pytest.mark.parametrize("repair", [True, False])
def test_recordings_that_cannot_work_say_why(folder: Path, repair: bool) -> None:
    image_list(1, shifted_camera)(folder)
    with pytest.raises(InputError, match="2 cameras without a time stamp in common"):
        open_recording(folder, repair=repair)
    image_list(0, shifted_camera)(folder)
    if repair:
        with pytest.raises(
            InputError, match=r"IMU and camera do not overlap: IMU from 1403715273\.\d+ to .* camera fr"
        ):
            open_recording(folder, repair=True)
    for file in images(folder, 1):
        file.unlink()
    if repair:
        with pytest.raises(InputError, match="6 images, none of which exists"):
            open_recording(folder, repair=True)


def test_an_imu_without_finite_samples_is_refused(folder: Path) -> None:
    imu_table(lambda rows: [re.sub(r",[^,]*", ",nan", row, count=1) for row in rows])(folder)
    with pytest.raises(InputError, match="60 samples, none of which is finite"):
        open_recording(folder, repair=True)


def test_images_of_another_size_are_no_defect(folder: Path) -> None:
    sensor = folder / "mav0" / "cam0" / "sensor.yaml"
    sensor.write_text(sensor.read_text().replace("[32, 24]", "[30, 24]"))
    with pytest.raises(InputError, match="an image of 32 × 24 px; expected an image of 30 × 24 px"):
        open_recording(folder, repair=True).frame(0)


stamps = st.lists(st.integers(-(2**40), 2**40), max_size=30)


@settings(max_examples=200, deadline=None)
@given(stamps)
def test_rows_are_those_of_a_stable_sort(t: list[int]) -> None:
    rows, defects = increasing_rows(np.array(t, dtype=np.int64), IMAGE_STAMPS, str)
    assert [t[row] for row in rows.tolist()] == sorted(set(t))
    assert all(t.index(t[row]) == row for row in rows.tolist())  # the first of equal stamps
    duplicates = [row for row in range(len(t)) if t[row] in t[:row]]
    unordered = [row for row in range(len(t)) if row not in duplicates and any(s > t[row] for s in t[:row])]
    by_kind = {kind: [int(d.description) for d in defects if d.kind is kind] for kind in DefectKind}
    assert by_kind[DefectKind.DUPLICATE_IMAGE_STAMP] == duplicates
    assert by_kind[DefectKind.UNORDERED_IMAGE_STAMP] == unordered
    assert len(defects) == len(duplicates) + len(unordered)


@settings(max_examples=200, deadline=None)
@given(st.lists(st.sets(st.integers(0, 200), min_size=1), min_size=1, max_size=4), st.integers(0, 5))
@example([{0, 183}, {0, 182, 183}, {0, 179, 187}], 5)
def test_each_image_belongs_to_one_frame(of_cameras: list[set[int]], tolerance: int) -> None:
    """No image is lost unless one camera has two within the tolerance; the images of a frame are within it."""
    t_ns: list[Times] = [np.array(sorted(of), dtype=np.int64) for of in of_cameras]
    groups = grouped_frames(t_ns, tolerance_s=tolerance * 1e-9)
    times, rows = groups.t_ns, groups.rows
    assert np.all(np.diff(times) > 0) and (rows != ABSENT).any(axis=1).all()
    for camera, column in enumerate(rows.T):
        used = column[column != ABSENT]
        assert np.all(np.diff(used) > 0)
        if tolerance == 0:
            assert len(used) == len(t_ns[camera])
    for t, row in zip(times.tolist(), rows.tolist(), strict=True):
        in_frame = [int(t_ns[camera][k]) for camera, k in enumerate(row) if k != ABSENT]
        assert t == in_frame[0] and max(in_frame) - min(in_frame) <= tolerance
    if tolerance == 0:
        np.testing.assert_array_equal(times, sorted(set().union(*of_cameras)))
    names = [f"cam{i}" for i in range(len(t_ns))]
    assert len(unpaired_images(times, rows, names)) == int((rows == ABSENT).any(axis=1).sum())


def test_the_time_offset_counts_for_the_overlap(folder: Path, noise_recording: Make) -> None:
    """Camera stamps that are an hour late belong to the IMU if the calibration says so."""
    recording = noise_recording("euroc-stereo", frames=FRAMES)
    imu = ImuSamples(recording.imu.t_ns + 3600 * 10**9, recording.imu.gyro_rad_s, recording.imu.accel_m_s2)
    rig = replace(recording.rig, time_offset_s=3600.0)
    write_euroc_recording(folder.parent / "late", replace(recording, imu=imu, rig=rig, ground_truth=None))
    assert open_recording(folder.parent / "late", repair=True).defects == ()
