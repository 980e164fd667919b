"""Orthophotos and height maps as GeoTIFF, read by rasterio, and their projection against that of PROJ."""

import re
import sys
from pathlib import Path

import numpy as np
import pytest

from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError
from dronevio.models.extras import install_command
from dronevio.models.geodesy import GeodeticPoint
from dronevio.models.reconstructions.geotiff import write_height_map, write_orthophoto
from dronevio.models.surfaces import OverheadMap

ORIGIN = (47.3977, 8.5456, 488.0)


@pytest.fixture
def view() -> OverheadMap:
    """A map of 300 × 400 cells of 5 cm, whose north-western corner is (−3, 12), with a hole."""
    row, column = np.mgrid[:300, :400]
    x, y = -3.0 + 0.05 * (column + 0.5), 12.0 - 0.05 * (row + 0.5)
    heights = (0.5 * x - 0.25 * y + 2.0).astype(np.float32)
    heights[10:20, 30:50] = np.nan
    colours = np.stack([row % 256, column % 256, np.full_like(row, 7)], axis=2).astype(np.uint8)
    return OverheadMap((-3.0, 12.0), 0.05, heights, np.where(np.isnan(heights)[..., None], 0, colours).astype(np.uint8))


def test_rasterio_reads_heights_at_their_places(tmp_path: Path, view: OverheadMap) -> None:
    rasterio = pytest.importorskip("rasterio")
    write_height_map(tmp_path / "height.tif", view)
    with rasterio.open(tmp_path / "height.tif") as read:
        assert (read.count, read.width, read.height, read.dtypes[0]) == (1, 400, 300, "float32")
        np.testing.assert_array_equal(read.read(1), view.heights)
        np.testing.assert_allclose(read.bounds, [-3.0, -3.0, 17.0, 12.0])
        assert np.isnan(read.nodata)
        assert (read.read(1, masked=True).mask == np.isnan(view.heights)).all()
        # The plane z = x / 2 − y / 4 + 2 at two places that are centres of cells
        found = [value[0] for value in read.sample([(1.025, 2.025), (16.975, -2.975)])]
        np.testing.assert_allclose(found, [0.5125 - 0.50625 + 2.0, 8.4875 + 0.74375 + 2.0], rtol=1e-6)
        assert "local east and north" in read.crs.to_wkt() and not read.crs.is_geographic


def test_rasterio_reads_the_orthophoto(tmp_path: Path, view: OverheadMap) -> None:
    rasterio = pytest.importorskip("rasterio")
    write_orthophoto(tmp_path / "photo.tif", view)
    with rasterio.open(tmp_path / "photo.tif") as read:
        names = [each.name for each in read.colorinterp]
        assert names == ["red", "green", "blue", "alpha"]
        np.testing.assert_array_equal(np.moveaxis(read.read([1, 2, 3]), 0, 2), view.colours)
        np.testing.assert_array_equal(read.read(4) == 255, np.isfinite(view.heights))
        assert set(np.unique(read.read(4))) == {0, 255}


def test_east_and_north_are_those_of_the_origin(tmp_path: Path, view: OverheadMap) -> None:
    """PROJ takes the coordinates of the file to longitude and latitude, where geodesy has the points of the plane."""
    rasterio = pytest.importorskip("rasterio")
    from rasterio.warp import transform

    write_height_map(tmp_path / "height.tif", view, GeodeticPoint(*ORIGIN))
    with rasterio.open(tmp_path / "height.tif") as read:
        np.testing.assert_allclose(read.read(1), view.heights + 488.0, rtol=1e-6)
        system = read.crs
    for east, north, tolerance_m in (
        (0.0, 0.0, 1e-6),
        (1000.0, 0.0, 5e-4),
        (0.0, -1000.0, 5e-4),
        (3000.0, 4000.0, 3e-3),
    ):
        longitude, latitude = geodetic_deg(ecef_m(*ORIGIN) + east_north_up(*ORIGIN[:2]).T @ [east, north, 0.0])
        [x], [y] = transform("EPSG:4326", system, [longitude], [latitude])
        assert np.hypot(x - east, y - north) < tolerance_m


def ecef_m(latitude_deg: float, longitude_deg: float, height_m: float) -> Array:
    """Return the position (3,) with the Earth's centre and axes, of a geodetic one on WGS 84."""
    a, f = 6378137.0, 1.0 / 298.257223563
    phi, lam = np.radians([latitude_deg, longitude_deg])
    n = a / np.sqrt(1.0 - f * (2.0 - f) * np.sin(phi) ** 2)
    x, y = (n + height_m) * np.cos(phi) * np.array([np.cos(lam), np.sin(lam)])
    return np.array([x, y, (n * (1.0 - f) ** 2 + height_m) * np.sin(phi)])


def east_north_up(latitude_deg: float, longitude_deg: float) -> Array:
    """Return the directions (3, 3) east, north and up, by rows."""
    (s, sl), (c, cl) = (
        np.sin(np.radians([latitude_deg, longitude_deg])),
        np.cos(np.radians([latitude_deg, longitude_deg])),
    )
    return np.array([[-sl, cl, 0.0], [-s * cl, -s * sl, c], [c * cl, c * sl, s]])


def geodetic_deg(p: Array) -> tuple[float, float]:
    """Return longitude and latitude [deg] of a position (3,), by iteration."""
    longitude, latitude, height = (
        np.degrees(np.arctan2(p[1], p[0])),
        np.degrees(np.arcsin(p[2] / np.linalg.norm(p))),
        0.0,
    )
    for _ in range(20):
        off = east_north_up(latitude, longitude) @ (p - ecef_m(latitude, longitude, height))
        latitude += np.degrees(off[1] / 6.37e6)
        height += off[2]
    return float(longitude), float(latitude)


def test_refusals(tmp_path: Path, view: OverheadMap, monkeypatch: pytest.MonkeyPatch) -> None:
    if "rasterio" in sys.modules or pytest.importorskip("rasterio"):
        with pytest.raises(ConfigError, match=r"latitude 91.0°, .* expected a position on the Earth"):
            write_height_map(tmp_path / "a.tif", view, GeodeticPoint(91.0, 0.0, 0.0))
    with pytest.raises(ConfigError, match=r"cell = 0\.0; expected"):
        OverheadMap((0.0, 0.0), 0.0, view.heights, view.colours)
    with pytest.raises(ConfigError, match=r"colours of shape \(400, 300, 3\)"):
        OverheadMap((0.0, 0.0), 1.0, view.heights, view.colours.swapaxes(0, 1))
    monkeypatch.setitem(sys.modules, "rasterio", None)
    with pytest.raises(ConfigError, match=re.escape(install_command("geo"))):
        write_orthophoto(tmp_path / "a.tif", view)
    assert not list(tmp_path.iterdir())
