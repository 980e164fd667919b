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
from typing import Literal, Self

import numpy as np

from dronevio.eval.map_results import MapResults, MapSummary
from dronevio.eval.metrics import IDENTITY, ScoredTrajectory, Scores
from dronevio.eval.provenance import RunInfo
from dronevio.eval.run import EstimatorRun, Innovations
from dronevio.models.arrays import Array
from dronevio.models.defects import defect_values
from dronevio.models.policies.outcome import PolicyOutcome
from dronevio.models.protocols import Recording
from dronevio.models.state import Trajectory

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


@dataclass(frozen=True)
class FlightSummary:
    """What a flight is like."""

    name: str
    """Name of the recording."""
    duration_s: float
    """Time from the first frame to the last [s]."""
    frames: int
    """Number of frames."""
    path_m: float
    """Length of the true path, or of the estimated one without ground truth [m]."""
    peak_speed_m_s: float | None
    """Largest speed on this path [m/s]; None if it is not known."""
    peak_angular_rate_deg_s: float | None
    """Largest angular rate of the gyroscope's samples [°/s]; None without samples."""

    @classmethod
    def of(cls, results: RunResults) -> Self:
        """Return the summary of the flight of a run."""
        recording = results.recording
        trajectory = recording.ground_truth or results.estimate
        velocity = np.zeros((0, 3)) if trajectory.velocity_m_s is None else trajectory.velocity_m_s
        speed, angular_rate = (np.linalg.norm(v, axis=1) for v in (velocity, recording.imu.gyro_rad_s))
        return cls(
            name=recording.name,
            duration_s=float(np.ptp(recording.frame_times_ns)) * 1e-9,
            frames=len(recording.frame_times_ns),
            path_m=trajectory.length_m,
            peak_speed_m_s=float(speed.max()) if len(speed) else None,
            peak_angular_rate_deg_s=float(np.degrees(angular_rate.max())) if len(angular_rate) else None,
        )


@dataclass(frozen=True)
class Timing:
    """Time per frame of a run; None without frames."""

    cpu_ms_mean: float | None = None
    """Mean processor time per frame [ms]."""
    cpu_ms_p99: float | None = None
    """99th percentile of the processor time per frame [ms]."""
    wall_ms_mean: float | None = None
    """Mean elapsed time per frame [ms]."""
    wall_ms_p99: float | None = None
    """99th percentile of the elapsed time per frame [ms]."""
    real_time_factor: float | None = None
    """Seconds of flight per second of processor time."""

    @classmethod
    def of(cls, run: EstimatorRun) -> Self:
        """Return the times of a run."""
        if not len(run.estimates):
            return cls()
        return cls(
            float(run.cpu_ms.mean()),
            float(np.percentile(run.cpu_ms, 99)),
            float(run.wall_ms.mean()),
            float(np.percentile(run.wall_ms, 99)),
            run.real_time_factor,
        )


@dataclass(frozen=True)
class RunWarning:
    """An event that tells of wrong measurements or a wrong calibration."""

    t_s: float
    """Time after the first frame [s]."""
    text: str
    """The event in words."""


@dataclass(frozen=True)
class EstimatorSummary:
    """What an estimator reported during a run."""

    poses: int
    """Number of frames with a valid pose."""
    first_pose_s: float | None
    """Time of the first one after the first frame [s]; None without poses."""
    mean_tracks: float | None
    """Mean number of tracked features; None without frames."""
    keyframes: int
    """Number of keyframes."""
    health: dict[str, int]
    """Number of frames of each state."""
    innovations: Innovations | None
    """Agreement of images and predictions; None if it is not known."""
    warnings: tuple[RunWarning, ...]
    """The events that tell of wrong measurements or a wrong calibration."""

    @classmethod
    def of(cls, results: RunResults) -> Self:
        """Return the summary of a run."""
        run, origin_ns = results.run, results.origin_ns
        poses_ns = run.trajectory.t_ns
        return cls(
            poses=len(poses_ns),
            first_pose_s=float(poses_ns[0] - origin_ns) * 1e-9 if len(poses_ns) else None,
            mean_tracks=float(run.n_tracks.mean()) if len(run.estimates) else None,
            keyframes=sum("keyframe" in estimate.events for estimate in run.estimates),
            health=dict(Counter(str(estimate.health) for estimate in run.estimates)),
            innovations=run.innovations,
            warnings=tuple(RunWarning((t_ns - origin_ns) * 1e-9, text) for t_ns, text in run.warnings),
        )


@dataclass(frozen=True)
class RunReport:
    """The figures of a run: the content of ``report.json``."""

    info: RunInfo
    """Provenance of the run."""
    flight: FlightSummary
    """What the flight is like."""
    scores: Scores | None
    """Scores of the estimate; None without ground truth."""
    timing: Timing
    """Time per frame."""
    control: ControlResult | None
    """Control of a simulated flight; None for recordings."""
    policy: PolicyOutcome | None
    """Outcome of the flight of a policy; None for other flights."""
    estimator: EstimatorSummary
    """What the estimator reported."""
    map: MapSummary | None
    """The map and the scores of the corrected trajectories; None without a map."""
    defects: dict[str, object]
    """Number and first occurrence of each kind of defect of the recording."""

    @classmethod
    def of(cls, results: RunResults) -> Self:
        """Return the figures of a run."""
        return cls(
            info=results.info,
            flight=FlightSummary.of(results),
            scores=None if results.scored is None else results.scored.scores,
            timing=Timing.of(results.run),
            control=results.control,
            policy=results.policy,
            estimator=EstimatorSummary.of(results),
            map=None if results.map is None else results.map.summary,
            defects=defect_values(results.run.defects),
        )

    @property
    def values(self) -> dict[str, object]:
        """The content of ``report.json``."""
        sections = asdict(self)
        info = sections.pop("info")
        origin = {name: info.pop(name) for name in ("configuration", "versions", "machine")}
        return {"format": FORMAT, **info, **sections, **origin}
