"""What walls hide, and what a metre of it costs."""

from math import cos, radians, sin

import numpy as np
import pytest

from dronevio.autonomy.planning.body import Body
from dronevio.autonomy.planning.goal_path import path_to_goal
from dronevio.autonomy.planning.hidden_space import path_costs
from dronevio.autonomy.planning.route import Route
from dronevio.models.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid

CELL_M, SHAPE = 0.1, (160, 160, 20)


def costs_of(points: np.ndarray, unknown: tuple[slice, ...] = ()) -> np.ndarray:
    """Return the costs in a plan view around occupied points [m] from the middle of the map."""
    occupied, is_unknown = np.zeros(SHAPE, bool), np.zeros(SHAPE, bool)
    occupied[(*np.floor(points / CELL_M + 80).astype(int).T, 10)] = True
    is_unknown[unknown] = True
    costs = path_costs(occupied, is_unknown, CELL_M)
    np.testing.assert_array_equal(costs, costs[..., :1].repeat(SHAPE[2], axis=2))
    return costs[..., 0]


def line(length_m: float, angle_deg: float) -> np.ndarray:
    """Return points (N, 2) of a line through the middle."""
    return np.linspace(-0.5, 0.5, 200)[:, None] * length_m * [cos(radians(angle_deg)), sin(radians(angle_deg))]


def at(costs: np.ndarray, along_m: float, behind_m: float, angle_deg: float) -> float:
    """Return the cost beside a line."""
    c, s = cos(radians(angle_deg)), sin(radians(angle_deg))
    x, y = along_m * c - behind_m * s, along_m * s + behind_m * c
    return float(costs[int(np.floor(x / CELL_M + 80)), int(np.floor(y / CELL_M + 80))])


@pytest.mark.parametrize("angle_deg", [0.0, 22.5, 45.0, 90.0, 112.5, 135.0])
def test_a_wall_hides_what_is_behind_and_before_it(angle_deg: float) -> None:
    costs = costs_of(line(3.0, angle_deg))
    for side in (-1, 1):
        assert all(at(costs, a, side * b, angle_deg) == 2.0 for a in (-1.0, 0.0, 1.0) for b in (0.5, 2.0, 3.7))
        assert at(costs, 0.0, side * 4.6, angle_deg) == at(costs, side * 2.6, 0.0, angle_deg) == 1.0


def test_posts_hide_nothing_and_what_is_known_costs_no_more() -> None:
    assert np.all(costs_of(line(0.6, 0.0)) == 1.0)
    costs = costs_of(line(3.0, 0.0), np.s_[:, 80:])
    assert at(costs, 0.0, 1.0, 0.0) == 2.0 and at(costs, 0.0, -1.0, 0.0) == 1.0


def test_the_aisle_of_the_goal_is_preferred_to_a_gap_in_a_rack() -> None:
    """The end of a rack was seen from the left, and the goal is in the aisle above: the way around is 0.4 m longer."""
    states = np.full((100, 140, 26), UNKNOWN, np.uint8)
    states[:60, 20:120] = FREE
    states[56:60, 50:74] = OCCUPIED
    known = OccupancyGrid(np.zeros(3), CELL_M, states, "map")
    start, goal = np.array([2.0, 5.0, 1.2]), np.array([11.0, 9.5, 1.2])
    found = path_to_goal(known, start, goal, Body(), (0.5, 2.0), np.zeros((0, 3)))
    assert isinstance(found, Route)
    behind = found.waypoints[np.argmin(np.abs(found.waypoints[:, 0] - 6.0))]
    assert behind[1] > 7.4 and found.length_m > np.linalg.norm(goal - start) + 0.1
