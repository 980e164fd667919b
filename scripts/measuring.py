"""What the scripts that measure the odometry share: one run, all its figures, a store of runs, and Markdown tables.

Each run is a process of its own, so that one that dies costs only itself, and a row that says so. A row is kept under a
hash of all that it depends on (recording, code, libraries): who asks again gets it again, until one of them changes.
"""

import hashlib
import json
import math
import sys
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import suppress
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

import dronevio
from dronevio.estimation import estimate_recording
from dronevio.eval.benchmark.cache import code_hash, recording_hash
from dronevio.eval.benchmark.isolation import isolated
from dronevio.eval.metrics.association import interpolate
from dronevio.eval.metrics.consistency import anchor_first
from dronevio.eval.metrics.errors import relative_errors, translation_errors_m
from dronevio.eval.metrics.scores import score_trajectory
from dronevio.eval.provenance import machine_here, versions_here
from dronevio.eval.runs import POSE_IS_VALID, EstimatorRun
from dronevio.models.errors import EvaluationError
from dronevio.models.progress import Progress, silent
from dronevio.models.recordings.tum import write_tum
from dronevio.models.state import Estimate, Health, Trajectory

Array = npt.NDArray[np.float64]
Mode = Literal["mono", "stereo"]
"""How many of a recording's cameras are used."""

CAMERAS: dict[Mode, int] = {"mono": 1, "stereo": 2}
ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "LP_NUM_THREADS"), "1")
WORST = math.inf
"""What a failed run's errors count as."""
HOLDS_S = 0.5
"""So long an estimator must go on tracking before it counts as recovered [s]."""
FIGURES_VERSION = 1
"""Whoever changes what a figure means counts on, so that rows of before are done again."""
_PACKAGES = ("python", "gtsam", "opencv-python-headless", "numpy")
_HOUSE = Path(dronevio.__file__).parent
_CODE = tuple(_HOUSE / name for name in ("estimator", "models", "eval/metrics", "estimation.py"))


@dataclass(frozen=True)
class Figures:
    """One run in figures. Of a failed one, errors are infinite, and what is not known is None."""

    flight: str
    """What was estimated."""
    mode: str
    """By whom: mono or stereo."""
    status: str = "ok"
    """How the run ended: ok, failed, timeout or crashed."""
    reason: str = ""
    """Why it is not ok, or what is wrong with it all the same."""
    frames: int = 0
    """Frames of the recording."""
    duration_s: float = 0.0
    """From the first frame to the last [s]."""
    path_m: float = math.nan
    """Length of the true path, frame by frame over the whole recording [m]."""
    ate_m: float = WORST
    """Absolute error of position, yaw and position aligned, root mean square [m]."""
    max_m: float = WORST
    """The largest of these errors [m]."""
    ate_deg: float = WORST
    """Absolute error of orientation, root mean square [°]."""
    rpe_m: float = WORST
    """Relative error of position over one second, root mean square [m]."""
    rpe_deg: float = WORST
    """Relative error of orientation over one second, root mean square [°]."""
    end_m: float = WORST
    """Error of the last position, where the first poses meet [m]."""
    scale_error_percent: float | None = None
    """By how much the estimated path is too large [%]."""
    coverage_percent: float = 0.0
    """Share of the frames later than 3 s after the first that have a pose [%]."""
    first_s: float = WORST
    """From the first frame to the first pose [s]."""
    nees_position: float = WORST
    """Squared error of position in units of its covariance, mean over time, gauge fixed at the first pose."""
    nees_orientation: float = WORST
    """The same of orientation."""
    nees_position_over_time: tuple[float, ...] = ()
    """NEES of position at each second since the first pose."""
    nees_orientation_over_time: tuple[float, ...] = ()
    """NEES of orientation at each second since the first pose."""
    cpu_ms_mean: float | None = None
    """Processor time a frame, of all threads [ms]."""
    cpu_ms_p99: float | None = None
    """Its 99th percentile [ms]."""
    cpu_ms_max: float | None = None
    """The most that one frame cost [ms]."""
    health: dict[str, float] = field(default_factory=dict)
    """Share of the frames in each state of health [%]."""
    longest_gap_s: float = WORST
    """Longest time between two poses [s]."""
    step_error_m: float = WORST
    """Largest difference between an estimated step from one frame to the next and the true step [m]."""
    step_jump_m: float = WORST
    """Largest difference between an estimated step and the one that the estimated velocities explain [m]."""
    step_jump_s: float | None = None
    """When that was, from the first frame [s]."""
    window_drift_m: float | None = None
    """Largest error of position since the beginning of the time to look at closely [m]; None where there is none."""
    recovery_s: float | None = None
    """From its end until the estimator says for half a second that it is tracking [s]."""
    not_finite: int = 0
    """Estimates in which a number is not finite."""
    peak_mb: float | None = None
    """The most memory that the process held [MB]."""

    @property
    def ate_percent(self) -> float:
        """Absolute error as a share of the path [%]."""
        return 100.0 * self.ate_m / self.path_m if math.isfinite(self.ate_m) else WORST

    @property
    def failed(self) -> bool:
        """Whether it did not end well: no score, frames without poses, or an error above 1 % of the path."""
        return self.status != "ok" or self.coverage_percent < 99.0 or self.ate_percent > 1.0


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
    from dronevio.estimator.rig_tracker import RigTracker
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


