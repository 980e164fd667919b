"""Runs of the odometry for the scripts that measure it, and a cache of their metrics.

Each run is a process of its own, so that a crash affects only one row, which states it. The metrics are cached under a
hash of everything on which they depend: recording, code and libraries.
"""

import hashlib
import json
import math
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import suppress
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from run_metrics import RunMetrics, metrics_of, recovery_s, window_drift_m

import dronevio
from dronevio.driver import estimate_recording
from dronevio.eval.benchmark.cache import code_hash, recording_hash
from dronevio.eval.benchmark.isolation import call_in_process
from dronevio.eval.provenance import machine_here, versions_here
from dronevio.eval.run import POSE_IS_VALID, EstimatorRun
from dronevio.models.errors import EvaluationError
from dronevio.models.progress import Progress, silent
from dronevio.models.recordings.tum import write_tum

Mode = Literal["mono", "stereo"]
"""Cameras that the estimator uses: the first, or the first two."""

CAMERAS: dict[Mode, int] = {"mono": 1, "stereo": 2}
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "LP_NUM_THREADS"), "1")
METRICS_VERSION = 1
"""Version of the metrics, which a change of their definition increments, so that cached rows become invalid."""
_PACKAGES = ("python", "gtsam", "opencv-python-headless", "numpy")
_PACKAGE = Path(dronevio.__file__).parent
_CODE = tuple(_PACKAGE / name for name in ("estimator", "models", "eval/metrics", "driver.py"))


@dataclass(frozen=True)
class EstimationTask:
    """One run of the odometry on a recording."""

    flight: str
    """Name of the flight."""
    recording: Path
    """Folder or file of the recording."""
    mode: Mode
    """Cameras of the estimator."""
    front_end: str = ""
    """Name in `corrupted_tracks.CORRUPTED_FRONT_ENDS`; empty for the front end of the estimator."""
    window_s: tuple[float, float] | None = None
    """Time window after the first frame with metrics of its own, such as that of a fault [s]."""

    def key(self, digest: str) -> str:
        """Return the name of the cached result.

        Args:
            digest: Hash of the estimator, see `estimator_hash`.
        """
        parts = f"{digest} {recording_hash(self.recording)} {self.mode} {self.front_end} {self.window_s}"
        return f"{self.flight}-{self.mode}-{hashlib.sha256(parts.encode()).hexdigest()[:16]}"


def estimator_hash() -> str:
    """Return a hash of the code and the packages on which an estimate depends."""
    installed = versions_here()
    packages = " ".join(f"{name} {installed.get(name)}" for name in _PACKAGES)
    return hashlib.sha256(f"{packages} {code_hash(*_CODE)} {METRICS_VERSION}".encode()).hexdigest()[:16]


def run_task(task: EstimationTask, trace: Path | None, progress: Progress = silent) -> dict[str, Any]:
    """Estimate the trajectory of a recording, and return its `RunMetrics` as plain data.

    Args:
        task: The run.
        trace: Path without suffix for the files of `write_trace`; None to write none.
        progress: Called with the number of processed frames.

    Raises:
        EvaluationError: The recording has too few cameras or no ground truth.
    """
    from corrupted_tracks import CORRUPTED_FRONT_ENDS

    from dronevio.estimator.config import VioConfig
    from dronevio.estimator.frontend.rig import RigTracker
    from dronevio.estimator.vio import VisualInertialOdometry
    from dronevio.models.recordings.open import open_recording

    recording = open_recording(task.recording, CAMERAS[task.mode])
    if len(recording.rig.cameras) < CAMERAS[task.mode]:
        raise EvaluationError(f"{task.recording} has one camera; expected two")
    if recording.ground_truth is None:
        raise EvaluationError(f"{task.recording} has no ground truth")
    config = VioConfig()
    front_end = RigTracker(recording.rig, config.tracker)
    used = CORRUPTED_FRONT_ENDS[task.front_end](front_end) if task.front_end else front_end
    estimator = VisualInertialOdometry(recording.rig, config, used)
    run = estimate_recording(recording, estimator, progress)
    if trace is not None:
        write_trace(trace, run)
    truth, frames = recording.ground_truth, recording.frame_times_ns
    metrics = metrics_of(task.flight, task.mode, run, truth, frames)
    if task.window_s is not None:
        drift_m = window_drift_m(run, truth, task.window_s)
        metrics = replace(metrics, window_drift_m=drift_m, recovery_s=recovery_s(run, task.window_s[1]))
    return asdict(metrics)


