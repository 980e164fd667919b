"""Files of compiled worlds: painting a world takes seconds, which later processes save.

The files are in ``$XDG_CACHE_HOME/dronevio/worlds``, by default in ``~/.cache``, and can be deleted at any time. Each
has the format of MuJoCo (MJB) after a checksum, and its name contains a fingerprint of everything that determines the
world: its arguments, the code, the versions of libraries and the machine. Only the most recent files are kept. The
variable DRONEVIO_WORLD_FILES=0 turns the files off.
"""

import hashlib
import json
import os
import platform
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path

import cv2
import mujoco
import numpy as np

FILES_MAX = 16
"""Number of files that are kept."""
SIZE_MAX_BYTES = 32 * 2**20
"""Largest size of a file; larger worlds, which are those with textures at full resolution, are not written."""
_SWITCH = "DRONEVIO_WORLD_FILES"
_CODE = ("sim", "models")  # folders of the package on which a world depends


def compiled(arguments: str, build: Callable[[], mujoco.MjModel]) -> mujoco.MjModel:
    """Return a compiled world from its file; without one, build it and write the file.

    A file that cannot be read or written is ignored.

    Args:
        arguments: Everything that determines the world apart from code and machine.
        build: Function that builds the world.
    """
    if not enabled():
        return build()
    path = folder() / f"{fingerprint(arguments)}.world"
    model = _read(path)
    if model is None:
        model = build()
        _write(path, model)
    return model


def enabled() -> bool:
    """Return whether files are used."""
    return os.environ.get(_SWITCH) != "0"


def folder() -> Path:
    """Return the folder of the files."""
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "dronevio" / "worlds"


def _read(path: Path) -> mujoco.MjModel | None:
    """Return the model in a file; None without a valid file."""
    try:
        content = path.read_bytes()
        os.utime(path)  # the most recently used files are kept
    except OSError:
        return None
    checksum, data = content[:32], content[32:]
    if hashlib.sha256(data).digest() != checksum:
        return None
    try:
        return mujoco.MjModel.from_binary_path("world.mjb", {"world.mjb": data})
    except ValueError:  # of another version of MuJoCo
        return None


def _write(path: Path, model: mujoco.MjModel) -> None:
    """Write a model to a temporary name and rename it, so that other processes see whole files only."""
    if mujoco.mj_sizeModel(model) > SIZE_MAX_BYTES:
        return
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=path.parent) as scratch:
            bare, whole = Path(scratch) / "bare.mjb", Path(scratch) / "whole"
            mujoco.mj_saveModel(model, str(bare), None)
            data = bare.read_bytes()
            whole.write_bytes(hashlib.sha256(data).digest() + data)
            whole.replace(path)
        files = sorted(path.parent.glob("*.world"), key=lambda file: file.stat().st_mtime)
        for old in files[: max(len(files) - FILES_MAX, 0)]:
            old.unlink(missing_ok=True)
    except OSError:  # no space, or no permission: the next process builds the world again
        return


def fingerprint(arguments: str) -> str:
    """Return a name for what arguments, the code of the simulator, libraries and this machine determine."""
    return hashlib.sha256(f"{arguments}\n{_environment()}".encode()).hexdigest()[:32]


@cache
def _environment() -> str:
    """Return a description of code, libraries and machine."""
    package = Path(__file__).resolve().parents[2]
    code = hashlib.sha256()
    for file in sorted(file for name in _CODE for file in (package / name).rglob("*.py")):
        code.update(file.read_bytes())
    versions = [mujoco.__version__, np.__version__, cv2.__version__]
    return json.dumps([code.hexdigest(), versions, platform.machine(), platform.node()])
