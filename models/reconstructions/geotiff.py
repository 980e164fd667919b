"""Maps seen from above as GeoTIFF files: the orthophoto with an alpha channel, and the height map in metres.

The package rasterio writes the files. Without the geographic position of the world frame, their coordinate reference
system is a local one in metres. With it, it is the transverse Mercator projection around that position with the scale
at its height. Its easting and northing are the x and y of a world frame with x east, y north and z up: to 3 mm at a
distance of 5 km and the height of the origin; a point 100 m higher or lower deviates by 16 mm at a distance of 1 km.
Heights have then the reference of that of the origin; the ellipsoid curves by 8 cm at a distance of 1 km.
Source: OGC 19-008r4, "GeoTIFF standard 1.1", 2019.
"""

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from dronevio.models.errors import ConfigError
from dronevio.models.extras import install_command
from dronevio.models.geodesy import FLATTENING, SEMI_MAJOR_M, GeodeticPoint
from dronevio.models.recordings.files import write_bytes
from dronevio.models.surfaces import OverheadMap

_LOCAL = 'LOCAL_CS["local east and north",UNIT["metre",1],AXIS["Easting",EAST],AXIS["Northing",NORTH]]'
_TILE = 256  # pixels


def check_geotiff() -> None:
    """Check that the package that writes the files is installed.

    Raises:
        ConfigError: It is not.
    """
    try:
        import rasterio  # noqa: F401
    except ImportError:
        raise ConfigError(f"GeoTIFF without rasterio; expected it, by `{install_command('geo')}`") from None


def write_orthophoto(path: Path, view: OverheadMap, origin: GeodeticPoint | None = None) -> None:
    """Write the colours of a map: red, green, blue and alpha, which is 0 where there is no surface.

    Args:
        path: The file to write.
        view: The map, in metres.
        origin: Origin of a world frame with x east and y north; None if it is unknown.

    Raises:
        ConfigError: The package is not installed, or the origin is no position on the Earth.
        InputError: The file cannot be written.
    """
    alpha = np.where(np.isfinite(view.heights), 255, 0).astype(np.uint8)
    bands = np.concatenate([np.moveaxis(view.colours, 2, 0), alpha[None]])
    _write(path, bands, view, origin, {"photometric": "RGB", "alpha": "YES"})


def write_height_map(path: Path, view: OverheadMap, origin: GeodeticPoint | None = None) -> None:
    """Write the heights of a map as numbers of 32 bits; NaN, which the file declares, where there is no surface.

    Args:
        path: The file to write.
        view: The map, in metres.
        origin: As for `write_orthophoto`. Heights are z plus its height.

    Raises:
        ConfigError: The package is not installed, or the origin is no position on the Earth.
        InputError: The file cannot be written.
    """
    height_m = view.heights + np.float32(0.0 if origin is None else origin.altitude_m)
    _write(path, height_m[None], view, origin, {"nodata": np.nan, "predictor": 3})


def _write(
    path: Path,
    bands: npt.NDArray[Any],
    view: OverheadMap,
    origin: GeodeticPoint | None,
    options: dict[str, Any],
) -> None:
    """Write bands (B, H, W), compressed without loss."""
    check_geotiff()
    import rasterio
    from rasterio.crs import CRS

    system = CRS.from_wkt(_LOCAL) if origin is None else CRS.from_proj4(_projection(origin))
    profile = {
        "driver": "GTiff",
        "count": len(bands),
        "height": bands.shape[1],
        "width": bands.shape[2],
        "dtype": bands.dtype,
        "crs": system,
        "transform": rasterio.Affine(view.cell, 0.0, view.west_north[0], 0.0, -view.cell, view.west_north[1]),
        "compress": "deflate",
        "tiled": True,
        "blockxsize": _TILE,
        "blockysize": _TILE,
    }
    with rasterio.MemoryFile() as file:
        with file.open(**profile, **options) as target:
            target.write(bands)
        write_bytes(Path(path), bytes(file.getbuffer()))


def _projection(origin: GeodeticPoint) -> str:
    """Return the projection around an origin.

    Raises:
        ConfigError: The origin is no position on the Earth.
    """
    latitude_deg, longitude_deg, height_m = origin.geodetic.tolist()
    if not (abs(latitude_deg) <= 90.0 and abs(longitude_deg) <= 360.0 and np.isfinite(height_m)):
        found = f"latitude {latitude_deg}°, longitude {longitude_deg}°, height {height_m} m"
        raise ConfigError(f"GeoTIFF: the origin {found}; expected a position on the Earth")
    e2 = FLATTENING * (2.0 - FLATTENING)
    radius_m = SEMI_MAJOR_M * np.sqrt(1.0 - e2) / (1.0 - e2 * np.sin(np.radians(latitude_deg)) ** 2)  # Gaussian
    place = f"+lat_0={latitude_deg!r} +lon_0={longitude_deg!r}"
    return f"+proj=tmerc {place} +k={1.0 + height_m / float(radius_m)!r} +x_0=0 +y_0=0 +datum=WGS84 +units=m"
