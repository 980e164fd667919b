"""Scale of a reconstruction from the baseline of a stereo rig."""

from dataclasses import replace
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
import pytest

from dronevio.estimator.array_store import digest
from dronevio.estimator.sfm.config import SfmConfig
from dronevio.estimator.sfm.pipeline import reconstruct
from dronevio.estimator.sfm.placement.rig import rig_poses
from dronevio.estimator.sfm.workspace import Workspace
from dronevio.models.rotation import inverse_pose

if TYPE_CHECKING:
    from pathlib import Path

    from tests.estimator.sfm.conftest import MakeImages, MakeScene

BASELINE_M = 0.2


def test_a_stereo_rig_gives_metres(make_scene: "MakeScene", make_images: "MakeImages", tmp_path: "Path") -> None:
    scene = make_scene(images=8, baseline_m=BASELINE_M)
    images, workspace = make_images(scene, tmp_path, BASELINE_M)
    result = reconstruct(images, SfmConfig(), workspace)
    assert result.is_metric
    [found] = result.reconstructions
    assert found.image_names == images.names
    true, estimated = scene.Ts_world_cam[:, :3, 3], found.positions
    for i, j in combinations(range(8), 2):
        assert np.linalg.norm(estimated[i] - estimated[j]) == pytest.approx(np.linalg.norm(true[i] - true[j]), rel=0.03)
    for i in range(0, 8, 2):  # the mounting holds to the accuracy of its factor
        T = inverse_pose(found.Ts_world_cam[i]) @ found.Ts_world_cam[i + 1]
        np.testing.assert_allclose(T[:3, 3], [BASELINE_M, 0.0, 0.0], atol=1e-4)


def test_without_a_rig_the_scale_is_arbitrary(
    make_scene: "MakeScene", make_images: "MakeImages", tmp_path: "Path"
) -> None:
    scene = make_scene(images=6, baseline_m=BASELINE_M)
    images, workspace = make_images(scene, tmp_path, BASELINE_M)
    alone = replace(images, frame=None, Ts_imu_cam=None)
    assert not reconstruct(alone, SfmConfig(), workspace).is_metric


def test_relative_poses_by_hand(make_scene: "MakeScene", make_images: "MakeImages", tmp_path: "Path") -> None:
    scene = make_scene(images=4, baseline_m=BASELINE_M)
    images, _ = make_images(scene, tmp_path, BASELINE_M)
    poses = rig_poses(images, np.array([True, True, False, True]))
    assert [(pose.first, pose.second) for pose in poses] == [(0, 1)]
    np.testing.assert_allclose(poses[0].T_first_second[:3, 3], [BASELINE_M, 0.0, 0.0])


def test_stored_features_belong_to_their_settings(make_scene: "MakeScene", tmp_path: "Path") -> None:
    features = make_scene(images=2).features[0]
    workspace = Workspace(tmp_path)
    workspace.save_features(0, digest("first settings"), features)
    loaded = workspace.load_features(0, digest("first settings"))
    assert loaded is not None
    np.testing.assert_array_equal(loaded.pixels, features.pixels)
    assert workspace.load_features(0, digest("other settings")) is None
    assert workspace.load_features(1, digest("first settings")) is None
