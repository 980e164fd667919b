"""Corners of a keyframe and their binary descriptors, for the recognition of places.

Beside the tracked features, further corners are detected, so that a landmark of an earlier visit is likely to be among
the corners of a later one. Corners are local maxima of the same score with which the tracker chooses its features (the
smaller eigenvalue of the gradient matrix; Shi and Tomasi, "Good features to track", CVPR 1994), for which reason the
two coincide more often than features of different detectors would.

Descriptors are those of ORB (Rublee et al., "ORB: An efficient alternative to SIFT or SURF", ICCV 2011): 256
comparisons of smoothed grey values in a rotated neighbourhood. ORB takes the rotation from the image itself; here it is
the direction of gravity, projected at the corner, which is known to a fraction of a degree. It does not depend on the
image, so that equal corners never get different orientations, and corners that differ by a rotation stay different.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import repeat
from typing import Annotated

import cv2
import numpy as np
import numpy.typing as npt

from dronevio.estimator.frontend.protocol import is_inside
from dronevio.estimator.slam.map.keyframe import (
    DESCRIPTOR_BYTES,
    NO_KEYFRAME_FEATURES,
    Descriptors,
    KeyframeFeatures,
)
from dronevio.estimator.types import Observations
from dronevio.models.arrays import Array, Image, Integers
from dronevio.models.camera import CameraModel
from dronevio.models.ranges import Range, Settings
from dronevio.models.rig import Rig, RigCamera

Scores = npt.NDArray[np.float32]

DOWNSAMPLING = 2  # pixels at full resolution per pixel of the image in which corners are detected
BLOCK_PX = 3  # side of the block over which gradients are summed, at half resolution
PATCH_PX = 31.0  # side of the neighbourhood that a descriptor compares; it also keeps as far from the border
DIRECTION_STEP = 1e-3  # length of the step along gravity whose projection is the direction at a corner
DOWN = np.array([0.0, 0.0, -1.0])
MIN_VERTICAL_DEG = 5.0  # smallest angle between bearing and vertical at which gravity defines a direction


@dataclass(frozen=True)
class PlaceFeatureConfig(Settings):
    """Settings of the corners that are described for the recognition of places."""

    corners: Annotated[int, Range(0, 5000)] = 500
    """Largest number of corners in each image beside the tracked features."""
    cell_px: Annotated[int, Range(16, 2000)] = 80
    """Side of the grid cells over which the corners are distributed evenly [px]."""
    spacing_px: Annotated[int, Range(1, 100)] = 7
    """Smallest distance between two corners in each direction, and between a corner and a tracked feature [px]."""
    min_score: Annotated[float, Range(low=0.0)] = 4e-5
    """Smallest accepted eigenvalue of the gradient matrix, for grey levels scaled to [0, 1]."""


class PlaceFeatureExtractor:
    """Detects and describes the corners of keyframes."""

    def __init__(self, config: PlaceFeatureConfig | None = None) -> None:
        """Prepare the descriptors.

        Args:
            config: Settings.
        """
        self._config = config or PlaceFeatureConfig()
        self._orb = cv2.ORB.create(nlevels=1, edgeThreshold=0, patchSize=int(PATCH_PX))

    def extract(
        self,
        images: Sequence[Image],
        rig: Rig,
        R_odom_imu: Array,
        observations: Observations,
        cameras: Sequence[int] | None = None,
    ) -> KeyframeFeatures:
        """Return the described corners of a keyframe.

        Args:
            images: Images of the cameras of the rig.
            rig: The calibration.
            R_odom_imu: (3, 3) Orientation of the IMU in the odometry frame, whose z axis points up.
            observations: The tracked features of the keyframe, which become the first corners of their cameras.
            cameras: Indices of the cameras whose images are used; by default those that track features. A camera that
                sees the same as another one adds cost and hardly any places.
        """
        parts = []
        for index in np.unique(observations.camera).tolist() if cameras is None else cameras:
            if images[index].size:
                of_camera = observations.camera == index
                pixels, ids = observations.pixels[of_camera], observations.ids[of_camera]
                down_imu = DOWN @ R_odom_imu
                parts.append(self._of_camera(images[index], index, rig.cameras[index], down_imu, pixels, ids))
        if not parts:
            return NO_KEYFRAME_FEATURES
        return KeyframeFeatures(
            np.concatenate([each.pixels for each in parts]),
            np.concatenate([each.xy for each in parts]),
            np.concatenate([each.camera for each in parts]),
            np.concatenate([each.descriptors for each in parts]),
            np.concatenate([each.landmark for each in parts]),
        )

    def _of_camera(
        self, image: Image, index: int, camera: RigCamera, down_imu: Array, tracked: Array, ids: Integers
    ) -> KeyframeFeatures:
        """Return the described corners of one camera."""
        extra = detect_spread_corners(image, tracked, self._config)
        pixels = np.concatenate([tracked, extra])
        landmark = np.concatenate([ids, np.full(len(extra), -1, np.int64)])
        xy = camera.model.normalize(pixels)
        down_cam = down_imu @ camera.T_imu_cam[:3, :3]
        angles, is_defined = gravity_angles(camera.model, xy, down_cam, np.radians(MIN_VERTICAL_DEG))
        pixels, xy, landmark, angles = pixels[is_defined], xy[is_defined], landmark[is_defined], angles[is_defined]
        rows, descriptors = self._describe(image, camera.model, pixels, angles)
        return KeyframeFeatures(
            pixels[rows], xy[rows], np.full(len(rows), index, np.int64), descriptors, landmark[rows]
        )

    def _describe(
        self, image: Image, camera: CameraModel, pixels: Array, angles_rad: Array
    ) -> tuple[Integers, Descriptors]:
        """Return the rows (M,) of corners away from the border, and their descriptors (M, 32)."""
        margin = PATCH_PX / np.sqrt(2.0)  # the neighbourhood may be rotated by 45°
        rows = np.flatnonzero(is_inside(pixels, camera, margin))
        x, y = pixels[rows].T.tolist()
        degrees = np.degrees(angles_rad[rows]).tolist()
        corners = list(map(cv2.KeyPoint, x, y, repeat(PATCH_PX), degrees, repeat(1.0), repeat(0), rows.tolist()))
        kept, descriptors = self._orb.compute(image, corners)
        if not kept:
            return np.zeros(0, np.int64), np.zeros((0, DESCRIPTOR_BYTES), np.uint8)
        return np.array([corner.class_id for corner in kept], np.int64), np.asarray(descriptors, np.uint8)


def detect_spread_corners(image: Image, occupied: Array, config: PlaceFeatureConfig) -> Array:
    """Return corners (N, 2) [px] that are spread over the image, N at most ``config.corners``.

    Corners are local maxima of the score. Of each grid cell, the best ones are taken, as many in each cell as keep the
    total below the limit. The position within the pixel is the maximum of a parabola through the neighbouring scores.

    Args:
        image: (H, W) Image.
        occupied: (M, 2) Positions of the tracked features, near which no corner is returned [px].
        config: Settings.
    """
    half = cv2.resize(image, None, fx=1.0 / DOWNSAMPLING, fy=1.0 / DOWNSAMPLING, interpolation=cv2.INTER_AREA)
    score = np.asarray(cv2.cornerMinEigenVal(half, BLOCK_PX, ksize=3), np.float32)
    side = 2 * (config.spacing_px // DOWNSAMPLING) + 1
    neighbourhood = np.ones((side, side), np.uint8)
    is_corner = (score >= cv2.dilate(score, neighbourhood)) & (score > config.min_score)
    is_near = np.zeros(score.shape, np.uint8)
    column, row = np.rint(occupied / DOWNSAMPLING).astype(int).T
    is_near[np.clip(row, 0, score.shape[0] - 1), np.clip(column, 0, score.shape[1] - 1)] = 1
    is_corner &= cv2.dilate(is_near, neighbourhood) == 0
    border = int(np.ceil(PATCH_PX / np.sqrt(2.0) / DOWNSAMPLING)) + 1
    is_corner[:border] = is_corner[-border:] = False
    is_corner[:, :border] = is_corner[:, -border:] = False
    row, column = np.nonzero(is_corner)
    rank = _rank_in_cell(row, column, score, max(config.cell_px // DOWNSAMPLING, 1))
    # Of equal ranks the better score is taken first; positions make the order unique.
    order = np.lexsort((column, row, -score[row, column], rank))[: config.corners]
    row, column = row[order], column[order]
    x = column + _peak(score[row, column - 1], score[row, column], score[row, column + 1])
    y = row + _peak(score[row - 1, column], score[row, column], score[row + 1, column])
    corners = np.column_stack([x, y]).astype(np.float64)
    return np.asarray(DOWNSAMPLING * (corners + 0.5) - 0.5)  # pixel centres have integer coordinates


def gravity_angles(
    camera: CameraModel, xy: Array, down_cam: Array, min_vertical_rad: float
) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Return the directions of gravity in an image, at some corners.

    Args:
        camera: Intrinsics of the camera.
        xy: (N, 2) Normalized coordinates of the corners.
        down_cam: (3,) Unit vector of gravity in the camera frame.
        min_vertical_rad: Smallest angle between a corner's bearing and the vertical [rad].

    Returns:
        The angles (N,) from the image's u axis toward its v axis [rad], and whether each is defined (N,).
    """
    rays = np.column_stack([xy, np.ones(len(xy))])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    step = DIRECTION_STEP * down_cam
    direction = camera.project(rays + step) - camera.project(rays - step)
    angles = np.arctan2(direction[:, 1], direction[:, 0])
    is_defined = (np.abs(rays @ down_cam) < np.cos(min_vertical_rad)) & np.isfinite(angles)
    return np.where(is_defined, angles, 0.0), is_defined


def _rank_in_cell(row: Integers, column: Integers, score: Scores, side: int) -> Integers:
    """Return the ranks (N,) of corners among those of their grid cell, 0 for the best."""
    cells = row // side * (score.shape[1] // side + 1) + column // side
    order = np.lexsort((column, row, -score[row, column], cells))
    is_first = np.diff(cells[order], prepend=-1) != 0
    position = np.arange(len(order))
    rank = np.empty(len(order), np.int64)
    rank[order] = position - np.maximum.accumulate(np.where(is_first, position, 0))
    return rank


def _peak(before: Scores, at: Scores, after: Scores) -> Scores:
    """Return the offset (N,), −0.5 to 0.5, of the maximum of a parabola through three neighbouring values (N,)."""
    curvature = before - 2.0 * at + after
    slope = 0.5 * (after - before)
    return np.clip(-slope / np.minimum(curvature, np.float32(-1e-12)), -0.5, 0.5)
