"""Boxes that moving objects do not leave in windows of time, by which vehicles are told that are far from all."""

from collections.abc import Sequence

import mujoco
import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array, Mask
from dronevio.sim.physics.clearance_grid import reach_m
from dronevio.sim.physics.collisions import Moving

WINDOW = 16
"""Intervals of a window."""
_SAMPLE = 4  # intervals from one sample to the next
_BLOCK = 256  # windows that are computed together
_BLOCKS = 16  # blocks that are kept
_SIGNS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])


class MoverBounds:
    """Axis-aligned boxes around M moving objects during windows of IMU intervals.

    An object is sampled four times a window; the box extends beyond the samples by the longest way of a corner from
    one sample to the next.
    """

    def __init__(self, model: mujoco.MjModel, movers: Sequence[Moving], interval_s: float) -> None:
        """Take a model of the vehicle and the moving objects, these objects, and the length of an interval [s]."""
        self._movers = [(mover, _corners(model, model.body(mover.body).id)) for mover in movers]
        self._interval_s = interval_s
        self._reach_m = reach_m(model)
        self._blocks: dict[int, Array] = {}

    def near(self, interval: npt.NDArray[np.int64], position: Array) -> Mask:
        """Return which vehicles (k,) at positions (k, 3) [m] may touch an object in intervals (k,)."""
        return np.asarray(self.gap_m(interval, position) <= 0.0)

    def gap_m(self, interval: npt.NDArray[np.int64], position: Array) -> Array:
        """Return how far vehicles (k,) at positions (k, 3) can move without touching an object [m].

        The gaps are those in the windows of intervals (k,), and negative if the vehicle may be in contact.
        """
        boxes, point = self._boxes(interval // WINDOW), position[:, None]
        beyond = np.maximum(np.maximum(boxes[..., :3] - point, point - boxes[..., 3:]), 0.0)
        return np.asarray(np.sqrt(np.einsum("kmi,kmi->km", beyond, beyond).min(axis=1)) - self._reach_m)

    def _boxes(self, window: npt.NDArray[np.int64]) -> Array:
        """Return lower and upper corners (k, M, 6) of the boxes in windows (k,)."""
        block, row = np.divmod(window, _BLOCK)
        if (block == block[0]).all():
            return self._block(int(block[0]))[row]
        return np.array([self._block(int(b))[r] for b, r in zip(block, row, strict=True)])

    def _block(self, number: int) -> Array:
        """Return the boxes (W, M, 6) of a block of windows."""
        if number not in self._blocks:
            per_window = WINDOW // _SAMPLE
            samples = number * _BLOCK * per_window + np.arange(_BLOCK * per_window + 1)
            first, offset = per_window * np.arange(_BLOCK)[:, None], np.arange(per_window + 1)
            t_s = np.asarray(samples * (_SAMPLE * self._interval_s), np.float64)
            boxes = np.empty((_BLOCK, len(self._movers), 6))
            for m, (mover, corners) in enumerate(self._movers):
                Ts = mover.poses(t_s)
                path = corners @ Ts[:, :3, :3].transpose(0, 2, 1) + Ts[:, None, :3, 3]
                parts = path[first + offset]  # (W, S, 8, 3), up to the start of the next window
                margin = np.linalg.norm(np.diff(parts, axis=1), axis=-1).max(axis=(1, 2))[:, None]
                boxes[:, m, :3] = parts.min(axis=(1, 2)) - margin
                boxes[:, m, 3:] = parts.max(axis=(1, 2)) + margin
            if len(self._blocks) == _BLOCKS:
                del self._blocks[next(iter(self._blocks))]  # the oldest
            self._blocks[number] = boxes
        return self._blocks[number]


def _corners(model: mujoco.MjModel, body: int) -> Array:
    """Return the corners (8, 3) of a box around the geoms of a body [m], in its frame."""
    own = np.flatnonzero(model.geom_bodyid == body)
    points = []
    for geom in own:
        R = np.empty(9)
        mujoco.mju_quat2Mat(R, model.geom_quat[geom])
        local = model.geom_aabb[geom, :3] + _SIGNS * model.geom_aabb[geom, 3:]
        points.append(local @ R.reshape(3, 3).T + model.geom_pos[geom])
    low, high = np.min(points, axis=(0, 1)), np.max(points, axis=(0, 1))
    return np.asarray(0.5 * (low + high) + 0.5 * _SIGNS * (high - low))
