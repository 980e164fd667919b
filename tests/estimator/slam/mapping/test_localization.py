"""Localization in an earlier keyframe on rendered images of a wall."""

from collections.abc import Callable
from dataclasses import fields, replace

import numpy as np
import pytest

from dronevio.estimator.slam.map.keyframe import KeyframeFeatures, MapKeyframe
from dronevio.estimator.slam.map.odometry_factors import RelativePose
from dronevio.estimator.slam.places.localization import (
    KeyframeImages,
    LandmarkPatches,
    LocalizationConfig,
    Localizer,
    landmark_patches,
)
from dronevio.models.arrays import Array, Image
from dronevio.models.camera import CameraModel
from dronevio.models.rig import Rig, euroc_rig
from dronevio.models.rig_presets import rig_named
from dronevio.models.rotation import exp_so3, inverse_pose, log_so3, pose_matrix

RenderWall = Callable[[CameraModel, Array], Image]

WALL_M = 3.0
"""Position of the wall along the z axis of the world [m]."""


class Views:
    """Two keyframes that see a wall, of which the first has landmarks on it."""

    def __init__(self, render: RenderWall, T_first_second: Array, rig: Rig | None = None) -> None:
        """Render both views; the second keyframe has the pose (4, 4) of its IMU in the frame of the first one's."""
        self.rig: Rig = rig or euroc_rig()
        camera = self.rig.cameras[0]
        T_world_imu = inverse_pose(camera.T_imu_cam)  # the first camera is the world frame
        Ts = T_world_imu, T_world_imu @ T_first_second
        self.images = [KeyframeImages((render(camera.model, T @ camera.T_imu_cam),), self.rig) for T in Ts]
        u, v = np.meshgrid(np.arange(60.0, 700.0, 64.0) + 0.3, np.arange(60.0, 430.0, 52.0) - 0.4)
        pixels = np.column_stack([u.ravel(), v.ravel()])
        rays = np.column_stack([camera.model.normalize(pixels), np.ones(len(pixels))])
        in_imu = WALL_M * rays @ camera.T_imu_cam[:3, :3].T + camera.T_imu_cam[:3, 3]
        count = len(pixels)
        ids = np.arange(count)
        nothing = np.zeros((count, 32), np.uint8)
        features = KeyframeFeatures(pixels, rays[:, :2], np.zeros(count, np.int64), nothing, ids)
        self.first = MapKeyframe(0, 0, Ts[0], features, ids, in_imu)
        no_corners = KeyframeFeatures(pixels[:0], pixels[:0], ids[:0], nothing[:0], ids[:0])
        self.second = MapKeyframe(1, 10**10, Ts[1], no_corners, ids[:0], in_imu[:0])
        self.patches = landmark_patches(self.first, self.images[0], LocalizationConfig())


MOTION = pose_matrix(exp_so3(np.array([0.05, -0.08, 0.1])), np.array([0.3, -0.2, 0.25]))
"""Pose of the second IMU in the frame of the first one."""
PREDICTION_ERROR = pose_matrix(exp_so3(np.array([0.002, -0.001, 0.0015])), np.array([0.01, -0.005, 0.008]))


@pytest.fixture(scope="module")
def views(render_wall: RenderWall) -> Views:
    """Return two views of the wall."""
    return Views(render_wall, MOTION)


def test_pose_is_found_to_a_millimetre(views: Views) -> None:
    predicted = MOTION @ PREDICTION_ERROR
    found = Localizer().localize(views.second, views.images[1], views.first, views.patches, predicted)
    assert found is not None and (found.first, found.second) == (0, 1)
    difference = inverse_pose(MOTION) @ found.T_first_second
    assert np.linalg.norm(difference[:3, 3]) < 2e-3
    assert np.linalg.norm(log_so3(difference[:3, :3])) < 5e-4
    error = np.concatenate([log_so3(difference[:3, :3]), difference[:3, 3]])
    assert error @ np.linalg.solve(found.covariance, error) < 20.0
    assert 1e-4 < np.sqrt(np.trace(found.covariance[3:, 3:])) < 0.02


