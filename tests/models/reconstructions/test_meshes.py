"""Meshes as GLB and OBJ: a triangle by hand, and what trimesh reads."""

import json
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dronevio.models.errors import ConfigError
from dronevio.models.reconstructions.gltf import write_glb
from dronevio.models.reconstructions.obj import write_obj
from dronevio.models.surfaces import Mesh, Texture

TRIANGLE = Mesh(
    vertices=np.array([[1.0, 2.0, 3.0], [3.0, 2.0, 3.0], [1.0, 6.0, 4.0]]),
    normals=np.array([[0.0, 0.0, 1.0]] * 3),
    colours=np.array([[255, 0, 128], [0, 255, 10], [0, 0, 255]], np.uint8),
    triangles=np.array([[0, 1, 2]]),
)


@pytest.fixture
def mesh() -> Mesh:
    """Two hundred triangles of a wavy surface, far from the origin."""
    x, y = (grid.ravel() for grid in np.meshgrid(np.arange(11.0), np.arange(11.0)))
    z = np.sin(x) + 0.3 * y
    normals = np.stack([-np.cos(x), np.full_like(x, -0.3), np.ones_like(x)], axis=1)
    corner = (np.arange(10)[:, None] * 11 + np.arange(10)).ravel()
    lower = np.stack([corner, corner + 1, corner + 11], axis=1)
    upper = np.stack([corner + 1, corner + 12, corner + 11], axis=1)
    return Mesh(
        vertices=np.stack([x, y, z], axis=1) + [5000.0, -8000.0, 300.0],
        normals=normals / np.linalg.norm(normals, axis=1, keepdims=True),
        colours=np.random.default_rng(2).integers(0, 256, (121, 3), dtype=np.uint8),
        triangles=np.concatenate([lower, upper]),
    )


def chunks(data: bytes) -> tuple[dict[str, Any], bytes]:
    """Return JSON and binary data of a GLB file, by section 4.4 of the specification."""
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON" and size % 4 == 0
    document = json.loads(data[20 : 20 + size])
    rest = data[20 + size :]
    if not rest:
        return document, b""
    binary, kind = struct.unpack_from("<I4s", rest)
    assert kind == b"BIN\0" and binary % 4 == 0 and len(rest) == 8 + binary
    return document, rest[8:]


def test_a_triangle_as_glb_by_hand(tmp_path: Path) -> None:
    """The centre of the triangle's box is (2, 4, 3.5), which is (2, 3.5, −4) with y up."""
    write_glb(tmp_path / "a.glb", TRIANGLE)
    document, binary = chunks((tmp_path / "a.glb").read_bytes())
    assert document["asset"] == {"version": "2.0", "generator": "dronevio"}
    [node] = document["nodes"]
    assert node["translation"] == [2.0, 3.5, -4.0]
    x, y, z, w = node["rotation"]
    assert (y, z) == (0.0, 0.0) and 2.0 * np.arctan2(x, w) == pytest.approx(-np.pi / 2.0)  # −90° about x
    positions, normals, colours, indices = document["accessors"]
    assert (positions["min"], positions["max"]) == ([-1.0, -2.0, -0.5], [1.0, 2.0, 0.5])
    assert [view["byteOffset"] for view in document["bufferViews"]] == [0, 36, 72, 96]
    assert struct.unpack_from("<9f", binary) == (-1.0, -2.0, -0.5, 1.0, -2.0, -0.5, -1.0, 2.0, 0.5)
    assert struct.unpack_from("<3f", binary, 36) == (0.0, 0.0, 1.0)
    # sRGB 128 is .2159 in linear light; 10, in the linear part of the curve, is 10 / 255 / 12.92.
    red, green, blue = (struct.unpack_from("<4H", binary, 72 + 8 * i) for i in range(3))
    assert red == (65535, 0, pytest.approx(0.21586 * 65535, abs=1), 65535)
    assert green == (0, 65535, pytest.approx(10.0 / 255.0 / 12.92 * 65535, abs=1), 65535) and blue[2] == 65535
    assert colours["normalized"] and indices["count"] == 3 and normals["type"] == "VEC3"
    assert struct.unpack_from("<3I", binary, 96) == (0, 1, 2) and len(binary) == 108


def test_a_triangle_as_obj_by_hand(tmp_path: Path) -> None:
    write_obj(tmp_path / "a.obj", TRIANGLE)
    assert (tmp_path / "a.obj").read_text(encoding="ascii").split("\n")[1:] == [
        "v 1 2 3 1 0 0.50196",
        "v 3 2 3 0 1 0.039216",
        "v 1 6 4 0 0 1",
        *3 * ["vn 0 0 1"],
        "f 1//1 2//2 3//3",
        "",
    ]


def test_trimesh_reads_glb_with_y_up(tmp_path: Path, mesh: Mesh) -> None:
    trimesh = pytest.importorskip("trimesh")
    write_glb(tmp_path / "a.glb", mesh)
    scene = trimesh.load_scene(tmp_path / "a.glb", process=False)
    [node] = scene.graph.nodes_geometry
    T, name = scene.graph[node]
    read = scene.geometry[name]
    np.testing.assert_array_equal(read.faces, mesh.triangles)
    np.testing.assert_allclose(T[:3, :3], [[1, 0, 0], [0, 0, 1], [0, -1, 0]], atol=1e-12)  # z becomes y
    found = read.vertices @ T[:3, :3].T + T[:3, 3]
    np.testing.assert_allclose(found, mesh.vertices @ T[:3, :3].T, atol=1e-6)  # although far from the origin
    np.testing.assert_allclose(read.vertex_normals, mesh.normals, atol=1e-6)
    linear = read.visual.vertex_attributes["color"][:, :3] / 65535.0
    srgb = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    np.testing.assert_array_equal(np.rint(255.0 * srgb), mesh.colours)


