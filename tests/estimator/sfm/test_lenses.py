"""Reconstructions with lenses of all kinds."""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from dronevio.estimator.sfm.adjustment import BundleAdjustmentConfig, adjust
from dronevio.estimator.sfm.pipeline import reconstruct
from dronevio.eval.metrics.alignment import umeyama
from dronevio.models.camera import CameraModel

if TYPE_CHECKING:
    from pathlib import Path

    from tests.estimator.sfm.conftest import MakeImages, MakeScene

DS = CameraModel(640, 640, 190.0, 191.0, 319.5, 318.0, (-0.172, 0.593), "ds")
OMNI = CameraModel(640, 480, 800.0, 802.0, 319.5, 238.0, (1.6, -0.2, 0.1, 1e-3, -1e-3), "omni")
RATIONAL = CameraModel(640, 480, 420.0, 422.0, 319.5, 238.0, (0.4, 0.05, 5e-4, -5e-4, 0.001, 0.5, 0.1, 0.002))


@pytest.mark.parametrize("camera", [DS, OMNI, RATIONAL], ids=lambda camera: camera.lens)
def test_scenes_are_reconstructed(
    make_scene: "MakeScene", make_images: "MakeImages", tmp_path: "Path", camera: CameraModel
) -> None:
    scene = make_scene(camera=camera, images=6, wide=camera.lens == "ds")
    images, workspace = make_images(scene, tmp_path)
    [found] = reconstruct(images, None, workspace).reconstructions
    assert found.image_names == images.names and found.cameras == (camera,)
    assert np.median(found.reprojection_errors_px()) < 0.8
    true = scene.Ts_world_cam[:, :3, 3]
    aligned = umeyama(true, found.positions, with_scale=True)
    errors = np.linalg.norm(true - (aligned.scale * found.positions @ aligned.R_truth_estimate.T + aligned.t_m), axis=1)
    assert errors.max() < 0.02


def test_a_superfluous_coefficient_does_not_change_the_minimum(
    make_scene: "MakeScene", make_images: "MakeImages", tmp_path: "Path", monkeypatch: pytest.MonkeyPatch
) -> None:
    """A radial-tangential lens, and the same one with a further coefficient that is zero."""
    camera = CameraModel(640, 480, 420.0, 422.0, 319.5, 238.0, (-0.2, 0.05, 1e-3, -1e-3))
    scene = make_scene(camera=camera, images=6)
    images, workspace = make_images(scene, tmp_path)
    seen = []

    def recorded(*arguments: object, **settings: object) -> object:
        seen.append((arguments, settings))
        return adjust(*arguments, **settings)  # type: ignore[arg-type]

    monkeypatch.setattr("dronevio.estimator.sfm.mapper.adjust", recorded)
    reconstruct(images, None, workspace)
    (measured, state, selected, _, *_), settings = seen[-1]
    longer = replace(camera, distortion=(*camera.distortion, 0.0))
    exact = BundleAdjustmentConfig(relative_tolerance=1e-12, cauchy_px=0.3)  # the minimum depends on the noise
    states = [
        adjust(measured, replace(state, cameras=(model,)), selected, exact)  # type: ignore[arg-type,type-var]
        for model in (camera, longer)
    ]
    assert settings is not None and states[1].cameras == (longer,)
    np.testing.assert_allclose(states[1].Ts_world_cam, states[0].Ts_world_cam, atol=1e-7)
    errors = [state.errors_px(measured, selected) for state in states]  # type: ignore[arg-type]
    assert np.sqrt(np.mean(errors[1] ** 2)) == pytest.approx(np.sqrt(np.mean(errors[0] ** 2)), rel=1e-7)
    uncalibrated = replace(measured, is_calibrated=np.array([False]))  # type: ignore[type-var]
    held = adjust(uncalibrated, replace(state, cameras=(longer,)), selected, exact)  # type: ignore[arg-type,type-var]
    assert held.cameras == (longer,)  # there is nothing to estimate it with
