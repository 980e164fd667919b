"""Synthetic scenes of known surfaces with a smooth texture, and their images."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from dronevio.models.arrays import Array
from dronevio.models.camera import CameraModel
from dronevio.models.image_sets import ImageSet
from dronevio.models.reconstruction import Reconstruction
from dronevio.models.rotation import exp_so3, pose_matrix

Surface = Callable[[Array, Array], Array]
"""Function of an origin (3,) and rays (…, 3) that returns the factors (…) of the rays at the surface."""

CAMERA = CameraModel(160, 120, 150.0, 150.0, 79.5, 59.5)


def plane(normal: tuple[float, float, float], distance: float) -> Surface:
    """Return the plane n · x = d."""
    n = np.array(normal) / np.linalg.norm(normal)

    def intersect(origin: Array, rays: Array) -> Array:
        along = rays @ n
        return np.where(along > 1e-6, (distance - origin @ n) / np.where(along > 1e-6, along, 1.0), np.inf)

    return intersect


def sphere(centre: tuple[float, float, float], radius: float) -> Surface:
    """Return the surface of a ball as it is seen from outside."""
    c = np.array(centre)

    def intersect(origin: Array, rays: Array) -> Array:
        a, b, d = (rays**2).sum(axis=-1), rays @ (origin - c), ((origin - c) ** 2).sum() - radius**2
        inside = b * b - a * d
        return np.where(inside > 0.0, (-b - np.sqrt(np.maximum(inside, 0.0))) / a, np.inf)

    return intersect


def texture(points: Array) -> Array:
    """Return grey values (…) of a random smooth function of points (…, 3), with wavelengths of 0.1 to 0.5."""
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(40, 3))
    waves = directions / np.linalg.norm(directions, axis=1, keepdims=True) / rng.uniform(0.1, 0.5, (40, 1))
    return np.asarray(128.0 + 14.0 * np.cos(2.0 * np.pi * points @ waves.T + rng.uniform(0.0, 6.3, 40)).sum(axis=-1))


@dataclass(frozen=True, eq=False)
class DenseScene:
    """Images of surfaces with their cameras and depths."""

    images: ImageSet
    """Images of the surfaces."""
    reconstruction: Reconstruction
    """True cameras, and points on the surfaces."""
    surfaces: tuple[Surface, ...]
    """Surfaces that the images show."""

    def depths(self, T_world_cam: Array, rays: Array) -> Array:
        """Return the z (…) of the nearest surface along rays (…, 3) of depth 1 in the camera frame."""
        R, p = T_world_cam[:3, :3], T_world_cam[:3, 3]
        return np.asarray(np.min([surface(p, rays @ R.T) for surface in self.surfaces], axis=0))


def build_dense_scene(
    *surfaces: Surface, camera: CameraModel = CAMERA, images: int = 5, baseline: float = 0.25, seed: int = 0
) -> DenseScene:
    """Return images from a row of positions along x that look along z, with small rotations."""
    rng = np.random.default_rng(seed)
    Ts = np.stack(
        [
            pose_matrix(
                exp_so3(np.array([0.01 * k, -0.03 * (k - 2), 0.02 * k])),
                np.array([baseline * (k - 2), 0.05 * (k % 2), 0.03 * k]),
            )
            for k in range(images)
        ]
    )
    rows, columns = np.mgrid[: camera.height, : camera.width]
    bearings = camera.unproject(np.stack([columns, rows], axis=-1).astype(np.float64))
    pictures, points = [], []
    for T in Ts:
        R, p = T[:3, :3], T[:3, 3]
        factors = np.min([surface(p, bearings @ R.T) for surface in surfaces], axis=0)
        seen = np.where(np.isfinite(factors), factors, 0.0)[..., None] * (bearings @ R.T) + p
        grey = np.where(np.isfinite(factors), texture(seen), 0.0) + rng.normal(scale=0.5, size=factors.shape)
        pictures.append(np.clip(np.round(grey), 0, 255).astype(np.uint8))
        points.append(seen[6::12, 6::12].reshape(-1, 3)[np.isfinite(factors[6::12, 6::12]).ravel()])
    cloud = np.concatenate(points)
    observed = [np.flatnonzero(np.isfinite(camera.project((cloud - T[:3, 3]) @ T[:3, :3])).all(axis=1)) for T in Ts]
    pixels = [camera.project((cloud[i] - T[:3, 3]) @ T[:3, :3]) for i, T in zip(observed, Ts, strict=True)]
    names = tuple(f"{k}.png" for k in range(images))
    image_camera = np.zeros(images, np.int64)
    image_set = ImageSet(
        names=names,
        image_camera=image_camera,
        cameras=(camera,),
        is_calibrated=np.array([True]),
        is_ordered=True,
        t_ns=None,
        frame=None,
        Ts_imu_cam=None,
        read=pictures.__getitem__,
        read_mask=lambda index: None,
    )
    reconstruction = Reconstruction(
        cameras=(camera,),
        image_names=names,
        image_camera=image_camera,
        Ts_world_cam=Ts,
        points=cloud,
        colours=np.full((len(cloud), 3), 128, np.uint8),
        observation_image=np.repeat(np.arange(images), [len(i) for i in observed]),
        observation_point=np.concatenate(observed),
        observation_px=np.concatenate(pixels),
    )
    return DenseScene(image_set, reconstruction, surfaces)


@pytest.fixture(scope="session")
def make_dense_scene() -> Callable[..., DenseScene]:
    """The function that makes scenes of other surfaces."""
    return build_dense_scene


@pytest.fixture(scope="session")
def make_plane() -> Callable[..., Surface]:
    """The function that makes planes."""
    return plane


@pytest.fixture(scope="session")
def slanted() -> DenseScene:
    """A plane that is slanted by 45°."""
    return build_dense_scene(plane((0.0, 0.7, 0.7), 2.0))


@pytest.fixture(scope="session")
def ball() -> DenseScene:
    """A ball in front of a wall."""
    return build_dense_scene(plane((0.0, 0.0, 1.0), 4.0), sphere((0.0, 0.0, 2.6), 0.6))
