"""Holes of disparity images that an occlusion explains, and what they say about the space in front of them."""

import numpy as np
import pytest

from dronevio.estimator.mapping.evidence import evidence
from dronevio.estimator.mapping.occlusion import LEAST_JUMP_PX, SLACK_PX, occluded
from dronevio.models.arrays import Floats
from dronevio.models.depth import DepthImage, Pinhole
from dronevio.models.errors import ConfigError

CAMERA = Pinhole(120, 80, np.array([[100.0, 0.0, 59.5], [0.0, 100.0, 39.5], [0.0, 0.0, 1.0]]))


def row(hole_px: int, left_px: float = 2.0, right_px: float = 10.0) -> Floats:
    """Return two surfaces with a hole between them, in three rows."""
    values = np.array([left_px] * 20 + [0.0] * hole_px + [right_px] * 20, np.float32)
    return np.tile(values, (3, 1))


@pytest.mark.parametrize(("left_px", "right_px"), [(2.0, 10.0), (10.0, 2.0)])
def test_a_hole_as_wide_as_the_jump_is_explained(left_px: float, right_px: float) -> None:
    """A jump of 8 px explains 8 px and the windows at both edges."""
    found = occluded(row(8 + SLACK_PX, left_px, right_px))
    np.testing.assert_array_equal(found[1], [0.0] * 20 + [10.0] * (8 + SLACK_PX) + [0.0] * 20)
    assert not occluded(row(9 + SLACK_PX, left_px, right_px)).any()


def test_a_hole_on_one_surface_or_at_the_border_is_not_explained() -> None:
    assert not occluded(row(3, 10.0, 9.9 + LEAST_JUMP_PX)).any() and occluded(row(3, 10.0, 10.1 + LEAST_JUMP_PX)).any()
    at_border = row(8)
    at_border[:, :20] = 0.0
    assert not occluded(at_border).any() and not occluded(np.zeros((3, 9), np.float32)).any()


def depth_image(least_m: float | None) -> DepthImage:
    """Return a wall at 3 m with a hole that is 20 px wide, straight ahead of a camera that looks along x."""
    T = np.eye(4)
    T[:3, :3] = [[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]
    depth = np.full((80, 120), 3.0, np.float32)
    depth[:, 50:70] = 0.0
    sigma = np.where(depth > 0.0, np.float32(0.01), np.float32(0.0))
    least = None if least_m is None else np.where(depth > 0.0, np.float32(0.0), np.float32(least_m))
    return DepthImage(0, CAMERA, T, depth, sigma, np.zeros((80, 120), np.uint8), least)


@pytest.mark.parametrize(("least_m", "free_m"), [(None, 0.0), (2.02, 2.0), (1.52, 1.5)])
def test_space_is_free_up_to_the_least_depth_of_a_hole(least_m: float | None, free_m: float) -> None:
    found = evidence(depth_image(least_m), 0.1, 4.0)
    x = np.arange(1.0, 2.9, 0.1) + 0.05
    ahead = np.floor(np.stack([x, np.full_like(x, 0.05), np.full_like(x, 0.05)], axis=1) / 0.1).astype(int) - found.low
    log_odds = found.log_odds[tuple(ahead.T)]
    assert np.all(log_odds <= 0.0)  # a hole makes nothing occupied
    np.testing.assert_array_equal(log_odds < 0.0, x + 0.05 <= free_m + 1e-6)


def test_the_least_depth_has_the_size_of_the_image() -> None:
    image = depth_image(2.0)
    with pytest.raises(ConfigError, match="least_m"):
        DepthImage(0, CAMERA, image.T_odom_cam, image.depth_m, image.sigma_m, image.grey, np.zeros((3, 3), np.float32))
