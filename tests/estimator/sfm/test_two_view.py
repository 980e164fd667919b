"""Matching and geometric verification of two images."""

from dataclasses import replace
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest

from dronevio.estimator.sfm.config import FeatureConfig, MatchingConfig, VerificationConfig
from dronevio.estimator.sfm.features import Features, detect_features
from dronevio.estimator.sfm.matching import match_features
from dronevio.estimator.sfm.two_view import Geometry, TwoView, verify, view_of
from dronevio.models.camera import CameraModel
from dronevio.models.rotation import inverse_pose, log_so3

if TYPE_CHECKING:
    from tests.estimator.sfm.conftest import MakeScene, SyntheticScene

FISHEYE = CameraModel(640, 640, 200.0, 200.0, 320.0, 320.0, (0.02, -0.003, 0.0, 0.0), "equidistant")


def verified(scene: "SyntheticScene", i: int, j: int, is_calibrated: bool = True) -> TwoView:
    views = tuple(view_of(scene.features[k].pixels, scene.camera, is_calibrated) for k in (i, j))
    matches = match_features(scene.features[i], scene.features[j], MatchingConfig())
    pair = verify(i, j, (views[0], views[1]), matches, VerificationConfig())
    assert pair is not None
    return pair


def test_matches_are_the_same_points(scene: "SyntheticScene") -> None:
    matches = match_features(scene.features[0], scene.features[3], MatchingConfig())
    common = np.intersect1d(scene.point_of[0], scene.point_of[3])
    assert len(matches) > 0.95 * len(common)
    assert np.mean(scene.point_of[0][matches[:, 0]] == scene.point_of[3][matches[:, 1]]) > 0.99
    assert len(np.unique(matches[:, 0])) == len(np.unique(matches[:, 1])) == len(matches)


def doubled(features: Features) -> Features:
    """Return each feature twice, as on a repetitive texture."""
    return replace(
        features,
        pixels=np.tile(features.pixels, (2, 1)),
        sizes_px=np.tile(features.sizes_px, 2),
        descriptors=np.tile(features.descriptors, (2, 1)),
        colours=np.tile(features.colours, (2, 1)),
    )


def test_large_features_are_less_certain(scene: "SyntheticScene") -> None:
    few = replace(scene.features[0], sizes_px=np.array([1.0, 8.0, 80.0]))
    assert few.sigmas == pytest.approx([1.0, np.sqrt(2.0), 10.05], rel=0.07)  # rounded to an eighth in the logarithm


def test_ambiguous_features_are_not_matched(scene: "SyntheticScene") -> None:
    first, second = scene.features[0], scene.features[1]
    assert len(match_features(first, second, MatchingConfig())) > 100
    assert len(match_features(first, doubled(second), MatchingConfig())) == 0


def test_a_stricter_ratio_leaves_fewer_matches(scene: "SyntheticScene") -> None:
    first, second = scene.features[:2]
    counts = [len(match_features(first, second, MatchingConfig(ratio=ratio))) for ratio in (0.01, 0.8)]
    assert counts[0] < counts[1]


def test_settings_change_the_number_of_features() -> None:
    shades = cv2.resize(np.random.default_rng(0).normal(size=(40, 50)), (500, 400), interpolation=cv2.INTER_CUBIC)
    image = np.clip(128.0 + 6.0 * shades, 0, 255).astype(np.uint8)
    default = len(detect_features(image, FeatureConfig()))
    assert len(detect_features(image, FeatureConfig(max_features=50))) < default
    assert len(detect_features(image, FeatureConfig(contrast_threshold=0.005))) > default > 50


def test_large_images_are_reduced_and_positions_stay_those_of_the_image() -> None:
    """An image whose pixels are repeated three times in each direction, reduced by three, is the image."""
    smooth = cv2.GaussianBlur(np.random.default_rng(7).uniform(size=(90, 120)), (0, 0), 1.5)
    image = np.asarray(255.0 * (smooth - smooth.min()) / np.ptp(smooth), np.uint8)
    mask = np.ones(image.shape, bool)
    mask[:, :60] = False
    small = detect_features(image, FeatureConfig(), mask)
    repeated, wide = (np.kron(each, np.ones((3, 3), each.dtype)) for each in (image, mask))
    large = detect_features(repeated, FeatureConfig(max_side_px=120), wide)
    np.testing.assert_allclose(large.pixels, 3.0 * (small.pixels + 0.5) - 0.5, atol=1e-9)
    np.testing.assert_allclose(large.sizes_px, 3.0 * small.sizes_px)
    np.testing.assert_array_equal(large.descriptors, small.descriptors)
    np.testing.assert_array_equal(large.colours, small.colours)
    assert len(large) > 20 and large.pixels[:, 0].min() > 170.0


