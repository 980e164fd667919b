"""Rerun files of dense surfaces."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from dronevio.eval.rerun import dense
from dronevio.models.surfaces import Mesh, PointCloud

if TYPE_CHECKING:
    from tests.eval.conftest import ReadRrd, SyntheticReconstruction, VerifyRrd


def test_every_nth_point_of_large_clouds_is_written(
    synthetic: "SyntheticReconstruction",
    read_rrd: "ReadRrd",
    verify_rrd: "VerifyRrd",
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(10, 3))
    normals = np.tile([0.0, 0.0, 1.0], (10, 1))
    colours = rng.integers(0, 256, (10, 3), dtype=np.uint8)
    cloud = PointCloud(points, normals, colours)
    mesh = Mesh(points, normals, colours, np.array([[0, 1, 2], [3, 4, 5]]))
    monkeypatch.setattr(dense, "MAX_POINTS", 4)
    path = tmp_path / "new" / "dense.rrd"
    dense.write_dense_rerun(synthetic.reconstruction, cloud, mesh, path, point_size=0.2)
    verify_rrd(path)
    columns = read_rrd(path)
    written = np.array(columns[dense.POINTS]["positions"][0].as_py())
    np.testing.assert_allclose(written, points[::3], rtol=1e-6)
    assert columns[dense.POINTS]["radii"][0].as_py() == [pytest.approx(0.1 * 3.0**0.5)]  # they cover the same area
    assert len(columns[dense.MESH]["triangle_indices"][0]) == 2
