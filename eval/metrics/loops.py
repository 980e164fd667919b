"""How well an estimator recognizes places again, and its errors after the first revisit of a flight.

Whether a flight revisits places is a property of its true motion, so that the frames whose errors count are the same
for all estimators.
"""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dronevio.eval.metrics.revisits import Views, revisit_recall, right_loops, true_relative_poses
from dronevio.eval.metrics.scores import ScoredTrajectory
from dronevio.models.rig import RigCamera
from dronevio.models.rotation import inverse_pose
from dronevio.models.slam_map import SlamMap

AFTER_S = 2.0
"""Time after the first revisit from which on frames count [s]."""


@dataclass(frozen=True, eq=False)
class FlightRevisits:
    """The revisits of a simulated flight, and the true views of the keyframes of an estimator."""

    first_ns: int | None
    """True time of the first frame that revisits a place, among frames at regular intervals [ns]; None without
    revisits."""
    keyframes: Views
    """The true views of K keyframes of a map; of none without a map."""
    revisiting: npt.NDArray[np.bool_]
    """(K,) Whether each keyframe revisits an earlier keyframe."""


@dataclass(frozen=True)
class LoopQuality:
    """How well an estimator recognizes places in one flight."""

    loops: int
    """Number of loops that the map accepts."""
    wrong: int
    """Number of them whose relative pose is wrong."""
    recall: float
    """Share of the revisiting keyframes with a right loop within 1 s; NaN without revisits."""


def loop_quality(slam_map: SlamMap, revisits: FlightRevisits, camera: RigCamera) -> LoopQuality:
    """Return the quality of the accepted loops of a map.

    Args:
        slam_map: The map.
        revisits: The revisits of the flight, with the true views of the keyframes of the map.
        camera: The camera of the views with its mounting.
    """
    closed, views = ~slam_map.rejected, revisits.keyframes
    then, now = slam_map.loops[closed].T
    claimed = inverse_pose(camera.T_imu_cam) @ slam_map.Ts_then_now[closed] @ camera.T_imu_cam
    right = right_loops(claimed, true_relative_poses(views, now, then), views.median_depth_m[now])
    recall = revisit_recall(views.t_ns, revisits.revisiting, views.t_ns[now[right]])
    return LoopQuality(len(now), int(np.sum(~right)), recall)


def rmse_after_revisit_m(scored: ScoredTrajectory, first_ns: int | None) -> float | None:
    """Return the RMSE of the position over the frames later than `AFTER_S` after the first revisit [m].

    Args:
        scored: A trajectory with its errors.
        first_ns: Time of the first revisit [ns]; None without revisits: all frames count.

    Returns:
        The RMSE; None if there is no such frame.
    """
    errors_m = scored.translation_error_m
    if first_ns is not None:
        errors_m = errors_m[scored.truth.t_ns > first_ns + round(AFTER_S * 1e9)]
    return math.sqrt(float(np.mean(errors_m**2))) if len(errors_m) else None
