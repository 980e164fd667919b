"""The space of a world: its shell and the boxes in it, how far a point is from touching any, and ways through it."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

_ROWS_AT_ONCE = 64  # points that are looked at together: along a path or in a grid they are close to each other


@dataclass(frozen=True, eq=False)
class Space:
    """An upright box to fly in, less the obstacles in it; each obstacle is an oriented box."""

    low: Array
    """(3,) Least corner of the shell [m]; z is the floor."""
    high: Array
    """(3,) Greatest corner of the shell [m]; z is the ceiling, or how high one may fly outdoors."""
    centres: Array
    """(K, 3) Middles of the obstacles [m]."""
    halves: Array
    """(K, 3) Half their widths, depths and heights [m]."""
    rotations: Array
    """(K, 3, 3) Their orientations."""

    def clearance(self, points: Array) -> Array:
        """Return how far points (…, 3) are from the nearest surface [m]; negative outside the shell or in an obstacle.

        It is the Euclidean distance outside a box, and the depth below its nearest face inside.
        """
        points = np.asarray(points, dtype=np.float64)
        flat = points.reshape(-1, 3)
        chunks = [self._clearance(flat[k : k + _ROWS_AT_ONCE]) for k in range(0, len(flat), _ROWS_AT_ONCE)]
        return np.concatenate([np.zeros(0), *chunks]).reshape(points.shape[:-1])

    def _clearance(self, points: Array) -> Array:
        """Return the clearance (N,) of points (N, 3).

        Clearance changes by no more than the distance moved. So what a box far from their middle has to say about any
        of them, if a near one has something to say, need not be asked.
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
        """Return the distances (N, M) of points (N, 3) from some of the boxes; negative inside."""
        turn, shift = (part[:, boxes].reshape(len(part), -1) for part in self._into_boxes)
        beyond = np.abs((points @ turn + shift).reshape(len(points), -1, 3)) - self.halves[boxes]
        inside = np.minimum(beyond.max(axis=-1), 0.0)
        np.maximum(beyond, 0.0, out=beyond)
        return np.asarray(np.sqrt(np.einsum("nki,nki->nk", beyond, beyond)) + inside)

    @cached_property
    def _into_boxes(self) -> tuple[Array, Array]:
        """Return turn (3, K, 3) and shift (1, K, 3) that take points into the boxes' frames, all in one product."""
        turn = np.ascontiguousarray(self.rotations.transpose(1, 0, 2))
        return turn, -np.einsum("kj,kji->ki", self.centres, self.rotations)[None]


@dataclass(frozen=True, eq=False)
class FlightArea:
    """What a planner has to know of a world."""

    space: Space
    """Shell and obstacles."""
    free_box: Array
    """(2, 3) Least and greatest corner of a space free of obstacles [m]; the pad is under its middle."""
    pad: Array
    """(3,) Middle of the landing pad, on the floor [m]."""
    route: Array
    """(R, 3) A tour through the whole world [m]; its legs, with the one back to the first point, are clear."""
