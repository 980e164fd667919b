"""Sparse models of COLMAP: a folder with cameras, images and points, as text or binary files.

Poses in the files map the world frame to the camera frame, whose axes are ours (x right, y down, z forward). The files
of rigs and frames, which COLMAP writes since version 3.12, are ignored on reading, because the images have all poses.
"""

from pathlib import Path

import numpy as np

from dronevio.models.errors import ConfigError, InputError
from dronevio.models.reconstruction import Reconstruction
from dronevio.models.reconstructions import colmap_binary as binary_files
from dronevio.models.reconstructions import colmap_text as text_files
from dronevio.models.reconstructions.colmap_model import (
    ColmapPoints,
    colmap_from_reconstruction,
    reconstruction_from_colmap,
)
from dronevio.models.reconstructions.colmap_rigs import RigFrames, write_rig_files
from dronevio.models.reconstructions.parsing import check_image_name

_FILES = ("cameras", "images", "points3D")
_RIG_FILES = ("rigs", "frames")


def is_colmap(folder: Path) -> bool:
    """Return whether a folder contains the images of a sparse model of COLMAP."""
    return any((folder / f"images{suffix}").is_file() for suffix in (".bin", ".txt"))


def read_colmap(folder: Path) -> Reconstruction:
    """Read a sparse model of COLMAP. Binary files are read where both kinds exist, as in COLMAP.

    Cameras, images and points are ordered by their numbers. Keypoints that observe no point are left out. The file of
    points may be missing if no image observes one, as in models that only give poses.

    Args:
        folder: The folder that contains ``cameras``, ``images`` and ``points3D`` with the suffix ``.bin`` or ``.txt``.

    Raises:
        InputError: A file is missing, damaged or truncated, has a camera model that is not supported, or refers to a
            camera, image or point that does not exist.
    """
    folder = Path(folder)
    binary = (folder / "images.bin").exists()
    if not binary and not (folder / "images.txt").exists():
        raise InputError(folder, "no images.bin and no images.txt", "the folder of a sparse model of COLMAP")
    cameras_path, images_path, points_path = paths = _paths(folder, binary)
    if binary:
        cameras = binary_files.read_cameras_binary(cameras_path)
        images = binary_files.read_images_binary(images_path)
        read_points = binary_files.read_points_binary
    else:
        cameras = text_files.read_cameras_text(cameras_path)
        images = text_files.read_images_text(images_path)
        read_points = text_files.read_points_text
    no_points = not points_path.exists() and not np.any(images.keypoint_point_ids >= 0)
    points = ColmapPoints.empty() if no_points else read_points(points_path)
    return reconstruction_from_colmap(paths, cameras, images, points)


def write_colmap(
    folder: Path, reconstruction: Reconstruction, binary: bool = True, rig: RigFrames | None = None
) -> None:
    """Write a sparse model of COLMAP. Each file is replaced atomically; numbers count from 1.

    The camera model is ``PINHOLE``, ``OPENCV`` or ``OPENCV_FISHEYE``; the error of a point is its mean reprojection
    error, −1 if it has none. Without a rig, no files of rigs and frames are written: COLMAP then uses one rig for each
    camera.

    Args:
        folder: The folder to write to; missing folders are created.
        reconstruction: The reconstruction to write.
        binary: Whether to write binary files instead of text.
        rig: Images of one moment and the mounting of the cameras; None without a rig.

    Raises:
        InputError: The folder cannot be written to or contains files of another model, which COLMAP would mix with
            these, or the name of an image is not a path below a folder.
        ConfigError: The name of an image contains a space, where COLMAP would end it in a text file, or the rig
            contradicts the reconstruction.
    """
    folder = Path(folder)
    if rig is not None:
        rig.check(reconstruction)
    ours = () if rig is None else _rig_paths(folder, binary)
    for path in (*_paths(folder, not binary), *_rig_paths(folder, False), *_rig_paths(folder, True)):
        if path in ours:
            continue
        if path.exists():
            raise InputError(path, "a file of another model, which COLMAP would mix with this one", "a new folder")
    cameras_path, images_path, points_path = _paths(folder, binary)
    for name in reconstruction.image_names:
        check_image_name(images_path, name)
        if not binary and len(name.split()) != 1:
            raise ConfigError(f"image name {name!r}; expected a name without spaces, or binary files")
    cameras, images, points = colmap_from_reconstruction(reconstruction)
    if binary:
        binary_files.write_cameras_binary(cameras_path, cameras)
        binary_files.write_images_binary(images_path, images)
        binary_files.write_points_binary(points_path, points)
    else:
        text_files.write_cameras_text(cameras_path, cameras)
        text_files.write_images_text(images_path, images)
        text_files.write_points_text(points_path, points)
    if rig is not None and len(reconstruction.image_names):
        write_rig_files(*_rig_paths(folder, binary), reconstruction, rig, binary)


def _paths(folder: Path, binary: bool) -> tuple[Path, Path, Path]:
    """Return the files of cameras, images and points."""
    suffix = ".bin" if binary else ".txt"
    cameras, images, points = (folder / f"{name}{suffix}" for name in _FILES)
    return cameras, images, points


def _rig_paths(folder: Path, binary: bool) -> tuple[Path, Path]:
    """Return the files of rigs and frames."""
    suffix = ".bin" if binary else ".txt"
    rigs, frames = (folder / f"{name}{suffix}" for name in _RIG_FILES)
    return rigs, frames
