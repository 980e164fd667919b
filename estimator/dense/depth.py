"""Depth map of an image: a plane sweep at half the resolution, and a refinement around its result.

Both examine inverse depths in steps, and choose among them by semi-global matching and a parabola.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from dronevio.estimator.dense.config import DepthConfig
from dronevio.estimator.dense.sgm import aggregate, subpixel_minimum
from dronevio.estimator.dense.sweep import SCALE, Warp, sweep
from dronevio.estimator.dense.views import View

Array = npt.NDArray[np.float64]
Floats = npt.NDArray[np.float32]

_MEDIAN_PX = 5  # side of the median filter of the first result


@dataclass(frozen=True, eq=False)
class DepthMap:
    """Inverse depth of the pixels of an undistorted image."""

    inverse_depth: Floats
    """(H, W) Inverse depth in the inverse unit of the reconstruction; 0 where it is unknown."""
    correlation: Floats
    """(H, W) Mean correlation (ZNCC) with the neighbours that match best, 0 to 1."""


def estimate_depth(
    reference: View, sources: Sequence[View], near: float, far: float, config: DepthConfig
) -> DepthMap:
    """Return the depth map of an image.

    Args:
        reference: The image.
        sources: Its neighbours, at least one.
        near: Smallest depth of the sweep, in the unit of the reconstruction.
        far: Largest depth of the sweep.
        config: Settings.
    """
    half = reference.halved()
    warps = [Warp(half, source.halved()) for source in sources]
    w_far, w_near = 1.0 / far, 1.0 / near
    step = max(_step(warps, 0.5 * (w_far + w_near)), (w_near - w_far) / (config.max_planes - 1))
    planes = np.arange(0, max(3, int(np.ceil((w_near - w_far) / step)) + 1)) * step + w_far
    inverse_depth, _ = _search(half, warps, None, planes.astype(np.float32), config)
    median = cv2.medianBlur(inverse_depth, _MEDIAN_PX)
    start = _enlarged(np.asarray(median), reference.grey.shape, step)
    warps = [Warp(reference, source) for source in sources]
    offsets = np.arange(-config.refinement_steps, config.refinement_steps + 1) * (0.25 * step)
    inverse_depth, cost = _search(reference, warps, start, offsets.astype(np.float32), config)
    known = reference.mask & (inverse_depth > 0.0)
    return DepthMap(np.where(known, inverse_depth, 0.0).astype(np.float32), 1.0 - cost)


def _step(warps: Sequence[Warp], inverse_depth: float) -> float:
    """Return the change of inverse depth that moves no projection by more than a pixel, for most neighbours."""
    return float(np.median([warp.step(inverse_depth) for warp in warps]))


def _search(
    view: View, warps: Sequence[Warp], base: Floats | None, offsets: Floats, config: DepthConfig
) -> tuple[Floats, Floats]:
    """Return the best inverse depth (H, W) and its cost (H, W)."""
    costs = sweep(view, warps, base, offsets, config.window_px, config.best_views)
    total = aggregate(costs, view.grey, SCALE * config.small_penalty, SCALE * config.large_penalty)
    index, shift = subpixel_minimum(total)
    step = offsets[1] - offsets[0]
    cost = np.take_along_axis(costs, index[:, None], axis=1)[:, 0].astype(np.float32) / SCALE
    found = offsets[index] + shift * step
    return found if base is None else base + found, cost


def _enlarged(inverse_depth: Floats, shape: tuple[int, ...], step: float) -> Floats:
    """Return a map at twice the resolution, interpolated except between surfaces, where the nearest value is used."""
    size = 2 * inverse_depth.shape[1], 2 * inverse_depth.shape[0]
    linear = cv2.resize(inverse_depth, size, interpolation=cv2.INTER_LINEAR)
    nearest = cv2.resize(inverse_depth, size, interpolation=cv2.INTER_NEAREST)
    mixed = np.where(np.abs(linear - nearest) < step, linear, nearest)
    return np.ascontiguousarray(mixed[: shape[0], : shape[1]].astype(np.float32))
