"""Poses of the moving objects of a world at the IMU intervals of a simulation, tabulated in blocks."""

from collections.abc import Sequence

import mujoco
import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array, Mask
from dronevio.models.rotation import quat_wxyz_from_matrix
from dronevio.sim.physics.clearance_grid import reach_m
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
        bodies = [model.body(mover.body).id for _, mover in sorted(self._numbers, key=lambda pair: pair[0])]
        balls = [_ball(model, body) for body in bodies]
        self._centres = np.array([centre for centre, _ in balls]).reshape(-1, 3)
        self._near_m2 = np.square([radius + reach_m(model) for _, radius in balls])

    def at(self, interval: npt.NDArray[np.int64]) -> tuple[Array, Array]:
        """Return positions (k, M, 3) [m] and quaternions (k, M, 4) of M objects at the starts of intervals (k,)."""
        rows = self._rows(interval)
        return rows[..., :3], rows[..., 3:7]

    def near(self, interval: npt.NDArray[np.int64], position: Array) -> Mask:
        """Return which vehicles at positions (k, 3) [m] may touch an object: balls around them meet."""
        between = self._rows(interval)[..., 7:] - position[:, None]
        return np.asarray((np.einsum("kmi,kmi->km", between, between) < self._near_m2).any(axis=1))

    def _rows(self, interval: npt.NDArray[np.int64]) -> Array:
        """Return positions, quaternions, and centres of the objects (k, M, 10)."""
        block, row = np.divmod(interval, _BLOCK)
        if block[0] == block[-1] and (block == block[0]).all():
            return self._block(int(block[0]))[row]
        rows = np.empty((len(interval), len(self._centres), 10))
        for number in np.unique(block):
            of = block == number
            rows[of] = self._block(int(number))[row[of]]
        return rows

    def _block(self, number: int) -> Array:
        """Return the rows (B, M, 10) of a block of intervals."""
        if number not in self._blocks:
            t_s = np.asarray((number * _BLOCK + np.arange(_BLOCK)) * self._interval_s, np.float64)
            Ts = np.empty((_BLOCK, len(self._centres), 4, 4))
            for place, mover in self._numbers:
                Ts[:, place] = mover.poses(t_s)
            centres = (Ts[..., :3, :3] @ self._centres[:, :, None])[..., 0] + Ts[..., :3, 3]
            if len(self._blocks) == _BLOCKS:
                del self._blocks[next(iter(self._blocks))]  # the oldest
            self._blocks[number] = np.concatenate(
                [Ts[..., :3, 3], quat_wxyz_from_matrix(Ts[..., :3, :3]), centres], axis=-1
            )
        return self._blocks[number]


def _ball(model: mujoco.MjModel, body: int) -> tuple[Array, float]:
    """Return centre (3,) and radius of a ball around the geoms of a body [m], in its frame."""
    own = np.flatnonzero(model.geom_bodyid == body)
    places, radii = model.geom_pos[own], model.geom_rbound[own, None]
    centre = np.asarray(0.5 * ((places - radii).min(axis=0) + (places + radii).max(axis=0)))
    return centre, float((np.linalg.norm(places - centre, axis=1) + radii[:, 0]).max())
