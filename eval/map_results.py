"""The results of an estimator with a map: the map, and the trajectories that it corrects, scored apart."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dronevio.eval.metrics import IDENTITY, Alignment, ScoredTrajectory, Scores, score_trajectory
from dronevio.eval.run import EstimatorRun
from dronevio.models.arrays import Array
from dronevio.models.imu import Times
from dronevio.models.protocols import Recording
from dronevio.models.rotation import yaw_rad_from_matrix
from dronevio.models.slam_map import SlamMap
from dronevio.models.state import Estimate, Trajectory


@dataclass(frozen=True, eq=False)
class MapResults:
    """The map of a run, and the odometry as it corrects it."""

    map: SlamMap
    """The map after the flight."""
    online: Trajectory
    """Poses in the map frame as they were corrected at their frames, causally."""
    final: Trajectory
    """Poses of the odometry corrected by the final map, which uses the whole recording."""
    scored_online: ScoredTrajectory | None = None
    """The former with their errors; None without ground truth."""
    scored_final: ScoredTrajectory | None = None
    """The latter with their errors; None without ground truth."""

    @property
    def online_alignment(self) -> Alignment:
        """Alignment of the online poses with the ground truth; identity without it."""
        return IDENTITY if self.scored_online is None else self.scored_online.alignment

    @property
    def final_alignment(self) -> Alignment:
        """Alignment of the final poses and of the map with the ground truth; identity without it."""
        return IDENTITY if self.scored_final is None else self.scored_final.alignment

    @property
    def summary(self) -> "MapSummary":
        """Size of the map and the scores of both trajectories."""
        rejected = int(self.map.rejected.sum())
        return MapSummary(
            keyframes=len(self.map.t_ns),
            points=len(self.map.points),
            loops=len(self.map.loops) - rejected,
            rejected_loops=rejected,
            adjustment=self.map.adjustment or None,
            online=None if self.scored_online is None else self.scored_online.scores,
            final=None if self.scored_final is None else self.scored_final.scores,
        )


@dataclass(frozen=True)
class MapSummary:
    """Size of a map and the scores of the trajectories that it corrects."""

    keyframes: int
    """Number of keyframes of the map."""
    points: int
    """Number of points of the map."""
    loops: int
    """Number of accepted loops."""
    rejected_loops: int
    """Number of loops that contradict the others."""
    adjustment: str | None
    """What determined the scale of the bundle adjustment, or why its result is not used; None without one."""
    online: Scores | None
    """Scores of the poses as corrected at their frames; None without ground truth."""
    final: Scores | None
    """Scores of the poses as corrected by the final map; None without ground truth."""


def map_results(run: EstimatorRun, recording: Recording) -> MapResults | None:
    """Return the results of the map of a run; None if it has none.

    Args:
        run: The run.
        recording: Its recording, whose ground truth is used if there is one.

    Raises:
        EvaluationError: The poses and the ground truth do not overlap in time.
    """
    if run.map is None or not len(run.map_trajectory):
        return None
    online, final = run.map_trajectory, run.final_trajectory
    truth, frame_times_ns = recording.ground_truth, recording.frame_times_ns
    if truth is None:
        return MapResults(run.map, online, final)
    scored_online, scored_final = (score_trajectory(truth, path, frame_times_ns) for path in (online, final))
    return MapResults(run.map, online, final, scored_online, scored_final)


@dataclass(frozen=True, eq=False)
class OnlineCorrection:
    """How the map corrects the odometry over time."""

    t_ns: Times
    """(N,) Time stamps of the frames [ns]."""
    position_m: Array
    """(N, 3) Position of the odometry frame in the map frame [m]."""
    yaw_deg: Array
    """(N,) Yaw of the odometry frame in the map frame [°]."""
    loops: npt.NDArray[np.int64]
    """(N,) Number of loops that have been closed."""


def online_correction(estimates: Sequence[Estimate], closed_before: int = 0) -> OnlineCorrection:
    """Return how the map corrects the odometry, at the frames where it does.

    Args:
        estimates: Successive estimates.
        closed_before: Number of loops that were closed before the first of them.
    """
    known = [(e.t_ns, e.T_map_odom) for e in estimates if e.T_map_odom is not None]
    t_ns = np.array([t for t, _ in known], dtype=np.int64)
    Ts = np.array([T for _, T in known]).reshape(-1, 4, 4)
    closed_ns = np.array([e.t_ns for e in estimates for _ in e.closed_loops_ns], dtype=np.int64)
    yaw_deg = np.degrees(yaw_rad_from_matrix(Ts[:, :3, :3]))
    return OnlineCorrection(t_ns, Ts[:, :3, 3], yaw_deg, closed_before + np.searchsorted(closed_ns, t_ns, "right"))
