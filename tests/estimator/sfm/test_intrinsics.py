"""Self-calibration: focal lengths without a guess, monotonic distortion, and parameters that images leave open."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from dronevio.estimator.sfm.config import SfmConfig
from dronevio.estimator.sfm.features import Features
from dronevio.estimator.sfm.intrinsics import (
    EVIDENCE_SIGMAS,
    MAX_FOCAL_SHARE,
    IntrinsicsPrior,
    is_monotonic,
    without_undetermined,
)
from dronevio.estimator.sfm.model import KnownPoses
from dronevio.estimator.sfm.pipeline import SfmResult, reconstruct
from dronevio.eval.metrics.alignment import umeyama
from dronevio.models.camera import CameraModel
from dronevio.models.image_sets import ImageSet, open_images

if TYPE_CHECKING:
    from tests.estimator.sfm.conftest import MakeImages, MakeScene, SyntheticScene

GUESS = CameraModel(640, 480, 768.0, 768.0, 320.0, 240.0)  # 1.2 times the longer side


def uncalibrated(images: ImageSet, guess: CameraModel = GUESS) -> ImageSet:
    """Return a set of images of one camera of which nothing is known."""
    return replace(images, cameras=(guess,), is_calibrated=np.array([False]), focal_source=("assumed",))


def reconstructed(scene: "SyntheticScene", make_images: "MakeImages", folder: Path) -> SfmResult:
    images, workspace = make_images(scene, folder)
    return reconstruct(uncalibrated(images), SfmConfig(), workspace)


def straight(scene: "SyntheticScene", step_m: float) -> "SyntheticScene":
    """Return a scene whose camera moves along its optical axis, without rotation."""
    rng = np.random.default_rng(0)
    cloud = rng.uniform([-4.0, -3.0, 6.0], [4.0, 3.0, 20.0], (400, 3))
    descriptors = rng.integers(0, 90, (len(cloud), 128))
    poses, features, point_of = [], [], []
    for k in range(6):
        T = np.eye(4)
        T[2, 3] = k * step_m
        pixels = scene.camera.project(cloud - T[:3, 3])
        seen = np.flatnonzero(np.all((pixels > 0.0) & (pixels < [639.0, 479.0]), axis=1))
        unit = descriptors[seen] / np.linalg.norm(descriptors[seen], axis=1, keepdims=True)
        noisy = pixels[seen] + rng.normal(scale=0.3, size=(len(seen), 2))
        grey = np.full((len(seen), 3), 128, np.uint8)
        features.append(Features(noisy, np.full(len(seen), 5.0), np.round(512.0 * unit).astype(np.uint8), grey))
        poses.append(T)
        point_of.append(seen)
    return replace(
        scene, Ts_world_cam=np.stack(poses), points=cloud, features=tuple(features), point_of=tuple(point_of)
    )


@pytest.mark.parametrize(("focal_px", "k1"), [(300.0, -0.05), (500.0, -0.1), (1000.0, 0.0)])
def test_a_focal_length_is_found_without_a_guess(
    make_scene: "MakeScene", make_images: "MakeImages", tmp_path: Path, focal_px: float, k1: float
) -> None:
    camera = CameraModel(640, 480, focal_px, focal_px, 320.0, 240.0, (k1, 0.0, 0.0, 0.0))
    result = reconstructed(make_scene(camera=camera, points=1500), make_images, tmp_path)
    (found,), ((calibration,),) = result.reconstructions[0].cameras, result.calibrations
    assert calibration is not None and "f" in calibration.sigmas
    assert found.fx == pytest.approx(focal_px, rel=0.02)
    assert abs(found.fx - focal_px) < 5.0 * calibration.sigmas["f"]
    assert found.distortion[0] == pytest.approx(k1, abs=0.05)


def test_standard_deviations_are_those_of_the_errors(
    make_scene: "MakeScene", make_images: "MakeImages", tmp_path: Path
) -> None:
    camera = CameraModel(640, 480, 500.0, 500.0, 320.0, 240.0, (-0.1, 0.0, 0.0, 0.0))
    ratios = []
    for seed in range(6):
        result = reconstructed(make_scene(camera=camera, seed=seed, sigma_px=0.5), make_images, tmp_path / f"{seed}")
        (calibration,) = result.calibrations[0]
        assert calibration is not None
        (found,) = result.reconstructions[0].cameras
        ratios += [(found.fx - 500.0) / calibration.sigmas["f"], (found.distortion[0] + 0.1) / calibration.sigmas["k1"]]
    assert 0.4 < np.sqrt(np.mean(np.square(ratios))) < 2.0


@pytest.mark.parametrize("step_m", [0.3, 1.0])
def test_straight_flight_has_no_absurd_distortion(
    scene: "SyntheticScene", make_images: "MakeImages", tmp_path: Path, step_m: float
) -> None:
    result = reconstructed(straight(scene, step_m), make_images, tmp_path)
    assert len(result.reconstructions) == 1
    for reconstruction, (calibration,) in zip(result.reconstructions, result.calibrations, strict=True):
        (found,) = reconstruction.cameras
        assert calibration is not None and is_monotonic(found)
        assert max(map(abs, found.distortion)) < 0.5
        for name in calibration.held:
            assert name == "f" or found.distortion[("k1", "k2").index(name)] == 0.0
        if "f" in calibration.sigmas:
            assert abs(found.fx - 500.0) < 5.0 * calibration.sigmas["f"]


def test_components_share_the_camera(make_scene: "MakeScene", make_images: "MakeImages", tmp_path: Path) -> None:
    first, second = make_scene(images=8, seed=1), make_scene(images=3, seed=2)
    both = replace(
        first,
        Ts_world_cam=np.concatenate([first.Ts_world_cam, second.Ts_world_cam]),
        features=first.features + second.features,
        point_of=first.point_of + second.point_of,
    )
    result = reconstructed(both, make_images, tmp_path)
    assert [len(component.image_names) for component in result.reconstructions] == [8, 3]
    assert result.reconstructions[0].cameras == result.reconstructions[1].cameras
    assert result.calibrations[0] == result.calibrations[1]
    assert result.reconstructions[1].reprojection_errors_px().mean() < 1.0


def test_calibrated_cameras_are_not_estimated(
    scene: "SyntheticScene", make_images: "MakeImages", tmp_path: Path
) -> None:
    images, workspace = make_images(scene, tmp_path)
    result = reconstruct(images, SfmConfig(), workspace)
    assert result.calibrations == ((None,),)
    assert result.reconstructions[0].cameras == (scene.camera,)


def test_distortion_is_monotonic_up_to_the_corner() -> None:
    """r (1 + k1 r²) increases up to r = 1 / √(−3 k1), where it is 2/3 r."""
    corner_px = np.hypot(320.0, 240.0)
    for k1 in (-0.1, -0.3, -1.0):
        turning = 2.0 / 3.0 / np.sqrt(-3.0 * k1)  # distorted radius from which no ray comes
        for share, expected in ((0.99, True), (1.01, False)):
            focal_px = corner_px / (share * turning)
            camera = CameraModel(641, 481, focal_px, focal_px, 320.0, 240.0, (k1, 0.0, 0.0, 0.0))
            assert is_monotonic(camera) is expected
    assert is_monotonic(CameraModel(641, 481, 500.0, 500.0, 320.0, 240.0, (0.3, 0.1, 0.0, 0.0)))
    assert not is_monotonic(CameraModel(641, 481, 300.0, 300.0, 320.0, 240.0, (0.0, -0.3, 0.0, 0.0)))


@pytest.mark.parametrize(
    ("focal_px", "k1", "k2", "is_plausible"),
    [
        (500.0, 0.0, 0.0, True),
        (949.0, 0.59, -0.29, True),  # within 3 · 0.3 · 500 px, 3 · 0.2 and 3 · 0.1
        (951.0, 0.0, 0.0, False),
        (49.0, 0.0, 0.0, False),
        (500.0, -0.61, 0.0, False),
        (500.0, 0.0, 0.31, False),
    ],
)
def test_plausible_cameras_by_hand(focal_px: float, k1: float, k2: float, is_plausible: bool) -> None:
    prior = IntrinsicsPrior(replace(GUESS, fx=500.0, fy=500.0))
    camera = replace(GUESS, fx=focal_px, fy=focal_px, distortion=(k1, k2, 0.0, 0.0))
    assert prior.is_plausible(camera) == is_plausible
    fisheye = replace(GUESS, lens="equidistant")
    assert IntrinsicsPrior(fisheye).is_plausible(replace(fisheye, fx=2000.0))


@pytest.mark.slow
@pytest.mark.parametrize("every", [10, 20, 30])
def test_a_video_straight_ahead(every: int, data_folder: Path) -> None:
    """A drone flies 70 m along a coast; its flight controller knows where, to a metre or two."""
    images = open_images(data_folder / "gopro" / "karma.mp4", every=every)
    [found] = reconstruct(images).reconstructions
    assert len(found.image_names) == len(images)
    (camera,) = found.cameras
    assert 430.0 < camera.fx < 620.0 and max(map(abs, camera.distortion)) < 0.5
    t_s, *enu = np.loadtxt(data_folder / "gopro" / "position_enu.csv", delimiter=",", skiprows=1).T
    assert images.t_ns is not None
    seen_s = 1e-9 * images.t_ns[[images.names.index(name) for name in found.image_names]] + 1.5e9
    rows = np.flatnonzero((seen_s > t_s[0]) & (seen_s < t_s[-1]))
    true = np.stack([np.interp(seen_s[rows], t_s, axis) for axis in enu], axis=1)
    aligned = umeyama(true, found.positions[rows], with_scale=True).positions(found.positions[rows])
    assert np.sqrt(np.mean(np.sum((aligned - true) ** 2, axis=1))) < 1.0  # [m]; 0.3 m beside 7 m of a wrong minimum


def test_parameters_without_evidence_are_held() -> None:
    prior = IntrinsicsPrior(GUESS, 0.3, estimated=3)

    def held(distortion: tuple[float, float], sigmas: tuple[float, float, float], estimated: int = 3) -> int:
        camera = replace(GUESS, fx=700.0, fy=700.0, distortion=(*distortion, 0.0, 0.0))
        return without_undetermined(replace(prior, estimated=estimated), camera, np.diag(np.square(sigmas))).estimated

    assert held((-0.1, 0.05), (5.0, 0.01, 0.99 * 0.05 / EVIDENCE_SIGMAS)) == 3
    assert held((-0.1, 0.05), (5.0, 0.01, 1.01 * 0.05 / EVIDENCE_SIGMAS)) == 2
    assert held((-0.1, 0.0), (5.0, 0.09, np.inf), 2) == 2  # small: the prior decides
    assert held((0.6, 0.0), (5.0, 0.2, np.inf), 2) == 1  # large, without evidence
    assert held((0.6, 0.0), (5.0, 0.1, np.inf), 2) == 2
    assert held((-2.0, 0.0), (5.0, 0.01, np.inf), 2) == 1  # not monotonic
    limit = MAX_FOCAL_SHARE * prior.sigmas[0]
    assert held((0.0, 0.0), (0.99 * limit, np.inf, np.inf), 1) == 1
    assert held((0.0, 0.0), (1.01 * limit, np.inf, np.inf), 1) == 0


def test_measured_poses_determine_the_focal_length(
    scene: "SyntheticScene", make_images: "MakeImages", tmp_path: Path
) -> None:
    """Also where the images of a straight flight do not."""
    made = straight(scene, 0.3)
    images, workspace = make_images(made, tmp_path)
    poses = KnownPoses(made.Ts_world_cam, 0.01, 0.002)
    result = reconstruct(uncalibrated(images), SfmConfig(), workspace, poses=poses)
    assert result.calibrations[0][0] is not None and "f" in result.calibrations[0][0].sigmas
    assert result.worlds[0].scale == "poses"
