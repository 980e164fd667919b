"""Collision-free polylines and curves: around obstacles, through doors, and errors where none exists."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from dronevio.models.errors import ConfigError
from dronevio.models.rotation import rotation_z
from dronevio.sim.paths.limits import LIMITS
from dronevio.sim.paths.minimum_snap import minimum_snap
from dronevio.sim.paths.route import collision_free_curve, collision_free_polyline, leg_clearances
from dronevio.sim.paths.space import Space

MARGIN = 0.4
START, GOAL = np.array([1.0, 3.0, 1.5]), np.array([9.0, 3.0, 1.5])


def hall(*boxes: tuple[list[float], list[float]], yaw_rad: float = 0.0) -> Space:
    """Return a space of 10 × 6 × 4 m with boxes of given centres and half sizes, rotated about z by an angle."""
    return Space(
        np.zeros(3),
        np.array([10.0, 6.0, 4.0]),
        np.array([middle for middle, _ in boxes]).reshape(-1, 3),
        np.array([half for _, half in boxes]).reshape(-1, 3),
        np.tile(rotation_z(yaw_rad), (len(boxes), 1, 1)),
    )


WALL_WITH_A_DOOR = (([5.0, 2.0, 2.0], [0.1, 2.0, 2.0]), ([5.0, 5.8, 2.0], [0.1, 0.2, 2.0]))  # 1.6 m wide, at y = 4.8
WALL = (([5.0, 3.0, 2.0], [0.1, 3.0, 2.0]),)


def lowest(space: Space, knots: np.ndarray, points: np.ndarray) -> float:
    return float(space.clearance(minimum_snap(knots, points)(np.linspace(0.0, knots[-1], 20_000))).min())


def test_leg_clearance_is_the_smallest_of_its_points() -> None:
    space = hall(*WALL_WITH_A_DOOR, yaw_rad=0.2)
    rng = np.random.default_rng(0)
    starts, ends = rng.uniform(space.low, space.high, (2, 40, 3))
    dense = starts[:, None] + np.linspace(0.0, 1.0, 3000)[:, None] * (ends - starts)[:, None]
    np.testing.assert_allclose(leg_clearances(space, starts, ends), space.clearance(dense).min(axis=1), atol=0.03)
    assert len(leg_clearances(space, starts[:0], ends[:0])) == 0


def test_a_clear_polyline_is_unchanged() -> None:
    points = np.stack([START, GOAL])
    np.testing.assert_array_equal(collision_free_polyline(hall(), points, MARGIN), points)


def test_a_polyline_leads_through_the_door() -> None:
    space, points = hall(*WALL_WITH_A_DOOR), np.stack([START, GOAL])
    assert leg_clearances(space, points[:1], points[1:])[0] < 0.0
    route = collision_free_polyline(space, points, MARGIN)
    assert leg_clearances(space, route[:-1], route[1:]).min() >= MARGIN
    np.testing.assert_array_equal(route[[0, -1]], points)
    length = np.linalg.norm(np.diff(route, axis=0), axis=1).sum()
    shortest = np.linalg.norm([4.0, 1.4]) * 2.0  # through the nearest point with clearance from the edge of the door
    assert shortest < length < 1.1 * shortest
    assert len(route) <= 6  # without the steps of the search grid


@pytest.mark.parametrize("level", ["easy", "race"])
def test_a_curve_leads_through_the_door(level: str) -> None:
    space = hall(*WALL_WITH_A_DOOR)
    route = collision_free_polyline(space, np.stack([START, GOAL, START + [0.0, 1.0, 0.5]]), MARGIN)
    knots, points = collision_free_curve(space, route, MARGIN, LIMITS[level])
    assert lowest(space, knots, points) >= MARGIN
    np.testing.assert_allclose(minimum_snap(knots, points)(knots[-1]), START + [0.0, 1.0, 0.5], atol=1e-9)


@pytest.mark.slow
@given(seed=st.integers(0, 10_000))
@settings(max_examples=12, deadline=None)
@example(seed=2381)  # legs with little more than the margin
@example(seed=2802)
def test_curves_keep_clear_of_random_obstacles(seed: int) -> None:
    rng = np.random.default_rng(seed)
    boxes = [(list(rng.uniform([1.5, 1.0, 0.5], [8.5, 5.0, 2.0])), list(rng.uniform(0.1, 0.5, 3))) for _ in range(6)]
    space = hall(*boxes, yaw_rad=rng.uniform(0.0, np.pi))
    candidates = rng.uniform(space.low + 0.6, space.high - 0.6, (200, 3))
    points = candidates[space.clearance(candidates) >= 0.55][:6]
    limits = LIMITS[("easy", "difficult", "race")[seed % 3]]
    knots, points = collision_free_curve(space, collision_free_polyline(space, points, MARGIN), MARGIN, limits)
    assert lowest(space, knots, points) >= MARGIN


def test_a_waypoint_in_a_wall_is_named_with_its_clearance() -> None:
    points = np.array([START, [5.0, 3.0, 1.5], GOAL])
    with pytest.raises(ConfigError, match=r"waypoint 1 at \[5.0, 3.0, 1.5\] m has -0.10 m .* expected at least 0.40 m"):
        collision_free_polyline(hall(*WALL), points, MARGIN)
    with pytest.raises(ConfigError, match=r"the third gate at \[9.7"):
        collision_free_polyline(hall(), np.array([START, [9.7, 3.0, 1.5]]), MARGIN, ["home", "the third gate"])


def test_a_waypoint_that_is_not_finite_is_refused() -> None:
    with pytest.raises(ConfigError, match="waypoint 1"):
        collision_free_polyline(hall(), np.array([START, [np.nan, 3.0, 1.5]]), MARGIN)


def test_a_leg_without_a_route_is_named() -> None:
    with pytest.raises(ConfigError, match=r"no route from waypoint 0 at \[1.0.* to waypoint 1 at \[9.0"):
        collision_free_polyline(hall(*WALL), np.stack([START, GOAL]), MARGIN)
    # The door of 1.6 m is too narrow for a margin of 0.85 m.
    with pytest.raises(ConfigError, match="no route"):
        collision_free_polyline(hall(*WALL_WITH_A_DOOR), np.stack([START, GOAL]), 0.85)


def test_a_curve_without_clearance_is_refused() -> None:
    # At the smallest allowed distance from the wall
    points = np.array([[1.0, 3.0, 1.5], [9.6, 3.0, 1.5], [1.0, 3.2, 1.5]])
    with pytest.raises(ConfigError, match=r"curve near .* expected more than 0.40 m"):
        collision_free_curve(hall(), points, MARGIN, LIMITS["medium"])
