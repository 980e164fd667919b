"""The folder of a world's file: reading of the files that it names, which must not lie outside."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from dronevio.models.errors import InputError
from dronevio.models.recordings.files import read_bytes
from dronevio.sim.worlds.own.names import HASH_DIGITS

MOST_BYTES = 32 * 2**20
"""Largest size of a file of a world."""
MOST_FILES = 64
"""Largest number of files of a world."""


@dataclass(frozen=True, eq=False)
class WorldFolder:
    """The file of a world and its folder."""

    path: Path
    """Absolute path of the file."""
    contents: dict[str, bytes] = field(default_factory=dict)
    """Content of all files that have been read, by their names relative to the folder."""

    def read(self, name: str, where: str, suffixes: Sequence[str], line: int | None = None) -> bytes:
        """Return the content of a file.

        Args:
            name: Path relative to the folder.
            where: Field that names the file, for error messages.
            suffixes: Suffixes of which the file has one.
            line: Line of the field.

        Raises:
            InputError: The path leaves the folder or has another suffix, or the file is missing or too large.
        """
        expected = f"a file {' or '.join(suffixes)} in the folder of the world, at most {MOST_BYTES // 2**20} MB"
        folder, path = self.path.parent.resolve(), Path(name)
        try:
            found = (folder / path).resolve()
            is_inside = not path.is_absolute() and found.is_relative_to(folder)
            is_file = is_inside and found.is_file()
        except (OSError, ValueError, RuntimeError):  # too long, a null character, a loop of links
            is_inside = is_file = False
        if not is_inside or found.suffix.lower() not in suffixes:
            raise InputError(self.path, f"{where}: {name!r}", expected, line)
        if not is_file:
            raise InputError(self.path, f"{where}: {name!r} does not exist", expected, line)
        if found.stat().st_size > MOST_BYTES:
            raise InputError(self.path, f"{where}: {name!r} of {found.stat().st_size // 2**20} MB", expected, line)
        relative = found.relative_to(folder).as_posix()
        if relative not in self.contents:
            if len(self.contents) >= MOST_FILES:
                raise InputError(self.path, f"{where}: {name!r}, after {MOST_FILES} other files", "fewer files", line)
            self.contents[relative] = read_bytes(found, expected)
        return self.contents[relative]

    @property
    def hash(self) -> str:
        """Hash of the content of all files that have been read."""
        parts = [(name, hashlib.sha256(content).hexdigest()) for name, content in sorted(self.contents.items())]
        return hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:HASH_DIGITS]
