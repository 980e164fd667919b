"""Correction of a trajectory of the odometry by the poses of the keyframes in the map."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array
from dronevio.models.rotation import exp_so3, log_so3, pose_matrix

Times = npt.NDArray[np.int64]

FIRST_NS = -(2**62)
"""Time at which the first track begins, before all others [ns]."""


@dataclass(frozen=True, eq=False)
class MapCorrection:
    """The pose of the odometry frame in the map frame over time, known at the keyframes of the map.

    Where the odometry was lost, another track with another odometry frame begins. Only keyframes of tracks that are
    joined with the map are contained.
    """

    t_ns: Times
    """(K,) Times of the keyframes by the clock of the trajectory, strictly increasing [ns]."""
    Ts_map_odom: Array
    """(K, 4, 4) Poses of the odometry frame in the map frame at the keyframes."""
    track: Times | None = None
    """(K,) Number of the track of each keyframe, not decreasing; None if there is one track."""
    starts_ns: Times | None = None
    """(T,) Times at which the tracks begin, strictly increasing [ns]; None if there is one track."""

    @classmethod
    def empty(cls) -> Self:
        """Return the correction before the first keyframe of the map, in the first track."""
        none = np.zeros(0, np.int64)
        return cls(none, np.zeros((0, 4, 4)), none, np.array([FIRST_NS]))

    def with_track(self, t_ns: int) -> Self:
        """Return the same correction after a loss, with a track without keyframes that begins at a time [ns]."""
        starts_ns = np.array([FIRST_NS]) if self.starts_ns is None else self.starts_ns
        track = np.zeros(len(self.t_ns), np.int64) if self.track is None else self.track
        return replace(self, track=track, starts_ns=np.append(starts_ns, max(t_ns, starts_ns[-1] + 1)))

    def of_track(self, track: int, t_ns: int) -> Array | None:
        """Return the pose (4, 4) of a track's odometry frame in the map frame at a time [ns]; see `at`.

        None if the track is not joined with the map.
        """
        tracks = np.zeros(len(self.t_ns), np.int64) if self.track is None else self.track
        a, b = np.searchsorted(tracks, [track, track + 1]).tolist()
        return None if a == b else _interpolated(self.t_ns[a:b], self.Ts_map_odom[a:b], np.array([t_ns]))[0]

    def at(self, t_ns: Times) -> Array:
        """Return the poses (N, 4, 4) of the odometry frame in the map frame at times (N,) [ns].

        Between keyframes, position and rotation are interpolated; before the first and after the last one of a track,
        the correction is constant. The poses of a track that is not joined with the map are not numbers.
        """
        if self.track is None or self.starts_ns is None:
            return _interpolated(self.t_ns, self.Ts_map_odom, t_ns)
        Ts = np.full((len(t_ns), 4, 4), np.nan)
        track = np.searchsorted(self.starts_ns, t_ns, side="right") - 1
        for number in np.unique(self.track).tolist():
            of_track, known = track == number, self.track == number
            Ts[of_track] = _interpolated(self.t_ns[known], self.Ts_map_odom[known], t_ns[of_track])
        return Ts


def _interpolated(known_ns: Times, Ts: Array, t_ns: Times) -> Array:
    """Return poses (N, 4, 4) at times (N,), interpolated between those (K, 4, 4) at known times (K,)."""
    if len(known_ns) == 1:
        return np.tile(Ts, (len(t_ns), 1, 1))
    after = np.clip(np.searchsorted(known_ns, t_ns), 1, len(known_ns) - 1)
    before = after - 1
    length = (known_ns[after] - known_ns[before]).astype(np.float64)
    ratio = np.clip((t_ns - known_ns[before]) / length, 0.0, 1.0)[:, None]
    T0, T1 = Ts[before], Ts[after]
    turn = log_so3(np.swapaxes(T0[:, :3, :3], 1, 2) @ T1[:, :3, :3])
    R = T0[:, :3, :3] @ exp_so3(ratio * turn)
    return pose_matrix(R, (1.0 - ratio) * T0[:, :3, 3] + ratio * T1[:, :3, 3])
