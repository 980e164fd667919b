"""Errors of occupancy grids, by values that are worked out by hand."""

import numpy as np
import pytest

from dronevio.eval.metrics.occupancy import (
    are_falsely_free,
    left_behind,
    state_shares,
    surface_scores,
    warning_distances_m,
)
from dronevio.models.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid

CELL_M = 0.1
LOW_M = np.array([1.0, -2.0, 0.5])


def grid_of(states: np.ndarray) -> OccupancyGrid:
    """Return a grid with a corner away from the origin."""
    return OccupancyGrid(LOW_M, CELL_M, states.astype(np.uint8))


@pytest.fixture
def one_wall() -> OccupancyGrid:
    """Return free cells 9 × 9 × 9 around an occupied cell in their middle, (4, 4, 4)."""
    states = np.full((9, 9, 9), FREE)
    states[4, 4, 4] = OCCUPIED
    return grid_of(states)


def test_the_warning_distance_is_that_to_the_box_of_a_cell(one_wall: OccupancyGrid) -> None:
    middle = LOW_M + 0.45
    offsets = np.array(
        [
            [0.0, 0.0, 0.0],  # in the occupied cell
            [0.08, 0.0, 0.0],  # 3 cm from its face
            [0.08, -0.09, 0.0],  # 3 and 4 cm from its edge
            [0.0, 0.0, 0.149],  # nearly one cell from its face
            [0.0, 0.0, 0.151],  # more than one cell
            [0.13, 0.13, 0.0],  # 8 and 8 cm from its edge, in a neighbouring cell, but more than one cell away
        ]
    )
    expected = [0.0, 0.03, 0.05, 0.099, np.inf, np.inf]
    np.testing.assert_allclose(warning_distances_m(one_wall, middle + offsets), expected, atol=1e-12)
    assert are_falsely_free(one_wall, middle + offsets).tolist() == [False] * 4 + [True] * 2


def test_unknown_cells_warn_and_so_does_the_outside(one_wall: OccupancyGrid) -> None:
    states = one_wall.states.copy()
    states[4, 4, 4] = UNKNOWN
    points = LOW_M + np.array([[0.45, 0.45, 0.58], [0.05, 0.45, 0.45], [-3.0, 0.0, 0.0], [0.25, 0.45, 0.45]])
    np.testing.assert_allclose(warning_distances_m(grid_of(states), points), [0.08, 0.05, 0.0, np.inf], atol=1e-12)


def test_states_are_counted() -> None:
    states = np.full((4, 1, 1), FREE)
    states[1], states[2] = OCCUPIED, UNKNOWN
    points = LOW_M + np.array([[0.05, 0.05, 0.05], [0.15, 0.05, 0.05], [0.25, 0.05, 0.05], [9.0, 0.0, 0.0]])
    shares = state_shares(grid_of(states), points)
    assert (shares.unknown, shares.free, shares.occupied) == (0.5, 0.25, 0.25)
    assert np.isnan(state_shares(grid_of(states), np.zeros((0, 3))).free)


def test_accuracy_and_completeness_of_centres() -> None:
    states = np.full((10, 1, 1), FREE)
    states[2], states[7] = OCCUPIED, OCCUPIED  # centres at 0.25 and 0.75
    line = np.array([[0.0, 0.05, 0.05]])
    x = np.array([[1.0, 0.0, 0.0]])
    surface = LOW_M + line + x * np.array([[0.28], [0.45]])  # 3 and 20 cm from the first centre
    exact, coarse = surface_scores(grid_of(states), surface, surface[1:], (0.05, 0.31))
    assert (exact.accuracy, exact.completeness) == (0.5, 0.0)
    assert (coarse.accuracy, coarse.completeness) == (1.0, 1.0)
    (nothing,) = surface_scores(grid_of(np.full((2, 2, 2), FREE)), surface, surface, (0.1,))
    assert (nothing.accuracy, nothing.completeness) == (0.0, 0.0)


def test_what_movers_leave_behind() -> None:
    states = np.full((10, 1, 1), FREE)
    states[2], states[3], states[9] = OCCUPIED, UNKNOWN, OCCUPIED
    at = LOW_M + [0.0, 0.05, 0.05] + np.array([[0.22, 0, 0], [0.25, 0, 0], [0.35, 0, 0], [0.55, 0, 0], [0.95, 0, 0]])
    wall = LOW_M + [[0.96, 0.05, 0.05]]
    assert left_behind(grid_of(states), wall, at, 0.05) == pytest.approx(1.0 / 3.0)  # one of the cells 2, 3 and 5
    assert left_behind(grid_of(states), np.zeros((0, 3)), at, 0.05) == pytest.approx(2.0 / 4.0)
    assert np.isnan(left_behind(grid_of(states), wall, np.zeros((0, 3)), 0.05))
