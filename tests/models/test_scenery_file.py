"""The file of the scenery: what is written is read back, and damaged files are refused."""

import io
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from dronevio.models.errors import ConfigError, InputError
from dronevio.models.recordings.scenery_file import SCENERY_FILE, read_scenery, write_scenery
from dronevio.models.scenery import Scenery, TexturedMesh


def rectangle(grey: int = 100) -> TexturedMesh:
    """Return a rectangle of two triangles with a texture of one colour."""
    return TexturedMesh(
        np.array([(0, 0, 0), (1, 0, 0), (1, 2, 0), (0, 2, 0)], np.float32),
        np.array([(0, 1), (1, 1), (1, 0), (0, 0)], np.float32),
        np.array([(0, 1, 2), (0, 2, 3)], np.uint32),
        np.full((16, 24, 3), (grey, 0, 50), np.uint8),
    )


SCENERY = Scenery(np.arange(12.0).reshape(2, 2, 3), (rectangle(), rectangle(200)))


def changed_file(folder: Path, **arrays: Any) -> Path:
    """Write a valid file in which some arrays are replaced, or left out if they are None."""
    write_scenery(folder / SCENERY_FILE, SCENERY)
    with np.load(folder / SCENERY_FILE) as loaded:
        content = {**loaded, **arrays}
    np.savez(folder / SCENERY_FILE, **{name: value for name, value in content.items() if value is not None})
    return folder


@pytest.mark.parametrize("folder", ["", "mav0"])
def test_scenery_is_read_back(tmp_path: Path, folder: str) -> None:
    write_scenery(tmp_path / SCENERY_FILE, SCENERY)
    found = read_scenery(tmp_path / folder)
    np.testing.assert_array_equal(found.outline, SCENERY.outline)
    assert len(found.meshes) == 2
    for mesh, written in zip(found.meshes, SCENERY.meshes, strict=True):
        for name in ("vertices", "texture_coordinates", "triangles"):
            np.testing.assert_array_equal(getattr(mesh, name), getattr(written, name))
        np.testing.assert_allclose(mesh.texture.astype(int), written.texture, atol=3)  # red is not blue


def test_the_same_scenery_gives_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        write_scenery(tmp_path / name, SCENERY)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_recordings_without_the_file_have_no_scenery(tmp_path: Path) -> None:
    found = read_scenery(tmp_path)
    assert found.outline.shape == (0, 2, 3) and found.meshes == ()


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"outline": None}, "no outline; expected outline: an array of kind 'f' and shape"),
        ({"vertices_1": np.zeros((4, 2), np.float32)}, "vertices_1 of kind 'f' and shape"),
        ({"triangles_0": np.zeros((2, 3), np.int64)}, "triangles_0 of kind 'i'"),
        ({"triangles_0": np.full((2, 3), 4, np.uint32)}, "triangles has the value 4; expected 0 to 3"),
        ({"vertices_0": np.full((4, 3), np.nan, np.float32)}, "values that are not finite"),
        ({"texture_0": np.zeros(9, np.uint8)}, "texture_0: an image of 0 × 0 px"),
        ({"vertices_0": np.array([{}], object)}, "cannot be read"),
    ],
)
def test_wrong_arrays_are_refused(tmp_path: Path, arrays: dict[str, Any], message: str) -> None:
    folder = changed_file(tmp_path, **arrays)
    with pytest.raises(InputError, match=f"{SCENERY_FILE}: .*{message}"):
        read_scenery(folder)


def test_large_textures_and_archives_are_refused(tmp_path: Path) -> None:
    jpeg = cv2.imencode(".jpg", np.zeros((8, 8, 3), np.uint8))[1].tobytes()
    at = jpeg.index(b"\xff\xc0") + 5
    large = jpeg[:at] + (60_000).to_bytes(2, "big") * 2 + jpeg[at + 4 :]
    with pytest.raises(InputError, match="texture_0: an image of 60000 × 60000 px"):
        read_scenery(changed_file(tmp_path, texture_0=np.frombuffer(large, np.uint8)))
    with io.BytesIO() as content:
        np.savez_compressed(content, outline=np.zeros((3_000_000, 2, 3)))
        (tmp_path / SCENERY_FILE).write_bytes(content.getvalue())
    with pytest.raises(InputError, match="arrays of 144000128 bytes; expected at most"):
        read_scenery(tmp_path)


@pytest.mark.parametrize("end", [0, 10, 100, -30])
def test_truncated_files_are_refused(tmp_path: Path, end: int) -> None:
    write_scenery(tmp_path / SCENERY_FILE, SCENERY)
    content = (tmp_path / SCENERY_FILE).read_bytes()
    (tmp_path / SCENERY_FILE).write_bytes(content[:end])
    with pytest.raises(InputError, match="cannot be read"):
        read_scenery(tmp_path)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("vertices", np.zeros((4, 2), np.float32)),
        ("texture_coordinates", np.zeros((3, 2), np.float32)),
        ("triangles", np.zeros((2, 4), np.uint32)),
        ("texture", np.zeros((0, 4, 3), np.uint8)),
    ],
)
def test_contradicting_shapes_are_refused(name: str, value: Any) -> None:
    arrays = {**vars(rectangle()), name: value}
    with pytest.raises(ConfigError, match=f"textured mesh: {name} has shape"):
        TexturedMesh(**arrays)
