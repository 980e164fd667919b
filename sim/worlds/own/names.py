"""Names of worlds of one's own: a file, or a builder in a Python module, with a hash of its content.

A complete name, such as ``/home/me/yard.yaml#0123456789abcdef``, identifies the content. It is a key of caches and
means the same in another process. Recordings state it without the folder.
"""

import re
from pathlib import PurePath

from dronevio.models.python_names import PREFIX

FILE_SUFFIXES = (".yaml", ".yml", ".xml")
"""Suffixes of files that describe worlds: YAML, and MuJoCo's XML."""
FORMS = ("FILE.yaml", "FILE.xml", f"{PREFIX}package.module:NAME")
"""Forms of names of worlds of one's own, for messages."""
HASH_DIGITS = 16
"""Number of hexadecimal digits of a hash in a name."""

_HASH = re.compile(rf"#([0-9a-f]{{{HASH_DIGITS}}})\Z")


def split_name(name: str) -> tuple[str, str | None]:
    """Return a name without its hash, and the hash if there is one."""
    found = _HASH.search(name)
    return (name, None) if found is None else (name[: found.start()], found[1])


def is_file(name: str) -> bool:
    """Return whether a name, with or without hash, is that of a file."""
    return PurePath(split_name(name)[0]).suffix.lower() in FILE_SUFFIXES and not is_python(name)


def is_python(name: str) -> bool:
    """Return whether a name, with or without hash, is that of a builder in a Python module."""
    return name.startswith(PREFIX)


def recorded_world(name: str) -> str:
    """Return the name of a world as recordings and reports state it: without the folder of a file."""
    return PurePath(name).name if is_file(name) else name


def file_stem(name: str) -> str:
    """Return the name of a world as a part of the names of files: letters, digits and hyphens."""
    text = shown_world(name)
    return re.sub(r"[^0-9A-Za-z]+", "-", PurePath(text).stem if is_file(text) else text).strip("-")


def shown_world(name: str) -> str:
    """Return the short name of a world for messages: without folder and hash."""
    return split_name(recorded_world(name))[0]