def test_trimesh_reads_obj(tmp_path: Path, mesh: Mesh) -> None:
    trimesh = pytest.importorskip("trimesh")
    write_obj(tmp_path / "a.obj", mesh)
    read = trimesh.load_mesh(tmp_path / "a.obj", process=False, maintain_order=True)
    np.testing.assert_array_equal(read.faces, mesh.triangles)
    np.testing.assert_allclose(read.vertices, mesh.vertices, atol=1e-5)
    np.testing.assert_array_equal(read.visual.vertex_colors[:, :3], mesh.colours)


def test_vertices_without_a_normal_have_one_in_glb(tmp_path: Path) -> None:
    normals = np.array([[0.0, 0.0, 0.0], [0.0, 3.0, 4.0], [1.0, 0.0, 0.0]])
    write_glb(tmp_path / "a.glb", replace(TRIANGLE, normals=normals))
    _, binary = chunks((tmp_path / "a.glb").read_bytes())
    found = np.frombuffer(binary, "<f4", 9, 36).reshape(3, 3)
    np.testing.assert_allclose(found, [[0.0, 0.0, 1.0], [0.0, 0.6, 0.8], [1.0, 0.0, 0.0]], rtol=1e-6)


def test_files_without_triangles(tmp_path: Path) -> None:
    none = np.empty((0, 3))
    empty = Mesh(none, none, none.astype(np.uint8), none.astype(np.int64))
    write_glb(tmp_path / "a.glb", empty)
    document, binary = chunks((tmp_path / "a.glb").read_bytes())
    assert document["scenes"] == [{}] and "nodes" not in document and not binary
    write_obj(tmp_path / "a.obj", empty)
    assert (tmp_path / "a.obj").read_text(encoding="ascii").count("\n") == 1


IMAGE = np.zeros((16, 32, 3), np.uint8)
IMAGE[:, :16], IMAGE[:, 16:] = (200, 30, 30), (30, 30, 200)
TEXTURED = replace(
    TRIANGLE,
    texture=Texture(
        IMAGE,
        pixels=np.array([[0.0, 0.0], [30.0, 2.0], [4.0, 12.0]]),
        vertices=np.array([0, 1, 2]),
        triangles=np.array([[0, 1, 2]]),
    ),
)


def test_a_textured_triangle_as_obj_by_hand(tmp_path: Path) -> None:
    write_obj(tmp_path / "a.obj", TEXTURED)
    assert (tmp_path / "a.obj").read_text(encoding="ascii").split("\n") == [
        "mtllib a.mtl",
        "usemtl texture",
        "v 1 2 3",
        "v 3 2 3",
        "v 1 6 4",
        "vt 0.015625 0.96875",  # (0 + ½) / 32, 1 − (0 + ½) / 16
        "vt 0.953125 0.84375",
        "vt 0.140625 0.21875",
        *3 * ["vn 0 0 1"],
        "f 1/1/1 2/2/2 3/3/3",
        "",
    ]
    assert "map_Kd a-texture.jpg" in (tmp_path / "a.mtl").read_text(encoding="ascii")


@pytest.mark.parametrize("name", ["a.glb", "a.obj"])
def test_trimesh_reads_textures(tmp_path: Path, name: str) -> None:
    trimesh = pytest.importorskip("trimesh")
    (write_glb if name == "a.glb" else write_obj)(tmp_path / name, TEXTURED)
    read = trimesh.load_mesh(tmp_path / name, process=False)
    assert len(read.faces) == 1
    coordinates = read.visual.uv[read.faces[0]]
    np.testing.assert_allclose(coordinates[:, 0], [0.015625, 0.953125, 0.140625], atol=1e-6)
    np.testing.assert_allclose(coordinates[:, 1], [0.96875, 0.84375, 0.21875], atol=1e-6)  # trimesh has v upwards
    material = read.visual.material
    image = np.asarray(material.baseColorTexture if name == "a.glb" else material.image)
    assert image.shape == (16, 32, 3)
    assert np.abs(image[8, 4].astype(int) - (200, 30, 30)).max() < 12
    assert np.abs(image[8, 28].astype(int) - (30, 30, 200)).max() < 12


def test_a_vertex_at_a_seam_is_there_twice(tmp_path: Path, mesh: Mesh) -> None:
    corners = mesh.triangles.ravel()  # no two triangles share a pixel
    texture = Texture(
        IMAGE, np.random.default_rng(0).uniform(0, 15, (len(corners), 2)), corners, np.arange(600).reshape(-1, 3)
    )
    write_glb(tmp_path / "a.glb", replace(mesh, texture=texture))
    document, _ = chunks((tmp_path / "a.glb").read_bytes())
    positions, _, coordinates, indices = document["accessors"]
    assert positions["count"] == coordinates["count"] == 600 and indices["count"] == 600
    assert document["images"] == [{"bufferView": 4, "mimeType": "image/jpeg"}]


def test_a_texture_of_other_triangles_is_refused() -> None:
    assert TEXTURED.texture is not None
    with pytest.raises(ConfigError, match="texture"):
        replace(TRIANGLE, texture=replace(TEXTURED.texture, vertices=np.array([1, 0, 2])))
