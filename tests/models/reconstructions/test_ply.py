"""PLY files: round trips, camera frusta, foreign properties, and damaged files."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError, InputError
from dronevio.models.reconstruction import Reconstruction
from dronevio.models.reconstructions import read_ply, write_ply

Make = Callable[..., Reconstruction]

ASCII = """ply
format ascii 1.0
comment The faces are ignored.
element camera 1
property list uchar float matrix
element vertex 2
property float x
property float y
property float nx
property float z
property uchar green
property uchar blue
property uchar red
element face 1
property list uchar int vertex_indices
end_header
2 0.5 0.5
1 2 0 3 11 12 10
-1.5 2e1 0 .25 21 22 20
3 0 1 1
"""


@pytest.mark.parametrize("binary", [True, False], ids=["binary", "ascii"])
def test_round_trip(tmp_path: Path, scene: Make, binary: bool) -> None:
    before = scene()
    write_ply(tmp_path / "a.ply", before, binary=binary)
    after = read_ply(tmp_path / "a.ply")
    np.testing.assert_array_equal(after.points, before.points)
    np.testing.assert_array_equal(after.colours, before.colours)
    assert not after.image_names and not len(after.observation_px)
    write_ply(tmp_path / "b.ply", after, binary=binary)
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


@pytest.mark.parametrize("binary", [True, False], ids=["binary", "ascii"])
def test_frusta_are_edges_behind_the_points(tmp_path: Path, scene: Make, binary: bool) -> None:
    """The image corners of a frustum project to the corners of the image; its first vertex is the camera."""
    camera = CameraModel(200, 100, 100.0, 100.0, 99.5, 49.5)
    r = scene(camera)
    write_ply(tmp_path / "a.ply", r, frustum_depth=0.5, binary=binary)
    vertices = read_ply(tmp_path / "a.ply").points
    np.testing.assert_array_equal(vertices[:20], r.points)
    frusta = vertices[20:].reshape(5, 5, 3)
    np.testing.assert_array_equal(frusta[:, 0], r.positions)
    np.testing.assert_allclose(np.linalg.norm(frusta[:, 1:] - frusta[:, :1], axis=2), 0.5)
    R, p = r.Ts_world_cam[2, :3, :3], r.positions[2]
    corners = camera.project((frusta[2, 1:] - p) @ R)
    np.testing.assert_allclose(corners, [[-0.5, -0.5], [199.5, -0.5], [199.5, 99.5], [-0.5, 99.5]], atol=1e-9)
    edges = edge_rows((tmp_path / "a.ply").read_bytes(), 45, binary)
    assert len(edges) == 40 and edges.min() == 20 and edges.max() == 44
    assert {tuple(edge) for edge in edges[:4]} == {(20, k) for k in range(21, 25)}


def edge_rows(data: bytes, vertices: int, binary: bool) -> np.ndarray:
    """Return the vertices of the edges of a file."""
    header, _, body = data.partition(b"end_header\n")
    assert b"element edge 40\nproperty int vertex1\nproperty int vertex2\n" in header
    if not binary:
        return np.array([row.split()[:2] for row in body.decode().splitlines()[vertices:]], int)
    edge = np.dtype([("vertices", "<i4", 2), ("colour", "u1", 3)])
    return np.asarray(np.frombuffer(body[vertices * 27 :], edge)["vertices"])


def test_frusta_of_wide_lenses_are_finite(tmp_path: Path, scene: Make) -> None:
    wide = CameraModel(400, 400, 100.0, 100.0, 199.5, 199.5, (-0.3, 0.0, 0.0, 0.0))
    assert np.isnan(wide.unproject(np.array([0.0, 0.0]))).any()
    write_ply(tmp_path / "a.ply", scene(wide), frustum_depth=1.0)
    assert np.isfinite(read_ply(tmp_path / "a.ply").points).all()
    with pytest.raises(ConfigError, match="frustum_depth = 0"):
        write_ply(tmp_path / "b.ply", scene(), frustum_depth=0.0)


def test_foreign_properties_and_elements(tmp_path: Path) -> None:
    (tmp_path / "a.ply").write_text(ASCII)
    r = read_ply(tmp_path / "a.ply")
    np.testing.assert_array_equal(r.points, [[1, 2, 3], [-1.5, 20, 0.25]])
    np.testing.assert_array_equal(r.colours, [[10, 11, 12], [20, 21, 22]])


@pytest.mark.parametrize(("form", "order"), [("binary_little_endian", "<"), ("binary_big_endian", ">")])
def test_binary_without_colours_is_grey(tmp_path: Path, form: str, order: str) -> None:
    header = f"ply\r\nformat {form} 1.0\r\nelement other 2\r\nproperty short a\r\nelement vertex 2\r\n"
    header += "property float z\r\nproperty double y\r\nproperty int x\r\nend_header\r\n"
    vertices = np.array(
        [(3.5, 2.25, -1), (6.5, 5.25, 4)], [("z", f"{order}f4"), ("y", f"{order}f8"), ("x", f"{order}i4")]
    )
    (tmp_path / "a.ply").write_bytes(header.encode() + b"\0\1\0\2" + vertices.tobytes())
    r = read_ply(tmp_path / "a.ply")
    np.testing.assert_array_equal(r.points, [[-1, 2.25, 3.5], [4, 5.25, 6.5]])
    assert (r.colours == 128).all()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("ply\n", "plx\n", ":1: 'plx'; expected 'ply'"),
        ("ascii 1.0", "text 1.0", ":2: 'format text 1.0'; expected a line of a PLY header"),
        ("vertex 2\n", "vertex -2\n", ":6: 'element vertex -2'"),
        ("vertex 2\n", "vertex 99999999999999\n", ": 4 rows where the header has 99999999999999 vertices"),
        ("float nx", "quad nx", ":9: 'property quad nx'"),
        ("float nx", "float x", ": two properties of the same name"),
        ("float z", "float w", ": vertices without x, y and z"),
        ("element vertex", "element corner", ": no vertices"),
        ("end_header", "end_heade", ":16: 'end_heade'"),
        ("1 2 0 3 11", "1 2 0 11", ":18: 6 values; expected 7 values: x, y, nx, z"),
        ("1 2 0 3 11", "1 2 0 three 11", r":18: .*'three'; expected numbers"),
        ("1 2 0 3 11", "1 2 0 inf 11", ":18: the number inf"),
        ("3 11 12 10", "3 11 12 256", ": the colour 256 11 12"),
    ],
)
def test_damage_is_named(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in ASCII
    (tmp_path / "a.ply").write_text(ASCII.replace(old, new, 1))
    with pytest.raises(InputError, match=r"a\.ply" + message):
        read_ply(tmp_path / "a.ply")


def test_truncated_files_are_refused(tmp_path: Path, scene: Make) -> None:
    write_ply(tmp_path / "a.ply", scene())
    data = (tmp_path / "a.ply").read_bytes()
    for end in range(0, len(data), 7):
        (tmp_path / "a.ply").write_bytes(data[:end])
        with pytest.raises(InputError, match=r"a\.ply"):
            read_ply(tmp_path / "a.ply")


@settings(max_examples=300, deadline=None)
@given(data=st.data(), binary=st.booleans())
def test_damaged_files_raise_only_input_errors(
    tmp_path_factory: pytest.TempPathFactory, scene: Make, data: st.DataObject, binary: bool
) -> None:
    path = tmp_path_factory.getbasetemp() / "damaged.ply"
    write_ply(path, scene(), binary=binary)
    original = path.read_bytes() if data.draw(st.booleans()) else ASCII.encode()
    start = data.draw(st.integers(0, len(original)))
    end = data.draw(st.integers(start, min(start + 6, len(original))) | st.just(len(original)))
    path.write_bytes(original[:start] + data.draw(st.binary(max_size=12)) + original[end:])
    try:
        read_ply(path)
    except InputError as error:
        assert str(path) in str(error)
