"""What stands and moves around the drone, as it is drawn in a recording."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dronevio.sim.world import World

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


def surroundings_of(world: World) -> Surroundings:
    """Return the outline of a simulated world, and what moves in it as large as it looks."""
    boxes = []
    for mover in world.movers:
        geoms = world.spec.body(mover.body).geoms
        vertices = np.concatenate([np.reshape(world.spec.mesh(geom.meshname).uservert, (-1, 3)) for geom in geoms])
        boxes.append(MovingBox(mover.body, vertices.min(axis=0), vertices.max(axis=0), mover.poses))
    return Surroundings(world.outline, tuple(boxes))
