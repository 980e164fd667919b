"""What a benchmark says: a figure beside what it should be."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Figure:
    """Something measured, and what it should be."""

    name: str
    """What was measured."""
    value: float
    """How much it is."""
    unit: str
    """In what."""
    bound: float
    """How much it may be."""
    sense: Literal["at most", "at least"]
    """Which way the bound works."""
    how: str
    """What was measured exactly."""

    @property
    def ratio(self) -> float:
        """Value by bound."""
        return self.value / self.bound

    @property
    def met(self) -> bool:
        """Whether the bound is kept."""
        return self.value <= self.bound if self.sense == "at most" else self.value >= self.bound