def test_no_feature_is_matched_twice(scene: "SyntheticScene") -> None:
    matches = match_features(doubled(scene.features[0]), scene.features[1], MatchingConfig())
    assert len(matches) > 100
    assert len(np.unique(matches[:, 1])) == len(matches)


@pytest.mark.parametrize("camera", [None, FISHEYE], ids=["radtan", "fisheye"])
def test_relative_pose_is_the_true_one(camera: CameraModel | None, make_scene: "MakeScene") -> None:
    scene = make_scene(camera=camera)
    pair = verified(scene, 0, 4)
    true = inverse_pose(scene.Ts_world_cam[0]) @ scene.Ts_world_cam[4]
    assert pair.geometry is Geometry.GENERAL
    assert np.degrees(np.linalg.norm(log_so3(true[:3, :3].T @ pair.T_first_second[:3, :3]))) < 0.5
    direction = true[:3, 3] / np.linalg.norm(true[:3, 3])
    assert np.degrees(np.arccos(direction @ pair.T_first_second[:3, 3])) < 2.0


def test_outliers_are_rejected(scene: "SyntheticScene") -> None:
    rng = np.random.default_rng(1)
    matches = match_features(scene.features[0], scene.features[4], MatchingConfig())
    wrong = np.column_stack([rng.integers(0, len(scene.features[k]), len(matches) // 2) for k in (0, 4)])
    views = tuple(view_of(scene.features[k].pixels, scene.camera, True) for k in (0, 4))
    mixed = np.concatenate([matches, wrong])
    pair = verify(0, 4, (views[0], views[1]), mixed, VerificationConfig())
    assert pair is not None
    is_right = scene.point_of[0][pair.matches[:, 0]] == scene.point_of[4][pair.matches[:, 1]]
    assert is_right.mean() > 0.95
    assert is_right.sum() > 0.95 * len(matches)


def test_planes_are_recognized(make_scene: "MakeScene") -> None:
    assert verified(make_scene(flat=True), 0, 4).geometry is Geometry.PLANAR


def test_scenes_with_little_parallax_are_not_planes() -> None:
    rng = np.random.default_rng(0)
    depth = np.where(np.arange(300) < 200, 5.0, rng.uniform(4.6, 5.4, 300))  # within 3 px of a homography
    camera = CameraModel(640, 480, 500.0, 500.0, 320.0, 240.0)
    points = depth[:, None] * np.column_stack([rng.uniform(-0.5, 0.5, (300, 2)), np.ones(300)])
    for far, geometry in ((depth, Geometry.GENERAL), (np.full(300, 5.0), Geometry.PLANAR)):
        points[:, 2] = far
        pixels = [camera.project(points - [x, 0.0, 0.0]) + rng.normal(scale=0.1, size=(300, 2)) for x in (0.0, 0.3)]
        views = tuple(view_of(px, camera, True) for px in pixels)
        matches = np.column_stack([np.arange(300)] * 2)
        pair = verify(0, 1, (views[0], views[1]), matches, VerificationConfig())
        assert pair is not None
        assert pair.geometry is geometry


@pytest.mark.parametrize("is_calibrated", [True, False])
def test_rotations_without_translation_are_recognized(is_calibrated: bool, make_scene: "MakeScene") -> None:
    scene = make_scene(rotation_only=True)
    pair = verified(scene, 2, 4, is_calibrated)
    assert pair.geometry is Geometry.ROTATION
    true = inverse_pose(scene.Ts_world_cam[2]) @ scene.Ts_world_cam[4]
    assert np.degrees(np.linalg.norm(log_so3(true[:3, :3].T @ pair.T_first_second[:3, :3]))) < 0.1


def test_unrelated_images_are_not_a_pair(scene: "SyntheticScene", make_scene: "MakeScene") -> None:
    other = make_scene(seed=9)
    views = tuple(view_of(f.pixels, scene.camera, True) for f in (scene.features[0], other.features[0]))
    rng = np.random.default_rng(0)
    random = np.column_stack([rng.permutation(len(f.pixels))[:100] for f in (scene.features[0], other.features[0])])
    assert verify(0, 1, (views[0], views[1]), random, VerificationConfig(min_inliers=40)) is None
