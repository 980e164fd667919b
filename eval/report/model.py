"""What the report of a run is about, and its numbers.

``report.json`` holds, all in SI units unless the name says otherwise, ``null`` where something is not known:

    format         "dronevio-report/1"
    title, command, open_command, seed          as in `RunInfo`
    flight         name, duration_s, frames, path_m, peak_speed_m_s, peak_turn_rate_deg_s
    scores         the fields of `Scores`, statistics as {rmse, mean, median, max}; null without truth
    timing         cpu_ms_mean, cpu_ms_p99, wall_ms_mean, wall_ms_p99 (a frame), real_time_factor
    estimator      poses, first_pose_s (after the first frame), mean_tracks, keyframes, health: {state: frames}
    configuration, versions, machine            as in `RunInfo`
"""

from collections import Counter
from dataclasses import asdict, dataclass

import numpy as np
import numpy.typing as npt

from dronevio.eval.metrics import IDENTITY, ScoredTrajectory
from dronevio.eval.provenance import RunInfo
from dronevio.eval.run import EstimatorRun
from dronevio.models.protocols import Recording
from dronevio.models.state import Trajectory

Array = npt.NDArray[np.float64]

FORMAT = "dronevio-report/1"


@dataclass(frozen=True, eq=False)
class Subject:
    """All that a report is about."""

    info: RunInfo
    """Where the run comes from."""
    recording: Recording
    """What was measured."""
    run: EstimatorRun
    """What the estimator made of it."""
    scored: ScoredTrajectory | None
    """Its trajectory beside the truth; None where there is no truth."""
    outline: Array
    """(L, 2, 3) Line segments of the surroundings [m], in the truth's world."""

    @property
    def estimate(self) -> Trajectory:
        """The estimated path, in the truth's world where that is known."""
        return (IDENTITY if self.scored is None else self.scored.alignment).apply(self.run.trajectory)

    @property
    def origin_ns(self) -> int:
        """Time stamp of the first frame [ns]: zero on every time axis."""
        return int(self.recording.frame_times_ns[0])


def report_numbers(subject: Subject) -> dict[str, object]:
    """Return what ``report.json`` holds."""
    info = subject.info
    return {
        "format": FORMAT,
        "title": info.title,
        "command": info.command,
        "open_command": info.open_command,
        "seed": info.seed,
        "flight": _flight(subject),
        "scores": None if subject.scored is None else asdict(subject.scored.scores),
        "timing": _timing(subject.run),
        "estimator": _estimator(subject),
        "configuration": info.configuration,
        "versions": info.versions,
        "machine": info.machine,
    }


def _flight(subject: Subject) -> dict[str, object]:
    recording = subject.recording
    flown = recording.ground_truth or subject.estimate
    speed = np.linalg.norm(np.zeros((0, 3)) if flown.velocity_m_s is None else flown.velocity_m_s, axis=1)
    turn_rate = np.linalg.norm(recording.imu.gyro_rad_s, axis=1)
    return {
        "name": recording.name,
        "duration_s": float(np.ptp(recording.frame_times_ns)) * 1e-9,
        "frames": len(recording.frame_times_ns),
        "path_m": flown.length_m,
        "peak_speed_m_s": float(speed.max()) if len(speed) else None,
        "peak_turn_rate_deg_s": float(np.degrees(turn_rate.max())) if len(turn_rate) else None,
    }


def _timing(run: EstimatorRun) -> dict[str, object]:
    if not len(run.estimates):
        return dict.fromkeys(("cpu_ms_mean", "cpu_ms_p99", "wall_ms_mean", "wall_ms_p99", "real_time_factor"))
    return {
        "cpu_ms_mean": float(run.cpu_ms.mean()),
        "cpu_ms_p99": float(np.percentile(run.cpu_ms, 99)),
        "wall_ms_mean": float(run.wall_ms.mean()),
        "wall_ms_p99": float(np.percentile(run.wall_ms, 99)),
        "real_time_factor": run.real_time_factor if np.isfinite(run.real_time_factor) else None,
    }


def _estimator(subject: Subject) -> dict[str, object]:
    run = subject.run
    poses = run.trajectory.t_ns
    return {
        "poses": len(poses),
        "first_pose_s": float(poses[0] - subject.origin_ns) * 1e-9 if len(poses) else None,
        "mean_tracks": float(run.n_tracks.mean()) if len(run.estimates) else None,
        "keyframes": sum("keyframe" in estimate.events for estimate in run.estimates),
        "health": dict(Counter(str(estimate.health) for estimate in run.estimates)),
    }
