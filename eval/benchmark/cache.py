"""Recordings under the hash of what they hold, made once however many ask for them."""

import fcntl
import hashlib
import json
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from dronevio.models.errors import InputError

_HASH_DIGITS = 16  # 64 bits: no two of a billion recordings are likely to share one
_IMAGES = (".png", ".jpg", ".pgm")
_HEAD = 1 << 20  # bytes of either end of a file that are read for its hash


def content_hash(settings: object) -> str:
    """Return the hash of plain settings (of what JSON can hold), whatever the order of their names."""
    text = json.dumps(settings, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:_HASH_DIGITS]


def code_hash(*places: Path) -> str:
    """Return the hash of the source code in some files and folders."""
    digest = hashlib.sha256()
    for place in places:
        files = [place] if place.is_file() else sorted(f for f in place.rglob("*") if f.suffix in (".py", ".xml"))
        for file in files:
            digest.update(f"{file.relative_to(place.parent)}\0".encode() + file.read_bytes() + b"\0")
    return digest.hexdigest()[:_HASH_DIGITS]


def recording_hash(path: Path) -> str:
    """Return the hash of a recording's files: names, sizes, and of all but images the first and last mebibyte.

    Raises:
        InputError: There is no such file or folder.
    """
    if not path.exists():
        raise InputError(path, "no such file or folder", "a recording")
    digest = hashlib.sha256()
    files = [path] if path.is_file() else sorted(file for file in path.rglob("*") if file.is_file())
    for file in files:
        size = file.stat().st_size
        digest.update(f"{file.name if file == path else file.relative_to(path)}\0{size}\0".encode())
        if file.suffix not in _IMAGES:
            with file.open("rb") as stream:
                digest.update(stream.read(_HEAD))
                stream.seek(max(0, size - _HEAD))
                digest.update(stream.read())
    return digest.hexdigest()[:_HASH_DIGITS]


class RecordingCache:
    """A folder of recordings, shared between estimators, benchmarks and processes."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def find(self, digest: str) -> Path | None:
        """Return the folder of a recording, None where it is not there."""
        folder = self._folder / digest
        return folder if folder.exists() else None

    @contextmanager
    def borrow(self, digest: str, make: Callable[[Path], None]) -> Iterator[Path]:
        """Give the folder of a recording, made now unless it is there; nobody drops it meanwhile.

        Whoever asks while another process makes it waits for that. What a killed process left is cleared away.

        Args:
            digest: Its hash.
            make: Writes the recording into an empty folder; what it raises goes through, and nothing stays.
        """
        with self._lock(digest) as lock:
            while True:
                fcntl.flock(lock, fcntl.LOCK_EX)
                folder = self.find(digest) or self._make(digest, make)
                fcntl.flock(lock, fcntl.LOCK_SH)  # between the two, another process may drop it
                if folder.exists():
                    break
            yield folder

    def drop(self, digest: str) -> None:
        """Delete a recording, unless somebody has borrowed it."""
        with self._lock(digest) as lock, suppress(BlockingIOError):
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            shutil.rmtree(self._folder / digest, ignore_errors=True)

    def _make(self, digest: str, make: Callable[[Path], None]) -> Path:
        for left in self._folder.glob(f".{digest}.partial-*"):
            shutil.rmtree(left, ignore_errors=True)
        partial = Path(tempfile.mkdtemp(prefix=f".{digest}.partial-", dir=self._folder))
        try:
            make(partial)
            partial.chmod(0o755)  # mkdtemp makes it private
            return partial.rename(self._folder / digest)
        finally:
            shutil.rmtree(partial, ignore_errors=True)

    def _lock(self, digest: str) -> IO[str]:
        """Open the recording's lock, which the system takes back from whoever dies."""
        self._folder.mkdir(parents=True, exist_ok=True)
        return (self._folder / f".{digest}.lock").open("w")
