"""Goals of flights through unknown worlds, drawn from the truth, and the shortest paths to them."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy import ndimage

from dronevio.autonomy.planning.body import Body, horizontal_distance
from dronevio.autonomy.planning.route import NoRoute, route
from dronevio.autonomy.true_map import true_map
from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError
from dronevio.models.occupancy import FREE, DistanceField, OccupancyGrid
from dronevio.sim.paths.space import Space
from dronevio.sim.streams import generator
from dronevio.sim.world import flight_area, resolved_world, solid_space
from dronevio.sim.worlds.own.names import shown_world

HOVER_M = 1.2
"""Height above the landing pad at which a flight begins and the sight of the goal is blocked [m]."""
PATH_HEIGHTS_M = (0.5, 2.0)
"""Heights above the floor between which shortest paths are [m]."""
GOAL_HEIGHTS_M = (0.8, 1.6)
"""Heights above the floor between which goals are [m]."""
GOAL_CLEARANCE_M = 0.6
"""Least distance of a goal from solids [m]."""
LENGTHS_M = (4.0, 40.0)
"""Least and greatest length of the shortest path to a goal [m]."""
OPEN_WORLDS = frozenset({"room"})
"""Worlds whose furniture leaves all their middle in sight: their goals are in sight, too."""
OPEN_LENGTHS_M = (3.0, 40.0)
"""Least and greatest length of the shortest path to a goal in one of the open worlds [m]."""

_DRAWS = 300
_SIGHT_STEP_M = 0.01
_BODY = Body()


def drawn_goal(world: str, world_seed: int, seed: int, body: Body = _BODY) -> Array:
    """Return a goal behind obstacles.

    It is drawn from the cells of the true map whose heights are in `GOAL_HEIGHTS_M` and which the body reaches from
    above the landing pad. The first is taken that is at least `GOAL_CLEARANCE_M` from all solids, towards which a solid
    blocks the straight line from above the pad, and whose shortest path has a length in `LENGTHS_M`. In `OPEN_WORLDS`
    the line may be free, and the lengths are `OPEN_LENGTHS_M`.

    Args:
        world: Name of the world.
        world_seed: Seed of the world.
        seed: Seed of the goal.
        body: What flies there; the default one does not pass doors of 0.9 m.

    Returns:
        The goal (3,) in the frame of the world [m].

    Raises:
        ConfigError: The world is unknown, or none of 300 draws is such a goal.
    """
    world = resolved_world(world)
    start, space = flight_area(world, world_seed).pad + [0.0, 0.0, HOVER_M], solid_space(world, world_seed)
    room = _true_room(world, world_seed, body)
    is_open = world in OPEN_WORLDS
    least_m, greatest_m = OPEN_LENGTHS_M if is_open else LENGTHS_M
    places = room.reached(start)
    heights = places[:, 2] - room.grid.low_m[2]
    places = places[(heights >= GOAL_HEIGHTS_M[0]) & (heights <= GOAL_HEIGHTS_M[1])]
    for number in generator(seed, "goal").permutation(len(places))[:_DRAWS]:
        goal = places[number]
        if space.clearance(goal) < GOAL_CLEARANCE_M or not (is_open or _hidden(space, start, goal)):
            continue
        if least_m <= room.shortest_m(start, goal) <= greatest_m:
            return np.asarray(goal)
    raise ConfigError(
        f"world {shown_world(world)} of seed {world_seed} has no goal behind obstacles: none of"
        f" {min(_DRAWS, len(places))} places that the drone reaches is out of sight, {GOAL_CLEARANCE_M:g} m from all"
        f" solids and {least_m:g} to {greatest_m:g} m away"
    )


def shortest_m(grid: OccupancyGrid, start: Array, goal: Array, body: Body = _BODY) -> float:
    """Return the length of the shortest path of a body on a true map.

    It is that of a `route`, which may exceed the optimum. For 40 goals of a world, the median of its ratio to a lower
    bound was 1.00 (room) to 1.08 (warehouse), the maximum 1.12, and 1.33 in the hall, where cells of 0.1 m close a gap
    little wider than the body. On cells of 0.05 m, paths are 1 % shorter, and 20 % past that gap. The bound is the
    shortest path with steps to 98 neighbours through cells in which the true body may fit, divided by the largest
    excess of such steps over straight lines, 1.05.

    Args:
        grid: True map, whose lower corner is on the floor.
        start: (3,) First point [m].
        goal: (3,) Last point [m].
        body: What flies; its centre remains within `PATH_HEIGHTS_M`.

    Returns:
        The length [m], inf without a path. A start or goal where the body does not fit is replaced by the nearest place
        within 1 m that it reaches, and the straight line to it is counted.

    Raises:
        ConfigError: A point is not finite.
    """
    return _Room.of(grid, body).shortest_m(start, goal)


def reachable_places(world: str, world_seed: int, start: Array, body: Body = _BODY) -> Array:
    """Return the centres (N, 3) of the cells of the true map that a body reaches from a point (3,) of the world [m]."""
    return _true_room(resolved_world(world), world_seed, body).reached(start)


@dataclass(frozen=True, eq=False)
class _Room:
    """Where the centre of a body may be in a true map."""

    grid: OccupancyGrid
    """The map from the floor to above the heights of paths."""
    distance: DistanceField
    """Horizontal distances, 0 outside the heights of paths."""
    body: Body
    """What flies."""

    @classmethod
    def of(cls, grid: OccupancyGrid, body: Body) -> "_Room":
        """Return the room for a body in a map."""
        above = PATH_HEIGHTS_M[1] + max(body.radius_m, body.half_height_m) + grid.cell_m  # routes avoid the border
        low = OccupancyGrid(grid.low_m, grid.cell_m, grid.states[..., : int(above / grid.cell_m) + 1], grid.frame)
        distance = horizontal_distance(low.states != FREE, low.cell_m, body.half_height_m)
        heights = low.cell_m * (np.arange(distance.shape[2]) + 0.5)
        distance[..., (heights < PATH_HEIGHTS_M[0]) | (heights > PATH_HEIGHTS_M[1])] = 0.0
        return cls(low, DistanceField(low.low_m, low.cell_m, distance, low.frame), body)

    def shortest_m(self, start: Array, goal: Array) -> float:
        """Return the length of the shortest path [m], inf without one."""
        found = route(self.grid, self.distance, start, goal, clearance_m=self.body.radius_m)
        return np.inf if isinstance(found, NoRoute) else found.length_m + found.short_of_goal_m

    def reached(self, start: Array) -> Array:
        """Return the centres (N, 3) of the cells that the body reaches from a point (3,) where it fits [m]."""
        parts, _ = ndimage.label(self.distance.distance_m >= self.body.radius_m, np.ones((3, 3, 3), np.bool_))
        part = parts[tuple(self.grid.cells(start))]
        return self.grid.centres(np.argwhere((parts == part) & (part > 0)))


@lru_cache(maxsize=4)
def _true_room(world: str, seed: int, body: Body) -> _Room:
    """Return the room for a body in the true map of a world."""
    return _Room.of(true_map(solid_space(world, seed)), body)


def _hidden(space: Space, start: Array, goal: Array) -> bool:
    """Return whether a solid is on the straight line between two points (3,), sampled every centimetre."""
    count = 2 + int(np.linalg.norm(goal - start) / _SIGHT_STEP_M)
    return bool(space.clearance(np.linspace(start, goal, count)).min() < 0.0)
