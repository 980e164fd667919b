"""The map of visual SLAM as arrays: keyframes before and after the correction, loops, and points."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError
from dronevio.models.imu import Times
from dronevio.models.map_correction import MapCorrection
from dronevio.models.rotation import inverse_pose
from dronevio.models.summary import Summarized, duration_text, size_text

Flags = npt.NDArray[np.bool_]
Rows = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False, repr=False)
class SlamMap(Summarized):
    """A map of K keyframes that are connected by an odometry and by L loops, with M points.

    Where the odometry was lost, another track with another odometry frame begins. Only keyframes of tracks that are
    joined with the map are contained.
    """

    t_ns: Times
    """(K,) Times of the keyframes, strictly increasing [ns]."""
    Ts_map_imu: Array
    """(K, 4, 4) Poses of the IMU at the keyframes in the map frame, after the optimization."""
    Ts_odom_imu: Array
    """(K, 4, 4) Poses of the IMU at the keyframes in the odometry frame, before it. Of a final map with loops, they are
    those of the causal path."""
    loops: Rows
    """(L, 2) Rows of the earlier and of the later keyframe of each loop."""
    Ts_then_now: Array
    """(L, 4, 4) Poses of the IMU at the later keyframes in the IMU frames of the earlier ones, as measured."""
    rejected: Flags
    """(L,) Whether a loop contradicts the others, so that the poses do not depend on it."""
    points: Array
    """(M, 3) Positions of the landmarks in the map frame [m]."""
    track: Rows
    """(K,) Number of the track of each keyframe, not decreasing."""
    starts_ns: Times
    """(T,) Times at which the tracks begin, the first of them before all keyframes, strictly increasing [ns]."""
    adjustment: str = ""
    """What has determined the scale of the bundle adjustment of a final map, or why the adjusted map is not used; empty
    without one, as without loops."""

    def __post_init__(self) -> None:
        """Check the shapes, the times and the rows.

        Raises:
            ConfigError: The shapes do not match, times or tracks do not increase, or a loop has a row without a
                keyframe.
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
            "track": (keyframes,),
            "starts_ns": (len(self.starts_ns),),
        }
        for name, shape in expected.items():
            if (found := getattr(self, name).shape) != shape:
                raise ConfigError(f"map whose {name} has shape {found}; expected {shape}")
        if keyframes > 1 and not np.all(np.diff(self.t_ns) > 0):
            raise ConfigError("map whose time stamps do not increase")
        if np.any(np.diff(self.track) < 0) or np.any(np.diff(self.starts_ns) <= 0):
            raise ConfigError("map whose tracks do not increase")
        unknown = self.track[(self.track < 0) | (self.track >= len(self.starts_ns))]
        if len(unknown):
            raise ConfigError(f"keyframe of track {unknown[0]}; expected one of the {len(self.starts_ns)} tracks")
        unknown = self.loops[(self.loops < 0) | (self.loops >= keyframes)]
        if len(unknown):
            raise ConfigError(f"loop with keyframe {unknown[0]}; expected one of the {keyframes} keyframes")

    def _summary(self) -> list[tuple[str, str]]:
        rows = [
            ("keyframes", f"{len(self.t_ns)}"),
            ("duration", duration_text(self.t_ns)),
            ("loops", f"{len(self.closed)}"),
            ("rejected loops", f"{int(self.rejected.sum())}"),
            ("points", f"{len(self.points)}"),
            ("size in x, y, z of the keyframes", size_text(self.Ts_map_imu[:, :3, 3])),
            ("tracks", f"{len(self.starts_ns)}"),
        ]
        return [*rows, ("bundle adjustment", self.adjustment)] if self.adjustment else rows

    @property
    def closed(self) -> Rows:
        """(C, 2) Rows of the keyframes of the loops that are not rejected."""
        return self.loops[~self.rejected]

    @property
    def correction(self) -> MapCorrection:
        """The correction of the odometry by the map."""
        return MapCorrection(self.t_ns, self.Ts_map_imu @ inverse_pose(self.Ts_odom_imu), self.track, self.starts_ns)
