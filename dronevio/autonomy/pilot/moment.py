"""What a pilot knows when it makes a plan."""

from dataclasses import dataclass

import numpy as np

from dronevio.autonomy.planning.body import Body
from dronevio.models.arrays import Array
from dronevio.models.occupancy import OccupancyGrid
from dronevio.models.rotation import inverse_pose, yaw_rad_from_matrix
from dronevio.models.state import Estimate

_REST = np.array([1e-3, 1e-2])  # speed and acceleration at rest [m/s, m/s²]


@dataclass(frozen=True, eq=False)
class Moment:
    """What is known when a plan is made, in the odometry frame unless another is named."""

    now_ns: int
    """Time of the plan on the clock of the course [ns]."""
    begins_ns: int
    """Time from which it will be flown [ns]."""
    start: Array
    """(4, 3) State at that time, as decided so far [m, s]."""
    yaw_rad: float
    """Heading at that time in the world [rad]."""
    yaw_rate_rad_s: float
    """Its rate [rad/s]."""
    body: Body
    """The body with the margin for the error of the estimate relative to the local map."""
    grid: OccupancyGrid | None
    """The local map."""
    T_world_odom: Array
    """(4, 4) Pose of the odometry frame in the world."""
    T_map_odom: Array
    """(4, 4) Its pose in the map frame."""
    estimate: Estimate
    """The newest estimate."""

    @property
    def position_m(self) -> Array:
        """(3,) Position at the start [m]."""
        return np.asarray(self.start[0])

    @property
    def position_map_m(self) -> Array:
        """(3,) The same in the map frame [m]."""
        return moved(self.T_map_odom, self.start[0])

    @property
    def speed_m_s(self) -> float:
        """Speed at the start [m/s]."""
        return float(np.linalg.norm(self.start[1]))

    @property
    def is_at_rest(self) -> bool:
        """Whether the vehicle stands still at the start, so that another motion can begin from rest without a step."""
        return bool(np.all(np.linalg.norm(self.start[1:3], axis=1) < _REST))

    def from_world(self, points: Array) -> Array:
        """Return points (…, 3) of the world in the odometry frame."""
        return moved(inverse_pose(self.T_world_odom), points)

    def from_map(self, points: Array) -> Array:
        """Return points (…, 3) of the map in the odometry frame."""
        return moved(inverse_pose(self.T_map_odom), points)

    def to_map(self, points: Array) -> Array:
        """Return points (…, 3) of the odometry frame in the map."""
        return moved(self.T_map_odom, points)

    def yaw_in_map_rad(self) -> float:
        """Return the heading at the start in the map frame [rad]."""
        T_map_world = self.T_map_odom @ inverse_pose(self.T_world_odom)
        return self.yaw_rad + float(yaw_rad_from_matrix(T_map_world[:3, :3]))


def moved(T_a_b: Array, points: Array) -> Array:
    """Return points (…, 3) of frame b in frame a."""
    return np.asarray(points @ T_a_b[:3, :3].T + T_a_b[:3, 3])
