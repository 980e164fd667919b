"""The list of the images of a camera in an EuRoC folder: ``data.csv`` with rows of time stamp and file name."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np
import numpy.typing as npt

from dronevio.models.defects import Defect, DefectKind
from dronevio.models.errors import InputError
from dronevio.models.imu import Times
from dronevio.models.recordings.files import read_text
from dronevio.models.recordings.repair import IMAGE_STAMPS, increasing_rows
from dronevio.models.recordings.timed_table import TIME_LIMIT_NS, check_increasing, parse_integer_ns

_EXPECTED = "rows of time stamp [ns], file name"


@dataclass(frozen=True, eq=False)
class ImageList:
    """The images of a camera."""

    path: Path
    """The file ``data.csv``."""
    t_ns: Times
    """(N,) Time stamps [ns]."""
    files: tuple[Path, ...]
    """N image files."""
    lines: npt.NDArray[np.int64]
    """(N,) Line number of each image in the list, counted from 1."""

    @classmethod
    def read(cls, camera: Path) -> Self:
        """Read the list in the folder of a camera.

        Raises:
            InputError: The list is missing, truncated, in another format, or names a file outside its folder.
        """
        path = camera / "data.csv"
        text = read_text(path, f"a list of images: {_EXPECTED}")
        rows = list(_image_rows(path, text))
        if not rows:
            raise InputError(path, "no rows", _EXPECTED)
        if not text.endswith("\n"):
            raise InputError(path, "a last row without a line end", "a complete file, not a truncated one", rows[-1][0])
        t_ns = np.array([t for _, t, _ in rows], dtype=np.int64)
        files = tuple(camera / "data" / name for _, _, name in rows)
        return cls(path, t_ns, files, np.array([line for line, _, _ in rows]))

    def check(self) -> Self:
        """Return the list if its time stamps increase.

        Raises:
            InputError: A time stamp is not later than the previous one.
        """
        check_increasing(self.path, self.t_ns, self.lines)
        return self

    def place(self, row: int) -> str:
        """Return file and line of a row."""
        return f"{self.path}:{self.lines[row]}"

    def ordered(self) -> tuple[Self, tuple[Defect, ...]]:
        """Return the list in the order of time with the first image of each time stamp, and the defects."""

        def describe(row: int) -> str:
            return f"{self.path}:{self.lines[row]}: time stamp {self.t_ns[row]} ns"

        rows, defects = increasing_rows(self.t_ns, IMAGE_STAMPS, describe)
        return self.selected(rows), defects

    def existing(self) -> npt.NDArray[np.bool_]:
        """Return for each image (N,) whether its file exists."""
        folders = {file.parent for file in self.files}
        listed = {file for folder in folders if folder.is_dir() for file in folder.iterdir()}
        return np.array([file in listed for file in self.files], dtype=np.bool_)

    def missing(self) -> tuple[Defect, ...]:
        """Return the defects of the images that are listed and do not exist."""
        return tuple(
            Defect(
                DefectKind.MISSING_IMAGE,
                int(self.t_ns[row]),
                f"{self.path}:{self.lines[row]}: no file {self.files[row].parent.name}/{self.files[row].name}",
            )
            for row in np.flatnonzero(~self.existing()).tolist()
        )

    def selected(self, rows: npt.NDArray[np.int64] | npt.NDArray[np.bool_]) -> Self:
        """Return the list of selected rows."""
        indices = np.arange(len(self.t_ns))[rows]
        files = tuple(self.files[row] for row in indices.tolist())
        return type(self)(self.path, self.t_ns[indices], files, self.lines[indices])


def is_file_name(name: str) -> bool:
    """Return whether a name in a list refers to a file in its folder, and not to one outside."""
    return name not in (".", "..") and not any(character in name for character in "/\\\0")


def _image_rows(path: Path, text: str) -> Iterator[tuple[int, int, str]]:
    """Yield line, time stamp [ns] and file name of each image, or raise InputError."""
    for line, raw in enumerate(text.split("\n"), 1):
        row = raw.strip()
        if not row or row[0] == "#":
            continue
        stamp, comma, name = (part.strip() for part in row.partition(","))
        try:
            t_ns = parse_integer_ns(stamp)
        except ValueError:
            raise InputError(path, f"time stamp {stamp[:40]!r}", "whole nanoseconds", line) from None
        if not comma or not name or "," in name:
            raise InputError(path, repr(row[:60]), "two columns: time stamp [ns], file name", line)
        if not is_file_name(name):
            raise InputError(path, f"file name {name[:60]!r}", "the name of a file in the folder data", line)
        if abs(t_ns) >= TIME_LIMIT_NS:
            raise InputError(path, f"time stamp {stamp[:40]}", "whole nanoseconds, below 2⁶² ns", line)
        yield line, t_ns, name
