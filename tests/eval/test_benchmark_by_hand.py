"""Resources of benchmarks, missing runs and quartiles, with values worked out by hand."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dronevio.eval.benchmark.isolation import Outcome, Status
from dronevio.eval.benchmark.jobs import USAGE_FILE, Job, RecordingSpec, ResourceUsage
from dronevio.eval.benchmark.metrics import OwnMetric
from dronevio.eval.benchmark.rows import Row
from dronevio.eval.benchmark.runner import BenchmarkPlan
from dronevio.eval.benchmark.sizing import JobUsage
from dronevio.eval.benchmark.store import ResultStore
from dronevio.eval.benchmark.summary import Quartiles, quartiles_of_errors
from tests.rows import row_of


@dataclass(frozen=True)
class SmallPipeline:
    """A pipeline that writes recordings of 1500 bytes and has a position error of 0.1 m."""

    versions: str = "1"
    own_metrics: tuple[OwnMetric, ...] = ()

    def config_hash(self, estimator: str) -> str:
        """Return the same text for all estimators."""
        return "settings"

    def record(self, spec: RecordingSpec, folder: Path, images: Path | None = None) -> None:
        """Write files of 1000 and 500 bytes."""
        (folder / "mav0").mkdir()
        (folder / "mav0" / "data.csv").write_bytes(bytes(1000))
        (folder / "note").write_bytes(bytes(500))
        if images is not None:
            (folder / "images").write_text(images.name, encoding="utf-8")

    def estimate(self, spec: RecordingSpec, recording: Path, estimator: str) -> dict[str, Any]:
        """Return a position error."""
        return {"ate_m": 0.1}


def call_here(function: Callable[..., object], *arguments: object, **options: object) -> Outcome:
    """Call a function in this process and return fixed resources: 1 s, 2 s of processor time and 3 MB."""
    return Outcome("ok", "", function(*arguments), wall_s=1.0, cpu_s=2.0, peak_mb=3.0)


def run(estimator: str, status: Status = "ok", seed: int = 0, ate_m: float | None = None) -> Row:
    """Return a run of an estimator."""
    return row_of("s", "w", seed, estimator, "settings", "1", status, recording_hash="hash", ate_m=ate_m)


def test_resources_scale_with_the_number_of_recordings() -> None:
    """100 recordings of 36 s and 500 MB each, and 72 s and 10 MB of an estimator: 1 h and 2 h of processor time."""
    usage = JobUsage(ResourceUsage(36.0, 99.0, 500.0), (("vio", ResourceUsage(72.0, 99.0, 10.0)),))
    rows = usage.scaled(recordings=100, cores=4)
    assert [name for name, *_ in rows] == ["recordings", "vio", "all"]
    # Hours of processor time, hours on four cores, and GB.
    np.testing.assert_allclose([row[1:] for row in rows], [[1.0, 0.25, 50.0], [2.0, 0.5, 1.0], [3.0, 0.75, 51.0]])


def test_quartiles_and_median_of_five_runs() -> None:
    rows = [run("vio", seed=seed, ate_m=ate_m) for seed, ate_m in enumerate((5.0, 1.0, 4.0, 2.0, 3.0))]
    assert quartiles_of_errors(rows, "ate_m") == Quartiles(lower=2.0, median=3.0, upper=4.0, runs=5, failed=0)


def test_a_retry_repeats_failed_runs_only(tmp_path: Path) -> None:
    store = ResultStore(tmp_path)
    for row in (run("a"), run("b", "failed"), run("c", "timeout"), run("d", "crashed")):
        store.add(row)
    recording = RecordingSpec("s", "w", 0, "hash", None)
    plan = BenchmarkPlan((recording,), ("a", "b", "c", "d", "e"), SmallPipeline(), tmp_path / "cache", 60.0)
    assert [job.estimators for job in plan.missing_jobs(store)] == [("e",)]
    assert [job.estimators for job in plan.missing_jobs(store, retry=True)] == [("b", "c", "d", "e")]


def test_a_job_records_the_resources_of_recording_and_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dronevio.eval.benchmark.jobs.call_in_process", call_here)
    job = Job(RecordingSpec("s", "w", 4, "hash", None), ("vio",), SmallPipeline(), tmp_path, timeout_s=60.0)
    [row] = job.run()
    usage = ResourceUsage.read(tmp_path / "hash" / USAGE_FILE)
    assert (usage.cpu_s, usage.wall_s, usage.disk_mb) == pytest.approx((2.0, 1.0, 1.5e-3))
    assert (row.identity, row.status, row["ate_m"], row["wall_s"], row["peak_mb"]) == (
        ("s", 4, "vio"),
        "ok",
        0.1,
        1.0,
        3.0,
    )


@pytest.mark.parametrize("keep", [True, False])
def test_a_recording_is_removed_unless_it_is_to_be_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, keep: bool
) -> None:
    monkeypatch.setattr("dronevio.eval.benchmark.jobs.call_in_process", call_here)
    job = Job(RecordingSpec("s", "w", 0, "hash", None), ("a", "b"), SmallPipeline(), tmp_path, 60.0, keep)
    assert [row.estimator for row in job.run()] == ["a", "b"]
    assert (tmp_path / "hash").exists() == keep


def test_a_flight_uses_the_images_of_one_with_another_imu(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The recording of the other flight is made first, also where its own job has not begun."""
    monkeypatch.setattr("dronevio.eval.benchmark.jobs.call_in_process", call_here)
    first = RecordingSpec("s", "w", 0, "first", None)
    spec = RecordingSpec("s+imu-100hz", "w", 0, "second", None, images_of=first)
    assert [row.status for row in Job(spec, ("vio",), SmallPipeline(), tmp_path, 60.0).run()] == ["ok"]
    assert (tmp_path / "second" / "images").read_text(encoding="utf-8") == "first"
    assert not (tmp_path / "first" / "images").exists()


def test_images_are_rendered_again_if_recordings_are_not_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dronevio.eval.benchmark.jobs.call_in_process", call_here)
    spec = RecordingSpec("s+imu-100hz", "w", 0, "second", None, images_of=RecordingSpec("s", "w", 0, "first", None))
    job = Job(spec, ("vio",), SmallPipeline(), tmp_path, 60.0, keep_recording=False)
    with job.recording() as folder:
        assert not (folder / "images").exists()
    assert not (tmp_path / "first").exists()
