"""Depth from the motion of one camera: a plane sweep over recent images at their estimated poses.

The newest image is compared with earlier ones by correlation at planes of constant inverse depth, the sums of
semi-global matching choose one of them at each pixel, and a step of least squares refines it; see
`dronevio.estimator.dense.sweep`, `dronevio.estimator.dense.sgm` and `dronevio.estimator.mapping.refinement`.
"""

import math
from collections import deque
from collections.abc import Sequence

import numpy as np

from dronevio.estimator.dense.config import ViewConfig
from dronevio.estimator.dense.sgm import Sums, aggregate, subpixel_minimum
from dronevio.estimator.dense.sweep import SCALE, Warp, sweep
from dronevio.estimator.dense.views import Undistortion, View
from dronevio.estimator.mapping.camera_pose import delay_s, pose_after
from dronevio.estimator.mapping.refinement import least_squares_step
from dronevio.estimator.mapping.rejection import borrowed, edges, slopes, speckles, variance_around
from dronevio.models.arrays import Floats, Integers, Mask
from dronevio.models.depth import DepthImage
from dronevio.models.rig import Rig
from dronevio.models.state import CameraFrame, Estimate, Health

MAX_SIDE_PX = 200
"""Longer side of the images [px]."""
MAX_ANGLE_DEG = 55.0
"""Largest angle from the optical axis [deg]."""
INTERVAL_S = 0.25
"""Shortest time between two depth images [s]."""
KEPT_S = 3.0
"""Time for which an image is compared with later ones [s]."""
BASELINES_M = (0.12, 0.22, 0.32)
"""Distances from the newest image of those that it is compared with [m]."""
MIN_BASELINE_M = 0.08
"""Smallest distance of the farthest of them [m]."""
MAX_TURN_DEG = 25.0
"""Largest rotation between two images that are compared [deg]."""
NEAREST_M = 0.5
"""Smallest depth that is searched [m]."""
MAX_PLANES = 64
POSE_PX = 0.14
"""Standard deviation of the place of a pixel in another image by the estimated motion [px]."""
SCALE_SIGMA = 0.012
"""Standard deviation of the length of the estimated motion, as a share of it."""
MAX_SIGMA_STEPS = 0.75
"""Largest standard deviation of an inverse depth, in steps of a pixel between the planes."""
MAX_COST = 0.5
"""Largest cost of a match, 0 to 1."""
UNIQUENESS = 1.03
"""Least ratio of the costs of another plane and of the best one."""
_WINDOW_PX, _BEST_VIEWS = 7, 2
_SMALL_PENALTY, _LARGE_PENALTY = 0.06, 0.4
_NO_COLOURS = np.zeros((0, 0, 3), np.uint8)


class SweepDepth:
    """Depth images of the first camera of a rig; a `DepthSource`."""

    def __init__(self, rig: Rig) -> None:
        """Take a rig with at least one camera."""
        self._rig = rig
        self._undistortion = Undistortion.of(rig.cameras[0].model, ViewConfig(MAX_SIDE_PX, MAX_ANGLE_DEG))
        self._views: deque[tuple[int, View]] = deque()
        self._track = 0
        self._last_ns: int | None = None

    def depth(self, frame: CameraFrame, estimate: Estimate) -> DepthImage | None:
        """Return the depth image of a frame; None without enough motion, or soon after the last one."""
        is_tracking = estimate.state is not None and estimate.health is Health.TRACKING
        if not is_tracking or estimate.track != self._track:  # earlier poses are in another odometry frame
            self._views.clear()
            self._track = estimate.track
        if estimate.state is None or not is_tracking:
            return None
        if not frame.images[0].size:
            return None
        while self._views and frame.t_ns - self._views[0][0] > KEPT_S * 1e9:
            self._views.popleft()
        undistortion = self._undistortion
        image = undistortion.apply(frame.images[0])
        T_odom_cam = pose_after(estimate.state, delay_s(self._rig, frame, 0)) @ self._rig.cameras[0].T_imu_cam
        view = View(undistortion.camera, T_odom_cam, image.astype(np.float32), undistortion.mask, _NO_COLOURS)
        found: tuple[Floats, Floats] | None = None
        if self._last_ns is None or frame.t_ns - self._last_ns >= INTERVAL_S * 1e9:
            sources = chosen(view, [earlier for _, earlier in self._views])
            found = inverse_depth(view, sources) if sources else None
        self._views.append((frame.t_ns, view))
        if found is None:
            return None
        self._last_ns = frame.t_ns
        w, sigma = found
        depth = np.divide(np.float32(1.0), w, out=np.zeros_like(w), where=w > 0.0)
        return DepthImage(frame.t_ns, view.camera, T_odom_cam, depth, depth * depth * sigma, image)


