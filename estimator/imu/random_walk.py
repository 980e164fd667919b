"""Online estimation of the random walk of a sensor's bias.

Biases follow the temperature, errors of scale and alignment act like a bias that varies with the motion, and a data
sheet states neither. Where the random walk is the assumed one, the estimate of a bias changes between two times by as
much as it gains certainty, plus what the bias walks meanwhile:

    E[(b₁ - b₀)²] = P₀ - P₁ + w² (t₁ - t₀)

(the innovations are white: Mehra, "On the identification of variances and adaptive Kalman filtering", IEEE TAC 1970).
The squared changes of the last intervals give the density w by variance components, as the white noise follows from
the residuals of the IMU (`noise`). A trend, as of an IMU that warms up, counts as the walk that explains it.
"""

import math
from dataclasses import dataclass

import numpy as np

from dronevio.models.arrays import Array

INTERVAL_S = 3.0
"""Smallest length of an interval [s]. Longer ones show a trend more clearly, but later."""
MEMORY = 10.0
"""Number of intervals that are averaged, with exponential forgetting."""
PRIOR_WEIGHT = 1.0
"""Weight of the initial density, as a number of intervals that determine the walk completely."""
MAX_NORMALIZED_SQUARE = 9.0
"""Largest ratio of a squared change to its expectation, so that a wrong bias is not taken for a walk at once."""


@dataclass(frozen=True, eq=False)
class _Known:
    """What was known about a bias at the begin of an interval."""

    t_ns: int
    bias: Array  # (3,)
    variance: Array  # (3,)


class RandomWalkEstimator:
    """Estimates the density of the random walk of one sensor's bias."""

    def __init__(self, initial: float, max_factor: float) -> None:
        """Create an estimator.

        Args:
            initial: Initial density, which is the smallest.
            max_factor: Largest ratio of the estimate to it.
        """
        self._smallest, self._max_factor = initial, max_factor
        # Sums over intervals with exponential forgetting: weighted squares of the density, weights
        self._squares = self._weight = 0.0
        self._known: _Known | None = None  # None before the first bias

    @property
    def density(self) -> float:
        """Estimated density in the unit of the initial one."""
        prior = PRIOR_WEIGHT * self._smallest**2
        estimated = math.sqrt(max(prior + self._squares, 0.0) / (PRIOR_WEIGHT + self._weight))
        return min(max(estimated, self._smallest), self._max_factor * self._smallest)

    def set_smallest(self, density: float) -> None:
        """Set the smallest density."""
        self._smallest = density

    def forget_bias(self) -> None:
        """Begin the interval anew, because the next bias changes for another reason."""
        self._known = None

    def add(self, t_ns: int, bias: Array, variance: Array) -> None:
        """Add an estimate of the bias (3,) with its variances (3,) at a time [ns], in the order of time."""
        now, known = _Known(t_ns, bias, variance), self._known
        if known is None or self._smallest <= 0.0:
            self._known = now
            return
        if (duration_s := (t_ns - known.t_ns) * 1e-9) < INTERVAL_S:
            return
        # Of the walk, what is not yet observed does not appear in the change
        walked = self.density**2 * duration_s
        gained = known.variance - variance
        seen = np.clip((gained + walked) / walked, 1e-3, 1.0)
        gained = np.maximum(gained, 0.0)
        expected = gained + seen * walked
        square = np.minimum((bias - known.bias) ** 2, MAX_NORMALIZED_SQUARE * expected)
        # Weights by the share of the walk in the change
        weight = seen * (seen * walked / expected) ** 2 / len(bias)
        kept = 1.0 - 1.0 / MEMORY
        self._squares = kept * self._squares + float(weight @ ((square - gained) / (seen * duration_s)))
        self._weight = kept * self._weight + float(weight.sum())
        self._known = now
