"""The space of a world: its shell and the boxes in it, and how far a point is from touching any of them."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

_ROWS_AT_ONCE = 4096  # points × boxes × 3 numbers at a time: some megabytes however long the path is


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
        """Return the clearance (N,) of points (N, 3)."""
        to_shell = np.minimum(points - self.low, self.high - points).min(axis=1)
        if not len(self.centres):
            return np.asarray(to_shell)
        local = np.einsum("kji,nkj->nki", self.rotations, points[:, None] - self.centres)
        beyond = np.abs(local) - self.halves
        outside = np.linalg.norm(np.maximum(beyond, 0.0), axis=-1)
        inside = np.minimum(beyond.max(axis=-1), 0.0)
        return np.asarray(np.minimum(to_shell, (outside + inside).min(axis=1)))
