"""The correction of the odometry by the map, and the covariance of the corrected pose."""

from dataclasses import dataclass

import numpy as np

from dronevio.estimator.backend.keyframe_estimate import KeyframeEstimate
from dronevio.estimator.slam.correction_changes import NO_CHANGES, CorrectionChanges
from dronevio.estimator.slam.map.odometry_factors import OdometryNode, RelativePose, odometry_factors, propagated
from dronevio.models.arrays import Array
from dronevio.models.state import NavState


@dataclass(frozen=True, eq=False)
class Correction:
    """Correction of the odometry by the map."""

    T_map_odom: Array | None
    """(4, 4) Pose of the odometry frame in the map frame at the anchor; None where the submap is not joined."""
    anchor: KeyframeEstimate
    """The anchor's estimate by the odometry: the newest keyframe of the map, or one that was located in it."""
    covariance: Array
    """(6, 6) Covariance of the anchor's pose in the map: δθ, then δp, both in the IMU frame."""
    track: int = 0
    """Number of the odometry frame; a correction of an earlier one is no longer valid."""
    is_joined: bool = False
    """Whether this is the first pose of the track in the map."""
    loops: tuple[RelativePose, ...] = ()
    """Loops that were closed since the last correction."""
    loop_times_ns: tuple[tuple[int, int], ...] = ()
    """Times of the earlier and the later keyframe of each of these loops [ns]."""
    tested_loops: int = 0
    """Number of loops of the submap that an optimization has accepted or rejected."""
    events: tuple[str, ...] = ()
    """Outcome of a bundle adjustment, as text for users."""
    changes: CorrectionChanges = NO_CHANGES
    """Keyframes of the map, of all tracks, that are new or have moved since the last correction."""

    def covariance_at(self, state: NavState) -> Array | None:
        """Return the covariance (6, 6) of a later pose of the same track in the map frame.

        It is the anchor's covariance in the map, transported to the later pose, and what the odometry has added since.

        Args:
            state: The state in the odometry frame.

        Returns:
            The covariance of δθ (right perturbation, IMU frame) and δp (map frame); None if there is no pose in the
            map or the state has no covariance.
        """
        if self.T_map_odom is None or state.covariance is None:
            return None
        anchor = OdometryNode(0, 0, self.anchor, self.anchor.covariance)
        _, factors = odometry_factors(anchor, 1, KeyframeEstimate.of_state(state))
        S = np.eye(6)
        S[3:, 3:] = self.T_map_odom[:3, :3] @ state.T_world_imu[:3, :3]
        return np.asarray(S @ propagated(self.covariance, factors.relative, factors.gravity) @ S.T)
