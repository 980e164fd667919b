"""Depth map of an image: plane sweeps at a low resolution, and refinements around their result at higher ones.

Planes are swept along the optical axis and along the normals of the large surfaces of the scene (Gallup et al.,
"Real-time plane-sweeping stereo with multiple sweeping directions", CVPR 2007). Each sweep and each refinement chooses
among the depths of a pixel by semi-global matching and a parabola.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from dronevio.estimator.dense.config import DepthConfig
from dronevio.estimator.dense.sgm import aggregate, subpixel_minimum
from dronevio.estimator.dense.sweep import SCALE, Warp, sweep
from dronevio.estimator.dense.views import View
from dronevio.models.arrays import Array, Floats

REFINEMENT_STEPS = 4
"""Number of depths on either side of the result of a lower resolution that the refinement examines."""
REFINEMENT_STEP = 0.5
"""Distance between the depths of the refinement [px]."""
_MEDIAN_PX = 5  # side of the median filter of a result before it is refined
_CHOICE_PX = (5, 5)  # windows over which the sums of two sweeps are compared
_PERCENTILES = (1.0, 99.0)  # of the depths of the points, between which planes are swept
_MIN_SLOPE = 0.05  # least ratio of the inverse depth and that of the plane, to avoid planes through the camera


@dataclass(frozen=True, eq=False)
class DepthMap:
    """Inverse depth of the pixels of an undistorted image."""

    inverse_depth: Floats
    """(H, W) Inverse depth in the inverse unit of the reconstruction; 0 where it is unknown."""
    correlation: Floats
    """(H, W) Mean correlation (ZNCC) with the neighbours that match best, 0 to 1."""


@dataclass(frozen=True, eq=False)
class _Found:
    """Result of a search."""

    inverse_depth: Floats
    """(H, W) Inverse depth with the lowest sum of costs."""
    cost: Floats
    """(H, W) Cost of this depth, 0 to 1."""
    total: Floats
    """(H, W) Sum of the costs of the paths of semi-global matching."""


def estimate_depth(
    reference: View, sources: Sequence[View], points: Array, normals: Array, config: DepthConfig
) -> DepthMap:
    """Return the depth map of an image.

    Args:
        reference: The image.
        sources: Its neighbours, at least one.
        points: (N, 3) Points in the world frame that the image observes, at least one; they bound the depths.
        normals: (D, 3) Unit normals in the world frame of planes to sweep, besides planes parallel to the image.
        config: Settings.
    """
    # Image pyramid
    levels = [(reference, list(sources))]
    for _ in range(config.levels - 1):
        view, nearby = levels[-1]
        levels.append((view.halved(), [source.halved() for source in nearby]))
    (view, nearby), *finer = reversed(levels)
    # Plane sweeps at the lowest resolution, along the axis and along the large surfaces
    warps = [Warp(view, source) for source in nearby]
    in_camera = (points - reference.T_world_cam[:3, 3]) @ reference.T_world_cam[:3, :3]
    step = _pixel_step(warps, 1.0 / float(np.median(in_camera[:, 2])))
    if not math.isfinite(step):
        unknown = np.zeros_like(reference.grey)
        return DepthMap(unknown, unknown)
    axes = np.concatenate([[[0.0, 0.0, 1.0]], normals @ reference.T_world_cam[:3, :3]])
    sweeps = [_sweep_planes(view, warps, in_camera, axis, step, config) for axis in axes]
    best = _best([result for result in sweeps if result is not None])
    # Refinement: at each finer resolution, a few depths around the result of the one before
    offsets = REFINEMENT_STEP * np.arange(-REFINEMENT_STEPS, REFINEMENT_STEPS + 1)
    for finer_view, finer_nearby in finer:
        start = _enlarged(np.asarray(cv2.medianBlur(best.inverse_depth, _MEDIAN_PX)), finer_view.grey.shape, step)
        step *= 0.5
        finer_warps = [Warp(finer_view, source) for source in finer_nearby]
        best = _search(finer_view, finer_warps, start, None, (step * offsets).astype(np.float32), config)
    known = reference.mask & (best.inverse_depth > 0.0)
    return DepthMap(np.where(known, best.inverse_depth, 0.0).astype(np.float32), 1.0 - best.cost)


def _pixel_step(warps: Sequence[Warp], inverse_depth: float) -> float:
    """Return the change of inverse depth that moves a projection by a pixel, for most pixels and neighbours.

    It is infinite if all neighbours have the same position, or none sees points of this inverse depth.
    """
    steps = [step for step in (warp.step(inverse_depth) for warp in warps) if math.isfinite(step)]
    return float(np.median(steps)) if steps else math.inf


def _sweep_planes(
    view: View, warps: Sequence[Warp], points: Array, normal: Array, step: float, config: DepthConfig
) -> _Found | None:
    """Return the result of a sweep of planes with a normal (3,) in the camera frame; None if no point is in front.

    The inverse depth of a plane at distance d is |n · r(x)| / d at the pixel with the ray r(x) of depth 1. Planes on
    both sides of the camera are swept at once, since each pixel sees one of them.
    """
    slope = np.abs(view.camera.rays() @ normal.astype(np.float32))
    distances = np.abs(points @ normal)
    near, far = np.percentile(distances, _PERCENTILES)
    lowest, highest = 1.0 / (far * (1.0 + config.range_margin)), 1.0 / max(near * (1.0 - config.range_margin), 1e-9)
    interval = config.plane_step * step / float(np.median(slope))
    highest = min(highest, lowest + interval * (config.max_planes - 1))
    count = max(3, int(np.ceil((highest - lowest) / interval)) + 1)
    planes = (lowest + interval * np.arange(count)).astype(np.float32)
    is_frontal = abs(normal[2]) > 1.0 - 1e-9
    return _search(view, warps, None, None if is_frontal else np.maximum(slope, _MIN_SLOPE), planes, config)


def _search(
    view: View, warps: Sequence[Warp], base: Floats | None, slope: Floats | None, offsets: Floats, config: DepthConfig
) -> _Found:
    """Return the best of the inverse depths base + slope · offset of each pixel."""
    costs = sweep(view, warps, base, slope, offsets, config.window_px, config.best_views)
    total = aggregate(costs, view.grey, SCALE * config.small_penalty, SCALE * config.large_penalty)
    index, shift = subpixel_minimum(total)
    chosen = offsets[index] + shift * (offsets[1] - offsets[0])
    if slope is not None:
        chosen = slope * chosen
    if base is not None:
        chosen = base + chosen
    cost, lowest = (np.take_along_axis(volume, index[:, None], axis=1)[:, 0] for volume in (costs, total))
    return _Found(chosen.astype(np.float32), cost.astype(np.float32) / np.float32(SCALE), lowest.astype(np.float32))


def _best(results: Sequence[_Found]) -> _Found:
    """Return at each pixel the result whose sum of costs is the lowest around it."""
    chosen = np.argmin([cv2.blur(result.total, _CHOICE_PX) for result in results], axis=0)

    def pick(maps: Sequence[Floats]) -> Floats:
        return np.asarray(np.choose(chosen, maps), dtype=np.float32)

    return _Found(*(pick([getattr(r, name) for r in results]) for name in ("inverse_depth", "cost", "total")))


def _enlarged(inverse_depth: Floats, shape: tuple[int, ...], step: float) -> Floats:
    """Return a map at twice the resolution, interpolated except between surfaces, where the nearest value is used."""
    size = 2 * inverse_depth.shape[1], 2 * inverse_depth.shape[0]
    linear = cv2.resize(inverse_depth, size, interpolation=cv2.INTER_LINEAR)
    nearest = cv2.resize(inverse_depth, size, interpolation=cv2.INTER_NEAREST)
    mixed = np.where(np.abs(linear - nearest) < step, linear, nearest)
    return np.ascontiguousarray(mixed[: shape[0], : shape[1]].astype(np.float32))
