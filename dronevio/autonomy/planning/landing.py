"""Places to land: level floor that was observed, below free space that was observed."""

import cv2
import numpy as np

from dronevio.autonomy.planning.body import Body
from dronevio.autonomy.planning.known_space import LocalSpace
from dronevio.models.arrays import Array, Integers
from dronevio.models.occupancy import FREE, OCCUPIED, States

_UNEVEN_CELLS = 1  # between the levels of the floor below the body
_HALO_CELLS = 2  # unknown cells between free space and the surface, since cells at surfaces are not seen to be free


def landing_place(space: LocalSpace, position: Array, body: Body) -> Array | None:
    """Return the nearest place at the height of a position from which a body can descend straight to the floor.

    Below the whole body, the floor must have been seen, level within a cell, and the space above it must be known to be
    free but for cells at the surface.

    Args:
        space: The local map.
        position: (3,) Position [m].
        body: The body.

    Returns:
        The place (3,) [m], the position itself if it is one; None if none was observed.
    """
    grid = space.grid
    here = grid.cells(position)
    if not np.all((here >= 0) & (here < grid.states.shape)):
        return None
    floor = _floor_levels(grid.states[..., : here[2] + 1])
    reach = int(np.ceil(body.bare_radius_m / grid.cell_m))
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    known = (floor >= 0).astype(np.uint8)
    highest, lowest = (f(floor.astype(np.float32), disc) for f in (cv2.dilate, cv2.erode))
    is_level = (cv2.erode(known, disc, borderValue=0) > 0) & (highest - lowest <= _UNEVEN_CELLS)
    level = np.s_[..., int(here[2])]
    usable = np.argwhere(is_level & space.is_clear(body.bare_radius_m)[level])
    if not len(usable):
        return None
    cells = np.concatenate([usable, np.full((len(usable), 1), here[2])], axis=1)
    if np.any(np.all(cells == here, axis=1)):
        return position
    places = grid.centres(cells)
    places[:, 2] = position[2]
    nearest = places[int(np.argmin(np.linalg.norm(places - position, axis=1)))]
    return np.asarray(nearest)


def _floor_levels(states: States) -> Integers:
    """Return the level (X, Y) of the first surface below the top of columns (X, Y, Z), -1 where it was not seen."""
    down = states[..., ::-1]
    depth = down.shape[2]
    is_free, is_surface = down == FREE, down == OCCUPIED
    first = np.where(is_surface.any(axis=2), np.argmax(is_surface, axis=2), depth)
    not_free = np.where(is_free.all(axis=2), depth, np.argmin(is_free, axis=2))
    seen = (first < depth) & (first - not_free <= _HALO_CELLS) & (not_free > 0)
    return np.where(seen, depth - 1 - first, -1)
