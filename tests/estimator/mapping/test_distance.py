"""Distance fields against all distances."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dronevio.estimator.mapping.distance import distance_field
from dronevio.models.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid


@given(st.integers(0, 10000), st.tuples(*[st.integers(1, 12)] * 3), st.sampled_from([0.0, 0.003, 0.05, 0.5, 1.0]))
@settings(max_examples=100, deadline=None)
@pytest.mark.parametrize("unknown_is_obstacle", [False, True])
def test_distances_equal_the_least_of_all(
    unknown_is_obstacle: bool, seed: int, shape: tuple[int, int, int], share: float
) -> None:
    rng = np.random.default_rng(seed)
    states = np.full(shape, FREE, np.uint8)
    draw = rng.random(shape)
    states[draw < share] = OCCUPIED
    states[draw > 1.0 - 0.3 * share] = UNKNOWN
    field = distance_field(OccupancyGrid(np.zeros(3), 0.2, states), unknown_is_obstacle=unknown_is_obstacle)
    obstacles = np.argwhere((states == OCCUPIED) | (unknown_is_obstacle & (states == UNKNOWN)))
    cells = np.argwhere(np.ones(shape, bool))
    least = np.full(len(cells), np.inf)
    for obstacle in obstacles:
        least = np.minimum(least, 0.2 * np.linalg.norm(cells - obstacle, axis=1))
    np.testing.assert_allclose(field.distance_m.ravel(), least, rtol=1e-6)


def test_a_large_field_has_exact_distances() -> None:
    states = np.full((300, 200, 30), FREE, np.uint8)
    states[3, 190, 29] = OCCUPIED
    distance = distance_field(OccupancyGrid(np.zeros(3), 1.0, states), unknown_is_obstacle=False).distance_m
    assert distance[299, 0, 0] == pytest.approx(np.sqrt(296.0**2 + 190.0**2 + 29.0**2), rel=1e-6)
