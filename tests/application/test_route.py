"""Routes through known-free space: clearance, shortest lengths, places near what cannot be reached, and reasons."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from dronevio.autonomy.planning.lattice_search import shortest_path
from dronevio.autonomy.planning.route import NoRoute, Route, route
from dronevio.estimator.mapping.distance import distance_field
from dronevio.models.errors import ConfigError
from dronevio.models.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid

CELL, CLEARANCE = 0.1, 0.3
LOW = np.array([-1.0, 2.0, 0.5])


def grid_of(shape: tuple[int, int, int] = (60, 40, 20), *boxes: tuple[list[float], list[float], int]) -> OccupancyGrid:
    """Return a free grid with boxes of other states, by their corners relative to that of the grid [m]."""
    states = np.full(shape, FREE, np.uint8)
    for low, high, state in boxes:
        a, b = np.rint(np.array([low, high]) / CELL).astype(int)
        states[a[0] : b[0], a[1] : b[1], a[2] : b[2]] = state
    return OccupancyGrid(LOW, CELL, states, "map")


def planned(grid: OccupancyGrid, start: list[float], goal: list[float], **options: float) -> Route | NoRoute:
    """Return the route between points that are relative to the corner of the grid [m]."""
    distance = distance_field(grid, unknown_is_obstacle=True)
    arguments = {"clearance_m": CLEARANCE, **options}
    return route(grid, distance, LOW + start, LOW + goal, **arguments)  # type: ignore[arg-type]


def found(grid: OccupancyGrid, start: list[float], goal: list[float], **options: float) -> Route:
    result = planned(grid, start, goal, **options)
    assert isinstance(result, Route), result
    return result


def points_of(result: Route) -> np.ndarray:
    return np.concatenate(
        [
            a + np.linspace(0.0, 1.0, 2 + int(1000 * np.linalg.norm(b - a)))[:, None] * (b - a)
            for a, b in pairwise(result.waypoints)
        ]
    )


def to_boxes(grid: OccupancyGrid, points: np.ndarray) -> float:
    """Return the distance of points to what is not free, as cubes, and to the border [m]."""
    shell = np.minimum(points - grid.low_m, grid.high_m - points).min()
    cubes = grid.centres(np.argwhere(grid.states != FREE))
    apart = np.maximum(np.abs(points[::10, None] - cubes) - 0.5 * CELL, 0.0) if len(cubes) else np.full((1, 1, 3), 9.0)
    return float(min(shell, np.linalg.norm(apart, axis=-1).min()))


def reference_length(is_clear: np.ndarray, start: np.ndarray, goal: np.ndarray, costs: np.ndarray) -> float:
    """Return the cost of the cheapest path to 26 neighbours by SciPy, inf without one."""
    cells = np.argwhere(is_clear)
    apart = np.abs(cells[:, None] - cells).max(axis=-1)
    tails, heads = np.nonzero(apart == 1)
    of_cells = costs[tuple(cells.T)]
    lengths = np.linalg.norm(cells[tails] - cells[heads], axis=1) * 0.5 * (of_cells[tails] + of_cells[heads])
    graph = coo_array((lengths, (tails, heads)), shape=(len(cells),) * 2).tocsr()
    first, last = (int(np.flatnonzero((cells == cell).all(axis=1))[0]) for cell in (start, goal))
    return float(dijkstra(graph, indices=first)[last])


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6), st.floats(0.3, 0.9), st.sampled_from([(14, 11, 3), (30, 24, 1)]), st.floats(1.0, 5.0))
def test_paths_are_the_cheapest_of_the_lattice(
    seed: int, share: float, shape: tuple[int, int, int], most: float
) -> None:
    rng = np.random.default_rng(seed)
    is_clear = rng.random(shape) < share
    start, goal = rng.integers(shape, size=(2, 3))
    is_clear[tuple(start)] = is_clear[tuple(goal)] = True
    costs = np.where(rng.random(shape) < 0.5, most, 1.0)
    path = shortest_path(is_clear, start, goal, 10**6, cell_costs=None if most == 1.0 else costs)
    expected = reference_length(is_clear, start, goal, costs)
    if path.cells is None:
        assert expected == np.inf
        return
    steps = np.diff(path.cells, axis=0)
    assert np.abs(steps).max(initial=0) <= 1 and is_clear[tuple(path.cells.T)].all()
    assert (path.cells[0] == start).all() and (path.cells[-1] == goal).all()
    of_cells = costs[tuple(path.cells.T)]
    assert np.linalg.norm(steps, axis=1) @ (0.5 * (of_cells[1:] + of_cells[:-1])) == pytest.approx(expected)


def test_a_search_stays_inside_the_lattice() -> None:
    is_clear = np.ones((3, 3, 3), np.bool_)
    is_clear[1] = False
    assert shortest_path(is_clear, np.array([0, 1, 2]), np.array([2, 1, 0]), 100).cells is None


def test_a_free_line_is_the_route() -> None:
    result = found(grid_of(), [1.0, 1.0, 1.0], [5.0, 3.0, 1.5])
    np.testing.assert_allclose(result.waypoints, LOW + np.array([[1.0, 1.0, 1.0], [5.0, 3.0, 1.5]]))
    assert result.expansions == 0 and result.short_of_goal_m == 0.0


@pytest.mark.parametrize(("cost", "is_around"), [(1.0, False), (1.3, False), (3.0, True)])
def test_a_costly_part_is_passed_or_avoided(cost: float, is_around: bool) -> None:
    """Straight on are 4 m, of which 2 m cost more; around them are 5.8 m."""
    grid = grid_of((60, 40, 20))
    costs = np.ones(grid.states.shape, np.float32)
    costs[20:40, :26] = cost
    distance = distance_field(grid, unknown_is_obstacle=True)
    result = route(grid, distance, LOW + 1.0, LOW + [5.0, 1.0, 1.0], clearance_m=0.3, cell_costs=costs)
    assert isinstance(result, Route)
    through = np.mean(costs[tuple(grid.cells(points_of(result)).T)] > 1.0)
    assert through < 0.02 if is_around or cost == 1.0 else through > 0.4
    assert result.length_m == pytest.approx(5.8 if is_around else 4.0, abs=0.1)


WALL_WITH_A_DOOR = (([3.0, 0.0, 0.0], [3.2, 3.0, 2.0], OCCUPIED),)  # the door is 1 m wide, at y = 3 to 4 m


def test_a_route_leads_through_the_door() -> None:
    grid = grid_of((60, 40, 20), *WALL_WITH_A_DOOR)
    start, goal = [1.0, 1.0, 1.0], [5.0, 1.0, 1.0]
    result = found(grid, start, goal)
    corners = np.array([start, [3.0, 3.0 + CLEARANCE, 1.0], [3.2, 3.0 + CLEARANCE, 1.0], goal])
    shortest = np.linalg.norm(np.diff(corners, axis=0), axis=1).sum()
    assert shortest - 2 * CELL < result.length_m < 1.05 * shortest
    assert to_boxes(grid, points_of(result)) >= CLEARANCE - np.sqrt(3.0) * CELL
    np.testing.assert_array_equal(result.waypoints[[0, -1]], LOW + np.array([start, goal]))
    assert len(result.waypoints) <= 6
    assert result.length_m == found(grid, start, goal).length_m


@pytest.mark.parametrize("state", [OCCUPIED, UNKNOWN])
def test_a_narrow_door_and_unknown_space_are_closed(state: int) -> None:
    narrow = ([3.0, 3.4, 0.0], [3.2, 4.0, 2.0], state)  # leaves four cells
    result = planned(grid_of((60, 40, 20), *WALL_WITH_A_DOOR, narrow), [1.0, 1.0, 1.0], [5.0, 1.0, 1.0])
    assert isinstance(result, NoRoute) and result.cause == "goal"
    assert result.reason == "nothing within 1.00 m of [4.0, 3.0, 1.5] m can be reached from [0.0, 3.0, 1.5] m"


def test_the_border_of_the_grid_is_not_free() -> None:
    gap = ([3.0, 0.0, 0.0], [3.2, 3.6, 2.0], OCCUPIED)  # four cells to the border
    assert isinstance(planned(grid_of((60, 40, 20), gap), [1.0, 1.0, 1.0], [5.0, 1.0, 1.0]), NoRoute)
    edge = found(grid_of(), [1.0, 1.0, 1.0], [5.97, 1.0, 1.0])
    assert edge.waypoints[-1, 0] == pytest.approx(LOW[0] + 5.75)  # the nearest outer centre is at 6.05 m
    outside = found(grid_of(), [1.0, 1.0, 1.0], [6.5, 1.0, 1.0])
    assert outside.waypoints[-1, 0] == pytest.approx(LOW[0] + 5.75)


def test_a_goal_in_an_obstacle_becomes_the_nearest_place() -> None:
    grid = grid_of((60, 40, 20), ([3.0, 1.0, 0.0], [4.0, 2.0, 2.0], OCCUPIED))
    result = found(grid, [1.0, 1.5, 1.0], [3.31, 1.52, 1.02])
    np.testing.assert_allclose(result.waypoints[-1], LOW + [2.75, 1.55, 1.05])
    assert result.short_of_goal_m == pytest.approx(np.linalg.norm([0.56, 0.03, 0.03]))
    assert isinstance(planned(grid, [1.0, 1.5, 1.0], [3.31, 1.52, 1.02], near_m=0.5), NoRoute)


def test_the_place_near_a_goal_can_be_reached() -> None:
    closed = [([3.0, 0.0, 0.0], [3.2, 4.0, 2.0], OCCUPIED)]
    result = found(grid_of((60, 40, 20), *closed), [1.0, 1.5, 1.0], [3.5, 1.5, 1.0])  # behind the wall, and clear
    np.testing.assert_allclose(result.waypoints[-1, 0], LOW[0] + 2.75)


def test_a_start_near_an_obstacle_is_left_through_free_cells() -> None:
    thin = ([3.0, 0.0, 0.0], [3.1, 4.0, 2.0], OCCUPIED)
    grid = grid_of((60, 40, 20), thin)
    result = found(grid, [3.12, 1.5, 1.0], [5.0, 1.5, 1.0])
    assert result.waypoints[1, 0] == pytest.approx(LOW[0] + 3.35)
    # On this side, unknown space leaves no clear cell: the nearest one is behind the wall.
    blocked = grid_of((60, 40, 20), thin, ([3.4, 0.0, 0.0], [6.0, 4.0, 2.0], UNKNOWN))
    none = planned(blocked, [3.12, 1.5, 1.0], [1.0, 1.5, 1.0])
    assert isinstance(none, NoRoute) and none.cause == "start"
    inside = planned(
        grid_of((60, 40, 20), ([1.0, 1.0, 0.5], [1.5, 1.5, 1.0], UNKNOWN)), [1.2, 1.2, 0.7], [5.0, 1.5, 1.0]
    )
    assert isinstance(inside, NoRoute) and inside.cause == "start"


def test_a_search_ends_after_a_number_of_expansions() -> None:
    grid = grid_of((60, 40, 20), *WALL_WITH_A_DOOR)
    needed = found(grid, [1.0, 1.0, 1.0], [5.0, 1.0, 1.0]).expansions
    assert 0 < needed <= grid.states.size
    assert found(grid, [1.0, 1.0, 1.0], [5.0, 1.0, 1.0], max_expansions=needed).expansions == needed
    result = planned(grid, [1.0, 1.0, 1.0], [5.0, 1.0, 1.0], max_expansions=needed - 1)
    assert isinstance(result, NoRoute) and result.cause == "search" and f"{needed - 1} expansions" in result.reason


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10**6))
def test_routes_keep_their_clearance(seed: int) -> None:
    rng = np.random.default_rng(seed)
    lows = rng.uniform(0.0, [5.0, 3.0, 0.5], (8, 3))
    boxes = [(low.tolist(), (low + rng.uniform(0.1, 1.0, 3)).tolist(), int(rng.integers(2) * 2)) for low in lows]
    grid = grid_of((60, 40, 20), *boxes)
    start, goal = rng.uniform(0.5, [5.5, 3.5, 1.5], (2, 3)).tolist()
    result = planned(grid, start, goal)
    if isinstance(result, Route):
        distance = distance_field(grid, unknown_is_obstacle=True).distance_m
        points = points_of(result)
        from_faces = np.abs(points - grid.low_m - CELL * np.rint((points - grid.low_m) / CELL))
        points = points[(from_faces > 1e-6).all(axis=1)]  # lines between centres pass edges of cells
        i, j, k = grid.cells(points).T
        clear = distance[i, j, k] >= CLEARANCE - 1e-6
        assert clear[int(np.argmax(clear)) :].all() and (grid.states[i, j, k] == FREE).all()
        reached = np.linalg.norm(result.waypoints[-1] - LOW - goal)
        assert result.short_of_goal_m == pytest.approx(reached) and reached <= 1.0


def test_grid_and_distances_belong_together() -> None:
    grid = grid_of()
    other = OccupancyGrid(LOW + 0.1, CELL, grid.states, "map")
    with pytest.raises(ConfigError, match="expected those of the same cells"):
        route(grid, distance_field(other, unknown_is_obstacle=True), LOW + 1.0, LOW + 1.5, clearance_m=0.3)
    with pytest.raises(ConfigError, match=r"goal of the route = .*expected three finite numbers"):
        planned(grid, [1.0, 1.0, 1.0], [np.nan, 1.0, 1.0])
