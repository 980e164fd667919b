"""Folders that are there whole or not at all."""

import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from dronevio.models.errors import InputError
from dronevio.models.recordings.euroc import INCOMPLETE


@contextmanager
def atomic_folder(target: Path, overwrite: bool = False, mark: str = "mav0") -> Iterator[Path]:
    """Give a hidden folder beside ``target`` to write to, which becomes ``target`` when all went well.

    Whatever goes wrong meanwhile, an interruption included, nothing half-written stays, and what was there before is
    untouched. Only a recording that was cut off, and says so itself, is kept for its finished frames: under the
    target's name with ``.incomplete`` behind it.

    Args:
        target: The folder to make; its parents are made too.
        overwrite: Replace a folder that is there already, in the end.
        mark: A file or folder in it by which one of our own is known; no other folder is replaced.

    Raises:
        InputError: The target exists and may not be replaced, or cannot be made here.
    """
    target = target.absolute()
    _refuse_to_destroy(target, overwrite, mark)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        partial = Path(tempfile.mkdtemp(prefix=f".{target.name}.partial-", dir=target.parent))
    except OSError as error:
        raise InputError(target, f"it cannot be made ({error.strerror})", "a place where I may write") from error
    try:
        partial.chmod(0o755)  # mkdtemp makes it private
        yield partial
        _refuse_to_destroy(target, overwrite, mark)
        if target.exists():
            old = Path(tempfile.mkdtemp(prefix=f".{target.name}.old-", dir=target.parent))
            target.rename(old / target.name)
            partial.rename(target)
            shutil.rmtree(old)
        else:
            partial.rename(target)
    finally:
        if (partial / "mav0" / INCOMPLETE).exists() and any(partial.glob("mav0/cam0/data/*.png")):
            kept = free_name(target.with_name(f"{target.name}.incomplete"))
            partial.rename(kept)
            print(f"dronevio: the frames that are done lie in {kept}", file=sys.stderr)
        shutil.rmtree(partial, ignore_errors=True)


def free_name(wanted: Path) -> Path:
    """Return a path that is not there yet: the wanted one, or the first free one with a number behind it."""
    candidate, number = wanted, 2
    while candidate.exists():
        candidate, number = wanted.with_name(f"{wanted.name}-{number}"), number + 1
    return candidate


def _refuse_to_destroy(target: Path, overwrite: bool, mark: str) -> None:
    """Raise InputError if something is in the way that is not ours to replace."""
    if not target.exists() or (target.is_dir() and not any(target.iterdir())):
        return
    if not target.is_dir():
        raise InputError(target, "it is a file", "the name of a folder to make")
    if not overwrite:
        raise InputError(target, "it exists already", "a new name, or --overwrite")
    if not (target / mark).exists():
        raise InputError(target, f"it holds no {mark}, so it is none of mine", "a new name, or an earlier result")


def size_mb(folder: Path) -> float:
    """Return how much the files in a folder hold [MB]."""
    return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()) * 1e-6
