"""The margin for the error of the estimate relative to the local map, by the growth of its covariance."""

from collections import deque
from math import sqrt

import numpy as np

from dronevio.models.arrays import Array

_MEMORY_NS = 4_000_000_000  # age of the local map around the vehicle
_SIGMAS, _LARGEST_M = 2.0, 0.15


class RelativeMargin:
    """Standard deviations of the position relative to where it was when the local map was seen."""

    def __init__(self) -> None:
        """Begin without an estimate."""
        self._variances: deque[tuple[int, float]] = deque()

    def add(self, t_ns: int, covariance: Array | None) -> float:
        """Return the margin at a time [m].

        Args:
            t_ns: Time [ns], not before that of the last call.
            covariance: (15, 15) Covariance of the state, see `NavState`; None if it is not known, without a margin.
        """
        if covariance is None:
            return 0.0
        variance = float(np.linalg.eigvalsh(covariance[3:6, 3:6])[-1])
        self._variances.append((t_ns, variance))
        while t_ns - self._variances[0][0] > _MEMORY_NS:
            self._variances.popleft()
        growth = variance - min(each for _, each in self._variances)
        return min(_SIGMAS * sqrt(growth), _LARGEST_M)
