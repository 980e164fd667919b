"""Names of results that are reserved while a process makes them, so that two processes do not make the same."""

import fcntl
import itertools
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from dronevio.models.errors import InputError


@contextmanager
def reserved(target: Path) -> Iterator[Path]:
    """Reserve a name for this process until the context ends, and yield its path.

    The reservation is the lock of a hidden file beside ``target``, which the system releases if the process dies.

    Raises:
        InputError: Another process has reserved the name, or its folder cannot be made.
    """
    lock = _reservation(target)
    if lock is None:
        raise InputError(target, "another process is writing it", "a new name, or the end of that process")
    with _released(lock):
        yield target


@contextmanager
def reserved_free_name(wanted: Path) -> Iterator[Path]:
    """Reserve a name that neither exists nor is reserved: the wanted one, or else the first with a number appended.

    Raises:
        InputError: The folder of the name cannot be made.
    """
    for target in numbered(wanted):
        if target.exists():
            continue
        lock = _reservation(target)
        if lock is None:
            continue
        with _released(lock):
            if not target.exists():  # else another process has completed it before the name was reserved
                yield target
                return


def numbered(wanted: Path) -> Iterator[Path]:
    """Yield the wanted path, then the same with the numbers from 2 on appended."""
    yield wanted
    yield from (wanted.with_name(f"{wanted.name}-{number}") for number in itertools.count(2))


def _reservation(target: Path) -> IO[str] | None:
    """Return the locked file that reserves a name; None if another process has reserved it.

    Raises:
        InputError: The file cannot be made.
    """
    target = target.resolve()
    path = target.with_name(f".{target.name}.lock")
    while True:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            lock = path.open("w")
        except OSError as error:
            raise InputError(target, f"it cannot be made ({error.strerror})", "a folder that can be made") from error
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            lock.close()
            return None
        except OSError:  # a file system without locks: the last process to end finds the name taken
            return lock
        with suppress(FileNotFoundError):
            if path.stat().st_ino == os.fstat(lock.fileno()).st_ino:
                return lock
        lock.close()  # its owner deleted the file between the two calls


@contextmanager
def _released(lock: IO[str]) -> Iterator[None]:
    """Delete the file of a reservation and release it when the context ends."""
    try:
        yield
    finally:
        with suppress(OSError):
            Path(lock.name).unlink(missing_ok=True)
        lock.close()
