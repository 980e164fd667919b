"""What the scripts that measure the odometry share: runs, done each on its own, and a store of them.

Each run is a process of its own, so that one that dies costs only itself, and a row that says so. A row is kept under a
hash of all that it depends on (recording, code, libraries): who asks again gets it again, until one of them changes.
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
from figures import Figures, figures_of, recovery_s, window_drift_m

import dronevio
from dronevio.driver import estimate_recording
from dronevio.eval.benchmark.cache import code_hash, recording_hash
from dronevio.eval.benchmark.isolation import isolated
from dronevio.eval.provenance import machine_here, versions_here
from dronevio.eval.run import POSE_IS_VALID, EstimatorRun
from dronevio.models.errors import EvaluationError
from dronevio.models.progress import Progress, silent
from dronevio.models.recordings.tum import write_tum

Mode = Literal["mono", "stereo"]
"""How many of a recording's cameras are used."""

CAMERAS: dict[Mode, int] = {"mono": 1, "stereo": 2}
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "LP_NUM_THREADS"), "1")
FIGURES_VERSION = 1
"""Whoever changes what a figure means counts on, so that rows of before are done again."""
_PACKAGES = ("python", "gtsam", "opencv-python-headless", "numpy")
_HOUSE = Path(dronevio.__file__).parent
_CODE = tuple(_HOUSE / name for name in ("estimator", "models", "eval/metrics", "driver.py"))


@dataclass(frozen=True)
class Task:
    """One run to be done."""

    flight: str
    """What to call it."""
    recording: Path
    """Where it lies."""
    mode: Mode
    """Which of its cameras to use."""
    front_end: str = ""
    """Spoils the front end: a name of `spoiling.FRONT_ENDS`; empty for the estimator's own."""
    window_s: tuple[float, float] | None = None
    """A time to look at closely, from the first frame on: that of a fault, or of a hover [s]."""

    def key(self, digest: str) -> str:
        """Return the name under which it is kept, given the hash of what estimates."""
        parts = f"{digest} {recording_hash(self.recording)} {self.mode} {self.front_end} {self.window_s}"
        return f"{self.flight}-{self.mode}-{hashlib.sha256(parts.encode()).hexdigest()[:16]}"


def estimator_hash() -> str:
    """Return the hash of all that an estimate depends on besides the recording."""
    installed = versions_here()
    packages = " ".join(f"{name} {installed.get(name)}" for name in _PACKAGES)
    return hashlib.sha256(f"{packages} {code_hash(*_CODE)} {FIGURES_VERSION}".encode()).hexdigest()[:16]


def run_task(task: Task, trace: Path | None, progress: Progress = silent) -> dict[str, Any]:
    """Estimate a recording's motion, and return the `Figures` as plain data."""
    from spoiling import FRONT_ENDS

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
    spoilt = FRONT_ENDS[task.front_end](front_end) if task.front_end else front_end
    estimator = VisualInertialOdometry(recording.rig, config, spoilt)
    run = estimate_recording(recording, estimator, progress)
    if trace is not None:
        write_trace(trace, run)
    truth, frames = recording.ground_truth, recording.frame_times_ns
    found = figures_of(task.flight, task.mode, run, truth, frames)
    if task.window_s is not None:
        found = replace(found, window_drift_m=window_drift_m(run, truth, task.window_s))
        found = replace(found, recovery_s=recovery_s(run, task.window_s[1]))
    return asdict(found)


def write_trace(path: Path, run: EstimatorRun) -> None:
    """Write what came of each frame, for whoever looks into a run: PATH.tum with the poses, PATH.npz with the rest."""
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


def done(tasks: Sequence[Task], results: Path | None, workers: int, timeout_s: float = 1800.0) -> Iterator[Figures]:
    """Do the runs that have not been done, and yield the figures of all as they come.

    Args:
        tasks: What to run.
        results: Folder in which rows and traces are kept; None to keep nothing.
        workers: How many runs at a time.
        timeout_s: How long one may take [s].
    """
    digest = estimator_hash()

    def carry_out(task: Task) -> Figures:
        place = None if results is None else results / task.key(digest)
        row = None if place is None else place.with_name(place.name + ".json")
        if row is not None and row.exists():
            return Figures(**read_row(row))
        outcome = isolated(
            run_task,
            task,
            place,
            timeout_s=timeout_s,
            environment={**ONE_THREAD, "PYTHONPATH": f"{Path(__file__).parent}:{_HOUSE.parent}"},
        )
        known = outcome.value or {"flight": task.flight, "mode": task.mode}
        if outcome.status != "ok":
            known |= {"status": outcome.status, "reason": outcome.reason}
        figures = Figures(**{**known, "peak_mb": outcome.peak_mb})
        if row is not None and estimator_hash() == digest:  # else somebody has changed the code meanwhile
            row.parent.mkdir(parents=True, exist_ok=True)
            row.write_text(json.dumps(asdict(figures)) + "\n", encoding="utf-8")
        return figures

    with ThreadPoolExecutor(max_workers=workers) as pool:
        waiting = [pool.submit(carry_out, task) for task in tasks]
        for number, future in enumerate(as_completed(waiting), start=1):
            figures = future.result()
            error = f"{1e3 * figures.ate_m:.1f} mm" if figures.status == "ok" else f"{figures.status}: {figures.reason}"
            print(f"{number}/{len(tasks)} {figures.flight} {figures.mode}: {error}", file=sys.stderr, flush=True)
            yield figures


def read_row(path: Path) -> dict[str, Any]:
    """Read the row of a run."""
    known = {each.name for each in fields(Figures)}
    values = json.loads(path.read_text(encoding="utf-8"))
    lists = {name: tuple(value) for name, value in values.items() if isinstance(value, list)}
    return {name: value for name, value in {**values, **lists}.items() if name in known}


def provenance() -> str:
    """Return which machine, packages and code the numbers are from."""
    machine, versions = machine_here(), versions_here()
    packages = ", ".join(f"{name} {versions[name]}" for name in _PACKAGES if name in versions)
    return (
        f"{machine['processor']}, {machine['cores']} cores, {machine['system']}; {packages}; code {estimator_hash()}."
    )


def write_json(path: Path | None, rows: Sequence[Figures]) -> None:
    """Write all rows as one document, where that is wanted."""
    if path is None:
        return
    document = {"provenance": provenance(), "runs": [_plain(asdict(row)) for row in rows]}
    with suppress(FileExistsError):
        path.parent.mkdir(parents=True)
    path.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


def _plain(values: dict[str, Any]) -> dict[str, Any]:
    """Return values as JSON has them: no infinity."""
    return {k: str(v) if isinstance(v, float) and not math.isfinite(v) else v for k, v in values.items()}
