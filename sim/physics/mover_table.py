"""Poses of the moving objects of a world at the IMU intervals of a simulation, tabulated in blocks."""

from collections.abc import Sequence

import mujoco
import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array
from dronevio.models.rotation import quat_wxyz_from_matrix
from dronevio.sim.physics.collisions import Moving

_BLOCK = 1024  # intervals that are computed together
_BLOCKS = 64  # blocks that are kept


class MoverTable:
    """Poses of the mocap bodies of a model at the starts of IMU intervals.

    They are computed for a block of intervals at once, and kept for all simulations and episodes that reach it.
    """

    def __init__(self, model: mujoco.MjModel, movers: Sequence[Moving], interval_s: float) -> None:
        """Take a model, all its moving objects, and the length of an interval [s]."""
        self._numbers = [(int(model.body(mover.body).mocapid[0]), mover) for mover in movers]
        self._interval_s = interval_s
        self._blocks: dict[int, Array] = {}

    def at(self, interval: npt.NDArray[np.int64]) -> tuple[Array, Array]:
        """Return positions (k, M, 3) [m] and quaternions (k, M, 4) of M objects at the starts of intervals (k,)."""
        block, row = np.divmod(interval, _BLOCK)
        rows = np.empty((len(interval), len(self._numbers), 7))
        for number in np.unique(block):
            of = block == number
            rows[of] = self._block(int(number))[row[of]]
        return rows[..., :3], rows[..., 3:]

    def _block(self, number: int) -> Array:
        """Return the rows (B, M, 7) of a block of intervals."""
        if number not in self._blocks:
            t_s = np.asarray((number * _BLOCK + np.arange(_BLOCK)) * self._interval_s, np.float64)
            rows = np.empty((_BLOCK, len(self._numbers), 7))
            for place, mover in self._numbers:
                Ts = mover.poses(t_s)
                rows[:, place, :3], rows[:, place, 3:] = Ts[:, :3, 3], quat_wxyz_from_matrix(Ts[:, :3, :3])
            if len(self._blocks) == _BLOCKS:
                del self._blocks[next(iter(self._blocks))]  # the oldest
            self._blocks[number] = rows
        return self._blocks[number]
