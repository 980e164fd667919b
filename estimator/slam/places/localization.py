"""Localization of a keyframe in the map, from landmarks of an earlier keyframe that shows the same place.

The earlier keyframe keeps a small image around each of its landmarks. Where its pose relative to the new one is nearly
known, each of them is warped as the change of viewpoint demands and aligned with the new image to a fraction of a pixel
(`frontend.patches`), which descriptors at corners cannot reach. The pose then follows from robust least squares
(`relative_pose`). It is the data association of direct methods (Forster et al., "SVO: Semidirect visual odometry for
monocular and multicamera systems", T-RO 2017, section VI) with the map instead of the previous frame.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any

import numpy as np

from dronevio.estimator.frontend.patches import PatchAligner, PatchConfig
from dronevio.estimator.slam.map.keyframe import KeyframeFeatures, MapKeyframe
from dronevio.estimator.slam.map.odometry_factors import RelativePose
from dronevio.estimator.slam.places.matching import Correspondences, described_landmarks
from dronevio.estimator.slam.places.relative_pose import RelativePoseConfig, Views, refine, whitened_errors
from dronevio.models.arrays import Array, Image, Integers, Mask
from dronevio.models.camera import CameraModel
from dronevio.models.ranges import Range, Settings
from dronevio.models.rig import Rig
from dronevio.models.rotation import inverse_pose

BORDER_PX = 3  # pixels around a patch that its gradients and its blur need
MIN_LOCALIZED_DEPTH_M = 0.2  # smallest depth of a landmark that is projected
MAX_LOCALIZED_VIEW_DEG = 35.0
"""Largest angle between the two views of a landmark [°]."""


@dataclass(frozen=True)
class LocalizationConfig(Settings):
    """Settings of the localization of keyframes in the map."""

    patches: PatchConfig = field(default_factory=lambda: PatchConfig(min_zncc=0.85, warp_sigma=0.1))
    """Settings of the alignment of patches."""
    pose: RelativePoseConfig = field(
        default_factory=lambda: RelativePoseConfig(pixel_sigma=0.4, depth_sigma=0.015, scale_sigma=0.003)
    )
    """Assumed errors of the measurements."""
    max_shift_px: Annotated[float, Range(0.1, 100.0)] = 4.0
    """Largest distance between the predicted and the aligned position of a patch [px]."""
    max_scale: Annotated[float, Range(1.0, 4.0)] = 1.8
    """Largest ratio of the distances from which a landmark is seen."""
    max_error_sigmas: Annotated[float, Range(0.1, 100.0)] = 3.0
    """Largest error of a landmark that agrees with the pose, in standard deviations."""
    min_inliers: Annotated[int, Range(3, 1000)] = 15
    """Smallest number of landmarks that agree with the pose."""
    min_inlier_ratio: Annotated[float, Range(0.0, 1.0)] = 0.5
    """Smallest share of the aligned patches that agree with the pose."""
    min_view_ratio: Annotated[float, Range(0.0, 1.0)] = 0.33
    """Smallest share of the landmarks in view that agree with the pose. If the prediction is wrong, some patches are
    aligned with similar texture near it, and these may agree with a wrong pose; most patches are not found."""
    max_sigma_m: Annotated[float, Range(1e-4, 10.0)] = 0.05
    """Largest standard deviation of the position, in any direction [m]."""
    max_sigma_deg: Annotated[float, Range(0.001, 90.0)] = 0.33
    """Largest standard deviation of the rotation, about any axis [°]. Few landmarks close together may leave more."""


@dataclass(frozen=True, eq=False)
class LandmarkPatches:
    """Small images around the landmarks of a keyframe."""

    landmark: Integers
    """(L,) Identities of the landmarks; -1 in a loaded map where they are not known."""
    points_imu: Array
    """(L, 3) Positions of the landmarks in the IMU frame of the keyframe [m]."""
    pixels: Array
    """(L, 2) Positions of the landmarks in the image [px]."""
    camera: Integers
    """(L,) Index of the camera that observes each landmark."""
    tiles: Image
    """(L, S, S) Small images, of which the middle pixel is the one nearest to the landmark."""


@dataclass(frozen=True, eq=False)
class KeyframeImages:
    """The images of a keyframe that has not left the odometry's window."""

    images: Sequence[Image]
    """Images of the cameras."""
    rig: Rig
    """The calibration in use."""


@dataclass(frozen=True, eq=False)
class KeyframeView:
    """What the cameras show at a keyframe."""

    features: KeyframeFeatures
    """The corners of its images."""
    images: KeyframeImages | None = None
    """Its images, by which it is localized and others are localized in it; None without images."""


