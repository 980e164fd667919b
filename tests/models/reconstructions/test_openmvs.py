"""Scenes of OpenMVS: read by the structures of its Interface.h, and images that follow its camera model."""

import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from dronevio.models.arrays import Array, Image
from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError, InputError
from dronevio.models.reconstruction import Reconstruction
from dronevio.models.reconstructions import write_openmvs, write_reconstruction
from dronevio.models.reconstructions.formats import check_format

Make = Callable[..., Reconstruction]

PINHOLES = (CameraModel(640, 480, 500.0, 510.0, 319.5, 200.0), CameraModel(320, 240, 200.0, 200.0, 150.0, 119.5))
RADTAN = CameraModel(752, 480, 458.7, 457.3, 367.2, 248.4, (-0.28, 0.07, 2e-4, -1e-4))
FISHEYE = CameraModel(512, 512, 190.9, 190.8, 254.9, 256.8, (0.0034, 0.0007, -0.002, 0.0002), "equidistant")


class Archive:
    """Reads what `ARCHIVE::ArchiveLoad` reads, in the order of ``serialize`` in Interface.h, version 3."""

    def __init__(self, data: bytes) -> None:
        self.data, self.offset = data, 0

    def values(self, form: str) -> tuple[Any, ...]:
        found = struct.unpack_from(f"<{form}", self.data, self.offset)
        self.offset += struct.calcsize(f"<{form}")
        return found

    def text(self) -> str:
        (size,) = self.values("Q")
        return str(self.values(f"{size}s")[0].decode("utf-8"))

    def items(self, read: Callable[[], Any]) -> list[Any]:
        (size,) = self.values("Q")
        return [read() for _ in range(size)]

    def matrix(self, rows: int) -> Array:
        return np.array(self.values(f"{rows * rows}d")).reshape(rows, rows)

    def camera(self) -> dict[str, Any]:
        name, size = self.text(), self.values("II")
        return {"name": name, "size": size, "K": self.matrix(3), "R": self.matrix(3), "C": np.array(self.values("3d"))}

    def pose(self) -> tuple[Array, Array]:
        return self.matrix(3), np.array(self.values("3d"))

    def platform(self) -> dict[str, Any]:
        return {"name": self.text(), "cameras": self.items(self.camera), "poses": self.items(self.pose)}

    def image(self) -> tuple[Any, ...]:
        return (self.text(), *self.values("IIII"))  # name, platform, camera, pose, identity

    def vertex(self) -> tuple[Array, list[tuple[int, float]]]:
        return np.array(self.values("3f")), self.items(lambda: self.values("If"))

    def scene(self) -> dict[str, Any]:
        assert self.values("4sII") == (b"MVSI", 3, 0)
        found = {
            "platforms": self.items(self.platform),
            "images": self.items(self.image),
            "vertices": self.items(self.vertex),
            "normals": self.items(lambda: self.values("3f")),
            "colours": self.items(lambda: self.values("3B")),
            "lines": [self.items(lambda: self.values("I")) for _ in range(3)],
            "transform": self.matrix(4),
        }
        assert self.offset == len(self.data)
        return found


def read(folder: Path) -> dict[str, Any]:
    return Archive((folder / "scene.mvs").read_bytes()).scene()


def projected(scene: dict[str, Any], image: int, point: Array) -> Array:
    """Return a pixel (2,), as Interface.h combines the poses of platforms and cameras and projects."""
    _, platform, camera, pose, _ = scene["images"][image]
    found = scene["platforms"][platform]
    camera, (R, C) = found["cameras"][camera], found["poses"][pose]
    R, C = camera["R"] @ R, R.T @ camera["C"] + C
    x, y, z = R @ (point - C)
    K = camera["K"]
    return np.array([K[0, 2] + K[0, 0] * x / z, K[1, 2] + K[1, 1] * y / z])


def test_points_project_as_in_openmvs(tmp_path: Path, scene: Make) -> None:
    whole = scene(*PINHOLES)
    kept = (whole.observation_point != 3) | (whole.observation_image == 0)  # point 3 has one view
    r = replace(
        whole,
        observation_image=whole.observation_image[kept],
        observation_point=whole.observation_point[kept],
        observation_px=whole.observation_px[kept],
    )
    write_reconstruction(r, tmp_path, "openmvs")
    found = read(tmp_path)
    assert [image[0] for image in found["images"]] == [f"images/{name}" for name in r.image_names]
    assert [platform["cameras"][0]["size"] for platform in found["platforms"]] == [(640, 480), (320, 240)]
    assert [image[4] for image in found["images"]] == [0, 1, 2, 3, 4]
    lengths = r.track_lengths()
    assert (lengths[3], lengths[7]) == (1, 0)  # points that OpenMVS does not take are left out
    kept = np.flatnonzero(lengths >= 2)
    assert len(found["vertices"]) == len(found["colours"]) == len(kept) < len(r.points)
    views = 0
    for (position, seen), colour, point in zip(found["vertices"], found["colours"], kept, strict=True):
        np.testing.assert_allclose(position, r.points[point], rtol=1e-6)
        assert colour == tuple(r.colours[point][::-1].tolist())  # blue, green, red
        images = sorted(r.observation_image[r.observation_point == point].tolist())
        assert [(image, 0.0) for image in images] == seen
        views += len(seen)
        for image in images:
            [row] = np.flatnonzero((r.observation_point == point) & (r.observation_image == image))
            error = projected(found, image, r.points[point]) - r.observation_px[row]
            assert np.linalg.norm(error) == pytest.approx(r.reprojection_errors_px()[row], abs=1e-9)
    assert views > 30 and not found["normals"] and found["lines"] == [[], [], []]
    np.testing.assert_array_equal(found["transform"], np.eye(4))


