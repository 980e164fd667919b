"""Holes of depth images: what they free, and what they may hide."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dronevio.estimator.mapping.evidence import FREE_LOG_ODDS, evidence
from dronevio.estimator.mapping.holes import HIDDEN_M, HOLE_PX, Band, without_holes
from dronevio.models.arrays import Array, Floats
from dronevio.models.rotation import exp_so3
from tests.estimator.mapping.scenes import (
    CELL_M,
    EUROC_HALF,
    FORWARDS,
    found_free,
    image,
    in_camera,
    pose,
    value_at,
    wall,
    with_pole,
)

rotations = st.tuples(*[st.floats(-3.0, 3.0)] * 3).map(lambda w: exp_so3(np.array(w)))


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


@pytest.mark.parametrize("yaw_rad", [0.0, 0.3, 1.0])
def test_the_rims_of_a_stripe_that_may_hide_a_thing_are_not_freed(yaw_rad: float) -> None:
    """At 1.31 to 1.83 m, 4 cm are at least 5 px wide, as the stripe is; cells of 5 cm are seen beside it."""
    depth, K = wall(3.95, EUROC_HALF), EUROC_HALF.K
    T = pose((0.02, 0.03, 0.04), exp_so3(np.array([0.0, 0.0, yaw_rad])) @ FORWARDS)
    depth[:, 185:190] = 0.0
    found = evidence(image(depth, T, 0.0, EUROC_HALF), 0.05, 4.0)
    corners = in_camera(found, found_free(found), T, 0.05)
    u, end_m = K[0, 0] * corners[..., 0] / corners[..., 2] + K[0, 2], corners[..., 2].max(axis=1)
    beside_px = np.maximum(u.min(axis=1) - 189.5, 184.5 - u.max(axis=1))[(end_m > 1.31) & (end_m < 1.83)]
    assert 0.5 <= beside_px.min() < 3.0


@pytest.mark.parametrize("width_px", [3, 6, 10])
def test_a_hole_at_the_edge_of_the_image_is_not_freed(width_px: int) -> None:
    """It goes on beyond the edge, so that it may be wide."""
    depth, K, T = wall(3.95, EUROC_HALF), EUROC_HALF.K, pose((0.0, 0.0, 0.0))
    holed = with_hole(depth, slice(0, width_px), slice(0, 240))
    leftmost_px = []
    for each in (depth, holed):
        found = evidence(image(each, T, 0.0, EUROC_HALF), 0.05, 4.0)
        corners = in_camera(found, found_free(found), T, 0.05)
        u = K[0, 0] * corners[..., 0] / corners[..., 2] + K[0, 2]
        leftmost_px.append(u.min(axis=1))
    known, unknown = leftmost_px
    assert (known < width_px - 0.5).sum() > 10
    assert unknown.min() >= width_px - 0.5


@pytest.mark.parametrize("disc_px", [2, 3, 4, 5])
def test_half_of_a_disc_may_lie_beyond_the_edge_of_the_image(disc_px: int) -> None:
    """A stripe that is a pixel narrower than the disc is closed inside the image, not at its edge."""
    values, width_px = np.full((60, 80), 1000, np.uint16), 2 * disc_px
    values[:, :width_px] = values[:, 40 : 40 + width_px] = 0
    (closed,) = without_holes(values, values > 0, [Band(0.5, 1.0, disc_px)])
    assert not closed[:, :width_px].any()
    assert (closed[disc_px:-disc_px, width_px:] == 1000).all()


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
