"""Evidence of depth images: what is free, occupied and left unknown."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dronevio.estimator.mapping.evidence import (
    FREE_LOG_ODDS,
    FREE_SIGMAS,
    OCCUPIED_LOG_ODDS,
    Evidence,
    evidence,
)
from dronevio.estimator.mapping.holes import HIDDEN_M, HOLE_PX
from dronevio.estimator.mapping.nearest_depth import NearestDepths
from dronevio.models.arrays import Array, Floats, Mask
from dronevio.models.rotation import exp_so3
from tests.estimator.mapping.scenes import CAMERA, EUROC_HALF, FORWARDS, image, pose, wall, with_box, with_pole

CELL_M = 0.1


def in_camera(found: Evidence, selected: Mask, T_odom_cam: Array, cell_m: float = CELL_M) -> Array:
    """Return all corners (N, 8, 3) of selected cells in the camera frame."""
    offsets = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    corners = ((np.argwhere(selected) + found.low)[:, None] + offsets) * cell_m
    return np.asarray((corners - T_odom_cam[:3, 3]) @ T_odom_cam[:3, :3])


def value_at(found: Evidence, point: tuple[float, float, float], cell_m: float = CELL_M) -> float:
    return float(found.log_odds[tuple(np.floor(np.array(point) / cell_m).astype(int) - found.low)])


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


def found_free(found: Evidence) -> Mask:
    return np.asarray(found.log_odds < 0.0)


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


def test_a_pole_of_unknown_depth_in_front_of_a_known_wall_is_not_freed() -> None:
    with_it = with_pole(wall(3.95), 2.0, 0.02)
    unknown = np.where(with_it < 3.0, 0.0, with_it)
    found = evidence(image(unknown, pose((0.0, 0.0, 0.0))), CELL_M, 4.0)
    for z in (1.05, 1.95, 2.05):
        assert value_at(found, (z, 0.0, 0.05)) == 0.0
    assert value_at(found, (0.55, 0.0, 0.05)) < 0.0  # where 4 cm would be 8 pixels wide
    assert value_at(found, (2.05, 0.35, 0.05)) < 0.0


def with_hole(depth_m: Floats, columns: slice, rows: slice) -> Floats:
    holed = depth_m.copy()
    holed[rows, columns] = 0.0
    return holed


def test_rejected_pixels_of_a_wall_do_not_block_what_is_in_front_of_it() -> None:
    whole = wall(3.05, EUROC_HALF)
    holed = np.where(np.random.default_rng(0).random(whole.shape) < 0.3, np.float32(0.0), whole)
    free, free_with_holes = (
        found_free(evidence(image(depth, pose((0.0, 0.0, 0.0)), 0.02, EUROC_HALF), CELL_M, 4.0))
        for depth in (whole, holed)
    )
    assert (free & ~free_with_holes).sum() < 0.001 * free.sum()
    assert not (free_with_holes & ~free).any()


def with_stripe(depth_m: Floats, width_px: float, angle_deg: float, off_px: float = 0.0) -> Floats:
    """Return a depth image without depths in a stripe beside the middle of the image; upright at 0°."""
    v, u = np.indices(depth_m.shape)
    K, angle = EUROC_HALF.K, np.deg2rad(angle_deg)
    away_px = (u - K[0, 2]) * np.cos(angle) - (v - K[1, 2]) * np.sin(angle) - off_px
    return np.where(np.abs(away_px) <= 0.5 * width_px, np.float32(0.0), depth_m)


def in_front_of(depth_m: Floats, x_m: float) -> float:
    """Return the evidence of the cell around (x, 0, 0.05) about a depth image of a camera at 0 that looks along x."""
    return value_at(evidence(image(depth_m, pose((0.0, 0.0, 0.0)), 0.0, EUROC_HALF), CELL_M, 4.0), (x_m, 0.0, 0.05))


@given(st.floats(0.0, 180.0), st.floats(-0.5, 0.5), st.integers(4, 29))
@settings(max_examples=60, deadline=None)
def test_a_stripe_that_may_hide_a_thing_is_not_freed_at_any_angle(angle_deg: float, off_px: float, cell: int) -> None:
    """It is as wide as a thing at the far side of the cell, or as a pole of a pixel with the bands of the matcher."""
    width_px = max(EUROC_HALF.K[0, 0] * HIDDEN_M / (CELL_M * (cell + 1)), 4.5)
    depth = with_stripe(wall(3.95, EUROC_HALF), width_px, angle_deg, off_px)
    assert in_front_of(depth, CELL_M * (cell + 0.5)) == 0.0


@given(st.floats(0.0, 180.0), st.floats(-0.5, 0.5), st.integers(4, 17))
@settings(max_examples=60, deadline=None)
def test_a_stripe_that_is_much_thinner_than_a_thing_is_freed(angle_deg: float, off_px: float, cell: int) -> None:
    """Things that are nearer than 0.83 m are as wide as there."""
    width_px = 0.6 * EUROC_HALF.K[0, 0] * HIDDEN_M / max(CELL_M * (cell + 1), 0.83)
    depth = with_stripe(wall(3.95, EUROC_HALF), width_px, angle_deg, off_px)
    assert (depth == 0.0).sum() > 150.0 * width_px
    assert in_front_of(depth, CELL_M * (cell + 0.5)) == pytest.approx(FREE_LOG_ODDS)


@pytest.mark.parametrize(
    "width_px, free_to_m",
    [(4, 1.832), (5, 1.308), (6, 1.308), (7, 1.017), (8, 1.017), (9, 0.832), (10, 0.832), (11, 0.0), (40, 0.0)],
)
@pytest.mark.parametrize("behind_m", [0.0, 0.05])
def test_a_stripe_is_freed_as_far_as_a_thing_would_be_wider(width_px: int, free_to_m: float, behind_m: float) -> None:
    """With f = 229 px, 4 cm are 5, 7, 9 and 11 px wide at 1.832, 1.309, 1.018 and 0.833 m, where a cell must end."""
    depth = wall(3.95, EUROC_HALF)
    depth[:, 187 - (width_px - 1) // 2 : 188 + width_px // 2] = 0.0
    found = evidence(image(depth, pose((-behind_m, 0.0, 0.0)), 0.0, EUROC_HALF), CELL_M, 4.0)
    for cell in range(5, 30):
        expected = FREE_LOG_ODDS if CELL_M * (cell + 1) + behind_m < free_to_m else 0.0
        assert value_at(found, (CELL_M * (cell + 0.5), 0.0, 0.05)) == pytest.approx(expected), cell


@pytest.mark.parametrize("width_px", [3, 8])
def test_a_hole_at_the_edge_of_the_image_is_not_freed(width_px: int) -> None:
    """It goes on beyond the edge, so that it may be wide."""
    depth, K, T = wall(3.95, EUROC_HALF), EUROC_HALF.K, pose((0.0, 0.0, 0.0))
    holed = with_hole(depth, slice(0, width_px), slice(0, 240))
    leftmost_px = []
    for each in (depth, holed):
        found = evidence(image(each, T, 0.0, EUROC_HALF), 0.05, 4.0)
        corners = in_camera(found, found_free(found), T, 0.05)
        u = K[0, 0] * corners[..., 0] / corners[..., 2] + K[0, 2]
        leftmost_px.append(u.min(axis=1)[corners[..., 2].max(axis=1) < 1.0])
    known, unknown = leftmost_px
    assert (known < width_px - 0.5).sum() > 10
    assert unknown.min() >= width_px - 0.5


@given(rotations, st.integers(0, 1000), st.floats(0.0, 0.6), st.integers(1, 30))
@settings(max_examples=25, deadline=None)
def test_a_wider_hole_never_frees_more_in_front_of_a_wall(R: Array, seed: int, share: float, stripes: int) -> None:
    """Holes of all sizes: single pixels, and stripes of up to 12 pixels."""
    rng = np.random.default_rng(seed)
    narrow = np.where(rng.random((240, 376)) < 0.2 * share, np.float32(0.0), wall(3.95, EUROC_HALF))
    for _ in range(stripes):
        narrow = with_stripe(narrow, rng.uniform(0.0, 12.0), rng.uniform(0.0, 180.0), rng.uniform(-150.0, 150.0))
    grown = cv2.erode(narrow, np.ones((2, 3), np.uint8))
    wide = np.where(rng.random(narrow.shape) < share, grown, narrow)
    free, free_of_wider = (
        found_free(evidence(image(depth, pose((0.0, 0.0, 0.0), R), 0.02, EUROC_HALF), CELL_M, 4.0))
        for depth in (narrow, wide)
    )
    assert not (free_of_wider & ~free).any()


@pytest.mark.parametrize("side_px, expected", [(HOLE_PX - 2, FREE_LOG_ODDS), (HOLE_PX + 2, 0.0)])
def test_only_a_small_hole_is_closed(side_px: int, expected: float) -> None:
    """A hole that is seen in the middle of the image, wider than the footprint of the cell."""
    columns, rows = (slice(c - side_px // 2, c - side_px // 2 + side_px) for c in (187, 119))
    depth = image(with_hole(wall(3.95, EUROC_HALF), columns, rows), pose((0.0, 0.0, 0.0)), 0.0, EUROC_HALF)
    assert value_at(evidence(depth, 0.05, 4.0), (2.525, 0.0, 0.0), 0.05) == pytest.approx(expected)


def test_a_hole_has_the_nearest_depth_beside_it() -> None:
    depth = wall(3.95, EUROC_HALF)
    depth[:, 194:] = 2.0
    holed = with_hole(depth, slice(182, 193), slice(114, 125))
    found = evidence(image(holed, pose((0.0, 0.0, 0.0)), 0.0, EUROC_HALF), 0.05, 4.0)
    assert value_at(found, (1.525, 0.0, 0.0), 0.05) == pytest.approx(FREE_LOG_ODDS)
    assert value_at(found, (3.025, 0.0, 0.0), 0.05) == 0.0


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


@given(st.integers(0, 1000), st.integers(30, 45), st.integers(30, 45), st.integers(1, 12))
@settings(max_examples=50, deadline=None)
def test_windows_reach_as_far_as_asked(seed: int, height: int, width: int, least_px: int) -> None:
    """Of two images, each with a size of windows of its own."""
    rng = np.random.default_rng(seed)
    images = rng.integers(1, 60000, (2, height, width)).astype(np.uint16)
    most_px = [least_px, least_px + int(rng.integers(0, 8))]
    windows = NearestDepths.of((values, least_px, most) for values, most in zip(images, most_px, strict=True))
    v, u = (axis.ravel().astype(np.int32) for axis in np.indices((height, width)))
    for image_number, (values, most) in enumerate(zip(images, most_px, strict=True)):
        radius = int(rng.integers(1, most + 1))
        numbers = np.full(u.shape, image_number)
        least = windows.at(u, v, np.full(u.shape, radius, np.int32), numbers)
        for column, row, value in zip(u, v, least, strict=True):
            square = values[max(0, row - radius) : row + radius + 1, max(0, column - radius) : column + radius + 1]
            assert value <= square.min()
            assert value == 0 or square.size == (2 * radius + 1) ** 2
        if least_px == most and 2 * radius + 1 < min(height, width) - 16:
            assert least.max() > 0
        assert not windows.at(u, v, np.full(u.shape, 10**6, np.int32), numbers).any()


def test_a_window_of_few_pixels_is_exact() -> None:
    values = np.arange(1, 401, dtype=np.uint16).reshape(20, 20)
    windows = NearestDepths.of([(values, 1, 1), (values + np.uint16(1000), 2, 3)])
    at = np.array([10, 10, 10, 10, 1, 2], np.int32)
    radius, number = np.array([1, 2, 3, 2, 2, 2], np.int32), np.array([0, 1, 1, 0, 1, 1])
    # Row 10, column 10 is 211; row 9, column 9 is 190, and so on; the smallest window of the first image reaches 1 px
    assert windows.at(at, at, radius, number).tolist() == [190, 1169, 1148, 0, 0, 1001]
