"""Online estimation of the random walk of a sensor's bias.

Biases follow the temperature, errors of scale and alignment act like a bias that varies with the motion, and a data
sheet states neither. If the random walk has the assumed density w, the estimate of a bias changes between two times by
as much as it gains certainty, plus what the bias walks meanwhile:

    E[(b₁ - b₀)²] = P₀ - P₁ + w² (t₁ - t₀)

(the innovations are white: Mehra, "On the identification of variances and adaptive Kalman filtering", IEEE TAC 1970).
The density is the most probable one, given the changes in the last intervals. A trend, as of an IMU that warms up,
counts as the walk that explains it.
"""

from dataclasses import dataclass

import numpy as np

from dronevio.models.arrays import Array

INTERVAL_S = 3.0
"""Smallest length of an interval [s]. Longer ones show a trend more clearly, but later."""
MEMORY = 10.0
"""Number of intervals that count, with exponential forgetting."""
LEVELS = 41
"""Number of densities that are compared."""
MAX_NORMALIZED_SQUARE = 25.0
"""Ratio of a squared change to its expectation from which on a change tells nothing, as a jump of the bias."""


@dataclass(frozen=True, eq=False)
class _Known:
    """What was known about a bias at the beginning of an interval."""

    t_ns: int
    bias: Array  # (3,)
    variance: Array  # (3,)


class RandomWalkEstimator:
    """Estimates the density of the random walk of one sensor's bias."""

    def __init__(self, smallest: float, max_factor: float) -> None:
        """Create an estimator.

        Args:
            smallest: Smallest density, with which it begins.
            max_factor: Largest ratio of the estimate to it.
        """
        self._smallest = smallest
        # Densities relative to the smallest, their prior, as if an interval had shown the smallest, and likelihood
        self._factors = np.geomspace(1.0, max_factor, LEVELS)
        self._log_prior = -1.5 * (np.log(self._factors**2) + self._factors**-2.0)
        self._log_likelihood = np.zeros(LEVELS)
        self._known: _Known | None = None  # None before the first bias

    @property
    def density(self) -> float:
        """Most probable density, in the unit of the smallest."""
        return self._smallest * float(self._factors[np.argmax(self._log_prior + self._log_likelihood)])

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
        gained, assumed = known.variance - variance, self.density**2 * duration_s
        seen = np.clip((gained + assumed) / assumed, 1e-3, 1.0)
        walked = (self._smallest * self._factors[:, None]) ** 2 * duration_s
        expected = np.maximum(gained, 0.0) + seen * walked
        normalized_square = np.minimum((bias - known.bias) ** 2 / expected, MAX_NORMALIZED_SQUARE)
        shown = -0.5 * (np.log(expected) + normalized_square) @ seen
        self._log_likelihood = (1.0 - 1.0 / MEMORY) * self._log_likelihood + shown
        self._known = now
