"""Scene: what changes between the frames of a world, its light and its moving objects."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.imu import Times
from dronevio.models.rotation import quat_wxyz_from_matrix
from dronevio.models.state import Trajectory
from dronevio.sim.cameras.atlas_renderer import MoverPoses
from dronevio.sim.cameras.interpolation import interpolated_poses
from dronevio.sim.world import Mover

_NEAREST_M = 0.3  # smallest distance of the centre of a moving object


@dataclass(frozen=True, eq=False)
class Scene:
    """Light and moving objects of a world during a time span."""

    illumination: float
    """Illumination relative to a well-lit world."""
    movers: dict[str, Trajectory]
    """Trajectories of the moving objects by the name of their body, on the clock of the IMU."""

    @classmethod
    def sampled(cls, illumination: float, movers: Sequence[Mover], t_ns: Times, start_ns: int) -> Self:
        """Return a scene whose moving objects are sampled at the time stamps of the true motion.

        Args:
            illumination: Illumination relative to a well-lit world.
            movers: The moving objects of the world.
            t_ns: (N,) Times of the samples [ns], at least two if there are moving objects.
            start_ns: Start of the flight, from which the objects move [ns].
        """
        return cls(illumination, {mover.body: _sampled(mover, t_ns, start_ns) for mover in movers})

    def movers_at(self, t_ns: int) -> MoverPoses:
        """Return the poses of all moving objects at a time [ns]."""
        return {name: interpolated_poses(path, np.array([t_ns]))[0] for name, path in self.movers.items()}

    def angle_swept_rad(self, from_ns: int, to_ns: int, p_world: Array) -> float:
        """Return the largest motion of any object between two times [ns] as seen from a point (3,) [rad]."""
        ends = [interpolated_poses(path, np.array([from_ns, to_ns]))[:, :3, 3] for path in self.movers.values()]
        ranges_m = (max(float(np.linalg.norm(start - p_world)), _NEAREST_M) for start, _ in ends)
        paths_m = (float(np.linalg.norm(end - start)) for start, end in ends)
        return max((path_m / away_m for path_m, away_m in zip(paths_m, ranges_m, strict=True)), default=0.0)


def _sampled(mover: Mover, t_ns: Times, start_ns: int) -> Trajectory:
    """Return the trajectory of a moving object at the given times."""
    poses = mover.poses(np.asarray((t_ns - start_ns) * 1e-9, dtype=np.float64))
    return Trajectory(t_ns, poses[:, :3, 3].copy(), quat_wxyz_from_matrix(poses[:, :3, :3]))
