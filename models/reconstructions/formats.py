"""Reading and writing of reconstructions in any supported format, which is recognized when a file is read.

Surfaces, points with normals and meshes, are only written.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal, get_args

from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError, InputError
from dronevio.models.reconstruction import Reconstruction
from dronevio.models.reconstructions.bundler import HEADER, check_bundler_camera, read_bundler, write_bundler
from dronevio.models.reconstructions.colmap import is_colmap, read_colmap, write_colmap
from dronevio.models.reconstructions.colmap_cameras import camera_to_colmap
from dronevio.models.reconstructions.colmap_rigs import RigFrames
from dronevio.models.reconstructions.geotiff import check_geotiff
from dronevio.models.reconstructions.gltf import write_glb
from dronevio.models.reconstructions.las import check_las, write_las
from dronevio.models.reconstructions.nerfstudio import check_nerfstudio, write_nerfstudio
from dronevio.models.reconstructions.obj import write_obj
from dronevio.models.reconstructions.openmvs import write_openmvs
from dronevio.models.reconstructions.ply import MAGIC, read_ply, write_ply
from dronevio.models.reconstructions.ply_surfaces import write_cloud, write_mesh
from dronevio.models.recordings.files import check_regular_file
from dronevio.models.surfaces import Mesh, PointCloud

ReconstructionFormat = Literal["colmap-text", "colmap-binary", "bundler", "ply", "nerfstudio", "openmvs"]
"""Names of the formats that `write_reconstruction` writes."""
SurfaceFormat = Literal["ply", "glb", "obj", "las", "laz", "geotiff"]
"""Names of the formats of surfaces."""

_EXPECTED = "a folder of a COLMAP model, a file of Bundler (v0.3) or a PLY file"


def read_reconstruction(path: Path | str) -> Reconstruction:
    """Read a reconstruction, whose format is recognized from the contents of the path.

    Args:
        path: A folder that contains a sparse model of COLMAP or a ``bundle.out``, the folder of a result of
            ``dronevio sfm``, of which the first component is read, a file of Bundler, or a PLY file.

    Raises:
        InputError: The path is none of these, or is damaged.
    """
    path = Path(path)
    if path.is_dir():
        if is_colmap(path):
            return read_colmap(path)
        for name in ("colmap-binary/0", "colmap-text/0"):
            if is_colmap(path / name):
                return read_colmap(path / name)
        for name in ("bundle.out", "bundle-0.out"):
            if (path / name).is_file():
                return read_bundler(path / name)
        raise InputError(path, "a folder without images.bin, images.txt and bundle.out", _EXPECTED)
    check_regular_file(path, _EXPECTED)
    try:
        with path.open("rb") as file:
            start = file.read(64)
    except FileNotFoundError:
        raise InputError(path, "no such file or folder", _EXPECTED) from None
    except (OSError, ValueError) as error:  # ValueError: a NUL character in the name
        raise InputError(path, f"cannot be read ({error})", _EXPECTED) from None
    if start.startswith(HEADER.encode("ascii")):
        return read_bundler(path)
    if start.startswith((MAGIC + b"\n", MAGIC + b"\r\n")):
        return read_ply(path)
    raise InputError(path, "a file of another format", _EXPECTED)


def check_format(format: ReconstructionFormat, cameras: Sequence[CameraModel], names: Sequence[str] = ()) -> None:
    """Check that a format can represent cameras and the names of images.

    Raises:
        ConfigError: The format does not have the lens of a camera, restricts its parameters, or has no spaces in names.
    """
    spaced = next((name for name in names if len(name.split()) != 1), None)
    if spaced is not None and format in ("bundler", "colmap-text"):
        raise ConfigError(f"{format}: the image {spaced!r}; expected a name without spaces, or --format colmap-binary")
    if format == "nerfstudio":
        check_nerfstudio(cameras)
    for index, camera in enumerate(cameras):
        if format in ("colmap-text", "colmap-binary"):
            camera_to_colmap(camera)
        elif format == "bundler":
            check_bundler_camera(index, camera)


def write_reconstruction(
    reconstruction: Reconstruction, path: Path | str, format: ReconstructionFormat, rig: RigFrames | None = None
) -> None:
    """Write a reconstruction.

    Args:
        reconstruction: The reconstruction to write.
        path: A folder for the formats of COLMAP, nerfstudio and OpenMVS, a file for the others.
        format: ``colmap-text``, ``colmap-binary``, ``bundler`` (and a list of the images beside it), ``ply`` (only
            the points, binary), ``nerfstudio`` (``transforms.json`` and the points; images are expected in ``images``)
            or ``openmvs`` (``scene.mvs``; undistorted images are expected in ``images``, see `write_openmvs`).
        rig: For the formats of COLMAP: images of one moment and the mounting of the cameras.

    Raises:
        InputError: The path cannot be written to, or has files of another model.
        ConfigError: The format is unknown or cannot represent a camera of the reconstruction.
    """
    path = Path(path)
    if format in ("colmap-text", "colmap-binary"):
        write_colmap(path, reconstruction, binary=format == "colmap-binary", rig=rig)
    elif format == "bundler":
        write_bundler(path, reconstruction)
    elif format == "ply":
        write_ply(path, reconstruction)
    elif format == "nerfstudio":
        write_nerfstudio(path, reconstruction)
    elif format == "openmvs":
        write_openmvs(path, reconstruction)
    else:
        raise ConfigError(f"format {format!r}; expected one of {', '.join(get_args(ReconstructionFormat))}")


def check_surface_format(format: SurfaceFormat) -> None:
    """Check that the packages are installed that a format of surfaces needs.

    Raises:
        ConfigError: A package is not installed.
    """
    if format in ("las", "laz"):
        check_las()
    elif format == "geotiff":
        check_geotiff()


def write_surfaces(folder: Path | str, cloud: PointCloud, mesh: Mesh, format: SurfaceFormat) -> None:
    """Write the surfaces of a scene.

    Args:
        folder: The folder to write to; missing folders are created.
        cloud: The points.
        mesh: The triangles.
        format: ``ply`` (points and mesh), ``glb`` or ``obj`` (the mesh), ``las`` or ``laz`` (the points). Maps are
            written by `dronevio.models.reconstructions.geotiff`.

    Raises:
        InputError: A file cannot be written.
        ConfigError: The format is unknown or of maps, or a package that it needs is not installed.
    """
    folder = Path(folder)
    if format == "ply":
        write_cloud(folder / "dense.ply", cloud)
        write_mesh(folder / "mesh.ply", mesh)
    elif format == "glb":
        write_glb(folder / "mesh.glb", mesh)
    elif format == "obj":
        write_obj(folder / "mesh.obj", mesh)
    elif format in ("las", "laz"):
        write_las(folder / f"dense.{format}", cloud)
    else:
        raise ConfigError(f"format of surfaces {format!r}; expected one of ply, glb, obj, las, laz")
