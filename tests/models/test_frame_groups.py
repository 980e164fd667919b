"""Frames of cameras that are exposed at different times: grouping, files, and the order of measurements."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError, InputError
from dronevio.models.imu import ImuSamples, Times
from dronevio.models.protocols import Recording, exposure_delay_ns, measurements
from dronevio.models.recordings.bag.recording import BagRecording
from dronevio.models.recordings.bag.writer import write_bag
from dronevio.models.recordings.calibration.exports import CONFIGURATIONS
from dronevio.models.recordings.calibration.kalibr import camchain_yaml, imu_yaml
from dronevio.models.recordings.calibration.reading import read_calibrated_rig
from dronevio.models.recordings.euroc import EurocRecording, write_euroc_recording
from dronevio.models.recordings.frame_groups import ABSENT, grouped_frames
from dronevio.models.rig import EUROC_T_IMU_CAM0, EUROC_T_IMU_CAM1, Rig, RigCamera
from dronevio.models.state import NO_IMAGE, CameraFrame, Trajectory

MS = 1_000_000
START_NS = 1_403_715_273_000_000_000
FRAME_NS = START_NS + 50 * MS * np.arange(8)
MODEL = CameraModel(32, 24, 20.0, 20.0, 15.5, 11.5)


def rows(*columns: list[int]) -> npt.NDArray[np.int64]:
    return np.array(columns).T


def test_a_constant_shift_is_the_delay_of_each_image() -> None:
    groups = grouped_frames([FRAME_NS, FRAME_NS + 2_160_000])
    np.testing.assert_array_equal(groups.t_ns, FRAME_NS)
    np.testing.assert_array_equal(groups.rows, rows([*range(8)], [*range(8)]))
    np.testing.assert_array_equal(groups.delays_ns, np.tile([0, 2_160_000], (8, 1)))
    earlier = grouped_frames([FRAME_NS, FRAME_NS - 24 * MS])
    np.testing.assert_array_equal(earlier.delays_ns[:, 1], -24 * MS)


def test_random_differences_are_delays_even_where_they_are_small() -> None:
    jitter_ns = np.array([-3, 3, 2, -2, 0, 1, -1, 3]) * MS
    groups = grouped_frames([FRAME_NS, FRAME_NS + jitter_ns])
    np.testing.assert_array_equal(groups.delays_ns[:, 1], jitter_ns)


def test_stamps_that_differ_a_little_are_those_of_one_trigger() -> None:
    noise_ns = np.array([0, 9, -9, 3, 3, 0, 5, 40]) * MS // 10
    groups = grouped_frames([FRAME_NS, FRAME_NS + noise_ns])
    np.testing.assert_array_equal(groups.delays_ns[:, 1], [0, 0, 0, 0, 0, 0, 0, 4 * MS])


def test_images_without_a_partner_are_frames_of_their_camera() -> None:
    first, second = np.delete(FRAME_NS, 3), np.delete(FRAME_NS, 6) + 4 * MS
    groups = grouped_frames([first, second])
    np.testing.assert_array_equal(groups.t_ns, np.sort([*first, FRAME_NS[3] + 4 * MS]))
    np.testing.assert_array_equal(groups.rows, rows([0, 1, 2, ABSENT, 3, 4, 5, 6], [0, 1, 2, 3, 4, 5, ABSENT, 6]))
    np.testing.assert_array_equal(groups.delays_ns[:, 1], np.array([4, 4, 4, 0, 4, 4, 0, 4]) * MS)
    np.testing.assert_array_equal(groups.is_complete, [True, True, True, False, True, True, False, True])


def test_the_nearest_images_are_grouped() -> None:
    groups = grouped_frames([np.array([100, 200]) * MS, np.array([90, 108, 208]) * MS], tolerance_s=0.02)
    np.testing.assert_array_equal(groups.rows, rows([ABSENT, 0, 1], [0, 1, 2]))
    groups = grouped_frames([np.array([100, 110]) * MS, np.array([108]) * MS], tolerance_s=0.02)
    np.testing.assert_array_equal(groups.rows, rows([0, 1], [ABSENT, 0]))


def test_offsets_count_for_the_grouping_only() -> None:
    """The second camera is stamped 30 ms late; its images belong to the frame before by their stamps alone."""
    stamps = [FRAME_NS, FRAME_NS + 30 * MS]
    groups = grouped_frames(stamps, (0.0, -0.03))
    np.testing.assert_array_equal(groups.rows, rows([*range(8)], [*range(8)]))
    np.testing.assert_array_equal(groups.delays_ns[:, 1], 30 * MS)
    equal = grouped_frames([FRAME_NS, FRAME_NS], (0.0, 0.00216))
    np.testing.assert_array_equal(equal.delays_ns, 0)
    assert equal.is_complete.all()


def test_three_cameras_and_single_images() -> None:
    groups = grouped_frames([FRAME_NS[:1], FRAME_NS[:1] + 2 * MS, FRAME_NS[:1] + 12 * MS])
    np.testing.assert_array_equal(groups.delays_ns, [[0, 2 * MS, 12 * MS]])
    apart = grouped_frames([FRAME_NS, FRAME_NS + 12 * MS, FRAME_NS + 36 * MS])
    assert not apart.is_complete.any()  # 14 ms before the first and 12 ms after it are 26 ms apart
    assert ((apart.rows != ABSENT).sum(axis=0) == 8).all()


@pytest.mark.parametrize("delays", [(1,), (1, 2, 3)])
def test_a_frame_has_a_delay_for_each_image(delays: tuple[int, ...]) -> None:
    with pytest.raises(ConfigError, match=f"2 images and {len(delays)} delays"):
        CameraFrame(0, (NO_IMAGE, NO_IMAGE), image_delays_ns=delays)


# --- files


def stereo(*offsets_s: float) -> Rig:
    poses = (EUROC_T_IMU_CAM0, EUROC_T_IMU_CAM1)
    cameras = tuple(RigCamera(MODEL, T, time_offset_s=offset) for T, offset in zip(poses, offsets_s, strict=True))
    return Rig(cameras)


class Delayed:
    """A recording whose second camera is exposed later, by a delay of each frame."""

    def __init__(self, rig: Rig, delays_ns: Times) -> None:
        self.name, self.rig, self.delays_ns = "delayed", rig, delays_ns
        t_ns = START_NS + 5 * MS * np.arange(-10, 110)
        self.imu = ImuSamples(t_ns, np.zeros((len(t_ns), 3)), np.zeros((len(t_ns), 3)))
        self.frame_times_ns = FRAME_NS
        self.ground_truth: Trajectory | None = None

    def frame(self, index: int) -> CameraFrame:
        images = tuple(np.full((24, 32), 10 * index + i, np.uint8) for i in range(2))
        return CameraFrame(int(FRAME_NS[index]), images, image_delays_ns=(0, int(self.delays_ns[index])))


JITTER_NS = np.array([-3, 3, 2, -2, 0, 1, -1, 3]) * MS + 123


def written(folder: Path, kind: str, recording: Recording) -> EurocRecording | BagRecording:
    if kind == "euroc":
        write_euroc_recording(folder / "flight", recording)
        return EurocRecording.open(folder / "flight")
    write_bag(folder / "flight.mcap", recording, images="png" if kind == "png" else "raw")
    return BagRecording.open(folder / "flight.mcap", repair=kind == "png")


@pytest.mark.parametrize("kind", ["euroc", "raw", "png"])
@pytest.mark.parametrize("offset_s", [0.0, 0.00216, -0.25])
def test_delays_and_offsets_are_kept_in_files(tmp_path: Path, kind: str, offset_s: float) -> None:
    source = Delayed(stereo(0.0, offset_s), JITTER_NS - round(1e9 * offset_s))
    found = written(tmp_path, kind, source)
    assert [camera.time_offset_s for camera in found.rig.cameras] == [0.0, offset_s]
    np.testing.assert_array_equal(found.frame_times_ns, FRAME_NS)
    for index in range(8):
        frame, expected = found.frame(index), source.frame(index)
        assert frame.image_delays_ns == expected.image_delays_ns
        for image, of in zip(frame.images, expected.images, strict=True):
            np.testing.assert_array_equal(image, of)


def test_a_folder_without_repair_has_the_frames_of_all_cameras(tmp_path: Path) -> None:
    """Before, cameras that are exposed 2.16 ms apart had no frame at all."""
    source = Delayed(stereo(0.0, 0.0), np.full(8, 2_160_000))
    write_euroc_recording(tmp_path, source)
    listed = tmp_path / "mav0/cam1/data.csv"
    listed.write_text("".join(line for k, line in enumerate(listed.read_text().splitlines(True)) if k != 3))
    strict, repaired = EurocRecording.open(tmp_path), EurocRecording.open(tmp_path, repair=True)
    np.testing.assert_array_equal(strict.frame_times_ns, np.delete(FRAME_NS, 2))
    np.testing.assert_array_equal(repaired.frame_times_ns, FRAME_NS)
    assert [str(defect.kind) for defect in repaired.defects] == ["unpaired image"]
    assert repaired.frame(2).images[1].size == 0


def test_cameras_of_different_rates_are_refused_with_a_reason(tmp_path: Path) -> None:
    write_euroc_recording(tmp_path, Delayed(stereo(0.0, 0.0), JITTER_NS))
    sensor = tmp_path / "mav0/cam1/sensor.yaml"
    sensor.write_text(sensor.read_text().replace("rate_hz: 20.0", "rate_hz: 30.0"))
    with pytest.raises(InputError, match=r"rate_hz = 20\.0, 30\.0; expected one rate"):
        EurocRecording.open(tmp_path)


def test_time_shifts_of_kalibr_may_differ(tmp_path: Path) -> None:
    rig = replace(stereo(0.0, 0.00216), time_offset_s=-0.0041)
    text = camchain_yaml(rig)
    assert "timeshift_cam_imu: -0.0041" in text and "timeshift_cam_imu: -0.00194" in text
    (tmp_path / "camchain.yaml").write_text(text)
    (tmp_path / "imu.yaml").write_text(imu_yaml(rig))
    found = read_calibrated_rig(tmp_path)
    assert found.time_offset_s == -0.0041
    assert [camera.time_offset_s for camera in found.cameras] == [0.0, 0.00216]
    (tmp_path / "camchain.yaml").write_text(camchain_yaml(stereo(0.0, 0.0004)))  # of cameras with one trigger
    assert [camera.time_offset_s for camera in read_calibrated_rig(tmp_path).cameras] == [0.0, 0.0]


@pytest.mark.parametrize("program", ["vins", "orbslam3", "basalt", "kimera"])
def test_programs_with_one_time_offset_refuse_several(program: str) -> None:
    imu = ImuSamples(FRAME_NS, np.zeros((8, 3)), np.zeros((8, 3)))
    with pytest.raises(ConfigError, match=r"time offsets of 0\.001 and 0\.00316 s; expected one"):
        CONFIGURATIONS[program](replace(stereo(0.0, 0.00216), time_offset_s=0.001), FRAME_NS, imu)
    assert CONFIGURATIONS[program](stereo(0.002, 0.002), FRAME_NS, imu)


@pytest.mark.parametrize("program", ["vins", "orbslam3"])
def test_programs_with_one_image_size_refuse_several(program: str) -> None:
    imu, (first, second) = ImuSamples(FRAME_NS, np.zeros((8, 3)), np.zeros((8, 3))), stereo(0.0, 0.0).cameras
    rig = Rig((first, replace(second, model=MODEL.resized(16, 12))))
    with pytest.raises(ConfigError, match="images of 32 × 24 and 16 × 12 px; expected one size"):
        CONFIGURATIONS[program](rig, FRAME_NS, imu)


# --- order of measurements


@pytest.mark.parametrize(
    ("offset_s", "delay_ns", "expected_ms"),
    [(0.0, 12 * MS, 15), (0.012, 0, 15), (0.007, 4 * MS, 15), (-0.012, 0, 0), (0.0, -12 * MS, 0)],
)
def test_a_frame_waits_for_its_last_image(offset_s: float, delay_ns: int, expected_ms: int) -> None:
    recording = Delayed(stereo(0.0, offset_s), np.full(8, delay_ns))
    newest_ns, lead_ms = 0, []
    for measurement in measurements(recording):
        if isinstance(measurement, ImuSamples):
            newest_ns = int(measurement.t_ns[-1])
        else:
            lead_ms.append((newest_ns - measurement.t_ns) // MS)
    assert lead_ms == [expected_ms] * 8
    expected_ns = max(delay_ns + round(1e9 * offset_s), 0)
    assert exposure_delay_ns(recording.rig, (0, delay_ns)) == expected_ns