def tile_side_px(config: LocalizationConfig) -> int:
    """Return the side of the small images around landmarks [px]."""
    return 2 * (config.patches.side_px // 2 + BORDER_PX) + 1


def landmark_patches(keyframe: MapKeyframe, images: KeyframeImages, config: LocalizationConfig) -> LandmarkPatches:
    """Return small images around the landmarks of a keyframe, except those near the border of the image."""
    rows, landmark = described_landmarks(keyframe)
    reach = config.patches.side_px // 2 + BORDER_PX
    pixels, camera = keyframe.features.pixels[rows], keyframe.features.camera[rows]
    centre = np.rint(pixels).astype(np.int64)
    size = np.array([images.images[i].shape[::-1] for i in camera.tolist()]).reshape(-1, 2)
    is_inside = np.all((centre >= reach) & (centre < size - reach), axis=1)
    rows, landmark, pixels, camera, centre = _select(is_inside, rows, landmark, pixels, camera, centre)
    tiles = np.zeros((len(rows), 2 * reach + 1, 2 * reach + 1), np.uint8)
    line = np.arange(-reach, reach + 1)
    for index in np.unique(camera).tolist():
        of_camera = camera == index
        u, v = centre[of_camera].T
        tiles[of_camera] = images.images[index][v[:, None, None] + line[:, None], u[:, None, None] + line]
    return LandmarkPatches(keyframe.landmark_ids[landmark], keyframe.landmarks_imu[landmark], pixels, camera, tiles)


class Localizer:
    """Measures the pose of a keyframe in the frame of an earlier one."""

    def __init__(self, config: LocalizationConfig | None = None) -> None:
        """Prepare the alignment.

        Args:
            config: Settings.
        """
        self._config = config or LocalizationConfig()
        self._aligner = PatchAligner(self._config.patches)

    def localize(
        self,
        query: MapKeyframe,
        images: KeyframeImages,
        match: MapKeyframe,
        patches: LandmarkPatches,
        T_match_query: Array,
    ) -> RelativePose | None:
        """Return the pose of a keyframe in the frame of an earlier one, None if too few landmarks agree.

        Args:
            query: The new keyframe.
            images: Its images.
            match: The earlier keyframe.
            patches: Its landmarks.
            T_match_query: (4, 4) Predicted pose of the query's IMU in the IMU frame of the match.
        """
        c, rig = self._config, images.rig
        # Patches of the match, aligned with the images of the query
        in_view = [self._in_view(patches, index, images, T_match_query) for index in range(len(rig.cameras))]
        aligned = [self._aligned(patches, images.images[i], rig.cameras[i].model, *v) for i, v in enumerate(in_view)]
        rows = np.concatenate([each[0] for each in aligned])
        xy = np.concatenate([each[1] for each in aligned])
        min_count = max(c.min_inliers, c.min_view_ratio * sum(len(each[0]) for each in in_view))
        if len(rows) < min_count:
            return None
        # Relative pose by the aligned landmarks
        camera = patches.camera[rows]
        old = Correspondences(patches.landmark[rows], patches.points_imu[rows], camera, xy, camera)
        new = old[np.zeros(0, np.int64)]
        Ts_imu_cam = np.stack([each.T_imu_cam for each in rig.cameras])
        focal_px = np.array([each.model.central_focal_px[0] for each in rig.cameras])
        views = Views(Ts_imu_cam, focal_px, match.T_odom_imu[:3, :3], query.T_odom_imu[:3, :3])
        fit = refine(T_match_query, old, new, views, c.pose)
        if fit is None:
            return None
        # Tests of the result: inliers and certainty
        error, _ = whitened_errors(fit.T_match_query, old, new, views, c.pose)
        agrees = error < c.max_error_sigmas
        if agrees.sum() < min_count or agrees.mean() < c.min_inlier_ratio:
            return None
        if not fit.is_certain(c.max_sigma_m, np.radians(c.max_sigma_deg)):
            return None
        observations = old[agrees & (old.landmark >= 0)].observed_by(query.number, c.pose.pixel_sigma)
        return RelativePose.measured(match.number, query.number, fit.T_match_query, fit.covariance, observations)

    def _in_view(
        self, patches: LandmarkPatches, index: int, images: KeyframeImages, T_match_query: Array
    ) -> tuple[Integers, Array, Array]:
        """Return the landmarks (N,) of a camera that its new image is expected to show, where (N, 2) [px], and the
        warps (N, 2, 2) of their patches.
        """
        c, camera, image = self._config, images.rig.cameras[index], images.images[index]
        rows = np.flatnonzero(patches.camera == index)
        T_old = camera.T_imu_cam
        T_new_old = inverse_pose(T_match_query @ camera.T_imu_cam) @ T_old
        in_old = (patches.points_imu[rows] - T_old[:3, 3]) @ T_old[:3, :3]
        in_new = in_old @ T_new_old[:3, :3].T + T_new_old[:3, 3]
        rows, in_old, in_new = _select(self._is_visible(in_old, in_new, T_new_old), rows, in_old, in_new)
        if not image.size or not len(rows):
            return rows[:0], np.zeros((0, 2)), np.zeros((0, 2, 2))
        pixels, warp = _projection(camera.model, patches.pixels[rows], in_old, T_new_old)
        reach = c.patches.side_px // 2 + 1
        size = np.array(image.shape[::-1])
        scale = np.sqrt(np.abs(np.linalg.det(warp)))
        is_usable = np.all((pixels >= reach) & (pixels < size - reach), axis=1)
        is_usable &= (scale < c.max_scale) & (scale > 1.0 / c.max_scale)
        rows, pixels, warp = _select(is_usable, rows, pixels, warp)
        return rows, pixels, warp

    def _aligned(
        self, patches: LandmarkPatches, image: Image, camera: CameraModel, rows: Integers, pixels: Array, warp: Array
    ) -> tuple[Integers, Array]:
        """Return the landmarks (N,) that are found near their predicted positions, and where (N, 2), normalized."""
        if not len(rows):
            return rows, np.zeros((0, 2))
        space, centres = _atlas(patches.tiles[rows], patches.pixels[rows])
        templates = self._aligner.extract(self._aligner.scale_space(space), centres)
        templates = type(templates)(templates.templates, templates.rows, warp)
        aligned = self._aligner.align(self._aligner.scale_space(image), templates, pixels)
        is_found = aligned.valid & (np.linalg.norm(aligned.pixels - pixels, axis=1) < self._config.max_shift_px)
        rows, shifted = _select(is_found, rows, aligned.pixels)
        return rows, camera.normalize(shifted)

    def _is_visible(self, in_old: Array, in_new: Array, T_new_old: Array) -> Mask:
        """Return which landmarks, given in both camera frames, are seen from similar directions."""
        away = in_old + T_new_old[:3, :3].T @ T_new_old[:3, 3]  # from the new camera, in the axes of the old one
        cosine = np.sum(in_old * away, axis=1) / (np.linalg.norm(in_old, axis=1) * np.linalg.norm(away, axis=1))
        is_ahead = (in_new[:, 2] > MIN_LOCALIZED_DEPTH_M) & (in_old[:, 2] > MIN_LOCALIZED_DEPTH_M)
        return np.asarray(is_ahead & (cosine > np.cos(np.radians(MAX_LOCALIZED_VIEW_DEG))))


def _projection(camera: CameraModel, pixels: Array, in_old: Array, T_new_old: Array) -> tuple[Array, Array]:
    """Return the predicted pixels (N, 2) of landmarks in a new image, and the affine warps (N, 2, 2) of their patches.

    The surface around a landmark is taken as parallel to the old image.

    Args:
        camera: Intrinsics of the camera.
        pixels: (N, 2) Pixels of the landmarks in the old image.
        in_old: (N, 3) Landmarks in the frame of the old camera [m].
        T_new_old: (4, 4) Pose of the old camera in the frame of the new one.
    """
    steps = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    rays = camera.normalize((pixels[:, None] + steps).reshape(-1, 2)).reshape(-1, 3, 2)
    on_surface = in_old[:, None] + in_old[:, None, 2:] * np.pad(rays - rays[:, :1], ((0, 0), (0, 0), (0, 1)))
    in_new = on_surface @ T_new_old[:3, :3].T + T_new_old[:3, 3]
    projected = camera.project(in_new.reshape(-1, 3)).reshape(-1, 3, 2)
    return projected[:, 0], np.swapaxes(projected[:, 1:] - projected[:, :1], 1, 2)


def _atlas(tiles: Image, pixels: Array) -> tuple[Image, Array]:
    """Return one image of all tiles (N, S, S), side by side, and the positions (N, 2) of their landmarks in it."""
    count, side = tiles.shape[:2]
    image = np.ascontiguousarray(tiles.transpose(1, 0, 2).reshape(side, count * side))
    middle = np.column_stack([np.arange(count) * side + side // 2, np.full(count, side // 2)])
    return image, middle + pixels - np.rint(pixels)


def _select(mask: Mask, *arrays: Any) -> Any:
    """Return the selected rows of arrays."""
    return tuple(array[mask] for array in arrays)
