"""A path is placed in a world by a rotation about z and a translation, clear of obstacles, or refused."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dronevio.models.errors import ConfigError
from dronevio.sim.paths.placement import place_path
from dronevio.sim.paths.space import Space

ONE_PILLAR = Space(
    np.array([-4.0, -3.0, 0.0]),
    np.array([4.0, 3.0, 3.0]),
    np.array([[1.0, 0.0, 1.5]]),
    np.array([[0.3, 0.3, 1.5]]),
    np.eye(3)[None],
)


def _random_walk(seed: int, size_m: float) -> np.ndarray:
    steps = np.cumsum(np.random.default_rng(seed).standard_normal((300, 3)), axis=0)
    low, high = steps.min(axis=0), steps.max(axis=0)
    return np.asarray((steps - low) / (high - low) * [size_m, size_m, 1.0] + [100.0, -50.0, -7.0])


@settings(max_examples=8, deadline=None)
@given(seed=st.integers(0, 10_000))
@pytest.mark.slow
def test_a_placed_path_is_clear_of_obstacles(seed: int) -> None:
    path = _random_walk(seed, 2.5)
    T = place_path(path, ONE_PILLAR, 0.25, "one pillar")
    assert ONE_PILLAR.clearance(path @ T[:3, :3].T + T[:3, 3]).min() >= 0.25
    assert T[:3, :3] @ T[:3, :3].T == pytest.approx(np.eye(3), abs=1e-12)
    assert T[2, :3] == pytest.approx([0.0, 0.0, 1.0])  # the direction of gravity is unchanged


def test_a_long_path_is_rotated_to_fit() -> None:
    along_y = np.column_stack([np.zeros(50), np.linspace(0.0, 7.0, 50), np.zeros(50)])
    T = place_path(along_y, ONE_PILLAR, 0.3, "one pillar")
    assert abs(T[0, 1]) > 0.9


def test_a_path_that_fits_nowhere_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"9\.0 × 9\.0 × 1\.0 m in world 'one pillar'.* larger world"):
        place_path(_random_walk(0, 9.0), ONE_PILLAR, 0.25, "one pillar")
