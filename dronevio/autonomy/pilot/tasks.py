"""Tasks of a flight, which tell where it leads: to a goal, or to see all that can be reached."""

from dataclasses import dataclass
from math import pi, radians
from typing import Literal, Protocol

import numpy as np

from dronevio.autonomy.pilot.map_columns import Area
from dronevio.autonomy.pilot.moment import Moment
from dronevio.autonomy.pilot.viewpoints import Viewpoints, frontier_views, viewpoints
from dronevio.models.arrays import Array
from dronevio.models.occupancy import OccupancyGrid
from dronevio.models.rotation import inverse_pose

Strategy = Literal["gain", "nearest"]
"""How the next view is chosen: by the volume that it is expected to show for its time, or as the nearest frontier."""

_ANOTHER = 1.3  # by which another view must be better than the present one
_SAME_M, _SAME_RAD = 0.6, radians(30.0)  # between two views that show the same
_KEPT_M = 1.0  # around the present target, where its gain is looked up


@dataclass(frozen=True, eq=False)
class Target:
    """Where a flight leads next."""

    position_map_m: Array
    """(3,) Position in the map frame [m]."""
    yaw_map_rad: float | None = None
    """Heading there in the map frame [rad]; None if it does not matter."""


class Task(Protocol):
    """Tells where a flight leads."""

    @property
    def has_others(self) -> bool:
        """Whether there are other targets than the present one."""

    def target(self, m: Moment, known: OccupancyGrid, heights_m: Array) -> Target | None:
        """Return the target by what is known, with the band of heights of routes (2,) [m]; None if none is left."""

    def leave(self) -> None:
        """Leave the present target, which was reached or cannot be."""


@dataclass(frozen=True, eq=False)
class ReachGoal:
    """Fly to a goal; implements `Task`."""

    goal_m: Array
    """(3,) The goal in the world [m]."""

    @property
    def has_others(self) -> bool:
        """No."""
        return False

    def target(self, m: Moment, known: OccupancyGrid, heights_m: Array) -> Target:
        """Return the goal: the map frame is the odometry frame of the start."""
        return Target(m.from_world(self.goal_m))

    def leave(self) -> None:
        """Do nothing."""


class Cover:
    """See all space of an area that can be reached; implements `Task`.

    The best view is the one with the largest expected volume for its time. It is kept until another one is better by
    `_ANOTHER`, so that the flight does not waver.
    """

    def __init__(self, corners_m: Array, strategy: Strategy = "gain") -> None:
        """Begin without a view.

        Args:
            corners_m: (2, 3) Lower and upper corner of what is to be seen, in the world [m].
            strategy: How the next view is chosen.
        """
        self._corners_m, self._strategy = corners_m, strategy
        self._present: Target | None = None
        self._seen = np.zeros((0, 4))  # positions and headings of views that were taken or cannot be reached

    @property
    def has_others(self) -> bool:
        """Yes."""
        return True

    def target(self, m: Moment, known: OccupancyGrid, heights_m: Array) -> Target | None:
        """Return the next view."""
        find = viewpoints if self._strategy == "gain" else frontier_views
        area = Area(self._corners_m, m.T_world_odom @ inverse_pose(m.T_map_odom))
        views = find(known, m.position_map_m, m.yaw_in_map_rad(), m.body, heights_m, area)
        value = views.gain_m3 / views.cost_s if self._strategy == "gain" else 1.0 / (views.way_m + 0.1)
        value = np.where(self._is_seen(views), 0.0, value)
        if not np.any(value > 0.0):
            self._present = None
            return None
        best = int(np.argmax(value))
        if self._present is not None:
            apart = np.linalg.norm(views.positions_m - self._present.position_map_m, axis=1)
            kept = np.where(apart < _KEPT_M, value, 0.0)
            if kept.max() * _ANOTHER > value[best]:
                best = int(np.argmax(kept))
        self._present = Target(views.positions_m[best], float(views.yaw_rad[best]))
        return self._present

    def leave(self) -> None:
        """Take the present view as seen: it was taken, or it cannot be reached."""
        if self._present is not None and self._present.yaw_map_rad is not None:
            self._seen = np.vstack([self._seen, [*self._present.position_map_m, self._present.yaw_map_rad]])
        self._present = None

    def _is_seen(self, views: Viewpoints) -> Array:
        """Return whether views (N,) show what others have shown."""
        apart = np.linalg.norm(views.positions_m[:, None] - self._seen[None, :, :3], axis=2)
        turned = np.abs(np.mod(views.yaw_rad[:, None] - self._seen[None, :, 3] + pi, 2.0 * pi) - pi)
        return np.asarray(np.any((apart < _SAME_M) & (turned < _SAME_RAD), axis=1))
