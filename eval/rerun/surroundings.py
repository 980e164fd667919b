"""What stands and moves around the drone, as it is drawn in a recording."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class MovingBox:
    """Something that moves by itself, as large as a box."""

    name: str
    """What it is called."""
    low: Array
    """(3,) Least corner in its own frame [m]."""
    high: Array
    """(3,) Greatest corner in its own frame [m]."""
    poses: Callable[[Array], Array]
    """Maps times (M,) since the start of the flight [s] to poses (M, 4, 4) in the world."""


@dataclass(frozen=True, eq=False)
class Surroundings:
    """What stands and moves around the drone."""

    outline: Array
    """(L, 2, 3) Line segments [m], in the truth's world."""
    movers: tuple[MovingBox, ...] = ()
    """What moves."""


NOTHING_KNOWN = Surroundings(np.zeros((0, 2, 3)))
"""The surroundings of a flight of which nobody wrote them down."""