@pytest.mark.parametrize("camera", [RADTAN, FISHEYE], ids=["radtan", "equidistant"])
def test_undistorted_images_follow_the_pinhole(tmp_path: Path, scene: Make, camera: CameraModel) -> None:
    """Bright spots at the projections of points by the lens are where OpenMVS projects the points."""
    r = scene(camera)
    points = r.points[:12]

    def draw(name: str) -> Image:
        T = np.linalg.inv(r.Ts_world_cam[r.image_names.index(name)])
        pixels = camera.project(points @ T[:3, :3].T + T[:3, 3])
        v, u = np.mgrid[: camera.height, : camera.width]
        squared = [(u - x) ** 2 + (v - y) ** 2 for x, y in pixels]
        grey = 250.0 * np.exp(-np.min(squared, axis=0) / 8.0)
        return np.repeat(grey[..., None], 3, axis=2).astype(np.uint8)

    write_openmvs(tmp_path, r, draw)
    found = read(tmp_path)
    checked = 0
    for i in range(2):
        name = found["images"][i][0]
        assert name == ("images/a.png", "images/left/b.png")[i]
        image = cv2.imread(str(tmp_path / name))
        assert image is not None
        width, height = found["platforms"][0]["cameras"][0]["size"]
        assert image.shape == (height, width, 3)
        pixels = np.array([projected(found, i, point) for point in points])
        apart = np.linalg.norm(pixels[:, None] - pixels, axis=2) + 1e9 * np.eye(len(pixels))
        for (x, y), nearest in zip(pixels, apart.min(axis=1), strict=True):
            if nearest < 25.0 or not (12 < x < width - 13 and 12 < y < height - 13):
                continue
            row, column = round(y), round(x)
            patch = image[row - 10 : row + 11, column - 10 : column + 11, 0].astype(np.float64)
            dv, du = np.mgrid[-10:11, -10:11]
            centroid = np.array([column + (du * patch).sum() / patch.sum(), row + (dv * patch).sum() / patch.sum()])
            assert np.linalg.norm(centroid - [x, y]) < 0.3
            checked += 1
    assert checked >= 5


@pytest.mark.parametrize("k1", [-0.1, 0.3], ids=["barrel", "pincushion"])
def test_undistorted_images_extend_to_the_middle_of_the_sides(tmp_path: Path, scene: Make, k1: float) -> None:
    camera = CameraModel(100, 80, 60.0, 60.0, 49.5, 39.5, (k1, 0.0, 0.0, 0.0))
    write_openmvs(tmp_path, scene(camera), lambda _: np.full((80, 100), 200, np.uint8))
    image = cv2.imread(str(tmp_path / "images" / "a.png"), cv2.IMREAD_UNCHANGED)
    assert image is not None
    height, width = image.shape
    # The undistorted half width x fulfils 60 x (1 + k1 x²) = 50, and likewise the half height.
    roots = [np.roots([k1, 0.0, 1.0, -side / 60.0]) for side in (50.0, 40.0)]
    half = [min(root.real for root in each if root.real > 0.0 and abs(root.imag) < 1e-12) for each in roots]
    np.testing.assert_allclose([width, height], 120.0 * np.array(half), atol=1.0)
    assert (image[height // 2] == 200).all() and (image[:, width // 2] == 200).all()
    [platform] = read(tmp_path)["platforms"]
    K = platform["cameras"][0]["K"]
    np.testing.assert_allclose(K[[0, 1], [2, 2]], [(width - 1) / 2, (height - 1) / 2], atol=0.6)
    assert image[0, 0] == (200 if k1 < 0.0 else 0)  # a corner that a pincushion does not see is black


def test_images_of_pinholes_stay(tmp_path: Path, scene: Make) -> None:
    pictures = {
        camera.width: np.random.default_rng(1).integers(0, 256, (camera.height, camera.width)) for camera in PINHOLES
    }
    r = scene(*PINHOLES)
    sizes = {name: r.cameras[k].width for name, k in zip(r.image_names, r.image_camera.tolist(), strict=True)}
    write_openmvs(tmp_path, r, lambda name: pictures[sizes[name]].astype(np.uint8))
    image = cv2.imread(str(tmp_path / "images" / "left" / "b.png"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(image, pictures[320])


def test_refusals(tmp_path: Path, scene: Make) -> None:
    check_format("openmvs", (RADTAN, FISHEYE), ("with space.png",))  # the command undistorts the images
    with pytest.raises(ConfigError, match="camera 1 has distortion; expected the images"):
        write_reconstruction(scene(PINHOLES[0], RADTAN), tmp_path, "openmvs")
    with pytest.raises(InputError, match=r"image name '\.\./a"):
        write_openmvs(tmp_path, replace(scene(*PINHOLES), image_names=("../a", "b", "c", "d", "e")))
    assert not list(tmp_path.iterdir())
