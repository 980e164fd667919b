"""A cache of recordings under the hash of their content, in which each recording is made once."""

import fcntl
import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from dronevio.eval.benchmark.cache_limit import limit_bytes, size_bytes
from dronevio.models.errors import InputError

_HASH_DIGITS = 16  # 64 bits: a collision is unlikely among a billion recordings
_IMAGE_SUFFIXES = (".png", ".jpg", ".pgm")
_HASHED_BYTES = 1 << 20  # of either end of a file
_SCRATCH = ".run-"  # beginning of the names of scratch folders


def content_hash(settings: object) -> str:
    """Return the hash of settings that JSON can represent; it does not depend on the order of keys."""
    text = json.dumps(settings, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()[:_HASH_DIGITS]


def code_hash(*paths: Path) -> str:
    """Return the hash of the Python and XML sources in some files and folders.

    Raises:
        FileNotFoundError: There is no such file or folder.
    """
    digest = hashlib.sha256()
    for path in paths:
        files = sorted(f for f in path.rglob("*") if f.suffix in (".py", ".xml")) if path.is_dir() else [path]
        for file in files:
            digest.update(f"{file.relative_to(path.parent)}\0".encode() + file.read_bytes() + b"\0")
    return digest.hexdigest()[:_HASH_DIGITS]


def recording_hash(path: Path) -> str:
    """Return the hash of a recording: names and sizes of its files, and the first and last MiB of all but images.

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
        if file.suffix not in _IMAGE_SUFFIXES:
            with file.open("rb") as stream:
                digest.update(stream.read(_HASHED_BYTES))
                stream.seek(max(0, size - _HASHED_BYTES))
                digest.update(stream.read())
    return digest.hexdigest()[:_HASH_DIGITS]


class RecordingCache:
    """A folder of recordings that estimators, benchmarks and processes share."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def find(self, digest: str) -> Path | None:
        """Return the folder of a recording, or None if it is not in the cache."""
        folder = self._folder / digest
        return folder if folder.exists() else None

    @contextmanager
    def acquire(self, digest: str, make: Callable[[Path], None]) -> Iterator[Path]:
        """Yield the folder of a recording, which is made first if it is missing and not removed while in use.

        The call waits while another process makes the same recording. What a killed process left is removed.

        Args:
            digest: Hash of the recording.
            make: Writes the recording into an empty folder. If it raises, the folder is removed.
        """
        while True:
            with self._locked(digest) as lock:
                if self.find(digest) is None:
                    try:
                        self._make(digest, make)
                    except BaseException:
                        self._lock_file(digest).unlink(missing_ok=True)
                        raise
                    self.trim()
                folder = self._folder / digest
                fcntl.flock(lock, fcntl.LOCK_SH)  # between the two, another process may remove recording and lock file
                if not folder.exists() or not self._is_current(lock, digest):
                    continue
                with suppress(PermissionError):
                    os.utime(folder)  # the most recently used recordings are kept
                yield folder
                return

    def remove(self, digest: str) -> None:
        """Delete a recording unless it is in use."""
        with suppress(BlockingIOError), self._locked(digest, wait=False):
            doomed = self._folder / f".{digest}.partial-removed"
            shutil.rmtree(doomed, ignore_errors=True)
            with suppress(FileNotFoundError):
                (self._folder / digest).rename(doomed)  # so that a killed process leaves no half of a recording
            shutil.rmtree(doomed, ignore_errors=True)
            self._lock_file(digest).unlink(missing_ok=True)

    def trim(self) -> None:
        """Delete the least recently used recordings while the cache is larger than `cache_limit.limit_bytes`.

        Recordings in use stay, also if the cache is then larger.

        Raises:
            ConfigError: The environment variable with the limit is not a size.
        """
        sizes = {folder: size_bytes(folder) for folder in self.recordings()}
        used = float(sum(sizes.values()))
        limit = limit_bytes(self._folder, used)
        for folder, size in sizes.items():
            if used <= limit:
                break
            self.remove(folder.name)
            used -= 0 if folder.exists() else size

    def recordings(self) -> list[Path]:
        """Return the folders of the recordings, the least recently used first."""
        used = []
        for folder in self._folder.glob("[!.]*"):
            with suppress(FileNotFoundError):  # removed by another process
                used.append((folder.stat().st_mtime_ns, folder))
        return [folder for _, folder in sorted(used)]

    @contextmanager
    def scratch(self) -> Iterator[Path]:
        """Yield an empty folder beside the recordings, which is locked while it is in use and deleted afterwards."""
        self._folder.mkdir(parents=True, exist_ok=True)
        while True:
            folder = Path(tempfile.mkdtemp(prefix=_SCRATCH, dir=self._folder))
            handle = os.open(folder, os.O_RDONLY)
            fcntl.flock(handle, fcntl.LOCK_SH)
            if folder.exists():  # else `remove_abandoned` of another process found it before it was locked
                break
            os.close(handle)
        try:
            yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)
            os.close(handle)

    def remove_abandoned(self) -> None:
        """Delete partial recordings, scratch folders and lock files that processes left; those in use are locked."""
        for scratch in self._folder.glob(f"{_SCRATCH}*"):
            with suppress(OSError):  # in use, or deleted meanwhile
                handle = os.open(scratch, os.O_RDONLY)
                try:
                    fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    shutil.rmtree(scratch, ignore_errors=True)
                finally:
                    os.close(handle)
        for partial in self._folder.glob(".*.partial-*"):
            digest = partial.name.removeprefix(".").partition(".partial-")[0]
            with suppress(BlockingIOError), self._locked(digest, wait=False):
                shutil.rmtree(partial, ignore_errors=True)
        for lock_file in self._folder.glob(".*.lock"):
            digest = lock_file.name.removeprefix(".").removesuffix(".lock")
            if self.find(digest) is None:
                with suppress(BlockingIOError), self._locked(digest, wait=False):
                    if self.find(digest) is None:
                        lock_file.unlink(missing_ok=True)

    def _make(self, digest: str, make: Callable[[Path], None]) -> Path:
        """Make a recording under a temporary name and rename it once it is complete."""
        for abandoned in self._folder.glob(f".{digest}.partial-*"):
            shutil.rmtree(abandoned, ignore_errors=True)
        partial = Path(tempfile.mkdtemp(prefix=f".{digest}.partial-", dir=self._folder))
        try:
            make(partial)
            partial.chmod(0o755)  # mkdtemp makes it private
            return partial.rename(self._folder / digest)
        finally:
            shutil.rmtree(partial, ignore_errors=True)

    @contextmanager
    def _locked(self, digest: str, *, wait: bool = True) -> Iterator[IO[str]]:
        """Yield the exclusively locked lock file of a recording; the system releases the locks of a process that dies.

        A process deletes the file only while it holds this lock. Who waited for the lock of a deleted file opens the
        new one.

        Raises:
            BlockingIOError: Another process holds the lock, and ``wait`` is false.
        """
        self._folder.mkdir(parents=True, exist_ok=True)
        while True:
            with self._lock_file(digest).open("w") as lock:
                fcntl.flock(lock, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
                if self._is_current(lock, digest):
                    yield lock
                    return

    def _is_current(self, lock: IO[str], digest: str) -> bool:
        """Return whether an open lock file is the one in the folder, and not one that was deleted."""
        with suppress(FileNotFoundError):
            return os.path.samestat(os.fstat(lock.fileno()), self._lock_file(digest).stat())
        return False

    def _lock_file(self, digest: str) -> Path:
        """Return the path of the lock file of a recording."""
        return self._folder / f".{digest}.lock"
