"""Space of a world for path planning: its bounds, its obstacles and the clearance of points."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array

_ROWS_AT_ONCE = 64  # points evaluated together, which are close to each other along a path or in a grid


@dataclass(frozen=True, eq=False)
class Space:
    """Axis-aligned box with obstacles, which are oriented boxes."""

    low: Array
    """(3,) Lower corner of the bounds [m]; z is the floor."""
    high: Array
    """(3,) Upper corner of the bounds [m]; z is the ceiling, or the largest height outdoors."""
    centres: Array
    """(K, 3) Centres of the obstacles [m]."""
    halves: Array
    """(K, 3) Half extents of the obstacles along their axes [m]."""
    rotations: Array
    """(K, 3, 3) Orientations of the obstacles in the world."""

    def clearance(self, points: Array) -> Array:
        """Return the signed distance of points (…, 3) to the nearest surface [m]; negative outside or in an obstacle.

        It is the Euclidean distance outside a box and the depth below the nearest face inside.
        """
        points = np.asarray(points, dtype=np.float64)
        flat = points.reshape(-1, 3)
        chunks = [self._clearance(flat[k : k + _ROWS_AT_ONCE]) for k in range(0, len(flat), _ROWS_AT_ONCE)]
        return np.concatenate([np.zeros(0), *chunks]).reshape(points.shape[:-1])

    def _clearance(self, points: Array) -> Array:
        """Return the clearance (N,) of points (N, 3).

        Clearance is Lipschitz continuous with constant 1, so that boxes far from the centre of the points cannot
        determine the clearance of any of them and are skipped.
        """
        to_shell = np.minimum(points - self.low, self.high - points).min(axis=1)
        if not len(self.centres):
            return np.asarray(to_shell)
        middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
        radius = float(np.linalg.norm(points - middle, axis=1).max())
        from_middle = self._to_boxes(middle[None], slice(None))[0]
        near = np.flatnonzero(from_middle <= min(from_middle.min(), to_shell.max()) + 2.0 * radius + 1e-9)
        return np.asarray(np.minimum(to_shell, self._to_boxes(points, near).min(axis=1, initial=np.inf)))

    def _to_boxes(self, points: Array, boxes: npt.NDArray[np.intp] | slice) -> Array:
        """Return the signed distances (N, M) of points (N, 3) to some of the boxes; negative inside."""
        rotation, translation = (part[:, boxes].reshape(len(part), -1) for part in self._into_boxes)
        beyond = np.abs((points @ rotation + translation).reshape(len(points), -1, 3)) - self.halves[boxes]
        inside = np.minimum(beyond.max(axis=-1), 0.0)
        np.maximum(beyond, 0.0, out=beyond)
        return np.asarray(np.sqrt(np.einsum("nki,nki->nk", beyond, beyond)) + inside)

    @cached_property
    def _into_boxes(self) -> tuple[Array, Array]:
        """Return rotation (3, K, 3) and translation (1, K, 3) into the frames of the boxes, for one matrix product."""
        rotation = np.ascontiguousarray(self.rotations.transpose(1, 0, 2))
        return rotation, -np.einsum("kj,kji->ki", self.centres, self.rotations)[None]


@dataclass(frozen=True, eq=False)
class Gate:
    """A gate of a race course, with a square opening."""

    middle: Array
    """(3,) Centre of the opening [m]."""
    heading_rad: float
    """Heading of the passage through the gate [rad]."""
    opening_m: float
    """Width and height of the opening [m]."""

    @property
    def ahead(self) -> Array:
        """(3,) Unit vector of the passage through the gate."""
        return np.array([np.cos(self.heading_rad), np.sin(self.heading_rad), 0.0])


@dataclass(frozen=True, eq=False)
class FlightArea:
    """Input of the path planner and of tasks: the space of a world, its landing pad, its route and its gates."""

    space: Space
    """Bounds and obstacles of the world."""
    free_box: Array
    """(2, 3) Lower and upper corner of a box free of obstacles [m]; the landing pad is below its centre."""
    pad: Array
    """(3,) Centre of the landing pad on the floor [m]."""
    route: Array
    """(R, 3) Closed tour through the whole world with collision-free straight legs [m]."""
    gates: tuple[Gate, ...] = ()
    """Gates in the order of passage, for a world with a race course."""
