"""Changes of the correction at the keyframes of the map, as small messages from the map to its odometry.

Both sides keep the same `MapCorrection`. Each answer of the map has the new keyframes and those that have moved since
they were last reported; between loops, that is one keyframe.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from dronevio.estimator.slam.map.keyframe import MapKeyframe
from dronevio.models.arrays import Array
from dronevio.models.map_correction import MapCorrection
from dronevio.models.rotation import inverse_pose

Times = npt.NDArray[np.int64]

REPORTED_M, REPORTED_RAD = 1e-3, 2e-4
"""Movement of a keyframe in the map from which on it is reported again: distance [m], angle [rad]."""


@dataclass(frozen=True, eq=False)
class CorrectionChanges:
    """New, moved and culled keyframes of the map."""

    t_ns: Times
    """(C,) Time stamps of the new and the moved keyframes, strictly increasing [ns]."""
    Ts_map_odom: Array
    """(C, 4, 4) Poses of the odometry frame in the map frame at them."""
    track: Times
    """(C,) Numbers of their tracks."""
    removed_ns: Times
    """(R,) Time stamps of the keyframes that are no longer in the graph of the map [ns]."""

    def applied(self, known: MapCorrection) -> MapCorrection:
        """Return a correction with these changes; the same one if there are none."""
        if not len(self.t_ns) and not len(self.removed_ns):
            return known
        assert known.track is not None
        stays = ~np.isin(known.t_ns, np.concatenate([self.t_ns, self.removed_ns]))
        t_ns = np.concatenate([known.t_ns[stays], self.t_ns])
        order = np.argsort(t_ns)
        Ts = np.concatenate([known.Ts_map_odom[stays], self.Ts_map_odom])[order]
        track = np.concatenate([known.track[stays], self.track])[order]
        return replace(known, t_ns=t_ns[order], Ts_map_odom=Ts, track=track)


_NONE = np.zeros(0, np.int64)
NO_CHANGES = CorrectionChanges(_NONE, np.zeros((0, 4, 4)), _NONE, _NONE)
"""The changes by an answer without a new keyframe."""


def changes_since(
    known: MapCorrection, stamps_ns: Times, keyframes: Sequence[MapKeyframe], Ts_map_imu: Array
) -> CorrectionChanges:
    """Return what has changed since a correction was reported.

    Args:
        known: The correction as it was reported.
        stamps_ns: (K,) Time stamps of the keyframes of the map, strictly increasing [ns].
        keyframes: The K keyframes.
        Ts_map_imu: (K, 4, 4) Their poses in the map frame.
    """
    Ts_odom_imu = np.stack([keyframe.T_odom_imu for keyframe in keyframes]) if keyframes else np.zeros((0, 4, 4))
    is_known, row = np.isin(stamps_ns, known.t_ns), np.searchsorted(known.t_ns, stamps_ns)
    before = known.Ts_map_odom[row[is_known]] @ Ts_odom_imu[is_known]
    now, changed = Ts_map_imu[is_known], ~is_known
    moved_m = np.linalg.norm(now[:, :3, 3] - before[:, :3, 3], axis=1)
    # The Frobenius norm of the difference of two rotations by a small angle is √2 times the angle.
    turned_rad = np.linalg.norm(now[:, :3, :3] - before[:, :3, :3], axis=(1, 2)) / np.sqrt(2.0)
    changed[is_known] = (moved_m > REPORTED_M) | (turned_rad > REPORTED_RAD)
    track = np.array([keyframe.track for keyframe in keyframes], np.int64)
    Ts_map_odom = Ts_map_imu[changed] @ inverse_pose(Ts_odom_imu[changed])
    removed_ns = known.t_ns[~np.isin(known.t_ns, stamps_ns)]
    return CorrectionChanges(stamps_ns[changed], Ts_map_odom, track[changed], removed_ns)
