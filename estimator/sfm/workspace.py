"""Features and matches of images, kept in a folder so that an interrupted reconstruction continues."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dronevio.estimator.array_store import ArrayStore
from dronevio.estimator.sfm.features import Features
from dronevio.estimator.sfm.two_view import Geometry, TwoView


@dataclass(frozen=True)
class Workspace:
    """A folder of intermediate results; without a folder, nothing is kept."""

    folder: Path | None
    """The folder; it is made when the first file is written."""

    @property
    def _store(self) -> ArrayStore:
        return ArrayStore(self.folder)

    def load_features(self, index: int, key: str) -> Features | None:
        """Return the features of an image if they are stored with this hash, otherwise None."""
        arrays = self._store.load(f"features-{index:06d}.npz", key)
        if arrays is None:
            return None
        return Features(arrays["pixels"], arrays["sizes_px"], arrays["descriptors"], arrays["colours"])

    def save_features(self, index: int, key: str, features: Features) -> None:
        """Store the features of an image."""
        self._store.save(
            f"features-{index:06d}.npz",
            key,
            pixels=features.pixels,
            sizes_px=features.sizes_px,
            descriptors=features.descriptors,
            colours=features.colours,
        )

    def load_pairs(self, first: int, key: str) -> list[TwoView] | None:
        """Return the verified pairs of an image with later ones if they are stored with this hash, otherwise None."""
        arrays = self._store.load(f"pairs-{first:06d}.npz", key)
        if arrays is None:
            return None
        matches = np.split(arrays["matches"], np.cumsum(arrays["counts"]))[:-1]  # none of no pair
        rows = zip(
            arrays["second"].tolist(),
            matches,
            arrays["geometry"].tolist(),
            arrays["Ts_first_second"],
            arrays["angle_rad"].tolist(),
            strict=True,
        )
        return [TwoView(first, second, m, Geometry(name), T, angle) for second, m, name, T, angle in rows]

    def save_pairs(self, first: int, key: str, pairs: list[TwoView]) -> None:
        """Store the verified pairs of an image with later ones."""
        self._store.save(
            f"pairs-{first:06d}.npz",
            key,
            second=np.array([pair.second for pair in pairs], np.int64),
            counts=np.array([len(pair.matches) for pair in pairs], np.int64),
            matches=np.concatenate([np.empty((0, 2), np.int64), *(pair.matches for pair in pairs)]),
            geometry=np.array([pair.geometry.value for pair in pairs], dtype="U8"),
            Ts_first_second=np.array([pair.T_first_second for pair in pairs]).reshape(-1, 4, 4),
            angle_rad=np.array([pair.angle_rad for pair in pairs]),
        )
