"""Evidence of depth images: what is free, occupied and left unknown."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dronevio.estimator.mapping.evidence import (
    FREE_LOG_ODDS,
    FREE_SIGMAS,
    OCCUPIED_LOG_ODDS,
    evidence,
)
from dronevio.models.arrays import Array
from dronevio.models.rotation import exp_so3
from tests.estimator.mapping.scenes import (
    CAMERA,
    CELL_M,
    EUROC_HALF,
    FORWARDS,
    found_free,
    image,
    in_camera,
    pose,
    value_at,
    wall,
    with_box,
    with_pole,
)

rotations = st.tuples(*[st.floats(-3.0, 3.0)] * 3).map(lambda w: exp_so3(np.array(w)))
positions = st.tuples(*[st.floats(-20.0, 20.0)] * 3)


def test_a_wall_is_occupied_and_free_in_front_of_it() -> None:
    found = evidence(image(wall(2.05), pose((0.02, 0.03, 0.04))), CELL_M, 4.0)
    assert value_at(found, (2.05, 0.05, 0.05)) == pytest.approx(OCCUPIED_LOG_ODDS)
    assert value_at(found, (1.95, 0.05, 0.05)) == pytest.approx(FREE_LOG_ODDS)
    assert value_at(found, (1.0, 0.05, 0.05)) == pytest.approx(FREE_LOG_ODDS)
    assert np.argwhere(found.log_odds)[:, 0].max() + found.low[0] == 20  # nothing is known behind it


@given(rotations, positions, st.floats(0.0, 0.2), st.integers(0, 1000))
@settings(max_examples=12, deadline=None)
def test_nothing_is_free_that_any_ray_does_not_pass(R: Array, position: Array, sigma_m: float, seed: int) -> None:
    """All corners of free cells are in the image and in front of the nearest depth of any pixel between them."""
    rng = np.random.default_rng(seed)
    depth = wall(3.5)
    for _ in range(4):
        low = np.array([*rng.uniform(-2.0, 2.0, 2), rng.uniform(0.5, 3.0)])
        depth = with_box(depth, low, low + rng.uniform(0.02, 0.6, 3))
    T = pose(np.array(position), R)
    corners = in_camera(found := evidence(image(depth, T, sigma_m), CELL_M, 4.0), found_free(found), T)
    u = CAMERA.K[0, 0] * corners[..., 0] / corners[..., 2] + CAMERA.K[0, 2]
    v = CAMERA.K[1, 1] * corners[..., 1] / corners[..., 2] + CAMERA.K[1, 2]
    first_u, last_u = np.ceil(u.min(axis=1)).astype(int), np.floor(u.max(axis=1)).astype(int)
    first_v, last_v = np.ceil(v.min(axis=1)).astype(int), np.floor(v.max(axis=1)).astype(int)
    assert (first_u >= 0).all() and (first_v >= 0).all()
    assert (last_u < CAMERA.width).all() and (last_v < CAMERA.height).all()
    deepest = corners[..., 2].max(axis=1)
    for a, b, c, d, z in zip(first_u, last_u, first_v, last_v, deepest, strict=True):
        footprint = depth[c : d + 1, a : b + 1]
        assert footprint.size == 0 or z <= footprint.min() - FREE_SIGMAS * sigma_m + 1e-4


@given(rotations, st.tuples(*[st.integers(-300, 300)] * 3), st.integers(0, 1000))
@settings(max_examples=20, deadline=None)
def test_a_motion_by_whole_cells_moves_the_evidence(R: Array, cells: tuple[int, int, int], seed: int) -> None:
    rng = np.random.default_rng(seed)
    depth = with_box(wall(3.0), np.array([-0.5, -0.3, 1.2]), np.array([0.1, 0.2, 1.6]))
    start = rng.uniform(-1.0, 1.0, 3)
    here = evidence(image(depth, pose(start, R), 0.05), CELL_M, 4.0)
    there = evidence(image(depth, pose(start + CELL_M * np.array(cells), R), 0.05), CELL_M, 4.0)
    np.testing.assert_array_equal(there.low, here.low + cells)
    differing = (there.log_odds != here.log_odds).sum()
    assert differing <= 0.01 * np.count_nonzero(here.log_odds)  # rounding at the limits of cells


@given(rotations, positions, st.floats(1.0, 3.0))
@settings(max_examples=20, deadline=None)
def test_the_points_of_pixels_are_in_occupied_cells(R: Array, position: Array, depth_m: float) -> None:
    depth = image(wall(depth_m), pose(np.array(position), R))
    found = evidence(depth, CELL_M, 4.0)
    corners = in_camera(found, np.asarray(found.log_odds > 0.0), depth.T_odom_cam)
    assert (corners[..., 2].min(axis=1) <= depth_m + 1e-4).all()
    assert (corners[..., 2].max(axis=1) >= depth_m - 1e-4).all()
    assert (
        len(corners) > 0.6 * (CAMERA.width / CAMERA.K[0, 0]) * (CAMERA.height / CAMERA.K[1, 1]) * (depth_m / 0.1) ** 2
    )


@pytest.mark.parametrize("yaw_rad", [0.0, 0.4, 0.785, 2.0])
def test_little_more_than_the_footprint_must_be_in_front(yaw_rad: float) -> None:
    """Cells beside an unknown half of the image are free from a seventh of a footprint on."""
    depth = wall(6.0, EUROC_HALF)
    depth[:, :188] = 0.0
    T = pose((0.02, 0.03, 0.04), exp_so3(np.array([0.0, 0.0, yaw_rad])) @ FORWARDS)
    found = evidence(image(depth, T, 0.0, EUROC_HALF), CELL_M, 4.0)
    corners, K = in_camera(found, np.ones_like(found.log_odds, bool), T), EUROC_HALF.K
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = (K[axis, axis] * corners[..., axis] / corners[..., 2] + K[axis, 2] for axis in (0, 1))
    width = u.max(axis=1) - u.min(axis=1)
    inside = (u.max(axis=1) < 375.0 - 0.4 * width) & (np.abs(v - K[1, 2]).max(axis=1) < 119.0 - width)
    near = (corners[..., 2].min(axis=1) > 0.8) & (corners[..., 2].max(axis=1) < 3.8)
    beside = near & inside & (u.min(axis=1) > 191.0 + 0.15 * width)
    assert beside.sum() > 1000
    assert found_free(found).ravel()[beside].all()


def test_an_error_of_the_depth_widens_what_is_unknown() -> None:
    sure, unsure = (evidence(image(wall(3.05), pose((0.0, 0.0, 0.0)), sigma), CELL_M, 4.0) for sigma in (0.0, 0.2))
    assert value_at(sure, (2.75, 0.05, 0.05)) < 0.0
    assert value_at(unsure, (2.75, 0.05, 0.05)) == 0.0
    assert value_at(unsure, (2.45, 0.05, 0.05)) < 0.0
    assert 0.0 < value_at(unsure, (3.05, 0.05, 0.05)) < 0.2 * value_at(sure, (3.05, 0.05, 0.05))


@pytest.mark.parametrize("diameter_m", [0.02, 0.04, 0.08])
@pytest.mark.parametrize("distance_m", [1.0, 2.0, 3.0, 3.9])
def test_poles_are_occupied_at_any_pixel(diameter_m: float, distance_m: float) -> None:
    for side in np.linspace(-0.5, 0.5, 12):
        depth = with_pole(wall(6.0, EUROC_HALF), distance_m, diameter_m, EUROC_HALF, side)
        if not (depth < 5.0).any():  # thinner than a pixel, between two
            continue
        surface = depth[depth < 5.0].min()
        found = evidence(image(depth, pose((0.013, 0.0, 0.013)), 0.0, EUROC_HALF), CELL_M, 4.0)
        near = [value_at(found, (0.013 + surface, -side + y, 0.05)) for y in (-0.02, 0.02)]
        assert max(near) > 0.0  # a pole at a limit of cells may be in either


@pytest.mark.parametrize("cell_m, range_m", [(0.05, 4.0), (0.1, 10.0), (0.2, 10.0)])
def test_other_cells_and_ranges(cell_m: float, range_m: float) -> None:
    z = 0.9 * range_m + 0.5 * cell_m
    z = np.floor(z / cell_m) * cell_m + 0.5 * cell_m
    found = evidence(image(wall(z, EUROC_HALF), pose((0.0, 0.0, 0.0)), 0.0, EUROC_HALF), cell_m, range_m)
    assert value_at(found, (z, 0.01, 0.01), cell_m) == pytest.approx(OCCUPIED_LOG_ODDS)
    assert value_at(found, (z - cell_m, 0.01, 0.01), cell_m) == pytest.approx(FREE_LOG_ODDS)
    assert value_at(found, (0.5 * z, 0.01, 0.01), cell_m) == pytest.approx(FREE_LOG_ODDS)


def test_nothing_is_said_beyond_the_range() -> None:
    found = evidence(image(wall(8.0), pose((0.0, 0.0, 0.0))), CELL_M, 4.0)
    assert not (found.log_odds > 0.0).any()
    assert in_camera(found, found_free(found), pose((0.0, 0.0, 0.0)))[..., 2].max() <= 4.0 + 1e-6
    assert value_at(found, (3.85, 0.05, 0.05)) < 0.0


def test_an_image_without_depth_says_nothing() -> None:
    assert evidence(image(wall(0.0), pose((0.0, 0.0, 0.0))), CELL_M, 4.0).log_odds.size == 0
