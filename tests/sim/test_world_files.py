"""Compiled worlds are read from their files, and built where there is no valid one."""

import os
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import pytest

from dronevio.models.rig import EUROC_CAM0, RigCamera
from dronevio.sim.envs.sensing.camera_observation import RenderedObservation
from dronevio.sim.rendering import loaded_world, world_files
from dronevio.sim.rendering.loaded_world import LOADED_WORLDS
from dronevio.sim.rendering.world_files import compiled, folder

RADIUS_M = 0.25


@pytest.fixture
def built() -> list[str]:
    """Gives a list to which `building` adds a name for every world that is built."""
    return []


@pytest.fixture
def building(built: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], mujoco.MjModel]:
    """Gives a function that returns a small world by name from a new folder of files, and builds it without one."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("DRONEVIO_WORLD_FILES", raising=False)

    def get(name: str) -> mujoco.MjModel:
        def build() -> mujoco.MjModel:
            built.append(name)
            spec = mujoco.MjSpec()
            spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[RADIUS_M, 0, 0])
            return spec.compile()

        return compiled(name, build)

    return get


def test_worlds_are_built_once(built: list[str], building: Callable[[str], mujoco.MjModel]) -> None:
    for _ in range(3):
        assert building("a").geom_size[0, 0] == RADIUS_M
    building("b")
    assert built == ["a", "b"]
    assert len(list(folder().iterdir())) == 2  # and nothing temporary


def test_files_depend_on_the_code(
    built: list[str], building: Callable[[str], mujoco.MjModel], monkeypatch: pytest.MonkeyPatch
) -> None:
    building("a")
    monkeypatch.setattr(world_files, "_environment", lambda: "another version")
    building("a")
    assert built == ["a", "a"]


@pytest.mark.parametrize(
    "damage", [lambda data: data[:-1], lambda data: data[:-4] + b"\x00\x01\x02\x03", lambda _: b""]
)
def test_damaged_files_are_replaced(
    damage: Callable[[bytes], bytes], built: list[str], building: Callable[[str], mujoco.MjModel]
) -> None:
    building("a")
    (file,) = folder().iterdir()
    whole = file.read_bytes()
    file.write_bytes(damage(whole))
    building("a")
    assert built == ["a", "a"]
    assert file.read_bytes() == whole


def test_only_recently_used_files_are_kept(
    building: Callable[[str], mujoco.MjModel], built: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(world_files, "FILES_MAX", 2)
    building("a")
    building("b")
    for file in folder().iterdir():
        os.utime(file, (0, 0))
    building("a")  # used again
    building("c")
    assert len(list(folder().iterdir())) == 2
    building("a")
    assert built == ["a", "b", "c"]


def test_large_worlds_are_not_written(
    building: Callable[[str], mujoco.MjModel], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(world_files, "SIZE_MAX_BYTES", 100)
    assert building("a").ngeom == 1
    assert not folder().exists()


def test_files_are_optional(
    built: list[str], building: Callable[[str], mujoco.MjModel], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    (tmp_path / "file").write_bytes(b"")  # where a folder cannot be made
    assert building("a").ngeom == 1
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("DRONEVIO_WORLD_FILES", "0")
    assert building("a").ngeom == 1
    assert built == ["a", "a"]
    assert not folder().exists()


def test_images_do_not_depend_on_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("DRONEVIO_WORLD_FILES", raising=False)
    T_world_imu = np.eye(4)[None]
    T_world_imu[0, :3, 3] = [0.0, 0.0, 1.2]
    images = []
    for _ in range(2):
        loaded_world._compiled.cache_clear()
        LOADED_WORLDS.clear()
        observation = RenderedObservation(RigCamera(EUROC_CAM0, np.eye(4)), "repetitive", 3)
        images.append(observation.observe(T_world_imu)["grey"])
        observation.close()
        monkeypatch.setattr(loaded_world, "build_world", None)  # the second time from the file
    assert len(list(folder().iterdir())) == 1
    np.testing.assert_array_equal(images[0], images[1])
    assert images[0].std() > 5.0
