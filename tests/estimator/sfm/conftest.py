"""A synthetic scene of known cameras and points, with verified pairs of its images."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from dronevio.estimator.array_store import digest
from dronevio.estimator.sfm.config import FeatureConfig
from dronevio.estimator.sfm.features import Features
from dronevio.estimator.sfm.workspace import Workspace
from dronevio.models.arrays import Array
from dronevio.models.camera import CameraModel
from dronevio.models.image_sets import ImageSet
from dronevio.models.rotation import exp_so3, pose_matrix

MakeScene = Callable[..., "SyntheticScene"]
MakeImages = Callable[..., tuple[ImageSet, Workspace]]


@dataclass(frozen=True, eq=False)
class SyntheticScene:
    """Points around a circle of cameras, and the noisy features of each image."""

    camera: CameraModel
    """The camera of all images."""
    Ts_world_cam: Array
    """(I, 4, 4) True poses of the cameras."""
    points: Array
    """(N, 3) True points of the scene."""
    features: tuple[Features, ...]
    """Features of each image, in random order; a point has nearly the same descriptor in all images."""
    point_of: tuple[npt.NDArray[np.int64], ...]
    """Point of each feature of each image."""


def build_scene(
    images: int = 8,
    points: int = 400,
    sigma_px: float = 0.3,
    camera: CameraModel | None = None,
    seed: int = 0,
    flat: bool = False,
    rotation_only: bool = False,
    baseline_m: float = 0.0,
    wide: bool = False,
) -> SyntheticScene:
    """Return a scene of cameras on an arc that look at a cloud of points, on a plane if it is flat.

    With a baseline, every second camera is mounted beside the one before it, and the two are a frame of a stereo rig.
    """
    rng = np.random.default_rng(seed)
    camera = camera or CameraModel(640, 480, 500.0, 500.0, 320.0, 240.0, (-0.1, 0.02, 0.0, 0.0))
    cloud = rng.uniform([-2.0, -1.5, 4.0], [2.0, 1.5, 7.0], (points, 3))
    if flat:
        cloud[:, 2] = 5.0 + 0.3 * cloud[:, 0]
    if wide:  # up to 75° from the optical axis
        cloud[:, :2] *= 6.0
    descriptors = rng.integers(0, 90, (points, 128))
    poses: list[Array] = []
    features: list[Features] = []
    point_of: list[npt.NDArray[np.int64]] = []
    for k in range(images):
        angle = 0.08 * (k - 0.5 * images)
        R = exp_so3(np.array([0.02 * np.sin(k), angle if rotation_only else -angle, 0.01 * k]))
        p = np.zeros(3) if rotation_only else np.array([5.5 * np.sin(angle), 0.1 * np.cos(2.0 * k), 0.3 * angle])
        T = pose_matrix(R, p)
        if baseline_m > 0.0 and k % 2 == 1:
            T = poses[-1] @ pose_matrix(np.eye(3), np.array([baseline_m, 0.0, 0.0]))
            R, p = T[:3, :3], T[:3, 3]
        pixels = camera.project((cloud - p) @ R)
        inside = np.all((pixels > 0.0) & (pixels < [camera.width - 1.0, camera.height - 1.0]), axis=1)
        visible = rng.permutation(np.flatnonzero(inside))
        noisy = pixels[visible] + rng.normal(scale=sigma_px, size=(len(visible), 2))
        described = np.clip(descriptors[visible] + rng.integers(-3, 4, (len(visible), 128)), 0, 255)
        unit = described / np.linalg.norm(described, axis=1, keepdims=True)
        grey = np.full((len(visible), 3), 128, np.uint8)
        features.append(Features(noisy, np.full(len(visible), 5.0), np.round(512.0 * unit).astype(np.uint8), grey))
        poses.append(T)
        point_of.append(visible)
    return SyntheticScene(camera, np.stack(poses), cloud, tuple(features), tuple(point_of))


def stored_images(scene: SyntheticScene, folder: Path, baseline_m: float = 0.0) -> tuple[ImageSet, Workspace]:
    """Return a set of blank images, of a stereo rig with a baseline, and a workspace that has their features."""
    count = len(scene.features)
    # The value of all pixels tells the images apart, so that stored features belong to an image wherever it is.
    blank = [np.full((scene.camera.height, scene.camera.width), i, np.uint8) for i in range(count)]
    workspace = Workspace(folder)
    for i, features in enumerate(scene.features):
        workspace.save_features(i, digest(blank[i], blank[i].shape, None, FeatureConfig()), features)
    Ts_imu_cam = np.tile(np.eye(4), (2, 1, 1))
    Ts_imu_cam[1, 0, 3] = baseline_m
    is_rig = baseline_m > 0.0
    images = ImageSet(
        names=tuple(f"{i}" for i in range(count)),
        image_camera=np.arange(count) % 2 if is_rig else np.zeros(count, np.int64),
        cameras=(scene.camera,) * (2 if is_rig else 1),
        is_calibrated=np.array([True, True] if is_rig else [True]),
        is_ordered=True,
        t_ns=None,
        frame=np.arange(count) // 2 if is_rig else None,
        Ts_imu_cam=Ts_imu_cam if is_rig else None,
        read=lambda index: blank[index],
        read_mask=lambda index: None,
    )
    return images, workspace


@pytest.fixture(scope="session")
def make_images() -> MakeImages:
    """The function that makes sets of images with stored features."""
    return stored_images


@pytest.fixture(scope="session")
def make_scene() -> MakeScene:
    """The function that makes scenes with other settings."""
    return build_scene


@pytest.fixture(scope="session")
def scene() -> SyntheticScene:
    """The scene with default settings."""
    return build_scene()
