"""Files of results for other programs: reconstructions with the images that belong to them, and surfaces."""

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dronevio.estimator.dense.overhead import overhead_map
from dronevio.estimator.dense.pipeline import DenseResult
from dronevio.models.errors import ConfigError
from dronevio.models.geodesy import GeodeticPoint
from dronevio.models.image_sets import ImageSet
from dronevio.models.reconstruction import Reconstruction
from dronevio.models.reconstructions import (
    ReconstructionFormat,
    RigFrames,
    SurfaceFormat,
    write_nerfstudio,
    write_openmvs,
    write_reconstruction,
    write_surfaces,
)
from dronevio.models.reconstructions.formats import check_surface_format
from dronevio.models.reconstructions.geotiff import write_height_map, write_orthophoto
from dronevio.models.reconstructions.nerfstudio import IMAGES
from dronevio.models.recordings.files import write_bytes
from dronevio.models.recordings.images import encode_png, png_name
from dronevio.sfm_inputs import read_world


def write_component(
    folder: Path,
    format: ReconstructionFormat,
    number: int,
    reconstruction: Reconstruction,
    images: ImageSet,
    *,
    sources: Sequence[Path],
    has_mounting: bool,
) -> None:
    """Write a component of a result in a format.

    Args:
        folder: Folder of the result, to write to. Paths of images start from it, also if it is renamed afterwards.
        format: Name of the format.
        number: Index of the component, part of the names of files.
        reconstruction: The component.
        images: The images from which it was made.
        sources: Folders of images; where an image is a file in one of them, it is not written again.
        has_mounting: Whether the mounting of the cameras on a rig constrains the reconstruction, in metres.

    Raises:
        ConfigError: The format cannot represent a camera or a name of the reconstruction.
        InputError: A file cannot be written, or an image cannot be read.
    """
    names = {"bundler": f"bundle-{number}.out", "ply": f"points-{number}.ply"}
    path = folder / names.get(format, f"{format}/{number}")
    row = {name: i for i, name in enumerate(images.names)}
    if format == "openmvs":
        write_openmvs(path, reconstruction, lambda name: images.read(row[name]))
        return
    if format == "nerfstudio":
        paths = _image_paths(path, reconstruction.image_names, images, sources)
        write_nerfstudio(path, reconstruction, paths)
        return
    rig = rig_frames(images, reconstruction) if has_mounting else None
    write_reconstruction(reconstruction, path, format, rig)


def rig_frames(images: ImageSet, reconstruction: Reconstruction) -> RigFrames | None:
    """Return which images of a reconstruction in metres belong to one moment of a rig, and its mounting.

    None if the images have no rig, or no moment has two registered images.

    Args:
        images: The images, with the mounting of their cameras.
        reconstruction: Some of the images, which have cameras of their own.
    """
    if images.frame is None or images.Ts_imu_cam is None:
        return None
    row = {name: i for i, name in enumerate(images.names)}
    rows = np.array([row[name] for name in reconstruction.image_names], np.int64)
    frames = images.frame[rows]
    if len(np.unique(frames)) == len(frames):
        return None
    _, first = np.unique(reconstruction.image_camera, return_index=True)
    if len(first) < len(reconstruction.cameras):  # a camera without images has no mounting
        return None
    return RigFrames(frames, images.Ts_imu_cam[images.image_camera[rows[first]]])


def _image_paths(folder: Path, names: Sequence[str], images: ImageSet, sources: Sequence[Path]) -> list[str]:
    """Return the paths of images relative to a folder; images that are no files are written below it as PNG."""
    row = {name: i for i, name in enumerate(images.names)}
    folders = [source.resolve() for source in sources]
    paths = []
    for name in names:
        file = next((source / name for source in folders if (source / name).is_file()), None)
        if file is None:
            relative = f"{IMAGES}/{png_name(name)}"
            write_bytes(folder / relative, encode_png(images.read(row[name])))
        else:
            relative = Path(os.path.relpath(file, folder.resolve())).as_posix()
        paths.append(relative)
    return paths


def write_surface_files(
    folder: Path, format: SurfaceFormat, result: DenseResult, origin: GeodeticPoint | None = None
) -> None:
    """Write the surfaces of a scene in a format; a map from above for ``geotiff``, of a world frame in metres, z up.

    The cells of the map have the side of the distance between points. It has a place on Earth if the origin of the
    world frame, with x east and y north, has one.

    Raises:
        ConfigError: A package that the format needs is not installed.
        InputError: A file cannot be written.
    """
    if format != "geotiff":
        write_surfaces(folder, result.cloud, result.mesh, format)
        return
    view = overhead_map(result.cloud, result.mesh, result.spacing)
    write_orthophoto(folder / "orthophoto.tif", view, origin)
    write_height_map(folder / "height.tif", view, origin)


def check_surface_formats(formats: Sequence[SurfaceFormat], scene: Path) -> None:
    """Check that surfaces can be written in formats, before they are computed.

    Args:
        formats: Names of the formats.
        scene: Folder of a result of ``dronevio sfm``, or another reconstruction, whose world frame is taken to be in
            metres and z to point up.

    Raises:
        ConfigError: A package is not installed, or the world frame of the scene does not suit ``geotiff``.
    """
    for format in formats:
        check_surface_format(format)
    if "geotiff" not in formats or not (scene / "report.json").is_file():
        return
    world = read_world(scene / "report.json")
    if not (world.is_metric and world.is_vertical):
        found = "arbitrary scale" if not world.is_metric else "unknown vertical"
        expected = "metres and z up, from an IMU or --poses of `dronevio sfm`"
        raise ConfigError(f"GeoTIFF: {scene} has a world frame of {found}; expected {expected}")