def chosen(reference: View, views: Sequence[View]) -> list[View]:
    """Return those of earlier views whose distances from a reference are closest to `BASELINES_M`; none if too near."""
    if not views:
        return []
    T = np.stack([view.T_world_cam for view in views])
    baselines = np.linalg.norm(T[:, :3, 3] - reference.T_world_cam[:3, 3], axis=1)
    cosines = 0.5 * (np.einsum("ij,nij->n", reference.T_world_cam[:3, :3], T[:, :3, :3]) - 1.0)
    usable = np.flatnonzero((cosines > math.cos(math.radians(MAX_TURN_DEG))) & (baselines < 1.5 * BASELINES_M[-1]))
    if not len(usable) or baselines[usable].max() < MIN_BASELINE_M:
        return []
    nearest = {int(usable[np.argmin(np.abs(baselines[usable] - b))]) for b in BASELINES_M}
    return [views[k] for k in sorted(nearest, key=lambda k: baselines[k])]


def inverse_depth(reference: View, sources: Sequence[View]) -> tuple[Floats, Floats] | None:
    """Return the inverse depths (H, W) of a view and their standard deviations (H, W) [1/m]; 0 where unknown.

    It is None if the motion moves no pixel.

    Args:
        reference: The view.
        sources: The views with which it is compared, that with the longest baseline last.
    """
    warps = [Warp(reference, source) for source in sources]
    step = warps[-1].step(1.0 / (4.0 * NEAREST_M))
    if not math.isfinite(step):
        return None
    count = int(np.clip(math.ceil(1.0 / (NEAREST_M * step)) + 1, 4, MAX_PLANES))
    planes = np.linspace(0.0, 1.0 / NEAREST_M, count, dtype=np.float32)
    spacing = planes[1]
    # Planes
    costs = sweep(reference, warps, None, None, planes, _WINDOW_PX, _BEST_VIEWS)
    total = aggregate(costs, reference.grey, SCALE * _SMALL_PENALTY, SCALE * _LARGE_PENALTY)
    index, offset = subpixel_minimum(total)
    matched = (index + offset).astype(np.float32) * spacing
    known = reference.mask & (index > 0) & (index < count - 1) & _is_unique(total, index)
    known &= np.take_along_axis(costs, index[:, None], axis=1)[:, 0] <= SCALE * MAX_COST
    # Refinement, to which each source contributes its information
    information, weighted, squares = (np.zeros_like(matched) for _ in range(3))
    for warp in warps:
        moved = _moved_px(warp, matched, spacing)
        before, here, after = (np.maximum(warp.surface(matched + k * spacing), 0.0) for k in (-0.5, 0.0, 0.5))
        gradient = (after - before) / spacing
        change, sigma = least_squares_step(reference.grey, here, gradient)
        squares += gradient * gradient
        weight = 1.0 / (sigma * sigma + (POSE_PX / moved) ** 2)
        information += weight
        weighted += weight * change
    known &= information > 0.0
    change = np.divide(weighted, information, out=np.zeros_like(matched), where=known)
    w = matched + change
    sigma = np.sqrt(np.divide(1.0, information, out=np.zeros_like(matched), where=known) + (SCALE_SIGMA * w) ** 2)
    known &= (w > 0.0) & (np.abs(change) <= spacing) & (sigma <= MAX_SIGMA_STEPS * step + SCALE_SIGMA * w)
    # A depth counts where the pixel, and not what is beside it, tells it
    zero, pixels = np.float32(0.0), np.float32(1.0 / step)
    matched = np.where(index > 0, matched * pixels, zero)
    slope = slopes(matched)
    known &= ~edges(np.where(known, w * pixels, zero), matched, slope)
    known &= ~borrowed(np.where(known, w * pixels, zero), squares)
    known &= ~speckles(np.where(known, w * pixels, zero))
    sigma = np.sqrt(sigma * sigma + variance_around(np.where(known, w * pixels, zero), matched, slope) / pixels**2)
    return np.where(known, w, zero).astype(np.float32), np.where(known, sigma, zero).astype(np.float32)


def _moved_px(warp: Warp, w: Floats, spacing: np.float32) -> Floats:
    """Return how far (H, W) the projection of each pixel moves by a change of its inverse depth [px m]."""
    (u, v), (a, b) = warp.pixels(w), warp.pixels(w + spacing)
    return np.asarray(np.maximum(np.hypot(a - u, b - v) / spacing, np.float32(1e-3)))


def _is_unique(total: Sums, index: Integers) -> Mask:
    """Return where (H, W) the lowest sum (H, D, W) is lower than all that are not beside it."""
    lowest = np.take_along_axis(total, index[:, None], axis=1)[:, 0].astype(np.float32)
    beside = np.abs(np.arange(total.shape[1])[None, :, None] - index[:, None]) <= 2
    second = np.where(beside, np.iinfo(np.uint16).max, total).min(axis=1)
    return np.asarray(second > UNIQUENESS * lowest)
