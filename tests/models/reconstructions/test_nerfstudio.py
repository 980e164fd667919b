"""Folders of nerfstudio: values worked out by hand, and agreement with OpenCV's lenses in nerfstudio's axes."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from dronevio.models.arrays import Array
from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError, InputError
from dronevio.models.reconstruction import Reconstruction
from dronevio.models.reconstructions import read_ply, write_nerfstudio, write_reconstruction
from dronevio.models.reconstructions.formats import check_format
from dronevio.models.rotation import inverse_pose

Make = Callable[..., Reconstruction]

RADTAN = CameraModel(752, 480, 458.7, 457.3, 367.2, 248.4, (-0.28, 0.07, 2e-4, -1e-4))
OTHER = CameraModel(640, 480, 500.0, 501.0, 319.5, 239.5, (-0.1, 0.02, 1e-3, 2e-3, 0.03))
FISHEYE = CameraModel(512, 512, 190.9, 190.8, 254.9, 256.8, (0.0034, 0.0007, -0.002, 0.0002), "equidistant")


def written(folder: Path, reconstruction: Reconstruction) -> dict[str, Any]:
    write_reconstruction(reconstruction, folder, "nerfstudio")
    document = json.loads((folder / "transforms.json").read_text(encoding="utf-8"))
    assert isinstance(document, dict)
    return document


def projected(document: dict[str, Any], frame: dict[str, Any], points: Array) -> Array:
    """Return pixels (N, 2) of points (N, 3), as nerfstudio's data parser and cameras understand the file.

    The camera looks along −z with y up, the centre of the first pixel is (0.5, 0.5), and the lens is that of OpenCV.
    """
    values = {**document, **frame}
    T_cam_world = np.linalg.inv(np.array(frame["transform_matrix"]))
    x, y, z = T_cam_world[:3, :3] @ points.T + T_cam_world[:3, 3:]
    rays = np.stack([x, -y, -z], axis=1)[:, None]
    K = np.array([[values["fl_x"], 0, values["cx"]], [0, values["fl_y"], values["cy"]], [0, 0, 1.0]])
    k1, k2, k3, k4, p1, p2 = (float(values.get(name, 0.0)) for name in ("k1", "k2", "k3", "k4", "p1", "p2"))
    none = np.zeros(3)
    if document["camera_model"] == "OPENCV_FISHEYE":
        pixels, _ = cv2.fisheye.projectPoints(rays, none, none, K, np.array([k1, k2, k3, k4]))
    else:
        assert k4 == 0.0  # that of OpenCV is another one
        pixels, _ = cv2.projectPoints(rays, none, none, K, np.array([k1, k2, p1, p2, k3]))
    return np.asarray(pixels[:, 0] - 0.5)


@pytest.mark.parametrize("cameras", [(RADTAN,), (RADTAN, OTHER), (FISHEYE,), (FISHEYE, replace(FISHEYE, fx=180.0))])
def test_points_project_as_in_nerfstudio(tmp_path: Path, scene: Make, cameras: tuple[CameraModel, ...]) -> None:
    r = scene(*cameras)
    document = written(tmp_path, r)
    assert document["camera_model"] == ("OPENCV" if cameras[0].lens == "radtan" else "OPENCV_FISHEYE")
    assert [frame["file_path"] for frame in document["frames"]] == [f"images/{name}" for name in r.image_names]
    points = read_ply(tmp_path / document["ply_file_path"]).points
    for i, frame in enumerate(document["frames"]):
        camera = r.cameras[r.image_camera[i]]
        assert ({**document, **frame}["w"], {**document, **frame}["h"]) == (camera.width, camera.height)
        T_cam_world = inverse_pose(r.Ts_world_cam[i])
        expected = camera.project(r.points @ T_cam_world[:3, :3].T + T_cam_world[:3, 3])
        inside = np.all((expected > 0) & (expected < [camera.width, camera.height]), axis=1)
        assert inside.sum() > 5
        np.testing.assert_allclose(projected(document, frame, points)[inside], expected[inside], atol=1e-6)


def test_a_file_by_hand(tmp_path: Path, scene: Make) -> None:
    """A camera at (1, 2, 3) that looks along +y with z up: right is x, up is z, and backwards is −y."""
    camera = CameraModel(640, 480, 500.0, 510.0, 319.5, 239.5)
    T = np.array([[1, 0, 0, 1], [0, 0, 1, 2], [0, -1, 0, 3], [0, 0, 0, 1.0]])
    r = scene(camera)
    document = written(tmp_path, replace(r, Ts_world_cam=np.repeat(T[None], 5, axis=0)))
    by_hand = [[1, 0, 0, 1], [0, 0, -1, 2], [0, 1, 0, 3], [0, 0, 0, 1]]
    assert document["frames"][0] == {"file_path": "images/a.png", "transform_matrix": by_hand}
    del document["frames"]
    assert document == {
        "camera_model": "PINHOLE",
        "w": 640,
        "h": 480,
        "fl_x": 500.0,
        "fl_y": 510.0,
        "cx": 320.0,
        "cy": 240.0,
        "applied_transform": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]],
        "ply_file_path": "sparse_pc.ply",
    }


def test_parameters_are_those_of_the_frames_with_several_cameras(tmp_path: Path, scene: Make) -> None:
    document = written(tmp_path, scene(RADTAN, replace(RADTAN, fx=400.0, distortion=(0.0, 0.0, 0.0, 0.0))))
    assert not {"fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "k2", "k3", "p1", "p2"} & set(document)  # they would win
    assert [frame["fl_x"] for frame in document["frames"]] == [458.7, 400.0, 458.7, 400.0, 458.7]
    assert [frame["k1"] for frame in document["frames"]] == [-0.28, 0.0, -0.28, 0.0, -0.28]


@pytest.mark.parametrize(
    ("cameras", "message"),
    [
        ((RADTAN, FISHEYE), "lenses radtan and equidistant; expected one lens"),
        ((CameraModel(640, 480, 200.0, 200.0, 319.5, 239.5, (-0.2, 0.6), "ds"),), "camera 0 has the lens ds"),
        ((RADTAN, replace(RADTAN, distortion=(0.1, 0, 0, 0, 0, 0.2, 0, 0))), "camera 1 has the rational distortion"),
    ],
)
def test_other_lenses_are_refused(tmp_path: Path, scene: Make, cameras: tuple[CameraModel, ...], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        check_format("nerfstudio", cameras, ("with space.png",))
    with pytest.raises(ConfigError, match=message):
        write_reconstruction(replace(scene(), cameras=cameras * (2 // len(cameras))), tmp_path, "nerfstudio")
    assert not list(tmp_path.iterdir())


def test_paths_of_images(tmp_path: Path, scene: Make) -> None:
    r = scene(RADTAN)
    write_nerfstudio(tmp_path, r, [f"../photographs/{name}" for name in r.image_names])
    document = json.loads((tmp_path / "transforms.json").read_text(encoding="utf-8"))
    assert document["frames"][3]["file_path"] == "../photographs/é.png"
    with pytest.raises(ConfigError, match="1 paths of 5 images"):
        write_nerfstudio(tmp_path, r, ["a.png"])
    with pytest.raises(InputError, match=r"image name '\.\./a\.png'"):
        write_nerfstudio(tmp_path, replace(r, image_names=("../a.png", "b", "c", "d", "e")))