def write_trace(path: Path, run: EstimatorRun) -> None:
    """Write the results of all frames: the poses as PATH.tum, and states, health and processor times as PATH.npz."""
    path.parent.mkdir(parents=True, exist_ok=True)
    trajectory = run.trajectory
    if len(trajectory):
        write_tum(path.with_name(path.name + ".tum"), trajectory)
    states = {name: getattr(trajectory, name) for name in ("t_ns", "p_world_imu", "quat_wxyz", "velocity_m_s")}
    states |= {name: getattr(trajectory, name) for name in ("gyro_bias_rad_s", "accel_bias_m_s2", "covariance")}
    np.savez_compressed(
        path.with_name(path.name + ".npz"),
        frame_t_ns=run.t_ns,
        cpu_ms=run.cpu_ms,
        n_tracks=run.n_tracks,
        health=np.array([estimate.health.value for estimate in run.estimates]),
        valid=np.array([estimate.health in POSE_IS_VALID for estimate in run.estimates]),
        events=np.array([";".join(estimate.events) for estimate in run.estimates]),
        **{name: values for name, values in states.items() if values is not None},
    )


def run_all(
    tasks: Sequence[EstimationTask], results: Path | None, workers: int, timeout_s: float = 1800.0
) -> Iterator[RunMetrics]:
    """Execute the tasks whose results are not cached, and yield the metrics of all tasks as they finish.

    Args:
        tasks: The runs.
        results: Folder of the cached metrics and traces; None to cache nothing.
        workers: Number of runs at the same time.
        timeout_s: Time limit of one run [s].
    """
    digest = estimator_hash()

    def execute(task: EstimationTask) -> RunMetrics:
        trace = None if results is None else results / task.key(digest)
        row = None if trace is None else trace.with_name(trace.name + ".json")
        if row is not None and row.exists():
            return RunMetrics(**read_row(row))
        outcome = call_in_process(
            run_task,
            task,
            trace,
            timeout_s=timeout_s,
            environment={**ONE_THREAD, "PYTHONPATH": f"{Path(__file__).parent}:{_PACKAGE.parent}"},
        )
        values = outcome.value or {"flight": task.flight, "mode": task.mode}
        if outcome.status != "ok":
            values |= {"status": outcome.status, "reason": outcome.reason}
        metrics = RunMetrics(**{**values, "peak_mb": outcome.peak_mb})
        if row is not None and estimator_hash() == digest:  # the code may have changed during the run
            row.parent.mkdir(parents=True, exist_ok=True)
            row.write_text(json.dumps(asdict(metrics)) + "\n", encoding="utf-8")
        return metrics

    with ThreadPoolExecutor(max_workers=workers) as pool:
        futures = [pool.submit(execute, task) for task in tasks]
        for number, future in enumerate(as_completed(futures), start=1):
            metrics = future.result()
            error = f"{1e3 * metrics.ate_m:.1f} mm" if metrics.status == "ok" else f"{metrics.status}: {metrics.reason}"
            print(f"{number}/{len(tasks)} {metrics.flight} {metrics.mode}: {error}", file=sys.stderr, flush=True)
            yield metrics


def read_row(path: Path) -> dict[str, Any]:
    """Return the fields of `RunMetrics` in a cached row, without fields that no longer exist."""
    names = {each.name for each in fields(RunMetrics)}
    values = json.loads(path.read_text(encoding="utf-8"))
    lists = {name: tuple(value) for name, value in values.items() if isinstance(value, list)}
    return {name: value for name, value in {**values, **lists}.items() if name in names}


def provenance() -> str:
    """Return the machine, the packages and the code on which the metrics depend, as text."""
    machine, versions = machine_here(), versions_here()
    packages = ", ".join(f"{name} {versions[name]}" for name in _PACKAGES if name in versions)
    return (
        f"{machine['processor']}, {machine['cores']} cores, {machine['system']}; {packages}; code {estimator_hash()}."
    )


def write_json(path: Path | None, rows: Sequence[RunMetrics]) -> None:
    """Write all rows to a JSON file; do nothing without a path."""
    if path is None:
        return
    document = {"provenance": provenance(), "runs": [_plain(asdict(row)) for row in rows]}
    with suppress(FileExistsError):
        path.parent.mkdir(parents=True)
    path.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


def _plain(values: dict[str, Any]) -> dict[str, Any]:
    """Return values for JSON, with infinite numbers and NaN as text."""
    return {k: str(v) if isinstance(v, float) and not math.isfinite(v) else v for k, v in values.items()}
