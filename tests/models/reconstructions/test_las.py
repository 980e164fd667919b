"""Point clouds as LAS and LAZ, read by laspy and by the layout of the specification."""

import re
import struct
import sys
from pathlib import Path

import numpy as np
import pytest

from dronevio.models.errors import ConfigError
from dronevio.models.extras import install_command
from dronevio.models.reconstructions.las import write_las
from dronevio.models.surfaces import PointCloud


@pytest.fixture
def cloud() -> PointCloud:
    """A thousand points, some hundred metres from the origin."""
    rng = np.random.default_rng(5)
    normals = rng.normal(size=(1000, 3))
    return PointCloud(
        points=rng.uniform([-300.0, 400.0, 20.0], [-250.0, 480.0, 35.0], (1000, 3)),
        normals=normals / np.linalg.norm(normals, axis=1, keepdims=True),
        colours=rng.integers(0, 256, (1000, 3), dtype=np.uint8),
    )


@pytest.mark.parametrize("name", ["points.las", "points.LAZ"])
def test_laspy_reads_the_same(tmp_path: Path, cloud: PointCloud, name: str) -> None:
    laspy = pytest.importorskip("laspy")
    write_las(tmp_path / name, cloud)
    read = laspy.read(tmp_path / name)
    np.testing.assert_allclose(read.xyz, cloud.points, atol=1e-6 * 80.0)
    np.testing.assert_array_equal(np.stack([read.red, read.green, read.blue], axis=1), 257 * cloud.colours.astype(int))
    normals = np.stack([read[f"Normal{axis}"] for axis in "XYZ"], axis=1)
    np.testing.assert_allclose(normals, cloud.normals, atol=1e-6)
    assert (read.header.version.major, read.header.version.minor, read.header.point_format.id) == (1, 4, 7)
    np.testing.assert_allclose(read.header.mins, cloud.points.min(axis=0), atol=1e-4)
    np.testing.assert_allclose(read.header.maxs, cloud.points.max(axis=0), atol=1e-4)


def test_a_file_by_the_specification(tmp_path: Path, cloud: PointCloud) -> None:
    """The public header block and the first point, at the offsets of LAS 1.4, table 3 and table 15."""
    pytest.importorskip("laspy")
    write_las(tmp_path / "a.las", cloud)
    data = (tmp_path / "a.las").read_bytes()
    assert data[:4] == b"LASF" and data[24:26] == bytes([1, 4])
    assert struct.unpack_from("<H", data, 6)[0] & 0b10000  # a coordinate reference system would be WKT
    start, _, form, length = struct.unpack_from("<IIBH", data, 96)
    assert (form, length) == (7, 36 + 12)
    scale, offset = (np.array(struct.unpack_from("<3d", data, place)) for place in (131, 155))
    assert struct.unpack_from("<Q", data, 247) == (1000,)
    point = np.array(struct.unpack_from("<3i", data, start)) * scale + offset
    np.testing.assert_allclose(point, cloud.points[0], atol=1e-4)
    assert struct.unpack_from("<3H", data, start + 30) == tuple(257 * int(c) for c in cloud.colours[0])


def test_compressed_files_are_smaller_and_clouds_may_be_empty(tmp_path: Path, cloud: PointCloud) -> None:
    laspy = pytest.importorskip("laspy")
    for name in ("a.las", "a.laz"):
        write_las(tmp_path / name, cloud)
    assert (tmp_path / "a.laz").stat().st_size < 0.9 * (tmp_path / "a.las").stat().st_size
    write_las(tmp_path / "none.las", cloud.selected(np.zeros(1000, bool)))
    assert len(laspy.read(tmp_path / "none.las").points) == 0


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e5])
@pytest.mark.parametrize("count", [1, 2, 1000])
def test_all_scales_fit_the_integers(tmp_path: Path, cloud: PointCloud, scale: float, count: int) -> None:
    laspy = pytest.importorskip("laspy")
    scaled = cloud.selected(np.arange(1000) < count).transformed(scale, np.eye(3), np.zeros(3))
    write_las(tmp_path / "a.laz", scaled)
    np.testing.assert_allclose(laspy.read(tmp_path / "a.laz").xyz, scaled.points, atol=1e-6 * 80.0 * scale)


def test_a_missing_package_is_named(tmp_path: Path, cloud: PointCloud, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "laspy", None)
    with pytest.raises(ConfigError, match=re.escape(install_command("las"))):
        write_las(tmp_path / "a.las", cloud)
    assert not list(tmp_path.iterdir())
