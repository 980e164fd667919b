"""Point clouds as LAS and LAZ files, which programs of geographic information and laser scanning read.

Files are of version 1.4 with points of format 7: positions as integers of 32 bits with a scale and an offset, colours
of 16 bits. Normals are the further dimensions NormalX, NormalY and NormalZ. The package laspy writes them, and lazrs
compresses them. Source: ASPRS, "LAS specification 1.4 − R15", 2019.
"""

import io
from pathlib import Path

import numpy as np

from dronevio.models.errors import ConfigError
from dronevio.models.extras import install_command
from dronevio.models.recordings.files import write_bytes
from dronevio.models.surfaces import PointCloud

_RESOLUTION = 1e-6
"""Upper limit of the step of the positions, relative to the largest extent of the points."""


def check_las() -> None:
    """Check that the packages that write the files are installed.

    Raises:
        ConfigError: One of them is not.
    """
    try:
        import laspy  # noqa: F401
        import lazrs  # noqa: F401
    except ImportError:
        raise ConfigError(f"LAS without laspy and lazrs; expected them, by `{install_command('las')}`") from None


def write_las(path: Path, cloud: PointCloud) -> None:
    """Write a point cloud with its normals and colours. The file has no coordinate reference system.

    Args:
        path: The file to write; it is compressed if its name ends in ``.laz``.
        cloud: The points.

    Raises:
        ConfigError: A package is not installed.
        InputError: The file cannot be written.
    """
    check_las()
    import laspy

    path = Path(path)
    header = laspy.LasHeader(version="1.4", point_format=7)
    header.global_encoding.wkt = True  # points of format 7 must not have the older GeoTIFF keys
    header.generating_software = "dronevio"
    if len(cloud):
        low, high = cloud.points.min(axis=0), cloud.points.max(axis=0)
        extent = max(float((high - low).max()), _RESOLUTION * float(np.abs(cloud.points).max()), 1e-9)
        scale = 10.0 ** np.floor(np.log10(_RESOLUTION * extent))
        header.scales, header.offsets = np.full(3, scale), scale * np.round((low + high) / (2.0 * scale))
    header.add_extra_dims([laspy.ExtraBytesParams(f"Normal{axis}", "float32") for axis in "XYZ"])
    las = laspy.LasData(header)
    las.x, las.y, las.z = cloud.points.T
    las.red, las.green, las.blue = 257 * cloud.colours.T.astype(np.uint16)  # 255 becomes 65535
    for axis, values in zip("XYZ", cloud.normals.T.astype(np.float32), strict=True):
        las[f"Normal{axis}"] = values
    buffer = io.BytesIO()
    las.write(buffer, do_compress=path.suffix.lower() == ".laz")
    write_bytes(path, buffer.getvalue())
