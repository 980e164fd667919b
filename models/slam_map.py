"""The map of visual SLAM as arrays: keyframes before and after the correction, loops, and points."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dronevio.models.errors import ConfigError
from dronevio.models.imu import Times
from dronevio.models.map_correction import MapCorrection
from dronevio.models.rotation import inverse_pose

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]
Rows = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class SlamMap:
    """A map of K keyframes that are connected by an odometry and by L loops, with M points."""

    t_ns: Times
    """(K,) Times of the keyframes, strictly increasing [ns]."""
    Ts_map_imu: Array
    """(K, 4, 4) Poses of the IMU at the keyframes in the map frame, after the optimization."""
    Ts_odom_imu: Array
    """(K, 4, 4) Poses of the IMU at the keyframes in the odometry frame, before it."""
    loops: Rows
    """(L, 2) Rows of the earlier and of the later keyframe of each loop."""
    Ts_then_now: Array
    """(L, 4, 4) Poses of the IMU at the later keyframes in the IMU frames of the earlier ones, as measured."""
    rejected: Flags
    """(L,) Whether a loop contradicts the others, so that the poses do not depend on it."""
    points: Array
    """(M, 3) Positions of the landmarks in the map frame [m]."""

    def __post_init__(self) -> None:
        """Check the shapes, the times and the rows.

        Raises:
            ConfigError: The shapes do not match, the times do not increase, or a loop has a row that is no keyframe.
        """
        keyframes, loops, points = len(self.t_ns), len(self.loops), len(self.points)
        expected = {
            "t_ns": (keyframes,),
            "Ts_map_imu": (keyframes, 4, 4),
            "Ts_odom_imu": (keyframes, 4, 4),
            "loops": (loops, 2),
            "Ts_then_now": (loops, 4, 4),
            "rejected": (loops,),
            "points": (points, 3),
        }
        for name, shape in expected.items():
            if (found := getattr(self, name).shape) != shape:
                raise ConfigError(f"map whose {name} has shape {found}; expected {shape}")
        if keyframes > 1 and not np.all(np.diff(self.t_ns) > 0):
            raise ConfigError("map whose time stamps do not increase")
        unknown = self.loops[(self.loops < 0) | (self.loops >= keyframes)]
        if len(unknown):
            raise ConfigError(f"loop with keyframe {unknown[0]}; expected one of the {keyframes} keyframes")

    @property
    def closed(self) -> Rows:
        """(C, 2) Rows of the keyframes of the loops that are not rejected."""
        return self.loops[~self.rejected]

    @property
    def correction(self) -> MapCorrection:
        """The correction of the odometry by the map."""
        return MapCorrection(self.t_ns, self.Ts_map_imu @ inverse_pose(self.Ts_odom_imu))
