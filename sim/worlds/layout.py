"""Layouts: the parts of a world before painting, lighting and conversion to MuJoCo."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from dronevio.models.arrays import Array
from dronevio.sim.appearance.cutouts import Print
from dronevio.sim.appearance.lightmap import AreaLight
from dronevio.sim.appearance.solids import Box, Face, Surface
from dronevio.sim.paths.space import Gate

Poses = Callable[[Array], Array]
"""Function from times (M,) since the start of the flight [s] to poses (M, 4, 4) in the world."""
Difficulty = Literal["normal", "hard"]

_FLAT_M = 0.01  # highest object on the floor that is no obstacle
ROUTE_CLEARANCE_M = 0.6
"""Smallest clearance of the route of a world [m]."""


@dataclass(frozen=True, eq=False)
class MovingObject:
    """A moving object, whose boxes are both visible and solid; planned paths avoid its lane."""

    name: str
    """Name of the object and of its body in the model."""
    boxes: tuple[Box, ...]
    """Boxes of the object in its own frame."""
    poses: Poses
    """Pose of the object as a function of time."""


@dataclass(frozen=True, eq=False)
class Mirror:
    """A reflecting floor, which shows its texture and a reflection."""

    face: Face
    """Rectangle and texture of the floor, facing up with its right edge along x."""
    reflectance: float
    """Fraction of the light that is reflected, 0 to 1."""


@dataclass(frozen=True, eq=False)
class Layout:
    """Geometry of a world."""

    low: Array
    """(3,) Lower corner of the flight space [m]; z is the floor."""
    high: Array
    """(3,) Upper corner of the flight space [m]; z is the ceiling, or the largest height outdoors."""
    shell: tuple[Surface, ...]
    """Surfaces that bound the view: floor, walls and ceiling, or ground and sky; also other surfaces that are no
    boxes."""
    boxes: tuple[Box, ...]
    """All other visible boxes; faces against the bounds of the flight space are omitted."""
    obstacles: tuple[Box, ...]
    """Keep-out boxes of path planning around whole objects, between whose parts no path leads; their paint is not used.
    What protrudes from them is kept clear of, too."""
    lights: tuple[AreaLight, ...]
    """Area lights of the world."""
    pad: Array
    """(3,) Centre of the landing pad on the floor [m]."""
    free_box: Array
    """(2, 3) Lower and upper corner of a space free of obstacles [m]; its centre is above the landing pad."""
    route: Array
    """(R, 3) Closed tour through the whole world that starts above the landing pad [m]; its legs keep
    `ROUTE_CLEARANCE_M` of clearance."""
    walled: bool = True
    """Whether walls and a ceiling bound the space; outdoors there is only the ground."""
    shading: tuple[Box, ...] | None = None
    """Boxes that cast shadows; by default all boxes without emission. A few coarse boxes are much faster."""
    illumination: float = 1.0
    """Illumination relative to a well-lit room."""
    scattered: float = 1.0
    """Scattered light relative to that of a well-lit room, in addition to the light that comes straight from lamps."""
    moving: tuple[MovingObject, ...] = ()
    """Moving objects of the world."""
    lanes: tuple[Box, ...] = ()
    """Lanes of the moving objects, which planned paths avoid."""
    mirror: Mirror | None = None
    """The reflecting floor, if there is one."""
    prints: tuple[Print, ...] = ()
    """Cutouts with shared textures that include their lighting, such as trunks and leaves."""
    gates: tuple[Gate, ...] = ()
    """Gates of a race course in the order of passage."""
    filling: tuple[Box, ...] = ()
    """Boxes that fill visible surfaces other than those of boxes, such as trunks, drums and the core of a building."""

    @property
    def solids(self) -> tuple[Box, ...]:
        """What is solid, apart from the bounds and the moving objects: the visible boxes and what fills other surfaces.

        Contacts, shortest paths and the truth of maps derive from these boxes. Mats on the floor are no obstacles.
        """
        level = self.low[2] + _FLAT_M
        return tuple(box for box in (*self.boxes, *self.filling) if box.centre[2] + np.abs(box.R[2]) @ box.half > level)


@dataclass(frozen=True)
class WorldBuilder:
    """Description and layout function of a world."""

    description: str
    """Short description for listings."""
    layout: Callable[[np.random.Generator], Layout]
    """Function that draws the layout from a random generator."""
    difficulty: Difficulty = "normal"
    """Whether the world has enough features for visual estimators, or is difficult by design."""
    layout_in_daylight: Callable[[np.random.Generator, np.random.Generator], Layout] | None = None
    """Function that draws the layout from a first random generator, and sun and weather from a second, for a world
    under the sky; None indoors."""
