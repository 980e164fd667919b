"""Clearances in the space of a world, against hand-worked values."""

import numpy as np
import pytest

from dronevio.models.rotation import rotation_z
from dronevio.sim.paths.space import Space
from dronevio.sim.world import build_world


def _hall(*boxes: tuple[list[float], list[float], float]) -> Space:
    return Space(
        np.array([-5.0, -5.0, 0.0]),
        np.array([5.0, 5.0, 4.0]),
        np.array([box[0] for box in boxes]).reshape(-1, 3),
        np.array([box[1] for box in boxes]).reshape(-1, 3),
        np.array([rotation_z(box[2]) for box in boxes]).reshape(-1, 3, 3),
    )


def test_clearance_of_an_empty_space_is_that_of_its_bounds() -> None:
    space = _hall()
    assert space.clearance(np.array([[0.0, 0.0, 1.0], [4.5, 0.0, 2.0], [6.0, 0.0, 2.0]])) == pytest.approx([1, 0.5, -1])


def test_clearance_of_faces_corners_and_interior() -> None:
    space = _hall(([0.0, 0.0, 2.0], [1.0, 1.0, 1.0], 0.0))
    beside, off_corner, within = space.clearance(np.array([[1.5, 0.0, 2.0], [1.3, 1.4, 2.0], [0.8, 0.0, 2.0]]))
    assert beside == pytest.approx(0.5)
    assert off_corner == pytest.approx(0.5)
    assert within == pytest.approx(-0.2)


def test_clearance_of_a_rotated_box() -> None:
    space = _hall(([1.0, 0.0, 2.0], [1.0, 0.1, 1.0], np.pi / 2))
    assert space.clearance(np.array([1.5, 0.0, 2.0])) == pytest.approx(0.4)


def test_clearances_of_many_points_equal_single_ones() -> None:
    space = _hall(([0.0, 0.0, 2.0], [1.0, 0.5, 1.0], 0.3), ([3.0, 1.0, 1.0], [0.5, 0.5, 1.0], 1.0))
    points = np.random.default_rng(0).uniform([-5, -5, 0], [5, 5, 4], (10_000, 3))
    assert space.clearance(points)[::1000] == pytest.approx([float(space.clearance(p)) for p in points[::1000]])


@pytest.mark.parametrize("spacing_m", [0.02, 0.5])
def test_clearance_with_many_boxes_is_exact(spacing_m: float) -> None:
    rng = np.random.default_rng(1)
    boxes = [
        (list(rng.uniform([-5, -5, 0], [5, 5, 4])), list(rng.uniform(0.05, 0.6, 3)), rng.uniform(0, 3))
        for _ in range(80)
    ]
    space = _hall(*boxes)
    path = np.cumsum(spacing_m * rng.normal(size=(2000, 3)), axis=0) % [10.0, 10.0, 4.0] - [5.0, 5.0, 0.0]
    local = np.einsum("kji,nkj->nki", space.rotations, path[:, None] - space.centres)
    beyond = np.abs(local) - space.halves
    distance = np.linalg.norm(np.maximum(beyond, 0.0), axis=-1) + np.minimum(beyond.max(axis=-1), 0.0)
    expected = np.minimum(distance.min(axis=1), np.minimum(path - space.low, space.high - path).min(axis=1))
    np.testing.assert_allclose(space.clearance(path), expected, atol=1e-12)


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_the_rooms_route_is_clear(seed: int) -> None:
    world = build_world("room", seed)
    legs = zip(world.route, np.roll(world.route, -1, axis=0), strict=True)
    points = np.concatenate([a + (b - a) * np.linspace(0.0, 1.0, 50)[:, None] for a, b in legs])
    assert world.space.clearance(points).min() >= 0.6
