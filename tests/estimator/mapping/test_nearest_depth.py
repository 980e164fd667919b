"""Least values in windows of images."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from dronevio.estimator.mapping.nearest_depth import NearestDepths


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
        numbers = np.full(u.shape, image_number, np.int32)
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
    radius, number = np.array([1, 2, 3, 2, 2, 2], np.int32), np.array([0, 1, 1, 0, 1, 1], np.int32)
    # Row 10, column 10 is 211; row 9, column 9 is 190, and so on; the smallest window of the first image reaches 1 px
    assert windows.at(at, at, radius, number).tolist() == [190, 1169, 1148, 0, 0, 1001]
