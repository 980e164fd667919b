"""A small scene with two cameras, and the comparison of reconstructions."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from dronevio.models.camera import CameraModel
from dronevio.models.reconstruction import Reconstruction
from dronevio.models.rotation import exp_so3, inverse_pose, pose_matrix

RADTAN = CameraModel(752, 480, 458.7, 457.3, 367.2, 248.4, (-0.28, 0.07, 2e-4, -1e-4))
FISHEYE = CameraModel(512, 512, 190.9, 190.8, 254.9, 256.8, (0.0034, 0.0007, -0.002, 0.0002), "equidistant")


@pytest.fixture(scope="session")
def scene() -> Callable[..., Reconstruction]:
    """Makes reconstructions of 20 points in 5 images, of which the last observes nothing; so does point 7."""

    def make(*cameras: CameraModel) -> Reconstruction:
        rng = np.random.default_rng(4)
        cameras = cameras or (RADTAN, FISHEYE)
        points = rng.uniform([-2, -1.5, 4], [2, 1.5, 8], (20, 3))
        Ts_world_cam = pose_matrix(exp_so3(rng.normal(0, 0.1, (5, 3))), rng.normal(0, 0.4, (5, 3)))
        image_camera = np.arange(5) % len(cameras)
        image, point, px = [], [], []
        for i, T in enumerate(inverse_pose(Ts_world_cam)[:4]):
            camera = cameras[image_camera[i]]
            pixels = camera.project(points @ T[:3, :3].T + T[:3, 3]) + rng.normal(0, 0.3, (20, 2))
            inside = np.all((pixels > 0) & (pixels < [camera.width - 1, camera.height - 1]), axis=1)
            inside[7] = False
            point.append(np.flatnonzero(inside))
            image.append(np.full(len(point[-1]), i))
            px.append(pixels[inside])
        order = rng.permutation(sum(map(len, point)))
        return Reconstruction(
            cameras=cameras,
            image_names=("a.png", "left/b.png", "left/c.jpg", "é.png", "last.png"),
            image_camera=image_camera,
            Ts_world_cam=Ts_world_cam,
            points=points,
            colours=rng.integers(0, 256, (20, 3), dtype=np.uint8),
            observation_image=np.concatenate(image)[order],
            observation_point=np.concatenate(point)[order],
            observation_px=np.concatenate(px)[order],
        )

    return make


@pytest.fixture(scope="session")
def assert_same_reconstruction() -> Callable[[Reconstruction, Reconstruction], None]:
    """Compares two reconstructions up to rounding and the order of their observations."""

    def same(ours: Reconstruction, theirs: Reconstruction) -> None:
        assert ours.image_names == theirs.image_names
        np.testing.assert_array_equal(ours.image_camera, theirs.image_camera)
        np.testing.assert_allclose(ours.Ts_world_cam, theirs.Ts_world_cam, rtol=0, atol=1e-13)
        np.testing.assert_array_equal(ours.points, theirs.points)
        np.testing.assert_array_equal(ours.colours, theirs.colours)
        assert len(ours.cameras) == len(theirs.cameras)
        for a, b in zip(ours.cameras, theirs.cameras, strict=True):
            assert (a.lens, a.width, a.height, a.distortion) == (b.lens, b.width, b.height, b.distortion)
            np.testing.assert_allclose((a.fx, a.fy, a.cx, a.cy), (b.fx, b.fy, b.cx, b.cy), rtol=1e-13)
        first, second = sorted_observations(ours), sorted_observations(theirs)
        np.testing.assert_array_equal(first[:, :2], second[:, :2])
        np.testing.assert_allclose(first[:, 2:], second[:, 2:], rtol=0, atol=1e-9)

    return same


def sorted_observations(r: Reconstruction) -> npt.NDArray[np.float64]:
    """Return image, point and pixel of each observation, sorted by image and point."""
    rows = np.column_stack([r.observation_image, r.observation_point, r.observation_px])
    return np.asarray(rows[np.lexsort(rows.T[::-1])])


@pytest.fixture(scope="session")
def contents() -> Callable[[Path], dict[str, bytes]]:
    """Gives the contents of all files below a folder."""

    def read(folder: Path) -> dict[str, bytes]:
        return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}

    return read
