"""Depth maps of an earlier computation: when they are used again, and files that hold none."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dronevio.estimator.array_store import ArrayStore
from dronevio.estimator.dense.config import DenseConfig, DepthConfig, MeshConfig
from dronevio.estimator.dense.finished import FinishedDepth, read_finished, reusable_depths
from dronevio.estimator.dense.pipeline import densify
from dronevio.estimator.dense.views import ViewLoader
from dronevio.models.errors import InputError
from dronevio.models.rotation import exp_so3

Scene = Any  # the class of conftest, which cannot be imported

SMALL = DenseConfig(depth=DepthConfig(levels=2), mesh=MeshConfig(min_triangles=20))


@pytest.fixture(scope="module")
def folder(slanted: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The depth maps of the slanted plane."""
    folder = tmp_path_factory.mktemp("depths")
    densify(slanted.images, slanted.reconstruction, SMALL, store=ArrayStore(folder))
    return folder


@pytest.fixture
def finished(folder: Path) -> dict[str, FinishedDepth]:
    """The same, by the names of the images."""
    return read_finished(folder)


def held(scene: Scene, finished: dict[str, FinishedDepth], config: DenseConfig = SMALL, **changes: Any) -> list[int]:
    """Return the images whose depth maps are used again after changes of the reconstruction."""
    reconstruction = replace(scene.reconstruction, **changes)
    load = ViewLoader(scene.images, reconstruction, config.views)
    return list(reusable_depths(load, reconstruction.image_names, finished, config))


def test_the_same_scene_needs_no_new_depth_map(
    slanted: Scene, finished: dict[str, FinishedDepth], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert set(finished) == set(slanted.reconstruction.image_names)
    first = densify(slanted.images, slanted.reconstruction, SMALL)
    monkeypatch.delattr("dronevio.estimator.dense.pipeline.estimate_depth")
    again = densify(slanted.images, slanted.reconstruction, SMALL, finished=finished)
    assert (first.reused, again.reused) == (0, 5)
    np.testing.assert_array_equal(first.cloud.points, again.cloud.points)


def test_a_new_world_frame_does_not_matter(slanted: Scene, finished: dict[str, FinishedDepth]) -> None:
    moved = slanted.reconstruction.transformed(1.0, exp_so3(np.array([0.3, 1.0, -0.2])), np.array([5.0, 1.0, -3.0]))
    assert held(slanted, finished, Ts_world_cam=moved.Ts_world_cam) == [0, 1, 2, 3, 4]
    other_unit = slanted.reconstruction.transformed(1.2, np.eye(3), np.zeros(3))
    assert held(slanted, finished, Ts_world_cam=other_unit.Ts_world_cam) == []


@pytest.mark.parametrize(("shift_px", "images"), [(0.1, [0, 1, 2, 3, 4]), (1.0, [])])
def test_cameras_that_have_turned(
    slanted: Scene, finished: dict[str, FinishedDepth], shift_px: float, images: list[int]
) -> None:
    Ts = slanted.reconstruction.Ts_world_cam.copy()
    Ts[2, :3, :3] = Ts[2, :3, :3] @ exp_so3(np.array([0.0, shift_px / 150.0, 0.0]))  # of a focal length of 150 px
    assert held(slanted, finished, Ts_world_cam=Ts) == images  # every image is compared with the middle one


def test_another_focal_length(slanted: Scene, finished: dict[str, FinishedDepth]) -> None:
    (camera,) = slanted.reconstruction.cameras
    assert held(slanted, finished, cameras=(replace(camera, fx=camera.fx * 1.0005, fy=camera.fy * 1.0005),))
    assert not held(slanted, finished, cameras=(replace(camera, fx=camera.fx * 1.2, fy=camera.fy * 1.2),))


def test_other_images_and_settings(slanted: Scene, finished: dict[str, FinishedDepth]) -> None:
    pictures = [slanted.images.read(i).copy() for i in range(5)]
    pictures[0][10, 10] ^= 1
    changed = replace(slanted.images, read=pictures.__getitem__)
    load = ViewLoader(changed, slanted.reconstruction, SMALL.views)
    uses_first = [k for k, depth in enumerate(finished.values()) if "0.png" in depth.names]
    found = reusable_depths(load, slanted.reconstruction.image_names, finished, SMALL)
    assert list(found) == [k for k in range(5) if k not in uses_first]
    assert held(slanted, finished, replace(SMALL, depth=DepthConfig(levels=2, window_px=9))) == []
    renamed = tuple(f"new/{name}" for name in slanted.reconstruction.image_names)
    assert (
        reusable_depths(ViewLoader(slanted.images, slanted.reconstruction, SMALL.views), renamed, finished, SMALL) == {}
    )


def test_depth_maps_used_again_are_kept_again(slanted: Scene, folder: Path, tmp_path: Path) -> None:
    densify(slanted.images, slanted.reconstruction, SMALL, store=ArrayStore(tmp_path), finished=read_finished(folder))
    for name, depth in read_finished(folder).items():
        np.testing.assert_array_equal(read_finished(tmp_path)[name].inverse_depth, depth.inverse_depth)


@pytest.mark.parametrize("damage", ["nothing", "words", "shape", "nan", "field"])
def test_damaged_files_are_named(folder: Path, tmp_path: Path, damage: str) -> None:
    if damage == "nothing":
        with pytest.raises(InputError, match="no depth maps"):
            read_finished(tmp_path / "absent")
        return
    file = tmp_path / "depth-000000.npz"
    arrays = dict(np.load(folder / file.name))
    if damage == "words":
        file.write_text("no arrays")
    else:
        arrays["inverse_depth"] = np.full((3, 4), np.nan, np.float32) if damage == "nan" else arrays["inverse_depth"]
        arrays["Ks"] = arrays["Ks"][0] if damage == "shape" else arrays["Ks"]
        np.savez(file, **{name: array for name, array in arrays.items() if damage != "field" or name != "names"})
    with pytest.raises(InputError, match=r"depth-000000\.npz.*keep-depths"):
        read_finished(tmp_path)
