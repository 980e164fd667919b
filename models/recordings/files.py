"""Reading and atomic writing of files, with errors that name the file."""

import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from dronevio.models.errors import ConfigError, InputError

_SPECIAL_FILES = (
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)


def read_text(path: Path, expected: str) -> str:
    r"""Return the text of a file, with every kind of line end converted to ``\n``.

    Args:
        path: The file to read.
        expected: Description of the expected content, for the error message.

    Raises:
        InputError: The file is missing, a folder, not readable or not encoded in UTF-8.
    """
    try:
        text = read_bytes(path, expected).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = error.object.count(b"\n", 0, error.start) + 1
        raise InputError(
            path, f"the byte 0x{error.object[error.start]:02x}, which is not UTF-8", expected, line
        ) from None
    return text.replace("\r\n", "\n").replace("\r", "\n")


def read_bytes(path: Path, expected: str) -> bytes:
    """Return the contents of a file.

    Args:
        path: The file to read.
        expected: Description of the expected content, for the error message.

    Raises:
        InputError: The file is missing, a folder, a pipe or a device, or not readable.
    """
    check_regular_file(path, expected)
    try:
        return path.read_bytes()
    except FileNotFoundError:
        raise InputError(path, "no such file", expected) from None
    except IsADirectoryError:
        raise InputError(path, "a folder", expected) from None
    except (OSError, ValueError) as error:  # ValueError: a NUL character in the name
        raise InputError(path, f"cannot be read ({error})", expected) from None


def check_regular_file(path: Path, expected: str) -> None:
    """Check that a path is not that of a pipe, a socket or a device, which may block or never end.

    Folders and missing files pass: what opens the path names them.

    Args:
        path: The path.
        expected: Description of the expected content, for the error message.

    Raises:
        InputError: It is one.
    """
    try:
        mode = path.stat().st_mode
    except (OSError, ValueError):  # ValueError: a NUL character in the name
        return
    for is_kind, name in _SPECIAL_FILES:
        if is_kind(mode):
            raise InputError(path, name, f"{expected}, as a file")


def first_row(path: Path, expected: str) -> str:
    """Return the first line of a text file that is neither empty nor a comment.

    Args:
        path: The file to read.
        expected: Description of the expected content, for the error message.

    Raises:
        InputError: The file cannot be read, or has no such line.
    """
    for line in read_text(path, expected).split("\n"):
        if line.strip() and not line.lstrip().startswith("#"):
            return line
    raise InputError(path, "no rows", expected)


def write_text(path: Path, text: str) -> None:
    r"""Write a text file in UTF-8 with line ends ``\n``, atomically; see `write_bytes`.

    Raises:
        InputError: The file cannot be written.
    """
    write_bytes(path, text.encode("utf-8"))


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file atomically: to a temporary file in the same folder, which then replaces the target.

    Missing parent folders are created.

    Raises:
        InputError: The file cannot be written.
    """
    temporary = path.with_name(f".{path.name}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.write_bytes(content)
        temporary.replace(path)
    except OSError as error:
        raise InputError(path, f"cannot be written ({error})", "a place to write a file") from None
    finally:
        with suppress(OSError):  # for example because its folder is a file
            temporary.unlink(missing_ok=True)


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Name a file or folder in errors of the system while it is written, for example that the disk is full.

    Raises:
        InputError: The body raised an OSError, or SQLite cannot write.
    """
    import sqlite3  # only bags need it

    try:
        yield
    except OSError as error:
        reason = error.strerror or str(error)
    except sqlite3.OperationalError as error:
        reason = str(error)
    else:
        return
    raise InputError(path, f"cannot be written ({reason})", "a place with enough space that can be written to")


@contextmanager
def as_input_error(path: Path) -> Iterator[None]:
    """Convert a ConfigError about invalid values into an InputError about the file that contains them.

    Raises:
        InputError: The body raised a ConfigError.
    """
    try:
        yield
    except ConfigError as error:
        found, _, expected = str(error).partition("; expected ")
        raise InputError(path, found, expected or "valid values") from None


def check_output_path(path: Path) -> None:
    """Check that a path can be the name of a new file.

    Raises:
        InputError: The path is a folder, or its folder is a file or read-only.
    """
    if path.is_dir():
        raise InputError(path, "a folder", "the name of a file to write")
    folder = next(parent for parent in path.absolute().parents if parent.exists())
    if not folder.is_dir():
        raise InputError(path, f"{folder} is a file", "a folder to write to")
    if not os.access(folder, os.W_OK):
        raise InputError(path, f"the folder {folder} is read-only", "a folder to write to")
