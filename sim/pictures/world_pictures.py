"""Pictures of several worlds, taken by several processes, and files of them for later calls.

The files are in ``$XDG_CACHE_HOME/dronevio/pictures``, by default in ``~/.cache``, and can be deleted at any time.
Their names contain a fingerprint of everything that determines the pictures. Only the most recent ones are kept.
"""

import os
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from dronevio.models.arrays import Image
from dronevio.models.camera import CameraModel
from dronevio.models.progress import Progress, silent
from dronevio.sim.pictures.contact_sheet import taken_views
from dronevio.sim.rendering import world_files
from dronevio.sim.rendering.worker_pool import default_workers, run_tasks
from dronevio.sim.world import build_world, resolved_world
from dronevio.sim.worlds.own.names import file_stem, is_python

FILES_MAX = 48
"""Number of files that are kept, each of 1 to 4 MB."""


@dataclass(frozen=True)
class PictureTask:
    """Pictures of some worlds, taken by one process."""

    names: tuple[str, ...]
    """Names of the worlds."""
    seed: int
    """Seed of the worlds."""
    count: int
    """Number of pictures of each world."""
    camera: CameraModel
    """Camera of the pictures."""
    folder: Path
    """Folder to which the pictures of each world are written as one image, below each other."""

    def run(self) -> Iterator[None]:
        """Take the pictures, and yield after each.

        Raises:
            GraphicsError: There is no off-screen OpenGL.
            OSError: A file cannot be written.
        """
        for name in self.names:
            pictures = []
            for picture in taken_views(build_world(name, self.seed), self.count, self.camera):
                pictures.append(picture)
                yield
            (self.folder / f"{file_stem(name)}.png").write_bytes(cv2.imencode(".png", np.vstack(pictures))[1].tobytes())


def pictures_of_worlds(
    names: Sequence[str],
    seed: int,
    count: int,
    camera: CameraModel,
    progress: Progress = silent,
    workers: int | None = None,
) -> list[list[Image]]:
    """Return pictures (H, W, 3) of each of some worlds, from files of an earlier call if there are any.

    Args:
        names: Names of the worlds.
        seed: Seed of the worlds.
        count: Number of pictures of each world.
        camera: Camera of the pictures.
        progress: Callback that receives the number of pictures that have been taken, and their total.
        workers: Number of processes; the number of cores by default, at most four.

    Raises:
        ConfigError: A world is unknown.
        GraphicsError: There is no off-screen OpenGL.
    """
    names = [resolved_world(name) for name in names]
    files = {name: None if is_python(name) else _file(f"{name} {seed} {count} {camera}") for name in names}
    by_world = {name: _read(file, count, camera) for name, file in files.items()}
    missing = [name for name, pictures in by_world.items() if pictures is None]
    if missing:
        shares = min(workers or default_workers(len(missing), 1), len(missing))
        with tempfile.TemporaryDirectory(prefix="dronevio-") as scratch:
            folder = Path(scratch)
            tasks = [PictureTask(tuple(missing[k::shares]), seed, count, camera, folder) for k in range(shares)]
            run_tasks(tasks, len(missing) * count, progress)
            for name in missing:
                by_world[name] = _read(folder / f"{file_stem(name)}.png", count, camera)
                _store(folder / f"{file_stem(name)}.png", files[name])
    return [pictures for name in names if (pictures := by_world[name]) is not None]


def _file(arguments: str) -> Path | None:
    """Return the file for the pictures of a world; None if files are turned off."""
    if not world_files.enabled():
        return None
    return world_files.folder().with_name("pictures") / f"{world_files.fingerprint(arguments)}.png"


def _read(file: Path | None, count: int, camera: CameraModel) -> list[Image] | None:
    """Return the pictures in a file; None without a valid file."""
    stacked = None
    if file is not None and file.is_file():
        stacked = cv2.imdecode(np.fromfile(file, np.uint8), cv2.IMREAD_COLOR)
        with suppress(OSError):
            os.utime(file)  # the most recently used files are kept
    if stacked is None or stacked.shape != (count * camera.height, camera.width, 3):
        return None
    return list(np.asarray(stacked, dtype=np.uint8).reshape(count, camera.height, camera.width, 3))


def _store(source: Path, target: Path | None) -> None:
    """Keep a file for later calls, if there is space, and remove the oldest ones."""
    if target is None:
        return
    with suppress(OSError):  # no space, or no permission: the next call takes the pictures again
        target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=target.parent) as scratch:
            whole = Path(scratch) / "whole"
            whole.write_bytes(source.read_bytes())
            whole.replace(target)
        files = sorted(target.parent.glob("*.png"), key=lambda file: file.stat().st_mtime)
        for old in files[: max(len(files) - FILES_MAX, 0)]:
            old.unlink(missing_ok=True)
