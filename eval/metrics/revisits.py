"""Revisits of places, right loops between frames, and the recall of place recognition.

A revisit is a property of the true motion and of the true scene, not of an estimator: a frame revisits an earlier one
if its camera is close to the earlier pose, looks in about the same direction, sees a part of the same surfaces, and
time and path lie between the two. A loop is the relative pose of two frames that an estimator claims. The frames may be
all frames of a flight or any subset of them, such as the keyframes of an estimator.

Sources of the terms: Gálvez-López and Tardós, "Bags of binary words for fast place recognition in image sequences",
2012 (recall at full precision); Campos et al., "ORB-SLAM3", 2021 (covisibility).
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array
from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError
from dronevio.models.imu import Times
from dronevio.models.ranges import Range, Settings
from dronevio.models.rotation import inverse_pose, log_so3

Flags = npt.NDArray[np.bool_]
Rows = npt.NDArray[np.int64]

COLUMNS, ROWS = 16, 12
"""Size of the grid of pixels at which the depth of a frame is sampled."""
_OCCLUSION_SHARE = 0.1  # a point so much farther than all samples of surfaces around it is hidden
_ORTHOGONALITY = 1e-3  # largest error of the elements of RᵀR of a rotation
_BLOCK_SIZE = 1 << 21  # elements of an array that is computed at a time


@dataclass(frozen=True)
class RevisitRule(Settings):
    """When a frame revisits an earlier one."""

    distance_m: Annotated[float, Range(0.0, 1e3)] = 1.0
    """Largest distance between the two positions of the camera [m]."""
    angle_rad: Annotated[float, Range(0.0, np.pi)] = np.radians(30.0)
    """Largest angle between the two optical axes [rad]."""
    age_s: Annotated[float, Range(0.0, 1e6)] = 10.0
    """Smallest time between the two frames [s]."""
    path_m: Annotated[float, Range(0.0, 1e6)] = 5.0
    """Smallest length of the path between the two frames [m]."""
    covisible: Annotated[float, Range(0.0, 1.0)] = 0.25
    """Smallest share of the sampled surfaces of the later frame that the earlier frame sees."""


@dataclass(frozen=True)
class LoopTolerance(Settings):
    """How far the relative pose of a right loop may be from the true one; any other loop is wrong."""

    distance_m: Annotated[float, Range(0.0, 1e3)] = 0.05
    """Constant part of the largest position error [m]."""
    depth_share: Annotated[float, Range(0.0, 1.0)] = 0.02
    """Part of the largest position error that is proportional to the median depth of the later frame."""
    angle_rad: Annotated[float, Range(0.0, np.pi)] = np.radians(1.0)
    """Largest rotation error [rad]."""


@dataclass(frozen=True, eq=False)
class Views:
    """The true views of K frames of one camera in time order: poses, and distances of surfaces on a grid of pixels."""

    t_ns: Times
    """(K,) Times of the frames, strictly increasing [ns]."""
    path_m: Array
    """(K,) Length of the true path of the whole flight up to each frame, from any start [m]."""
    Ts_world_cam: Array
    """(K, 4, 4) True poses of the camera."""
    camera: CameraModel
    """The camera of all frames."""
    ranges_m: Array
    """(K, R, C) Distances from the camera to the first surface along the rays of `grid_pixels`; inf without a surface
    [m]. Rays without a direction have any value."""

    def __post_init__(self) -> None:
        """Check the shapes.

        Raises:
            ConfigError: The shapes do not match, or the times do not increase.
        """
        n = len(self.t_ns)
        shapes = (self.t_ns.shape, self.path_m.shape, self.Ts_world_cam.shape, self.ranges_m.shape[:1])
        if shapes != ((n,), (n,), (n, 4, 4), (n,)) or self.ranges_m.ndim != 3 or min(self.ranges_m.shape[1:]) < 2:
            raise ConfigError(
                f"views with shapes {', '.join(map(str, (*shapes[:3], self.ranges_m.shape)))};"
                " expected (K,), (K,), (K, 4, 4) and (K, R, C) with at least two rows and columns"
            )
        if n > 1 and not np.all(np.diff(self.t_ns) > 0):
            raise ConfigError("views whose times do not increase")

    def __len__(self) -> int:
        return len(self.t_ns)

    def __getitem__(self, rows: slice | Rows | Flags) -> "Views":
        """Return the views of some of the frames, in time order."""
        return Views(self.t_ns[rows], self.path_m[rows], self.Ts_world_cam[rows], self.camera, self.ranges_m[rows])

    @property
    def bearings(self) -> Array:
        """(R · C, 3) Unit vectors of the sampled rays in the camera frame; NaN where the lens has none."""
        return self.camera.unproject(grid_pixels(self.camera, *self.ranges_m.shape[:0:-1])).reshape(-1, 3)

    @property
    def median_depth_m(self) -> Array:
        """(K,) Median depth of the sampled surfaces of each frame, the coordinate along the optical axis [m].

        Rays at 90° and more from the axis and rays without a surface are not used; NaN without any surface.
        """
        bearings = self.bearings
        depth = self.ranges_m.reshape(len(self), len(bearings)) * bearings[:, 2]
        used = np.isfinite(depth) & (depth > 0.0)
        ordered = np.sort(np.where(used, depth, np.inf), axis=1)
        count = used.sum(axis=1)
        rows = np.arange(len(self))
        low, high = (ordered[rows, np.maximum(middle, 0)] for middle in ((count - 1) // 2, count // 2))
        return np.where(count > 0, 0.5 * (low + high), np.nan)


@dataclass(frozen=True, eq=False)
class Revisits:
    """All pairs of frames of which the later one revisits the earlier one."""

    frames: int
    """Number K of frames."""
    now: Rows
    """(M,) Rows of the later frames, in ascending order."""
    then: Rows
    """(M,) Rows of the earlier frames."""
    covisible: Array
    """(M,) Share of the sampled surfaces of the later frame that the earlier one sees."""

    @property
    def revisiting(self) -> Flags:
        """(K,) Whether each frame revisits an earlier one."""
        revisits = np.zeros(self.frames, dtype=np.bool_)
        revisits[self.now] = True
        return revisits

    @property
    def percent(self) -> float:
        """Share of the frames that revisit an earlier one [%]; NaN without frames."""
        return 100.0 * float(self.revisiting.mean()) if self.frames else float("nan")


def grid_pixels(camera: CameraModel, columns: int = COLUMNS, rows: int = ROWS) -> Array:
    """Return the pixels (rows, columns, 2) in the middle of the cells of a regular grid over an image [px]."""
    u = (np.arange(columns) + 0.5) * camera.width / columns - 0.5
    v = (np.arange(rows) + 0.5) * camera.height / rows - 0.5
    return np.stack(np.meshgrid(u, v), axis=-1)


def find_revisits(views: Views, rule: RevisitRule | None = None) -> Revisits:
    """Return all revisits among the frames of a flight.

    Time is proportional to K² for K frames, with a small factor, and to the number of pairs of close poses.

    Args:
        views: The true views of the frames.
        rule: When a frame revisits an earlier one.
    """
    rule = rule or RevisitRule()
    now, then = _close_pairs(views, rule)
    covisible = covisible_shares(views, now, then)
    kept = covisible >= rule.covisible  # False for NaN
    return Revisits(len(views), now[kept], then[kept], covisible[kept])


def covisible_shares(views: Views, now: Rows, then: Rows) -> Array:
    """Return the share of the sampled surfaces of a frame that another frame sees, for pairs of frames: (M,).

    A sampled point is seen by the other frame if it is within the image there and is not hidden: it is at most 10 %
    farther than the farthest of the four samples around its pixel. The result is NaN if the frame sees no surface.

    Args:
        views: The true views of the frames.
        now: (M,) Rows of the frames whose points are examined.
        then: (M,) Rows of the frames into which they are projected.
    """
    bearings = views.bearings
    points = views.ranges_m.reshape(len(views), len(bearings), 1) * bearings  # (K, S, 3) in the camera frame
    sampled = np.asarray(np.isfinite(points).all(axis=-1))
    points = np.where(sampled[..., None], points, 0.0)
    Ts_cam_world = inverse_pose(views.Ts_world_cam)
    farthest = _farthest_around(views.ranges_m)
    shares, size = np.empty(len(now)), max(1, _BLOCK_SIZE // max(bearings.size, 1))
    for start in range(0, len(now), size):
        block = slice(start, start + size)
        T_then_now = Ts_cam_world[then[block]] @ views.Ts_world_cam[now[block]]
        p = points[now[block]] @ np.swapaxes(T_then_now[:, :3, :3], 1, 2) + T_then_now[:, None, :3, 3]
        seen = sampled[now[block]] & _seen(views.camera, farthest[then[block]], p)
        with np.errstate(invalid="ignore"):  # a frame without surfaces
            shares[block] = seen.sum(axis=1) / sampled[now[block]].sum(axis=1)
    return shares


def right_loops(
    Ts_then_now: Array, true_Ts_then_now: Array, median_depth_m: Array, tolerance: LoopTolerance | None = None
) -> Flags:
    """Return which loops are right (M,): those whose relative pose is within the tolerance of the true one.

    All other loops are wrong, also those whose matrix is no pose.

    Args:
        Ts_then_now: (M, 4, 4) Relative poses that an estimator claims, of the later camera in the frame of the earlier.
        true_Ts_then_now: (M, 4, 4) True relative poses; see `true_relative_poses`.
        median_depth_m: (M,) Median depths of the scene of the later frames, as of `Views.median_depth_m` [m].
        tolerance: Largest errors of a right loop.
    """
    tolerance = tolerance or LoopTolerance()
    valid = _are_poses(Ts_then_now)
    claimed = np.where(valid[:, None, None], Ts_then_now, np.eye(4))
    distance = np.linalg.norm(claimed[:, :3, 3] - true_Ts_then_now[:, :3, 3], axis=1)
    R_error = np.swapaxes(true_Ts_then_now[:, :3, :3], 1, 2) @ claimed[:, :3, :3]
    angle = np.linalg.norm(log_so3(R_error), axis=1)
    near = distance <= tolerance.distance_m + tolerance.depth_share * median_depth_m  # False for NaN
    return np.asarray(valid & near & (angle <= tolerance.angle_rad))


def true_relative_poses(views: Views, now: Rows, then: Rows) -> Array:
    """Return the true poses (M, 4, 4) of cameras ``now`` (M,) in the frames of cameras ``then`` (M,), both rows."""
    return np.asarray(inverse_pose(views.Ts_world_cam[then]) @ views.Ts_world_cam[now])


def revisit_recall(t_ns: Times, revisiting: Flags, t_match_ns: Times, within_s: float = 1.0) -> float:
    """Return the recall of place recognition: the share of revisiting frames that are matched soon, NaN without any.

    A frame is matched if there is a match of it, or of a frame that is at most ``within_s`` later.

    Args:
        t_ns: (K,) Times of the frames [ns].
        revisiting: (K,) Whether each frame revisits an earlier one.
        t_match_ns: (L,) Times of the later frames of verified matches in any order [ns]. Wrong loops do not belong
            among them.
        within_s: Longest time from a frame to a match [s].
    """
    wanted = t_ns[revisiting]
    if not len(wanted):
        return float("nan")
    matches = np.append(np.sort(t_match_ns), np.iinfo(np.int64).max)
    following = matches[np.searchsorted(matches[:-1], wanted)]
    return float(np.mean(following <= wanted + round(within_s * 1e9)))


def _are_poses(Ts: Array) -> Flags:
    """Return which matrices (M, 4, 4) are finite and have a rotation (M,)."""
    finite = np.asarray(np.isfinite(Ts).all(axis=(1, 2)))
    R = np.where(finite[:, None, None], Ts[:, :3, :3], 0.0)
    orthogonal = np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max(axis=(1, 2), initial=0.0) <= _ORTHOGONALITY
    return np.asarray(finite & orthogonal & (np.linalg.det(R) > 0.0))


def _close_pairs(views: Views, rule: RevisitRule) -> tuple[Rows, Rows]:
    """Return the rows (M,) and (M,) of later and earlier frames that comply with all of a rule but covisibility."""
    n = len(views)
    positions, axes = views.Ts_world_cam[:, :3, 3], views.Ts_world_cam[:, :3, 2]
    size, blocks = max(1, _BLOCK_SIZE // max(3 * n, 1)), [(np.zeros(0, np.int64), np.zeros(0, np.int64))]
    for start in range(0, n, size):
        rows = np.arange(start, min(start + size, n))
        old = views.t_ns[rows, None] - views.t_ns >= round(rule.age_s * 1e9)
        away = views.path_m[rows, None] - views.path_m >= rule.path_m
        near = np.linalg.norm(positions[rows, None] - positions, axis=-1) <= rule.distance_m
        # The angle between a and b is 2 atan2(|a − b|, |a + b|), which is accurate also where the cosine is flat.
        apart = np.linalg.norm(axes[rows, None] - axes, axis=-1)
        angle = 2.0 * np.arctan2(apart, np.linalg.norm(axes[rows, None] + axes, axis=-1))
        now, then = np.nonzero(old & away & near & (angle <= rule.angle_rad) & (rows[:, None] > np.arange(n)))
        blocks.append((now + start, then))
    return np.concatenate([pair[0] for pair in blocks]), np.concatenate([pair[1] for pair in blocks])


def _farthest_around(ranges_m: Array) -> Array:
    """Return the farthest of each four neighbouring samples, without NaN: (K, R − 1, C − 1) of (K, R, C)."""
    upper, lower = ranges_m[:, :-1], ranges_m[:, 1:]
    return np.fmax(np.fmax(upper[..., :-1], upper[..., 1:]), np.fmax(lower[..., :-1], lower[..., 1:]))


def _seen(camera: CameraModel, farthest_m: Array, p_cam: Array) -> Flags:
    """Return which points are within the image and not hidden (M, S).

    Args:
        camera: The camera.
        farthest_m: (M, R − 1, C − 1) Farthest surfaces between the samples of each image [m].
        p_cam: (M, S, 3) Points in the camera frame of each image [m].
    """
    pixels = camera.project(p_cam)
    size = np.array([camera.width, camera.height])
    inside = np.all((pixels >= -0.5) & (pixels <= size - 0.5), axis=-1)  # False for NaN
    cells = np.array(farthest_m.shape[:0:-1])  # columns and rows between the samples
    on_grid = (np.where(inside[..., None], pixels, 0.0) + 0.5) * (cells + 1) / size - 0.5
    column, row = np.moveaxis(np.clip(np.floor(on_grid).astype(np.int64), 0, cells - 1), -1, 0)
    limit = (1.0 + _OCCLUSION_SHARE) * farthest_m[np.arange(len(farthest_m))[:, None], row, column]
    return np.asarray(inside & (np.linalg.norm(p_cam, axis=-1) <= limit))
