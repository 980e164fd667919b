"""Defective recordings in the driver and in ``dronevio estimate``: events, warnings, figures and ``--strict``."""

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dronevio.cli import main
from dronevio.estimators.driver import estimate_recording
from dronevio.models.defects import DefectKind
from dronevio.models.errors import InputError
from dronevio.models.imu import ImuSamples
from dronevio.models.recordings.euroc import EurocRecording, write_euroc_recording
from dronevio.models.recordings.open import open_recording
from dronevio.models.recordings.tum import read_tum, write_tum
from dronevio.models.state import CameraFrame, Estimate, Health, NavState

Make = Callable[..., Any]
Result = Any  # the class of conftest, which cannot be imported
CommandRunner = Callable[..., Result]


class Standing:
    """An estimator that claims that nothing moves, and keeps the numbers of images that it receives."""

    def __init__(self) -> None:
        self.images: list[int] = []

    def add_imu(self, samples: ImuSamples) -> None:
        assert np.isfinite(samples.accel_m_s2).all()

    def add_frame(self, frame: CameraFrame) -> Estimate:
        self.images.append(sum(image.size > 0 for image in frame.images))
        return Estimate(frame.t_ns, Health.TRACKING, self.state_at(frame.t_ns), events=("standing",))

    def state_at(self, t_ns: int) -> NavState:
        zero = np.zeros(3)
        return NavState(t_ns, np.eye(4), zero, zero, zero)


def edit_rows(path: Path, change: Callable[[list[str]], None]) -> None:
    """Change the rows of a table, without its header, in place."""
    header, *rows = path.read_text().splitlines(keepends=True)
    change(rows)
    path.write_text("".join([header, *rows]))


def test_defects_are_events_of_their_frames(tmp_path: Path, noise_recording: Make) -> None:
    """Those of consecutive frames are one event of the first of them."""
    write_euroc_recording(tmp_path, noise_recording("euroc-stereo", frames=8))
    mav0 = tmp_path / "mav0"
    edit_rows(mav0 / "cam1" / "data.csv", lambda rows: rows.__delitem__(slice(2, 5)))
    damaged = sorted((mav0 / "cam0" / "data").iterdir())[6]
    damaged.write_bytes(b"")
    edit_rows(mav0 / "imu0" / "data.csv", lambda rows: rows.insert(40, rows[40]))  # 33 and 43 are at frames 3 and 4
    recording, estimator = open_recording(tmp_path, repair=True), Standing()
    run = estimate_recording(recording, estimator)
    assert estimator.images == [2, 2, 1, 1, 1, 2, 1, 2]
    standing = ("standing",)
    assert [estimate.events for estimate in run.estimates] == [
        standing,
        standing,
        ("standing", "unpaired image"),
        standing,
        ("standing", "duplicate IMU stamp"),
        standing,
        ("standing", "damaged image"),
        standing,
    ]
    assert run.defects[: len(recording.defects)] == recording.defects
    assert [(d.kind, d.t_ns) for d in run.defects[len(recording.defects) :]] == [
        (DefectKind.DAMAGED_IMAGE, int(recording.frame_times_ns[6]))
    ]
    run.check_belongs_to(recording)
    with pytest.raises(InputError, match="an empty file"):
        estimate_recording(replace(recording, repair=False), Standing())


