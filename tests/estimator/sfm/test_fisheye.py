"""Fisheyes without a calibration."""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from dronevio.estimator.sfm.config import MatchingConfig, VerificationConfig
from dronevio.estimator.sfm.focal import guess_fisheyes
from dronevio.estimator.sfm.pipeline import reconstruct
from dronevio.eval.metrics.alignment import umeyama
from dronevio.models.camera import CameraModel
from dronevio.models.image_sets.intrinsics import initial_camera

if TYPE_CHECKING:
    from pathlib import Path

    from tests.estimator.sfm.conftest import MakeImages, MakeScene

FISHEYE = CameraModel(640, 640, 230.0, 230.0, 319.5, 319.5, (0.02, -0.01, 0.004, 0.0), "equidistant")
GUESS, _ = initial_camera(640, 640, lens="equidistant")


@pytest.mark.slow
def test_a_fisheye_is_estimated(make_scene: "MakeScene", make_images: "MakeImages", tmp_path: "Path") -> None:
    scene = make_scene(camera=FISHEYE, wide=True)
    images, workspace = make_images(scene, tmp_path)
    images = replace(images, cameras=(GUESS,), is_calibrated=np.array([False]))
    [found] = reconstruct(images, None, workspace).reconstructions
    assert found.image_names == images.names
    [camera] = found.cameras
    assert camera.lens == "equidistant"
    assert camera.fx == camera.fy
    assert (camera.cx, camera.cy) == (319.5, 319.5)
    # The image of a ray at 60° is where it is with the true camera, to within two pixels.
    ray = np.array([np.sin(np.pi / 3), 0.0, np.cos(np.pi / 3)])
    assert np.abs(camera.project(ray) - FISHEYE.project(ray)).max() < 2.0
    true = scene.Ts_world_cam[:, :3, 3]
    aligned = umeyama(true, found.positions, with_scale=True)
    errors = np.linalg.norm(true - (aligned.scale * found.positions @ aligned.R_truth_estimate.T + aligned.t_m), axis=1)
    assert errors.max() < 0.05


def test_the_first_focal_length_of_a_fisheye(
    make_scene: "MakeScene", make_images: "MakeImages", tmp_path: "Path"
) -> None:
    scene = make_scene(camera=FISHEYE, wide=True)
    images, _ = make_images(scene, tmp_path)
    guess = replace(images, cameras=(GUESS,), is_calibrated=np.array([False]))
    pairs = [(0, 3), (1, 5), (2, 7), (0, 7)]
    arguments = scene.features, pairs, MatchingConfig(), VerificationConfig()
    [camera] = guess_fisheyes(guess, *arguments)
    assert camera.fx == pytest.approx(FISHEYE.fx, rel=0.1)
    assert guess_fisheyes(images, *arguments) == (FISHEYE,)  # calibrated
    pinhole = replace(guess, cameras=(replace(GUESS, lens="radtan"),))
    assert guess_fisheyes(pinhole, *arguments) == pinhole.cameras
    assert guess_fisheyes(guess, scene.features, [], MatchingConfig(), VerificationConfig()) == (GUESS,)


def test_the_initial_fisheye() -> None:
    assert (GUESS.lens, GUESS.fx, GUESS.cx, GUESS.distortion) == ("equidistant", 256.0, 319.5, (0.0, 0.0, 0.0, 0.0))
