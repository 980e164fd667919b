"""A box of cells of the lattice with the log-odds of being occupied."""

from dataclasses import dataclass

import numpy as np

from dronevio.estimator.mapping.evidence import Evidence
from dronevio.models.arrays import Floats, Integers
from dronevio.models.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid

FREE_BELOW, OCCUPIED_ABOVE = -0.7, 0.7
LEAST, MOST = -2.0, 3.5


@dataclass(eq=False)
class LogOdds:
    """Log-odds of the cells of a box of the lattice, which accumulate evidence."""

    low: Integers
    """(3,) Index of the first cell of the box in the lattice."""
    values: Floats
    """(X, Y, Z) Log-odds of being occupied; 0 where nothing is known."""

    def add(self, evidence: Evidence) -> None:
        """Add the evidence about the cells of the box."""
        first = np.maximum(self.low, evidence.low)
        last = np.minimum(self.low + self.values.shape, evidence.low + evidence.log_odds.shape)
        if np.any(last <= first):
            return
        own = tuple(slice(a, b) for a, b in zip(first - self.low, last - self.low, strict=True))
        other = tuple(slice(a, b) for a, b in zip(first - evidence.low, last - evidence.low, strict=True))
        self.values[own] = np.clip(self.values[own] + evidence.log_odds[other], LEAST, MOST)

    def moved(self, low: Integers) -> "LogOdds":
        """Return a box of the same size at another index, unknown where this one does not reach."""
        new = LogOdds(low, np.zeros_like(self.values))
        new.add(Evidence(self.low, self.values))
        return new

    def grid(self, cell_m: float) -> OccupancyGrid:
        """Return the states of the cells."""
        states = np.full(self.values.shape, UNKNOWN, np.uint8)
        states[self.values <= FREE_BELOW] = FREE
        states[self.values >= OCCUPIED_ABOVE] = OCCUPIED
        return OccupancyGrid(cell_m * self.low.astype(np.float64), cell_m, states)
