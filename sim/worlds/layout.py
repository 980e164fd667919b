"""A layout: the plain parts that a world is made of, before anything is painted, lit or given to MuJoCo."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from dronevio.sim.appearance.cutouts import Print
from dronevio.sim.appearance.lightmap import AreaLight
from dronevio.sim.appearance.solids import Box, Face, Surface

Array = npt.NDArray[np.float64]
Poses = Callable[[Array], Array]
"""Maps times (M,) since the start of the flight [s] to poses (M, 4, 4) in the world."""
Difficulty = Literal["normal", "hard"]

ROUTE_CLEARANCE_M = 0.6
"""How far a world's route keeps from every surface [m]."""


@dataclass(frozen=True, eq=False)
class MovingObject:
    """Something that moves by itself: seen, never touched, since paths keep away from where it goes."""

    name: str
    """What it is called; its body in the model has this name, too."""
    boxes: tuple[Box, ...]
    """What it is made of, in its own frame."""
    poses: Poses
    """Where it is, and when."""


@dataclass(frozen=True, eq=False)
class Mirror:
    """A polished floor: it shows what it is painted with, and what stands on it upside down."""

    face: Face
    """Where it is, and its pattern; it looks up, its right edge is along x."""
    reflectance: float
    """Share of the light that it reflects, 0 to 1."""


@dataclass(frozen=True, eq=False)
class Layout:
    """Where everything in a world is."""

    low: Array
    """(3,) Least corner of the space to fly in [m]; z is the floor."""
    high: Array
    """(3,) Greatest corner [m]; z is the ceiling, or how high one may fly outdoors."""
    shell: tuple[Surface, ...]
    """What bounds the view: floor, walls and ceiling, or ground and sky. Other surfaces that are no boxes go here."""
    boxes: tuple[Box, ...]
    """Everything else that is seen; faces that lie against the bounds of the space are left out."""
    obstacles: tuple[Box, ...]
    """What a drone would hit: upright or turned boxes around the things that are seen; their paint does not matter."""
    lights: tuple[AreaLight, ...]
    """What lights it."""
    pad: Array
    """(3,) Middle of the landing pad, on the floor [m]."""
    free_box: Array
    """(2, 3) Least and greatest corner of a space free of obstacles, its middle above the pad [m]."""
    route: Array
    """(R, 3) A tour through the whole world [m], from above the pad; its legs, with the one from the last point back to
    the first, keep `ROUTE_CLEARANCE_M` from every surface."""
    walled: bool = True
    """Whether walls and a ceiling bound the space; outdoors there is only the ground to hit."""
    shading: tuple[Box, ...] | None = None
    """What casts shadows; by default every box without light of its own. A few coarse boxes are lit much faster."""
    illumination: float = 1.0
    """Light that falls in, relative to a well lit room."""
    moving: tuple[MovingObject, ...] = ()
    """What moves."""
    lanes: tuple[Box, ...] = ()
    """Where it moves: paths keep out, though there is nothing to hit but what is moving."""
    mirror: Mirror | None = None
    """The floor, where it reflects."""
    prints: tuple[Print, ...] = ()
    """What shares images that bring their own light: trunks and leaves."""


@dataclass(frozen=True)
class WorldBuilder:
    """How a world comes about."""

    description: str
    """What it is, in a few words, for people."""
    layout: Callable[[np.random.Generator], Layout]
    """Draws it."""
    difficulty: Difficulty = "normal"
    """Whether a camera finds plenty to hold on to, or the world is made to be hard on it."""