def test_landmarks_are_observed_where_the_new_camera_sees_them(views: Views) -> None:
    found = Localizer().localize(views.second, views.images[1], views.first, views.patches, MOTION @ PREDICTION_ERROR)
    assert found is not None
    seen, camera = found.observations, views.rig.cameras[0]
    assert len(seen) > 30 and len(np.unique(seen.landmark)) == len(seen)
    assert set(seen.keyframe.tolist()) == {views.second.number} and set(seen.camera.tolist()) == {0}
    in_imu = views.first.landmarks_imu[np.searchsorted(views.first.landmark_ids, seen.landmark)]
    T_new_first = inverse_pose(MOTION @ camera.T_imu_cam)
    in_new = in_imu @ T_new_first[:3, :3].T + T_new_first[:3, 3]
    error_px = camera.model.fx * (seen.xy - in_new[:, :2] / in_new[:, 2:])
    assert np.sqrt(np.mean(error_px**2)) < 0.5 * seen.sigma_scale[0]
    np.testing.assert_array_equal(seen.sigma_scale, LocalizationConfig().pose.pixel_sigma)


def test_change_of_light_leaves_the_pose(views: Views) -> None:
    darker = tuple(np.clip(0.6 * image + 20.0, 0, 255).astype(np.uint8) for image in views.images[1].images)
    found = Localizer().localize(
        views.second, replace(views.images[1], images=darker), views.first, views.patches, MOTION @ PREDICTION_ERROR
    )
    assert found is not None
    assert np.linalg.norm((inverse_pose(MOTION) @ found.T_first_second)[:3, 3]) < 3e-3


def test_another_place_is_not_found(views: Views) -> None:
    elsewhere = tuple(np.ascontiguousarray(image[:, ::-1]) for image in views.images[1].images)
    images = replace(views.images[1], images=elsewhere)
    assert Localizer().localize(views.second, images, views.first, views.patches, MOTION) is None


def test_wrong_prediction_is_refused(views: Views) -> None:
    far = MOTION @ pose_matrix(np.eye(3), np.array([0.3, 0.3, 0.0]))
    assert Localizer().localize(views.second, views.images[1], views.first, views.patches, far) is None


def test_few_of_the_landmarks_in_view_are_no_place(views: Views) -> None:
    """With a wrong prediction, a few patches may agree by chance; here, most of the image shows nothing."""

    def localized(visible_rows: int, config: LocalizationConfig) -> RelativePose | None:
        image = views.images[1].images[0].copy()
        image[visible_rows:] = 128
        images = replace(views.images[1], images=(image,))
        return Localizer(config).localize(views.second, images, views.first, views.patches, MOTION)

    whole = localized(480, LocalizationConfig())
    assert whole is not None
    half, few = localized(300, LocalizationConfig()), localized(140, LocalizationConfig(min_view_ratio=0.0))
    assert half is not None and len(half.observations) > 0.4 * len(whole.observations)
    assert few is not None and 15 <= len(few.observations) < 0.3 * len(whole.observations)
    assert localized(140, LocalizationConfig()) is None


def test_patches_far_from_their_predicted_positions_are_not_used(views: Views) -> None:
    """The prediction turns all patches by about 6 px, which the alignment could correct."""
    turned = MOTION @ pose_matrix(exp_so3(views.rig.cameras[0].T_imu_cam[:3, :3] @ [0.0, 0.013, 0.0]), np.zeros(3))

    def localized(max_shift_px: float) -> RelativePose | None:
        config = LocalizationConfig(max_shift_px=max_shift_px)
        return Localizer(config).localize(views.second, views.images[1], views.first, views.patches, turned)

    found = localized(9.0)
    assert found is not None and np.linalg.norm((inverse_pose(MOTION) @ found.T_first_second)[:3, 3]) < 2e-3
    assert localized(5.0) is None


