"""Settings of the dense map."""

from dataclasses import dataclass
from typing import Annotated

from dronevio.models.ranges import Range, Settings


@dataclass(frozen=True)
class DenseMapConfig(Settings):
    """Settings of the dense map."""

    cell_m: Annotated[float, Range(0.01, 1.0)] = 0.1
    """Side of the cells [m]."""
    range_m: Annotated[float, Range(0.5, 100.0)] = 4.0
    """Largest depth that enters the map [m]."""
    rate_hz: Annotated[float, Range(0.1, 100.0)] = 10.0
    """Rate of depth images [Hz]; frames between them are left out."""
    submap_m: Annotated[float, Range(0.5, 1000.0)] = 6.0
    """Length of the path after which another submap begins [m]: within a submap, the drift is not corrected."""
    memory_mb: Annotated[float, Range(0.0, 100_000.0)] = 32.0
    """Memory of ended submaps beyond which the oldest are moved to a temporary folder [MB]."""
