"""The significant length of a correction, by hand."""

import numpy as np
import pytest

from dronevio.estimator.calibration.significance import significant_length
from dronevio.models.rotation import exp_so3


@pytest.mark.parametrize(
    ("difference", "expected"),
    [
        ([2.0, 0.0, 0.0], 0.0),  # two standard deviations
        ([0.0, 0.4, 0.0], 0.4),  # four
        ([2.0, 0.4, 0.3], 0.5),  # four and three and a half; the first does not count
    ],
)
def test_components_beyond_three_sigmas_count(difference: list[float], expected: float) -> None:
    covariance = np.diag([1.0, 0.1, 0.3 / 3.5]) ** 2
    assert significant_length(np.array(difference), covariance, 3.0) == pytest.approx(expected)
    R = exp_so3(np.array([0.5, -1.2, 0.8]))
    assert significant_length(R @ difference, R @ covariance @ R.T, 3.0) == pytest.approx(expected)


def test_difference_of_correlated_parameters_is_significant() -> None:
    """Two parameters of ±1 whose difference is known to ±0.014: a difference of 0.1 counts, and a sum of 0.1 not."""
    covariance = np.array([[1.0, 0.9999], [0.9999, 1.0]])
    assert significant_length(np.array([-0.05, 0.05]), covariance, 3.0) == pytest.approx(0.05 * np.sqrt(2.0))
    assert significant_length(np.array([0.05, 0.05]), covariance, 3.0) == 0.0
