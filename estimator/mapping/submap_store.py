"""The closed submaps of a flight: in memory up to a limit, older ones in a temporary folder."""

import shutil
import tempfile
import weakref
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dronevio.estimator.mapping.submap import Anchor, PackedSubmap
from dronevio.models.arrays import Integers


@dataclass(frozen=True, eq=False)
class StoredSubmap:
    """A submap in a file."""

    anchor: Anchor
    """What it moves with."""
    low: Integers
    """(3,) Index of the first cell in the lattice of the odometry frame."""
    shape: tuple[int, int, int]
    """Number of cells along each axis."""
    path: Path
    """File with the packed cells."""

    def load(self) -> PackedSubmap:
        """Return the submap with its cells."""
        return PackedSubmap(self.anchor, self.low, self.shape, np.load(self.path, allow_pickle=False).tobytes())


class SubmapStore:
    """Keeps closed submaps in the order of time.

    Files are in a temporary folder, which is deleted with the store, and are complete once they have their names.
    """

    def __init__(self, memory_mb: float) -> None:
        """Begin without submaps.

        Args:
            memory_mb: Memory of the packed submaps beyond which the oldest ones are written to files [MB].
        """
        self._limit = memory_mb * 1e6
        self._folder: Path | None = None
        self._stored: list[StoredSubmap] = []
        self._kept: list[PackedSubmap] = []

    def __len__(self) -> int:
        """Return the number of submaps."""
        return len(self._stored) + len(self._kept)

    @property
    def memory_bytes(self) -> int:
        """Memory of the packed submaps [B]."""
        return sum(len(submap.data) for submap in self._kept)

    @property
    def all(self) -> tuple[StoredSubmap | PackedSubmap, ...]:
        """The submaps in the order of time, without reading their files."""
        return (*self._stored, *self._kept)

    def add(self, submap: PackedSubmap) -> None:
        """Keep a submap."""
        self._kept.append(submap)
        while self._kept and self.memory_bytes > self._limit:
            self._stored.append(self._written(self._kept.pop(0)))

    def __iter__(self) -> Iterator[PackedSubmap]:
        """Return the submaps in the order of time, of which one is read at a time."""
        return (submap.load() if isinstance(submap, StoredSubmap) else submap for submap in self.all)

    def close(self) -> None:
        """Delete the files, with all submaps."""
        self._stored, self._kept = [], []
        if self._folder is not None:
            shutil.rmtree(self._folder, ignore_errors=True)
            self._folder = None

    def _written(self, submap: PackedSubmap) -> StoredSubmap:
        """Return a submap that is written to a file."""
        if self._folder is None:
            self._folder = Path(tempfile.mkdtemp(prefix="dronevio-submaps-"))
            weakref.finalize(self, shutil.rmtree, self._folder, ignore_errors=True)
        path = self._folder / f"{submap.anchor.number}.npy"
        unfinished = path.with_suffix(".part.npy")
        np.save(unfinished, np.frombuffer(submap.data, np.uint8), allow_pickle=False)
        unfinished.replace(path)
        return StoredSubmap(submap.anchor, submap.low, submap.shape, path)
