"""The variance factor, the medians of groups and the thresholds of the robust loss."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dronevio.estimator.backend.weighting import group_medians, image_variance, robust_thresholds, variance_factor


@pytest.mark.parametrize(("sigma", "expected"), [(0.5, 1.0), (1.0, 1.0), (2.0, 4.0), (3.0, 9.0)])
def test_variance_factor_is_that_of_the_noise(sigma: float, expected: float) -> None:
    """Squared residuals of two dimensions, at the quantiles of their distribution."""
    squared = -2.0 * sigma**2 * np.log((np.arange(1001) + 0.5) / 1001)
    assert variance_factor(squared) == pytest.approx(expected, rel=1e-3)


def test_variance_factor_without_observations_is_one() -> None:
    assert variance_factor(np.zeros(0)) == 1.0


@pytest.mark.parametrize("views", [2, 3, 9])
def test_image_variance_counts_the_fitted_landmarks(views: int) -> None:
    """With V views, 2V − 3 of 2V equations are redundant, and the residuals are smaller than the noise."""
    landmark = np.repeat(np.arange(10), views)
    redundancy = (2 * views - 3) / (2 * views)
    squared = np.full(len(landmark), 0.25 * redundancy * 2.0 * np.log(2.0))  # a standard deviation of half the assumed
    assert image_variance(squared, landmark) == pytest.approx(0.25)


def test_image_variance_of_single_views_is_unknown() -> None:
    assert image_variance(np.ones(3), np.arange(3)) is None and image_variance(np.zeros(0), np.zeros(0, int)) is None


def test_threshold_grows_with_the_median_of_the_keyframe() -> None:
    squared = np.array([0.01, 0.02, 90.0, 100.0, 110.0])
    thresholds = robust_thresholds(squared, np.array([0, 0, 1, 1, 1]), robust_sigmas=1.5)
    np.testing.assert_allclose(thresholds, [1.5, 1.5, 15.0, 15.0, 15.0])


@given(st.lists(st.tuples(st.integers(0, 5), st.floats(0.0, 1e6)), max_size=60))
def test_medians_are_those_of_each_group(pairs: list[tuple[int, float]]) -> None:
    group, values = np.array([k for k, _ in pairs], dtype=np.int64), np.array([v for _, v in pairs])
    expected = [np.median(values[group == k]) for k in group]
    np.testing.assert_array_equal(group_medians(group, values), expected)
