"""The route to a target in the map: sought anew once a second, and when the local map has an obstacle on it."""

from collections.abc import Callable

import numpy as np
from scipy.spatial import KDTree

from dronevio.autonomy.pilot.moment import Moment
from dronevio.autonomy.planning.body import Body
from dronevio.autonomy.planning.goal_path import path_to_goal
from dronevio.autonomy.planning.known_space import around
from dronevio.autonomy.planning.local_plan import sampled
from dronevio.autonomy.planning.route import NoRoute
from dronevio.models.arrays import Array
from dronevio.models.occupancy import OCCUPIED, UNKNOWN, OccupancyGrid

_RETRIES = 2  # of what was given up, before a target is unreachable
_SEEN_AHEAD = 10  # points of a path around which unknown space is given up


class MapRoute:
    """Holds the route to a target, and the unknown space that was given up since it cannot be seen."""

    def __init__(self, interval_ns: int, say: Callable[[str], None]) -> None:
        """Begin without a route.

        Args:
            interval_ns: Time between two routes [ns].
            say: Receives what is decided.
        """
        self._interval_ns, self._say = interval_ns, say
        self._waypoints: Array | None = None
        self._due_ns = 0
        self._given_up, self._retries = np.zeros((0, 3)), _RETRIES

    def path(
        self, m: Moment, known: Callable[[], OccupancyGrid | None], target: Array, heights_m: Array
    ) -> Array | None:
        """Return the path (N, 3) to a target in the odometry frame; None if it is unreachable.

        Args:
            m: What is known.
            known: Returns the map.
            target: (3,) Target in the map frame [m].
            heights_m: (2,) Least and greatest height of the path in the map frame [m].
        """
        assert m.grid is not None
        path = self.placed(m)
        is_due = m.now_ns >= self._due_ns
        if path is None or is_due or np.any(m.grid.at(sampled(path, path[0])) == OCCUPIED):
            self._waypoints, self._due_ns = self._sought(m, known(), target, heights_m), m.now_ns + self._interval_ns
            path = self.placed(m)
        return path

    def placed(self, m: Moment) -> Array | None:
        """Return the route (N, 3) in the odometry frame, None without one."""
        return None if self._waypoints is None else m.from_map(self._waypoints)

    def is_due(self, now_ns: int) -> bool:
        """Return whether the next path is sought anew at a time [ns]."""
        return self._waypoints is None or now_ns >= self._due_ns

    def drop(self) -> None:
        """Drop the route, for another target."""
        self._waypoints = None

    def give_up(self, m: Moment, body: Body, ahead: Array) -> bool:
        """Take what is unknown around the next points of a path (N, 3) as occupied, since it cannot be seen from here.

        Returns:
            Whether there was something unknown that had not been given up.
        """
        assert m.grid is not None
        points = around(ahead[:_SEEN_AHEAD], body, m.grid.cell_m)
        cells = np.unique(m.grid.cells(points[m.grid.at(points) == UNKNOWN]), axis=0)
        unseen = m.to_map(m.grid.centres(cells))
        if len(self._given_up) and len(unseen):
            apart_m, _ = KDTree(self._given_up).query(unseen)
            unseen = unseen[apart_m > 0.5 * m.grid.cell_m]
        if not len(unseen):
            return False
        self._say(f"give up {len(unseen)} cells of the route, which cannot be seen")
        self._given_up = np.concatenate([self._given_up, unseen])
        self._due_ns = m.now_ns
        return True

    def _sought(self, m: Moment, known: OccupancyGrid | None, target: Array, heights_m: Array) -> Array | None:
        """Return a path in the map to a target (3,), through all that was not seen to be occupied; None without one."""
        if known is None:
            return None
        start, heights = m.position_map_m, (float(heights_m[0]), float(heights_m[1]))
        found = path_to_goal(known, start, target, m.body, heights, self._given_up)
        if isinstance(found, NoRoute) and found.cause == "goal" and len(self._given_up) and self._retries:
            self._say("no route: try again what was given up")
            self._given_up, self._retries = self._given_up[:0], self._retries - 1
            found = path_to_goal(known, start, target, m.body, heights, self._given_up)
        if isinstance(found, NoRoute):
            self._say(f"no route: {found.reason}")
            return None
        return found.waypoints
