"""Known poses of images, exact or measured."""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from dronevio.estimator.sfm.model import KnownPoses
from dronevio.estimator.sfm.pipeline import reconstruct
from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError
from dronevio.models.rotation import exp_so3

if TYPE_CHECKING:
    from pathlib import Path

    from tests.estimator.sfm.conftest import MakeImages, SyntheticScene


def noisy_poses(scene: "SyntheticScene", sigma_rad: float, sigma_m: float) -> Array:
    """Return the true poses (I, 4, 4) with noise."""
    rng = np.random.default_rng(5)
    Ts = scene.Ts_world_cam.copy()
    Ts[:, :3, :3] = Ts[:, :3, :3] @ exp_so3(rng.normal(scale=sigma_rad, size=(len(Ts), 3)))
    Ts[:, :3, 3] += rng.normal(scale=sigma_m, size=(len(Ts), 3))
    return Ts


def test_exact_poses_stay(scene: "SyntheticScene", make_images: "MakeImages", tmp_path: "Path") -> None:
    images, workspace = make_images(scene, tmp_path)
    known = scene.Ts_world_cam.copy()
    known[5] = np.nan
    result = reconstruct(images, None, workspace, poses=KnownPoses(known))
    [found] = result.reconstructions
    assert result.worlds[0].scale == "poses"
    assert found.image_names == images.names
    others = np.delete(np.arange(8), 5)
    np.testing.assert_array_equal(found.Ts_world_cam[others], scene.Ts_world_cam[others])
    assert np.linalg.norm(found.positions[5] - scene.Ts_world_cam[5, :3, 3]) < 0.01
    # A point in the depth of 5 m, observed by eight cameras within 3 m, has an error of about a centimetre.
    nearest = np.linalg.norm(found.points[:, None] - scene.points[None], axis=2).min(axis=1)
    assert np.median(nearest) < 0.01


def test_poses_of_another_frame_are_refused(
    scene: "SyntheticScene", make_images: "MakeImages", tmp_path: "Path"
) -> None:
    images, workspace = make_images(scene, tmp_path)
    turned = scene.Ts_world_cam.copy()
    turned[:, :3, :3] = turned[:, :3, :3] @ exp_so3(np.array([0.0, np.pi / 2, 0.0]))
    with pytest.raises(ConfigError, match="% of the observations agree with the known poses"):
        reconstruct(images, None, workspace, poses=KnownPoses(turned))
    with pytest.raises(ConfigError, match="known poses of 3 images; expected 8"):
        reconstruct(images, None, workspace, poses=KnownPoses(turned[:3]))


def test_measured_poses_give_the_world_frame(
    scene: "SyntheticScene", make_images: "MakeImages", tmp_path: "Path"
) -> None:
    images, workspace = make_images(scene, tmp_path)
    sigma_rad, sigma_m = 0.02, 0.05
    measured = noisy_poses(scene, sigma_rad, sigma_m)
    [found] = reconstruct(images, None, workspace, poses=KnownPoses(measured, sigma_rad, sigma_m)).reconstructions
    errors, noise = (
        np.linalg.norm(T[:, :3, 3] - scene.Ts_world_cam[:, :3, 3], axis=1) for T in (found.Ts_world_cam, measured)
    )
    assert np.sqrt(np.mean(errors**2)) < 0.8 * np.sqrt(np.mean(noise**2))
    assert errors.max() < 2.0 * sigma_m


def test_precise_poses_outweigh_the_images(
    scene: "SyntheticScene", make_images: "MakeImages", tmp_path: "Path"
) -> None:
    images, workspace = make_images(scene, tmp_path)
    measured = noisy_poses(scene, 1e-4, 0.01)
    measured[3] = np.nan
    [found] = reconstruct(images, None, workspace, poses=KnownPoses(measured, 1e-5, 1e-4)).reconstructions
    others = np.delete(np.arange(8), 3)
    np.testing.assert_allclose(found.positions[others], measured[others, :3, 3], atol=2e-3)


def test_sigmas_of_known_poses() -> None:
    Ts = np.tile(np.eye(4), (2, 1, 1))
    Ts[1] = np.nan
    assert KnownPoses(Ts).is_exact
    assert KnownPoses(Ts).is_known.tolist() == [True, False]
    assert not KnownPoses(Ts, 0.01, 0.1).is_exact
    for sigmas in ((0.01, 0.0), (0.0, 0.1), (-0.01, 0.1)):
        with pytest.raises(ConfigError, match="standard deviations of"):
            replace(KnownPoses(Ts), sigma_rad=sigmas[0], sigma_m=sigmas[1])
