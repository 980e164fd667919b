"""Goals behind obstacles, shortest paths on true maps, and the room for a flat body."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dronevio.autonomy.goals import HOVER_M, drawn_goal, shortest_m
from dronevio.autonomy.planning.body import Body, horizontal_distance
from dronevio.autonomy.true_map import clear_samples, true_map
from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError
from dronevio.models.occupancy import FREE, OCCUPIED
from dronevio.sim.paths.space import Space
from dronevio.sim.streams import generator
from dronevio.sim.world import flight_area, solid_space
from dronevio.sim.worlds.office_plan import drawn_plan

CELL = 0.1


def boxes_in(high: list[float], *boxes: tuple[list[float], list[float]]) -> Space:
    """Return a space from the origin with axis-aligned boxes by their corners [m]."""
    corners = np.array(boxes, dtype=np.float64).reshape(-1, 2, 3)
    centres, halves = corners.mean(axis=1), 0.5 * np.ptp(corners, axis=1)
    return Space(np.zeros(3), np.array(high), centres, halves, np.tile(np.eye(3), (len(boxes), 1, 1)))


def start_of(world: str, seed: int) -> Array:
    return np.asarray(flight_area(world, seed).pad + [0.0, 0.0, HOVER_M])


@pytest.mark.parametrize(
    ("world", "seed"),
    [
        ("corridor", 0),
        ("warehouse", 1),
        ("forest", 2),
        ("office", 3),
        ("office-narrow", 0),
        ("office-glass", 0),
        ("hall", 1),
    ],
)
def test_goals_are_behind_obstacles_and_can_be_reached(world: str, seed: int) -> None:
    space, start = solid_space(world, seed), start_of(world, seed)
    grid = true_map(space)
    goals = [drawn_goal(world, seed, number) for number in range(3)]
    for goal in goals:
        assert space.clearance(goal) >= 0.6
        assert 0.8 <= goal[2] - space.low[2] <= 1.6
        line = start + np.linspace(0.0, 1.0, 5000)[:, None] * (goal - start)
        assert space.clearance(line).min() < 0.0
        length_m = shortest_m(grid, start, goal)
        assert max(4.0, float(np.linalg.norm(goal - start))) <= length_m <= 40.0
    assert len(np.unique(goals, axis=0)) == 3
    np.testing.assert_array_equal(drawn_goal(world, seed, 1), goals[1])


def test_goals_of_the_room_are_in_sight() -> None:
    start = start_of("room", 0)
    for number in range(5):
        goal = drawn_goal("room", 0, number)
        assert solid_space("room", 0).clearance(goal) >= 0.6
        assert shortest_m(true_map(solid_space("room", 0)), start, goal) == pytest.approx(np.linalg.norm(goal - start))
        assert np.linalg.norm(goal - start) >= 3.0


def test_goals_of_the_office_are_mostly_in_rooms() -> None:
    rooms = drawn_plan(generator(5, "layout")).rooms
    goals = np.array([drawn_goal("office", 5, number)[:2] for number in range(12)])
    inside = [np.all((goals > room.low) & (goals < room.high), axis=1) for room in rooms]
    assert np.any(inside, axis=0).sum() >= 6
    assert np.any(inside, axis=1).sum() >= 3


def test_a_slim_body_passes_narrow_doors() -> None:
    plan = drawn_plan(generator(0, "layout"))
    grid, start = true_map(solid_space("office-narrow", 0)), start_of("office-narrow", 0)
    rooms = [np.array([*room.middle, 1.2]) for room in plan.rooms]
    assert np.isfinite([shortest_m(grid, start, room, Body(0.35)) for room in rooms]).all()
    assert np.isinf([shortest_m(grid, start, room) for room in rooms]).any()


def test_a_world_without_hidden_places_is_an_error() -> None:
    with pytest.raises(ConfigError, match="world mirror of seed 0 has no goal behind obstacles: none of 300 places"):
        drawn_goal("mirror", 0, 0)
    with pytest.raises(ConfigError, match="unknown world 'attic'"):
        drawn_goal("attic", 0, 0)


def test_shortest_path_around_a_wall() -> None:
    # The wall is 0.2 m thick and leaves 2 m to the border, in the middle of which the body passes.
    grid = true_map(boxes_in([8.0, 6.0, 3.0], ([3.9, 0.0, 0.0], [4.1, 4.0, 3.0])))
    start, goal = np.array([2.05, 1.05, 1.25]), np.array([5.95, 1.05, 1.25])
    corners = np.array([start[:2], [3.9 - 0.45, 4.0], [3.9, 4.45], [4.1, 4.45], [4.1 + 0.45, 4.0], goal[:2]])
    shortest = np.linalg.norm(
        np.diff(corners, axis=0), axis=1
    ).sum()  # its ends are chords of the arcs, which are longer
    assert shortest - 0.05 < shortest_m(grid, start, goal) < 1.08 * shortest
    assert shortest_m(grid, start, np.array([2.05, 4.05, 1.25])) == pytest.approx(3.0)


@pytest.mark.parametrize(("low_m", "high_m", "aside_m"), [(0.0, 1.3, 0.3), (1.0, 3.0, 0.5)])
def test_paths_lead_over_and_under_things(low_m: float, high_m: float, aside_m: float) -> None:
    grid = true_map(boxes_in([6.0, 3.0, 3.0], ([2.9, 0.0, low_m], [3.1, 3.0, high_m])))
    length_m = shortest_m(grid, np.array([1.55, 1.55, 1.25]), np.array([4.55, 1.55, 1.25]))
    # The body rises or sinks within 0.9 m, and by up to two cells more on the map.
    least_m, greatest_m = (3.0 + 2.0 * (np.hypot(0.9, z) - 0.9) for z in (aside_m, aside_m + 0.2))
    assert least_m < length_m < greatest_m + 0.1


@pytest.mark.parametrize(("low_m", "high_m"), [(0.0, 1.8), (0.7, 3.0)])
def test_paths_remain_between_their_heights(low_m: float, high_m: float) -> None:
    grid = true_map(boxes_in([6.0, 3.0, 3.0], ([2.9, 0.0, low_m], [3.1, 3.0, high_m])))
    assert np.isinf(shortest_m(grid, np.array([1.55, 1.55, 1.25]), np.array([4.55, 1.55, 1.25])))


def test_true_maps_mark_what_solids_may_touch() -> None:
    space = boxes_in([1.0, 1.0, 1.0], ([0.42, 0.42, 0.42], [0.58, 0.58, 0.58]))
    states = true_map(space).states
    assert states.shape == (10, 10, 10) and true_map(space).frame == "map"
    assert (states[[0, -1]] == OCCUPIED).all() and (states[:, :, [0, -1]] == OCCUPIED).all()
    # Centres at 0.35 are 0.07 m from the box in one direction, √2 × 0.07 m in two.
    assert states[3, 4, 4] == OCCUPIED and states[3, 3, 4] == FREE and states[2, 4, 4] == FREE
    assert (states[4:6, 4:6, 4:6] == OCCUPIED).all()


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10**6))
def test_samples_are_clear_by_their_clearance(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rotations = np.linalg.qr(rng.standard_normal((6, 3, 3)))[0]
    high = rng.uniform(1.0, 2.0, 3)
    space = Space(
        np.array([-0.3, 0.2, 0.0]), high, rng.uniform(-0.5, 2.2, (6, 3)), rng.uniform(0.01, 0.6, (6, 3)), rotations
    )
    least_m, shift = float(rng.uniform(0.05, 0.4)), float(rng.uniform())
    first, is_clear = clear_samples(space, 0.13, shift, least_m)
    points = first + 0.13 * np.stack(np.meshgrid(*map(np.arange, is_clear.shape), indexing="ij"), axis=-1)
    np.testing.assert_array_equal(is_clear, space.clearance(points) >= least_m)


def test_horizontal_distance_of_a_pillar() -> None:
    blocked = np.zeros((9, 7, 6), np.bool_)
    blocked[2, 3] = True
    distance = horizontal_distance(blocked, CELL, 0.25)
    expected = CELL * np.hypot(np.arange(9)[:, None] - 2, np.arange(7) - 3)
    np.testing.assert_allclose(distance, np.repeat(expected[..., None], 6, axis=2), atol=1e-6)
    assert distance.dtype == np.float32 and distance[2, 3].max() == 0.0


@pytest.mark.parametrize(("half_height_m", "reach"), [(0.0, 0), (0.1, 1), (0.11, 2), (0.25, 3), (0.3, 3), (2.0, 20)])
def test_blocked_cells_reach_up_and_down_by_half_the_height(half_height_m: float, reach: int) -> None:
    blocked = np.zeros((5, 5, 12), np.bool_)
    blocked[1, 1, 5] = True
    distance = horizontal_distance(blocked, CELL, half_height_m)
    near = np.abs(np.arange(12) - 5) <= reach
    np.testing.assert_array_equal(distance[1, 1] == 0.0, near)
    np.testing.assert_allclose(distance[4, 1, near], 0.3, atol=1e-6)
    assert np.isinf(distance[..., ~near]).all()


def test_a_body_fits_between_floor_and_lintel() -> None:
    blocked = np.zeros((20, 20, 20), np.bool_)
    blocked[..., 0] = True
    blocked[10, :, 12] = True
    fits = horizontal_distance(blocked, CELL, 0.25) >= 0.45
    assert fits[10, 10].nonzero()[0].tolist() == [*range(4, 9), *range(16, 20)]
    assert fits[15, 10, 4:].all() and not fits[14, 10, 12] and fits[14, 10, 8]
