"""Pictures of worlds by several processes, and their files."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError
from dronevio.sim.pictures import world_pictures
from dronevio.sim.pictures.contact_sheet import views
from dronevio.sim.pictures.world_pictures import PictureTask, pictures_of_worlds
from dronevio.sim.world import build_world

SMALL = CameraModel(width=40, height=30, fx=25.0, fy=25.0, cx=19.5, cy=14.5)
NAMES = ("low-texture", "repetitive", "low-texture")


@pytest.mark.slow
def test_processes_take_the_same_pictures_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("DRONEVIO_WORLD_FILES")
    reported: list[tuple[int, int]] = []
    first = pictures_of_worlds(NAMES, 0, 2, SMALL, lambda done, total: reported.append((done, total)), workers=2)
    assert reported[0] == (0, 4) and reported[-1] == (4, 4)
    for name, pictures in zip(NAMES, first, strict=True):
        np.testing.assert_array_equal(pictures, views(build_world(name, 0), 2, SMALL))

    files = sorted((tmp_path / "dronevio" / "pictures").iterdir())
    assert len(files) == 2
    monkeypatch.setattr(world_pictures, "run_tasks", lambda *_: pytest.fail("the files are not used"))
    np.testing.assert_array_equal(pictures_of_worlds(NAMES, 0, 2, SMALL), first)
    with pytest.raises(pytest.fail.Exception, match="not used"):
        pictures_of_worlds(NAMES, 1, 2, SMALL)
    files[0].write_bytes(files[0].read_bytes()[:100])
    with pytest.raises(pytest.fail.Exception, match="not used"):  # the damaged file is not used
        pictures_of_worlds(NAMES, 0, 2, SMALL)


def take_grey(tasks: list[PictureTask], units: int, progress: object) -> None:
    """Write grey pictures in place of those of the tasks."""
    for task in tasks:
        for name in task.names:
            grey = np.full((task.count * SMALL.height, SMALL.width, 3), 128, np.uint8)
            (task.folder / f"{name}.png").write_bytes(cv2.imencode(".png", grey)[1].tobytes())


def test_only_the_most_recent_files_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("DRONEVIO_WORLD_FILES")
    monkeypatch.setattr(world_pictures, "run_tasks", take_grey)
    monkeypatch.setattr(world_pictures, "FILES_MAX", 2)
    for seed in range(4):
        (picture,) = pictures_of_worlds(["room"], seed, 1, SMALL)
        assert picture[0].mean() == 128.0
    assert len(list((tmp_path / "dronevio" / "pictures").iterdir())) == 2


def test_folders_that_cannot_be_written_are_no_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "dronevio").write_text("a file in the way")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv("DRONEVIO_WORLD_FILES")
    monkeypatch.setattr(world_pictures, "run_tasks", take_grey)
    assert len(pictures_of_worlds(["room"], 0, 1, SMALL)) == 1


def test_unknown_worlds_are_named() -> None:
    with pytest.raises(ConfigError, match="'moon'"):
        pictures_of_worlds(["room", "moon"], 0, 1, SMALL)
