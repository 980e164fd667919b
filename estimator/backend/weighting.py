"""Weights of image observations: the variance factor of their noise, and thresholds of the robust loss."""

import numpy as np

from dronevio.estimator.backend.reprojection import MEDIAN_CHI2_2DOF
from dronevio.models.arrays import Array, Integers


def variance_factor(squared: Array) -> float:
    """Return by how much the variance of image observations exceeds the assumed one; 1 where it does not.

    It is the a-posteriori variance of unit weight, estimated from the median: if more than half of the residuals exceed
    the median of their distribution, the noise is larger than assumed.

    Args:
        squared: (N,) Squared residuals in units of the assumed variance.
    """
    return max(1.0, median(squared) / MEDIAN_CHI2_2DOF) if len(squared) > 0 else 1.0


def image_variance(squared: Array, landmark: Integers) -> float | None:
    """Return the variance of image observations relative to the assumed one, or None where it is not observable.

    In contrast to `variance_factor` it may be below 1, and counts the redundancy of the observations: three coordinates
    of each landmark are fitted to them.

    Args:
        squared: (N,) Squared residuals in units of the assumed variance.
        landmark: (N,) Landmark of each observation.
    """
    equations, unknowns = 2 * len(squared), 3 * len(np.unique(landmark))
    if equations <= unknowns:
        return None
    return median(squared) / MEDIAN_CHI2_2DOF * equations / (equations - unknowns)


def robust_thresholds(squared: Array, keyframe: Integers, robust_sigmas: float) -> Array:
    """Return the residuals (N,) at which Cauchy's loss halves the weight, in assumed standard deviations.

    The threshold scales with the median residual of the keyframe: where most residuals of a keyframe are large, its
    pose is inaccurate and none of its observations is an outlier.

    Args:
        squared: (N,) Squared residuals in units of the assumed variance.
        keyframe: (N,) Keyframe of each observation.
        robust_sigmas: Threshold where the median residual is one standard deviation or less.
    """
    median = np.sqrt(group_medians(keyframe, squared))
    return np.asarray(robust_sigmas * np.maximum(1.0, median))


def group_medians(group: Integers, values: Array) -> Array:
    """Return for each of some values (N,) the median (N,) of the values of the same group (N,)."""
    order = np.argsort(group, kind="stable")  # fast, because the groups are sorted in most cases
    bounds = np.flatnonzero(np.diff(group[order])) + 1
    parts = np.split(values[order], bounds)
    medians = np.empty(len(values))
    medians[order] = np.repeat([median(part) for part in parts], [len(part) for part in parts])
    return medians


def median(values: Array) -> float:
    """Return the median of values (N,), NaN for none; faster than `numpy.median`."""
    if not len(values):
        return float("nan")
    low, high = (len(values) - 1) // 2, len(values) // 2
    ordered = np.partition(values, (low, high))
    return float(0.5 * (ordered[low] + ordered[high]))
