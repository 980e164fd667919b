"""Fusion of depth maps into one point cloud.

Each pixel whose depth enough other depth maps confirm gives a point, the weighted mean of all that agree. The pixels of
the other images that are part of it give no further point. Source: Merrell et al., "Real-time visibility-based fusion
of depth maps", ICCV 2007; Schönberger et al., "Pixelwise view selection for unstructured multi-view stereo", ECCV
2016, section 4.5.
"""

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

from dronevio.estimator.dense.config import ConsistencyConfig
from dronevio.estimator.dense.consistency import PosedDepth, confirm
from dronevio.models.progress import Progress, silent
from dronevio.models.surfaces import PointCloud

Array = npt.NDArray[np.float64]
Floats = npt.NDArray[np.float32]
Indices = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]


def fuse(
    depths: Sequence[PosedDepth],
    neighbours: Sequence[Indices],
    colours: Callable[[int], npt.NDArray[np.uint8]],
    config: ConsistencyConfig,
    progress: Progress = silent,
) -> tuple[PointCloud, list[Floats]]:
    """Return the point cloud of depth maps, and the depth maps without what is not consistent.

    Args:
        depths: (I,) Depth maps.
        neighbours: (I,) Indices of the depth maps with which each is compared.
        colours: Returns the undistorted image (H, W, 3) with an index.
        config: Tolerances.
        progress: Called with the number of finished depth maps.

    Returns:
        The cloud, and the inverse depths (H, W) of each image, averaged over those that agree and 0 elsewhere.
    """
    is_used = [np.zeros(depth.inverse_depth.shape, bool) for depth in depths]
    filtered, clouds = [], []
    for i, depth in enumerate(depths):
        points, count, confirmations = _mean_points(depth, [depths[j] for j in neighbours[i]], config)
        consistent = count >= config.min_views
        with np.errstate(invalid="ignore", divide="ignore"):
            filtered.append(np.where(consistent, 1.0 / points[..., 2], 0.0).astype(np.float32))
        normals = surface_normals(points, consistent)
        emitted = consistent & ~is_used[i] & np.isfinite(normals[..., 0])
        T = depth.T_world_cam
        clouds.append(
            PointCloud(
                points[emitted].astype(np.float64) @ T[:3, :3].T + T[:3, 3],
                normals[emitted].astype(np.float64) @ T[:3, :3].T,
                colours(i)[emitted],
            )
        )
        for j, (confirmed, pixels) in zip(neighbours[i], confirmations, strict=True):
            part = np.round(pixels[emitted & confirmed]).astype(np.int64)
            is_used[j][part[:, 1], part[:, 0]] = True
        progress(i + 1, len(depths))
    return concatenated(clouds), filtered


def _mean_points(
    depth: PosedDepth, others: Sequence[PosedDepth], config: ConsistencyConfig
) -> tuple[Floats, Indices, list[tuple[Mask, Floats]]]:
    """Return the mean (H, W, 3) of the points that agree in the camera frame, and who confirms each.

    Points have the weight z⁻², because the error of a depth grows at least with the depth.
    """
    points = depth.points()
    weight = 1.0 / points[..., 2] ** 2
    sums, weights = points * weight[..., None], weight.copy()
    count = np.zeros(weight.shape, np.int64)
    found = []
    for other in others:
        confirmation = confirm(depth, other, config)
        confirmed = confirmation.confirmed
        T = np.linalg.inv(other.T_world_cam) @ depth.T_world_cam
        z = confirmation.points[confirmed] @ T[2, :3].astype(np.float32) + np.float32(T[2, 3])
        sums[confirmed] += confirmation.points[confirmed] / z[:, None] ** 2
        weights[confirmed] += 1.0 / z**2
        count += confirmed
        found.append((confirmed, confirmation.pixels))
    return sums / weights[..., None], count, found


def surface_normals(points: Floats, valid: Mask) -> Floats:
    """Return the normals (H, W, 3) of the surface through points (H, W, 3), towards the camera; NaN where unknown.

    They are cross products of the differences of the neighbours on either side, or of one of them and the point.
    """
    p = np.where(valid[..., None], points, np.nan)
    along = _difference(p, axis=1)
    down = _difference(p, axis=0)
    normal = np.cross(down, along)  # x × y is along z, away from the camera
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        normal = normal / length
        facing = np.sum(normal * p, axis=-1, keepdims=True) > 0.0
    return np.where(facing, -normal, normal)


def _difference(points: Floats, axis: int) -> Floats:
    """Return the central difference (H, W, 3) along an axis, a one-sided one where a neighbour is missing."""
    pad = [(0, 0)] * 3
    pad[axis] = (1, 1)
    padded = np.pad(points, pad, constant_values=np.nan)
    count = points.shape[axis]
    before, after = padded.take(range(count), axis), padded.take(range(2, count + 2), axis)
    both = after - before
    return np.where(np.isfinite(both), both, np.where(np.isfinite(after), after - points, points - before))


def concatenated(clouds: Sequence[PointCloud]) -> PointCloud:
    """Return the points of several clouds as one."""
    return PointCloud(
        np.concatenate([np.zeros((0, 3)), *(c.points for c in clouds)]),
        np.concatenate([np.zeros((0, 3)), *(c.normals for c in clouds)]),
        np.concatenate([np.zeros((0, 3), np.uint8), *(c.colours for c in clouds)]),
    )
