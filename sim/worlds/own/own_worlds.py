"""Own worlds by name: complete names, which identify the content, and builders."""

import hashlib
from functools import cache, lru_cache
from pathlib import Path
from typing import ClassVar

from dronevio.models.errors import ConfigError, InputError
from dronevio.models.python_names import PythonName
from dronevio.models.recordings.files import read_bytes
from dronevio.sim.worlds.layout import WorldBuilder
from dronevio.sim.worlds.own.description import description_of_model, read_description
from dronevio.sim.worlds.own.file_world import file_world
from dronevio.sim.worlds.own.folder import MOST_BYTES, WorldFolder
from dronevio.sim.worlds.own.names import HASH_DIGITS, is_python, split_name

_EXPECTED = "a world in YAML or MJCF"


class _PythonWorld(PythonName):
    """Name of the builder of a world in a Python module."""

    what: ClassVar[str] = "world"


def complete_name(name: str) -> str:
    """Return the complete name of an own world: the absolute path of its file, or its builder, with a hash.

    A complete name is returned unchanged, without a look at the file.

    Args:
        name: The name of a file or builder, complete or not. A hash that is given must be that of the content.

    Raises:
        ConfigError: The file or builder is missing, damaged, or another one than the hash states.
    """
    text, expected = split_name(name)
    if is_python(name):
        found = _python_world(text)[1]
    elif expected is not None and Path(text).is_absolute():
        return name
    else:
        text = str(Path(text).expanduser().absolute())
        if expected is not None and not Path(text).is_file():
            raise ConfigError(
                f"world {name}: there is no file {Path(text).name} in {Path(text).parent}; expected the world of the"
                " recording"
            )
        found = _read(Path(text))[1]
    if expected is not None and found != expected:
        raise ConfigError(
            f"world {name}: the content has the hash {found} now; expected {expected}, as it was recorded"
        )
    return f"{text}#{found}"


@lru_cache(maxsize=16)
def builder_of(name: str) -> WorldBuilder:
    """Return the builder of an own world.

    Args:
        name: A complete name.

    Raises:
        ConfigError: The file is missing or damaged, or has changed since the name was made.
    """
    text, expected = split_name(name)
    if is_python(name):
        return _python_world(text)[0]
    builder, found = _read(Path(text))
    if found != expected:
        raise ConfigError(f"{text}: the file has changed during the simulation; expected the content as it was")
    return builder


def _read(path: Path) -> tuple[WorldBuilder, str]:
    """Return the world of a file, and the hash of all its files.

    Raises:
        ConfigError: The file is missing or damaged.
    """
    try:
        content = read_bytes(path, _EXPECTED)
        if len(content) > MOST_BYTES:
            raise InputError(path, f"{len(content)} bytes", f"a world of at most {MOST_BYTES}")
        folder = WorldFolder(path, {path.name: content})
        if path.suffix.lower() == ".xml":
            description = description_of_model(folder, content)
        else:
            description = read_description(folder, _decoded(path, content))
    except InputError as error:
        raise ConfigError(str(error)) from None
    return file_world(description), folder.hash


def _decoded(path: Path, content: bytes) -> str:
    """Return the text of a file, or raise InputError."""
    try:
        return content.decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise InputError(path, f"the byte 0x{content[error.start]:02x}, which is not UTF-8", _EXPECTED, line) from None


@cache
def _python_world(text: str) -> tuple[WorldBuilder, str]:
    """Return a builder in a Python module, and the hash of the source of the module as it was imported.

    Raises:
        ConfigError: The text has another form, the module cannot be imported, or it has no such builder.
    """
    named = _PythonWorld.parse(text)
    module = named.imported_module()
    builder = getattr(module, named.name, None)
    if not isinstance(builder, WorldBuilder):
        found = "nothing" if builder is None else f"a {type(builder).__name__}"
        raise ConfigError(f"world {text}: {named.name} in {named.module} is {found}; expected a WorldBuilder")
    file = getattr(module, "__file__", None)
    source = Path(file).read_bytes() if file and Path(file).is_file() else b""
    return builder, hashlib.sha256(source).hexdigest()[:HASH_DIGITS]