@pytest.mark.parametrize("ahead_m", [0.9, -0.9])
def test_landmarks_from_very_different_distances_are_not_used(render_wall: RenderWall, ahead_m: float) -> None:
    """The distance from the wall, 3 m, changes to 2.1 or 3.9 m."""
    rig = rig_named("pinhole")
    T_imu_cam = rig.cameras[0].T_imu_cam
    ahead = pose_matrix(np.eye(3), np.array([0.0, 0.0, ahead_m]))
    T_first_second = T_imu_cam @ ahead @ inverse_pose(T_imu_cam)
    v = Views(render_wall, T_first_second, rig)
    ratio = max(WALL_M / (WALL_M - ahead_m), (WALL_M - ahead_m) / WALL_M)

    def localized(max_scale: float) -> RelativePose | None:
        localizer = Localizer(LocalizationConfig(max_scale=max_scale))
        return localizer.localize(v.second, v.images[1], v.first, v.patches, T_first_second)

    assert localized(1.01 * ratio) is not None
    assert localized(0.99 * ratio) is None


def test_patches_that_contradict_the_pose_are_counted(views: Views) -> None:
    """Every fourth landmark is wrong by 2 cm: its patch is aligned 3 px beside its prediction, against the pose."""
    points = views.patches.points_imu.copy()
    R_imu_cam, across = views.rig.cameras[0].T_imu_cam[:3, :3], np.zeros((len(points[::4]), 3))
    across[:, :2] = np.random.default_rng(0).normal(size=(len(across), 2))
    points[::4] += 0.02 * across / np.linalg.norm(across, axis=1, keepdims=True) @ R_imu_cam.T
    patches = replace(views.patches, points_imu=points)

    def localized(min_inlier_ratio: float) -> RelativePose | None:
        localizer = Localizer(LocalizationConfig(min_inlier_ratio=min_inlier_ratio))
        return localizer.localize(views.second, views.images[1], views.first, patches, MOTION)

    found = localized(0.75)
    assert found is not None and np.linalg.norm((inverse_pose(MOTION) @ found.T_first_second)[:3, 3]) < 5e-3
    assert 0.75 * len(points) < len(found.observations) < 0.9 * len(points)
    assert localized(0.9) is None


def test_an_uncertain_pose_is_refused(views: Views) -> None:
    """Landmarks close together give it with larger standard deviations than all of them."""

    def localized(patches: LandmarkPatches, config: LocalizationConfig) -> RelativePose | None:
        return Localizer(config).localize(views.second, views.images[1], views.first, patches, MOTION)

    near = np.argsort(np.linalg.norm(views.patches.pixels - np.array([500.0, 250.0]), axis=1))[:16]
    close = replace(views.patches, **{f.name: getattr(views.patches, f.name)[near] for f in fields(views.patches)})
    found = localized(close, LocalizationConfig())
    assert found is not None
    sigmas = [float(np.sqrt(np.linalg.eigvalsh(found.covariance[i : i + 3, i : i + 3])[-1])) for i in (0, 3)]
    limits = (
        LocalizationConfig(max_sigma_deg=float(np.degrees(0.99 * sigmas[0]))),
        LocalizationConfig(max_sigma_m=0.99 * sigmas[1]),
    )
    for config in limits:
        assert localized(close, config) is None and localized(views.patches, config) is not None


def test_landmarks_near_the_border_have_no_patch(views: Views) -> None:
    features = views.first.features
    pixels = features.pixels.copy()
    pixels[:5] = [[2.0, 100.0], [749.0, 100.0], [100.0, 3.0], [100.0, 476.0], [8.0, 8.0]]
    keyframe = replace(views.first, features=replace(features, pixels=pixels))
    patches = landmark_patches(keyframe, views.images[0], LocalizationConfig())
    assert len(patches.tiles) == len(pixels) - 5
    middle = patches.tiles.shape[1] // 2
    u, v = np.rint(patches.pixels).astype(int).T
    np.testing.assert_array_equal(patches.tiles[:, middle, middle], views.images[0].images[0][v, u])
