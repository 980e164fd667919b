"""Reading and writing text files, with errors that name them and without half-written ones."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from dronevio.models.errors import ConfigError, InputError


def read_text(path: Path, expected: str) -> str:
    r"""Return the text of a file, every kind of line end turned into ``\n``.

    Args:
        path: The file.
        expected: What it should be, for the error.

    Raises:
        InputError: It is missing, a folder, not readable or not UTF-8.
    """
    try:
        return path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise InputError(path, "no such file", expected) from None
    except IsADirectoryError:
        raise InputError(path, "a folder", expected) from None
    except UnicodeDecodeError as error:
        line = error.object.count(b"\n", 0, error.start) + 1
        raise InputError(
            path, f"the byte 0x{error.object[error.start]:02x}, which is no UTF-8", expected, line
        ) from None
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        raise InputError(path, f"cannot be read ({error})", expected) from None


def first_row(path: Path, expected: str) -> str:
    """Return the first line of a text file that is neither empty nor a comment.

    Raises:
        InputError: The file cannot be read, or has no such line.
    """
    for line in read_text(path, expected).split("\n"):
        if line.strip() and not line.lstrip().startswith("#"):
            return line
    raise InputError(path, "no rows", expected)


def write_text(path: Path, text: str) -> None:
    """Write a text file beside its place and then move it there, so that nobody ever sees half of it.

    Folders that are missing on the way are made.

    Raises:
        InputError: It cannot be written there.
    """
    beside = path.with_name(f".{path.name}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        beside.write_text(text, encoding="utf-8", newline="\n")
        beside.replace(path)
    except OSError as error:
        raise InputError(path, f"cannot be written ({error})", "a place to write a file") from None
    finally:
        with suppress(OSError):  # such as that its folder is a file
            beside.unlink(missing_ok=True)


@contextmanager
def blamed_on(path: Path) -> Iterator[None]:
    """Turn what is raised for values that make no sense into the fault of the file that they were read from.

    Raises:
        InputError: In place of a ConfigError.
    """
    try:
        yield
    except ConfigError as error:
        found, _, expected = str(error).partition("; expected ")
        raise InputError(path, found, expected or "values that make sense") from None


def check_place(path: Path) -> None:
    """Check that a file can be written at a path, as far as can be told before.

    Raises:
        InputError: A folder is there, or a file where one of its folders should be.
    """
    if path.is_dir():
        raise InputError(path, "a folder", "the name of a file to write")
    for folder in path.absolute().parents:
        if folder.exists() and not folder.is_dir():
            raise InputError(path, f"{folder} is a file", "a folder to write to")
