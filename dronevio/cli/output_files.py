"""Output files and folders that exist complete or not at all."""

import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from dronevio.cli.reservations import numbered, reserved
from dronevio.models.errors import InputError
from dronevio.models.recordings.euroc import INCOMPLETE


@contextmanager
def resumable(kept: Path, what: str) -> Iterator[None]:
    """Say where finished parts of the work are kept, if what is within the context fails or is interrupted.

    Args:
        kept: Their file or folder; nothing is said if it does not exist.
        what: What they are, in the plural.
    """
    try:
        yield
    except BaseException:
        if kept.exists():
            print(f"dronevio: finished {what} are kept in {kept}; the same command continues", file=sys.stderr)
        raise


@contextmanager
def atomic_folder(target: Path, overwrite: bool = False, mark: str = "mav0") -> Iterator[Path]:
    """Yield a hidden folder beside ``target`` that is renamed to ``target`` if the context ends without an error.

    After an error or an interruption the hidden folder is deleted, and an earlier ``target`` is unchanged. The
    exception is an interrupted recording with at least one image: its finished frames are kept in a folder named like
    ``target`` with ``.incomplete`` appended.

    The name of ``target`` is reserved meanwhile: a second process that is to make the same folder fails at once.

    Args:
        target: Folder to make, with its parents. Of a symbolic link, it is the target of the link.
        overwrite: Whether an existing folder is replaced.
        mark: File or folder in ``target`` that identifies it as an earlier result; no other folder is replaced.

    Raises:
        InputError: The target exists and must not be replaced, another process is writing it, or it cannot be made.
    """
    target = target.resolve()  # the target of a symbolic link is written, and the link stays
    _require_replaceable(target, overwrite, mark)
    with reserved(target), reserved_folder(target, overwrite, mark) as folder:
        yield folder


@contextmanager
def reserved_folder(target: Path, overwrite: bool = False, mark: str = "mav0") -> Iterator[Path]:
    """Do the same as `atomic_folder` for a name that this process has reserved.

    Raises:
        InputError: The target exists and must not be replaced, or it cannot be made.
    """
    target = target.resolve()
    _require_replaceable(target, overwrite, mark)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        partial = Path(tempfile.mkdtemp(prefix=f".{target.name}.partial-", dir=target.parent))
    except OSError as error:
        raise InputError(target, f"it cannot be made ({error.strerror})", "a folder that can be made") from error
    try:
        partial.chmod(0o755)  # mkdtemp makes it private
        yield partial
        _require_replaceable(target, overwrite, mark)
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
            print(f"dronevio: the finished frames are in {kept}", file=sys.stderr)
        shutil.rmtree(partial, ignore_errors=True)


@contextmanager
def atomic_file(target: Path) -> Iterator[Path]:
    """Yield a path beside ``target`` that is renamed to ``target`` if the context ends without an error.

    Of a symbolic link, the target is replaced. The name of the path has ``.incomplete`` before the suffix. It is
    deleted after an error; if the process is killed,
    what was written so far stays there.
    """
    target = target.resolve()  # the target of a symbolic link is written, and the link stays
    partial = target.with_name(f"{target.stem}.incomplete{target.suffix}")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        yield partial
        partial.replace(target)
    finally:
        partial.unlink(missing_ok=True)


def require_free(path: Path, overwrite: bool) -> None:
    """Raise InputError if a path exists and must not be overwritten; an empty folder counts as free."""
    if path.exists() and not overwrite and not (path.is_dir() and not any(path.iterdir())):
        raise InputError(path, "it exists already", "a new name, or --overwrite")


def free_name(wanted: Path) -> Path:
    """Return a path that does not exist: the wanted one, or else the first with a number from 2 on appended."""
    return next(candidate for candidate in numbered(wanted) if not candidate.exists())


def size_mb(path: Path) -> float:
    """Return the size of a file, or of all files in a folder [MB]."""
    files = path.rglob("*") if path.is_dir() else [path]
    return sum(file.stat().st_size for file in files if file.is_file()) * 1e-6


def _require_replaceable(target: Path, overwrite: bool, mark: str) -> None:
    """Raise InputError if a path exists that is neither an empty folder nor an earlier result to overwrite."""
    if target.exists() and not target.is_dir():
        raise InputError(target, "it is a file", "the name of a folder to make")
    require_free(target, overwrite)
    if target.exists() and any(target.iterdir()) and not (target / mark).exists():
        raise InputError(target, f"it holds no {mark}, so it is no earlier result", "a new name, or an earlier result")
