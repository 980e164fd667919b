"""Results of performance measurements, with the bounds that they have to meet."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class PerformanceFigure:
    """A measured value and its bound."""

    name: str
    """Name of the measured quantity."""
    value: float
    """Measured value in `unit`."""
    unit: str
    """Unit of value and bound."""
    bound: float
    """Required smallest or largest value in `unit`."""
    sense: Literal["at most", "at least"]
    """Whether the bound is the largest or the smallest allowed value."""
    method: str
    """Description of the measurement."""

    @property
    def ratio(self) -> float:
        """Ratio of the value to the bound."""
        return self.value / self.bound

    @property
    def met(self) -> bool:
        """Whether the value meets the bound."""
        return self.value <= self.bound if self.sense == "at most" else self.value >= self.bound
