"""Intermediate results that are kept as files of arrays, so that an interrupted computation continues.

A file is valid for the input and the settings whose hash it contains. Files are written under a temporary name and
renamed, so that each is complete or absent.
"""

import hashlib
import os
import tempfile
import threading
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

_READING = threading.Lock()
"""Held while a file is read. numpy parses the headers of arrays as Python expressions, and CPython 3.11 counts the
depth of such a parse for all threads together: two at a time may end in `SystemError` (AST constructor recursion)."""


def digest(*parts: object) -> str:
    """Return a hash of arrays and of the representations of other values."""
    state = hashlib.sha256()
    for part in parts:
        data = np.ascontiguousarray(part).tobytes() if isinstance(part, np.ndarray) else repr(part).encode()
        state.update(len(data).to_bytes(8, "little") + data)
    return state.hexdigest()


def load_arrays(path: Path) -> dict[str, Any] | None:
    """Return the arrays of a file; None if it is absent or damaged."""
    try:
        with _READING, path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
            return dict(file)
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None


@dataclass(frozen=True)
class ArrayStore:
    """A folder of intermediate results; without a folder, nothing is kept."""

    folder: Path | None = None
    """The folder; it is made when the first file is written."""

    def load(self, name: str, key: str) -> dict[str, Any] | None:
        """Return the arrays of a file; None if it is absent, damaged or has another hash."""
        arrays = None if self.folder is None else load_arrays(self.folder / name)
        return arrays if arrays is not None and str(arrays.get("key")) == key else None

    def save(self, name: str, key: str, **arrays: Any) -> None:
        """Write arrays with the hash of their input and settings."""
        if self.folder is None:
            return
        self.folder.mkdir(parents=True, exist_ok=True)
        handle, partial = tempfile.mkstemp(prefix=f".{name}.", dir=self.folder)
        try:
            with os.fdopen(handle, "wb") as file:
                np.savez(file, key=np.array(key), **arrays)
            Path(partial).replace(self.folder / name)
        except BaseException:
            Path(partial).unlink(missing_ok=True)
            raise
