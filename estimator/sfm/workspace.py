"""Results of the stages before mapping, kept in a folder so that an interrupted reconstruction continues.

A file is valid for the input and the settings whose hash it contains. Files are written under a temporary name and
renamed, so that each is complete or absent.
"""

import hashlib
import os
import tempfile
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dronevio.estimator.sfm.features import Features
from dronevio.estimator.sfm.two_view import Geometry, TwoView


def digest(*parts: object) -> str:
    """Return a hash of arrays and of the representations of other values."""
    state = hashlib.sha256()
    for part in parts:
        data = np.ascontiguousarray(part).tobytes() if isinstance(part, np.ndarray) else repr(part).encode()
        state.update(len(data).to_bytes(8, "little") + data)
    return state.hexdigest()


@dataclass(frozen=True)
class Workspace:
    """A folder of intermediate results; without a folder, nothing is kept."""

    folder: Path | None
    """The folder; it is made when the first file is written."""

    def load_features(self, index: int, key: str) -> Features | None:
        """Return the features of an image if they are stored with this hash, otherwise None."""
        arrays = self._load(f"features-{index:06d}.npz", key)
        if arrays is None:
            return None
        return Features(arrays["pixels"], arrays["sizes_px"], arrays["descriptors"], arrays["colours"])

    def save_features(self, index: int, key: str, features: Features) -> None:
        """Store the features of an image."""
        self._save(
            f"features-{index:06d}.npz",
            key,
            pixels=features.pixels,
            sizes_px=features.sizes_px,
            descriptors=features.descriptors,
            colours=features.colours,
        )

    def load_pairs(self, first: int, key: str) -> list[TwoView] | None:
        """Return the verified pairs of an image with later ones if they are stored with this hash, otherwise None."""
        arrays = self._load(f"pairs-{first:06d}.npz", key)
        if arrays is None:
            return None
        ends = np.cumsum(arrays["counts"])[:-1]
        rows = zip(
            arrays["second"].tolist(),
            np.split(arrays["matches"], ends),
            arrays["geometry"].tolist(),
            arrays["Ts_first_second"],
            arrays["angle_rad"].tolist(),
            strict=True,
        )
        return [TwoView(first, second, m, Geometry(name), T, angle) for second, m, name, T, angle in rows]

    def save_pairs(self, first: int, key: str, pairs: list[TwoView]) -> None:
        """Store the verified pairs of an image with later ones."""
        self._save(
            f"pairs-{first:06d}.npz",
            key,
            second=np.array([pair.second for pair in pairs], np.int64),
            counts=np.array([len(pair.matches) for pair in pairs], np.int64),
            matches=np.concatenate([np.empty((0, 2), np.int64), *(pair.matches for pair in pairs)]),
            geometry=np.array([pair.geometry.value for pair in pairs], dtype="U8"),
            Ts_first_second=np.array([pair.T_first_second for pair in pairs]).reshape(-1, 4, 4),
            angle_rad=np.array([pair.angle_rad for pair in pairs]),
        )

    def _load(self, name: str, key: str) -> dict[str, Any] | None:
        """Return the arrays of a file; None if it is absent, damaged or has another hash."""
        if self.folder is None:
            return None
        try:
            with (self.folder / name).open("rb") as stream, np.load(stream, allow_pickle=False) as file:
                return dict(file) if str(file["key"]) == key else None
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
            return None

    def _save(self, name: str, key: str, **arrays: Any) -> None:
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
