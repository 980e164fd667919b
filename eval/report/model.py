"""The results that the report of a run shows, and their form in ``report.json``.

``report.json`` holds the following keys; values are in SI units unless the name gives another unit, and ``null`` where
they are not known:

    format         "dronevio-report/1"
    title, command, open_command, seed          as in `RunInfo`
    flight         name, duration_s, frames, path_m, peak_speed_m_s, peak_angular_rate_deg_s
    scores         the fields of `Scores`, with statistics as {rmse, mean, median, max, min, std, n}; null without truth
    timing         cpu_ms_mean, cpu_ms_p99, wall_ms_mean, wall_ms_p99 per frame, real_time_factor
    control        flown_on, reference_rmse_m, reference_max_m, collision; null for recordings
    policy         environment, success, duration_s, distance_m, end; null unless a policy flies
    estimator      poses, first_pose_s (after the first frame), mean_tracks, keyframes, health: {state: frames},
                   innovations: {median_px, p95_px, median_nis, p95_nis}, warnings: [{t_s, text}]
    map            keyframes, points, loops, rejected_loops; adjustment: what determined the scale of the bundle
                   adjustment, or why its result is not used, null without one; online, final: the fields of `Scores`
                   of the poses in the map frame as corrected at their frames, and by the map after the flight; null
                   without a map
    defects        of the recording: {kind: {count, first}}; empty without defects
    configuration, versions, machine            as in `RunInfo`
"""

from collections import Counter
from dataclasses import asdict, dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from dronevio.eval.map_results import MapResults
from dronevio.eval.metrics import IDENTITY, ScoredTrajectory
from dronevio.eval.provenance import RunInfo
from dronevio.eval.run import EstimatorRun
from dronevio.models.defects import defect_values
from dronevio.models.policies.outcome import PolicyOutcome
from dronevio.models.protocols import Recording
from dronevio.models.state import Trajectory

Array = npt.NDArray[np.float64]

FORMAT = "dronevio-report/1"


@dataclass(frozen=True)
class ControlResult:
    """State that a simulated vehicle was flown on, and how well it followed its reference trajectory."""

    flown_on: Literal["truth", "estimate"]
    """State that the controller received."""
    reference_rmse_m: float | None
    """Root mean square of the true distances of the centre of mass from the reference [m]; None if it did not fly, or
    if a policy flew, which has no reference."""
    reference_max_m: float | None
    """Largest distance [m]."""
    collision: str | None
    """Description of the collision that ended the flight; None without a collision."""


@dataclass(frozen=True, eq=False)
class RunResults:
    """Everything that the report of a run shows."""

    info: RunInfo
    """Provenance of the run."""
    recording: Recording
    """The measurements of the run."""
    run: EstimatorRun
    """The estimates of all frames and their costs."""
    scored: ScoredTrajectory | None
    """The estimated trajectory with its errors; None without ground truth."""
    outline: Array
    """(L, 2, 3) Line segments of the surroundings in the world frame of the ground truth [m]."""
    control: ControlResult | None = None
    """Control of a simulated flight; None for recordings."""
    policy: PolicyOutcome | None = None
    """Outcome of the flight of a policy; None for other flights."""
    map: MapResults | None = None
    """The map with the corrected trajectories; None for an estimator without a map."""

    @property
    def estimate(self) -> Trajectory:
        """The estimated trajectory, in the world frame of the ground truth if that is known."""
        return (IDENTITY if self.scored is None else self.scored.alignment).apply(self.run.trajectory)

    @property
    def corrected(self) -> Trajectory | None:
        """The trajectory corrected by the final map, in the same frame; None without a map."""
        return None if self.map is None else self.map.final_alignment.apply(self.map.final)

    @property
    def origin_ns(self) -> int:
        """Time stamp of the first frame [ns], which is zero on all time axes."""
        return int(self.recording.frame_times_ns[0])


def report_values(results: RunResults) -> dict[str, object]:
    """Return the content of ``report.json``."""
    info = results.info
    return {
        "format": FORMAT,
        "title": info.title,
        "command": info.command,
        "open_command": info.open_command,
        "seed": info.seed,
        "flight": _flight_values(results),
        "scores": None if results.scored is None else asdict(results.scored.scores),
        "timing": _timing_values(results.run),
        "control": None if results.control is None else asdict(results.control),
        "policy": None if results.policy is None else asdict(results.policy),
        "estimator": _estimator_values(results),
        "map": None if results.map is None else results.map.values,
        "defects": defect_values(results.run.defects),
        "configuration": info.configuration,
        "versions": info.versions,
        "machine": info.machine,
    }


def _flight_values(results: RunResults) -> dict[str, object]:
    recording = results.recording
    trajectory = recording.ground_truth or results.estimate
    velocity = np.zeros((0, 3)) if trajectory.velocity_m_s is None else trajectory.velocity_m_s
    speed, angular_rate = (np.linalg.norm(v, axis=1) for v in (velocity, recording.imu.gyro_rad_s))
    return {
        "name": recording.name,
        "duration_s": float(np.ptp(recording.frame_times_ns)) * 1e-9,
        "frames": len(recording.frame_times_ns),
        "path_m": trajectory.length_m,
        "peak_speed_m_s": float(speed.max()) if len(speed) else None,
        "peak_angular_rate_deg_s": float(np.degrees(angular_rate.max())) if len(angular_rate) else None,
    }


def _timing_values(run: EstimatorRun) -> dict[str, object]:
    if not len(run.estimates):
        return dict.fromkeys(("cpu_ms_mean", "cpu_ms_p99", "wall_ms_mean", "wall_ms_p99", "real_time_factor"))
    return {
        "cpu_ms_mean": float(run.cpu_ms.mean()),
        "cpu_ms_p99": float(np.percentile(run.cpu_ms, 99)),
        "wall_ms_mean": float(run.wall_ms.mean()),
        "wall_ms_p99": float(np.percentile(run.wall_ms, 99)),
        "real_time_factor": run.real_time_factor,
    }


def _estimator_values(results: RunResults) -> dict[str, object]:
    run = results.run
    poses_ns = run.trajectory.t_ns
    return {
        "poses": len(poses_ns),
        "first_pose_s": float(poses_ns[0] - results.origin_ns) * 1e-9 if len(poses_ns) else None,
        "mean_tracks": float(run.n_tracks.mean()) if len(run.estimates) else None,
        "keyframes": sum("keyframe" in estimate.events for estimate in run.estimates),
        "health": dict(Counter(str(estimate.health) for estimate in run.estimates)),
        "innovations": None if run.innovations is None else asdict(run.innovations),
        "warnings": [{"t_s": (t_ns - results.origin_ns) * 1e-9, "text": text} for t_ns, text in run.warnings],
    }
