"""Reconstructions as a folder of nerfstudio: cameras and poses in ``transforms.json``, the points in ``sparse_pc.ply``.

nerfstudio's cameras look along −z with y up (OpenGL), and the centre of the first pixel is (0.5, 0.5). ``OPENCV`` is
our ``radtan`` with up to five coefficients, whose k3 belongs to r⁶ in both, and ``OPENCV_FISHEYE`` our ``equidistant``.
All images of a file have one of these models; their parameters may differ. The world frame stays: ``applied_transform``
is the identity, in place of which nerfstudio takes another one where it finds a model of COLMAP. Source: nerfstudio's
``nerfstudio/data/dataparsers/nerfstudio_dataparser.py`` and ``nerfstudio/process_data/colmap_utils.py``.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError
from dronevio.models.reconstruction import Reconstruction
from dronevio.models.reconstructions.parsing import check_image_name
from dronevio.models.reconstructions.ply import write_ply
from dronevio.models.recordings.files import write_text

TRANSFORMS = "transforms.json"
"""Name of the file of cameras and poses."""
POINTS = "sparse_pc.ply"
"""Name of the file of points."""
IMAGES = "images"
"""Name of the folder in which nerfstudio expects images by default."""
PIXEL_SHIFT = 0.5
"""Coordinate of the centre of the first pixel in nerfstudio minus that here [px]."""

_FLIP_YZ = np.diag([1.0, -1.0, -1.0, 1.0])  # between a camera with y up that looks along −z and ours
_RADTAN = ("k1", "k2", "p1", "p2", "k3")
_FISHEYE = ("k1", "k2", "k3", "k4")


def check_nerfstudio(cameras: Sequence[CameraModel]) -> None:
    """Check that nerfstudio has the lenses of cameras, and all of them in one file.

    Raises:
        ConfigError: It has not.
    """
    for index, camera in enumerate(cameras):
        if camera.lens not in ("radtan", "equidistant"):
            expected = "radtan, equidistant or another format"
            raise ConfigError(f"nerfstudio: camera {index} has the lens {camera.lens}; expected {expected}")
        if camera.lens == "radtan" and any(camera.distortion[5:]):
            found = f"camera {index} has the rational distortion k4 to k6 = {camera.distortion[5:]}"
            raise ConfigError(f"nerfstudio: {found}; expected up to k1, k2, p1, p2, k3, or another format")
    if len({camera.lens for camera in cameras}) > 1:
        raise ConfigError("nerfstudio: cameras of the lenses radtan and equidistant; expected one lens for all images")


def write_nerfstudio(folder: Path, reconstruction: Reconstruction, image_paths: Sequence[str] | None = None) -> None:
    """Write a folder for nerfstudio.

    Args:
        folder: The folder to write to; missing folders are created.
        reconstruction: The reconstruction to write.
        image_paths: Paths (C,) of the images, relative to the folder, with slashes; by default, their names below the
            folder ``images``.

    Raises:
        ConfigError: nerfstudio does not have the lens of a camera, or the number of paths differs from that of images.
        InputError: The folder cannot be written to, or the name of an image is not a path below a folder.
    """
    folder, r = Path(folder), reconstruction
    check_nerfstudio(r.cameras)
    path = folder / TRANSFORMS
    if image_paths is None:
        image_paths = [f"{IMAGES}/{check_image_name(path, name)}" for name in r.image_names]
    if len(image_paths) != len(r.image_names):
        raise ConfigError(f"nerfstudio: {len(image_paths)} paths of {len(r.image_names)} images; expected one of each")
    models = _intrinsics(r.cameras)
    is_shared = len(models) == 1
    frames = [
        {"file_path": file, **({} if is_shared else models[camera]), "transform_matrix": T.tolist()}
        for file, camera, T in zip(image_paths, r.image_camera.tolist(), r.Ts_world_cam @ _FLIP_YZ, strict=True)
    ]
    document = {
        "camera_model": _model_name(r.cameras),
        **(models[0] if is_shared else {}),
        "applied_transform": np.eye(4)[:3].tolist(),
        "ply_file_path": POINTS,
        "frames": frames,
    }
    write_ply(folder / POINTS, r)
    write_text(path, json.dumps(document, indent=2) + "\n")


def _model_name(cameras: Sequence[CameraModel]) -> str:
    """Return the name of the model of all cameras."""
    if any(camera.lens == "equidistant" for camera in cameras):
        return "OPENCV_FISHEYE"
    return "OPENCV" if any(any(camera.distortion) for camera in cameras) else "PINHOLE"


def _intrinsics(cameras: Sequence[CameraModel]) -> list[dict[str, Any]]:
    """Return the parameters of each camera by their names in the file."""
    has_distortion = _model_name(cameras) != "PINHOLE"
    values = []
    for camera in cameras:
        size = {"w": camera.width, "h": camera.height, "fl_x": camera.fx, "fl_y": camera.fy}
        centre = {"cx": camera.cx + PIXEL_SHIFT, "cy": camera.cy + PIXEL_SHIFT}
        names = _FISHEYE if camera.lens == "equidistant" else _RADTAN
        coefficients = dict(zip(names, camera.distortion, strict=False)) if has_distortion else {}
        values.append({**size, **centre, **coefficients})
    return values