def figures_of(
    flight: str, mode: str, run: EstimatorRun, truth: Trajectory, frame_times_ns: npt.NDArray[np.int64]
) -> Figures:
    """Return the figures of a run."""
    at_frames, _ = interpolate(truth, frame_times_ns)
    bare = Figures(
        flight,
        mode,
        frames=len(frame_times_ns),
        duration_s=float(np.ptp(frame_times_ns)) * 1e-9,
        path_m=at_frames.length_m,
        cpu_ms_mean=float(run.cpu_ms.mean()),
        cpu_ms_p99=float(np.percentile(run.cpu_ms, 99.0)),
        cpu_ms_max=float(run.cpu_ms.max()),
        health=health_shares(run.estimates),
        not_finite=sum(not is_finite(estimate) for estimate in run.estimates),
    )
    if bare.not_finite:
        return replace(bare, status="failed", reason=f"{bare.not_finite} estimates are not finite")
    estimate, reason = run.trajectory, ""
    try:
        scored = score_trajectory(truth, estimate, frame_times_ns)
    except EvaluationError as error:
        reason, estimate = str(error), replace(estimate, covariance=None)
        try:
            scored = score_trajectory(truth, estimate, frame_times_ns)
        except EvaluationError:
            return replace(bare, status="failed", reason=reason)
    s = scored.scores
    assert s.rpe_m is not None and s.rpe_deg is not None
    step_error_m, step_jump_m, when_s = steps(scored.truth, estimate, int(frame_times_ns[0]))
    found = replace(
        bare,
        reason=reason,
        ate_m=s.ate_m.rmse,
        max_m=s.ate_m.max,
        ate_deg=s.ate_deg.rmse,
        rpe_m=s.rpe_m.rmse,
        rpe_deg=s.rpe_deg.rmse,
        scale_error_percent=s.scale_error_percent,
        coverage_percent=s.coverage_percent or 0.0,
        first_s=WORST if s.initialised_s is None else s.initialised_s,
        longest_gap_s=s.longest_gap_s,
        step_error_m=step_error_m,
        step_jump_m=step_jump_m,
        step_jump_s=when_s,
    )
    if scored.consistency is None:
        return found
    c = scored.consistency
    each = [int(np.argmin(np.abs(c.t_ns - (c.t_ns[0] + t * 10**9)))) for t in range(1, int(np.ptp(c.t_ns) * 1e-9) + 1)]
    return replace(
        found,
        end_m=float(np.linalg.norm(c.position_error_m[-1])),
        nees_position=float(c.position_nees.mean()),
        nees_orientation=float(c.orientation_nees.mean()),
        nees_position_over_time=tuple(np.round(c.position_nees[each], 4).tolist()),
        nees_orientation_over_time=tuple(np.round(c.orientation_nees[each], 4).tolist()),
    )