@pytest.fixture(scope="module")
def defective(flown: Result, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The short flight with a defect of each kind that a single camera can have."""
    folder = tmp_path_factory.mktemp("defective") / "flight"
    shutil.copytree(flown.folder, folder)
    mav0 = folder / "mav0"
    images = sorted((mav0 / "cam0" / "data").iterdir())
    images[40].unlink()
    for image in images[50:53]:
        image.write_bytes(image.read_bytes()[:1000])

    def change_images(rows: list[str]) -> None:
        rows[20], rows[21] = rows[21], rows[20]
        rows.insert(30, rows[30])

    def change_imu(rows: list[str]) -> None:
        rows[300], rows[301] = rows[301], rows[300]
        rows[310] = re.sub(r",[^,]*", ",nan", rows[310], count=1)
        rows.insert(320, rows[320])
        del rows[700:710]

    edit_rows(mav0 / "cam0" / "data.csv", change_images)
    edit_rows(mav0 / "imu0" / "data.csv", change_imu)
    return folder


COUNTS = {
    "missing_image": 1,
    "damaged_image": 3,
    "duplicate_image_stamp": 1,
    "unordered_image_stamp": 1,
    "duplicate_imu_stamp": 1,
    "unordered_imu_stamp": 1,
    "non_finite_imu_sample": 1,
    "imu_gap": 1,
}


def test_estimation_goes_on_and_reports(
    defective: Path, flown: Result, run_command: CommandRunner, tmp_path: Path
) -> None:
    out = tmp_path / "e.tum"
    result = run_command(tmp_path, "estimate", defective, "--out", out, "--json")
    document = result.document
    assert {key: each["count"] for key, each in document["defects"].items()} == COUNTS
    warnings = [line for line in result.err.splitlines() if "warning" in line]
    assert len(warnings) == len(COUNTS)
    for each in document["defects"].values():
        assert sum(each["first"] in line and f"{each['count']} × " in line for line in warnings) == 1
    frames = EurocRecording.open(flown.folder).frame_times_ns
    assert document["frames"] == len(frames) - 1
    estimate = read_tum(out)
    assert np.isin(estimate.t_ns, frames).all()
    scores = run_command(tmp_path, "evaluate", flown.folder, out, "--json").document
    assert scores["ate_m"]["rmse"] < 0.05


def test_strict_refuses_on_one_line(defective: Path, flown: Result, tmp_path: Path, capsys: Any) -> None:
    out = str(tmp_path / "e.tum")
    assert main(["estimate", str(defective), "--strict", "--out", out]) == 2
    assert main(["benchmark", "--recordings", str(defective), "--strict", "--out", str(tmp_path / "b")]) == 2
    shown = capsys.readouterr()
    assert shown.out == "" and len(shown.err.splitlines()) == 2
    for line in shown.err.splitlines():
        assert "1 × missing image" in line and "1 × IMU gap" in line and "expected a recording without defects" in line
    only_damaged = tmp_path / "damaged"
    shutil.copytree(flown.folder, only_damaged)
    sorted((only_damaged / "mav0" / "cam0" / "data").iterdir())[3].write_bytes(b"")
    assert main(["estimate", str(only_damaged), "--strict", "--out", out, "--json"]) == 2
    assert "an empty file" in capsys.readouterr().err and not Path(out).exists()


def test_clean_flights_have_no_defects(flown: Result, run_command: CommandRunner, tmp_path: Path) -> None:
    strict, lenient = (
        run_command(tmp_path, "estimate", flown.folder, "--out", tmp_path / f"{word}.tum", "--json", *options)
        for word, options in (("strict", ("--strict",)), ("lenient", ()))
    )
    assert strict.document["defects"] == lenient.document["defects"] == {}
    assert strict.err == lenient.err == ""
    assert (tmp_path / "strict.tum").read_bytes() == (tmp_path / "lenient.tum").read_bytes()


@pytest.mark.slow
def test_benchmarks_store_and_print_defects(defective: Path, run_command: CommandRunner, tmp_path: Path) -> None:
    words = ("--recordings", defective, "--estimators", "dead-reckoning", "--out", tmp_path / "b", "--json")
    result = run_command(tmp_path, "benchmark", *words)
    (row,) = json.loads(result.out)["rows"]
    assert row["status"] == "ok" and "3 × damaged image" in row["defects"] and "1 × IMU gap" in row["defects"]
    assert f"warning: {defective}: 1 × missing image" in result.err


def test_logs_show_what_is_there(defective: Path, flown: Result, run_command: CommandRunner, tmp_path: Path) -> None:
    out, truth = tmp_path / "truth.tum", EurocRecording.open(flown.folder).ground_truth
    assert truth is not None
    write_tum(out, truth)
    run_command(tmp_path, "log", defective, out, "--out", tmp_path / "e.rrd", "--json")
    assert (tmp_path / "e.rrd").stat().st_size > 10_000