def health_shares(estimates: Sequence[Estimate]) -> dict[str, float]:
    """Return the share of the frames in each state of health [%]."""
    counts = {health.value: sum(e.health == health for e in estimates) for health in Health}
    return {name: 100.0 * count / max(len(estimates), 1) for name, count in counts.items()}


def is_finite(estimate: Estimate) -> bool:
    """Say whether all numbers of an estimate are finite."""
    state = estimate.state
    if state is None:
        return True
    optional = (state.covariance, state.angular_velocity_rad_s)
    given = (state.T_world_imu, state.velocity_m_s, state.gyro_bias_rad_s, state.accel_bias_m_s2, *optional)
    return all(bool(np.isfinite(values).all()) for values in given if values is not None)


def steps(truth: Trajectory, estimate: Trajectory, start_ns: int) -> tuple[float, float, float | None]:
    """Return how far the largest step of an estimate is off, the largest that velocity does not explain, and when.

    A step leads from one pose to the next. It is compared with the true one, both seen from where they begin, and with
    the mean of the estimated velocities at its ends, times its duration: an estimate that is put elsewhere, a teleport,
    stands out in both.

    Args:
        truth: N true poses at the estimate's instants.
        estimate: N estimated poses with velocities.
        start_ns: From when times are counted [ns].
    """
    estimate = estimate[np.isin(estimate.t_ns, truth.t_ns)]
    if len(estimate) < 2 or estimate.velocity_m_s is None:
        return WORST, WORST, None
    rows = np.arange(len(estimate))
    metres, _ = relative_errors(
        truth.p_world_imu, truth.quat_wxyz, estimate.p_world_imu, estimate.quat_wxyz, (rows[:-1], rows[1:])
    )
    v, dt_s = estimate.velocity_m_s, np.diff(estimate.t_ns)[:, None] * 1e-9
    explained = 0.5 * (v[:-1] + v[1:]) * dt_s
    jumps_m = translation_errors_m(np.diff(estimate.p_world_imu, axis=0), explained)
    worst = int(jumps_m.argmax())
    return float(metres.max()), float(jumps_m[worst]), float(estimate.t_ns[worst + 1] - start_ns) * 1e-9


def window_drift_m(run: EstimatorRun, truth: Trajectory, window_s: tuple[float, float]) -> float:
    """Return the largest error of position since the beginning of a time, where the poses meet [m].

    The first pose after the end counts as well: where the estimator is when it sees again. Infinite without poses.
    """
    estimate = run.trajectory
    t_s = (estimate.t_ns - run.t_ns[0]) * 1e-9
    last = int(np.searchsorted(t_s, window_s[1]))
    rows = (
        np.flatnonzero((t_s >= window_s[0]) & (t_s <= t_s[min(last, len(t_s) - 1)])) if len(t_s) else np.zeros(0, int)
    )
    if len(rows) < 2:
        return WORST
    estimate = estimate[rows]
    true, found = interpolate(truth, estimate.t_ns)
    estimate = estimate[found]
    moved = anchor_first(true, estimate).positions(estimate.p_world_imu)
    return float(translation_errors_m(true.p_world_imu, moved).max())


def recovery_s(run: EstimatorRun, end_s: float) -> float:
    """Return how long after a time the estimator begins to track for at least half a second [s]; infinite if never."""
    t_s = (run.t_ns - run.t_ns[0]) * 1e-9
    tracking = np.array([estimate.health == Health.TRACKING for estimate in run.estimates])
    bad_s = np.append(t_s[~tracking], math.inf)  # nothing is known beyond the end
    following = bad_s[np.searchsorted(bad_s, t_s)]
    good = np.flatnonzero((t_s >= end_s - 1e-6) & tracking & (following - t_s >= HOLDS_S))
    return float(t_s[good[0]] - end_s) if len(good) else WORST


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


def failures(rows: Iterable[Figures]) -> str:
    """Return a list of the runs that failed, and why; empty if none did."""
    lines = [f"- {row.flight} {row.mode}: {row.status}, {row.reason}" for row in rows if row.status != "ok"]
    return "\n".join(["", "Failed runs, which count as ∞:", *lines]) if lines else ""
