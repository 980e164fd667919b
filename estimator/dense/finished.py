"""Depth maps of an earlier computation, which are used again.

A depth map depends on its image, on those that it was compared with, and on their relative poses. Where further images
are added to a reconstruction, its cameras move by fractions of a pixel, and its depth maps hold.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dronevio.estimator.array_store import digest, load_arrays
from dronevio.estimator.dense.config import DenseConfig
from dronevio.estimator.dense.views import View, ViewLoader
from dronevio.models.arrays import Array, Floats
from dronevio.models.errors import InputError

MAX_SHIFT_PX = 0.25
"""Largest shift of the points of a depth map in the other images at which it is used again [px]."""
SHIFT_SHARE = 0.95
"""Share of the points whose shift is at most the largest one."""
SAMPLES = 1000
"""Number of points that are tested."""


@dataclass(frozen=True, eq=False)
class FinishedDepth:
    """Depth map of an image with the cameras from which it was computed: its own, and those of S other images."""

    settings: str
    """Hash of the settings."""
    names: tuple[str, ...]
    """(1 + S,) Names of the image and of the others."""
    contents: tuple[str, ...]
    """(1 + S,) Hashes of the images."""
    Ks: Array
    """(1 + S, 3, 3) Intrinsic matrices of the undistorted images [px]."""
    Ts_world_cam: Array
    """(1 + S, 4, 4) Poses of the cameras in the world frame."""
    inverse_depth: Floats
    """(H, W) Inverse depth; 0 where it is unknown."""

    @classmethod
    def of(cls, settings: str, names: Sequence[str], views: Sequence[View], inverse_depth: Floats) -> "FinishedDepth":
        """Return a depth map of the first of some views, of images with names, that the others were compared with."""
        return cls(
            settings,
            tuple(names),
            tuple(view.content for view in views),
            np.stack([view.camera.K for view in views]),
            np.stack([view.T_world_cam for view in views]),
            inverse_depth,
        )

    def arrays(self) -> dict[str, Array | Floats]:
        """Return what `read_finished` reads, as arrays by name."""
        return {field: np.asarray(getattr(self, field)) for field in _FIELDS}

    def holds(self, settings: str, views: Mapping[str, View]) -> bool:
        """Return whether the depth map is right for views, by their names, which contain all of its images.

        It is if settings and images are the same, and its points move by at most a fraction of a pixel in the images
        that it was compared with.
        """
        used = [views[name] for name in self.names]
        if settings != self.settings or tuple(view.content for view in used) != self.contents:
            return False
        if used[0].grey.shape != self.inverse_depth.shape:
            return False
        Ks, Ts = np.stack([view.camera.K for view in used]), np.stack([view.T_world_cam for view in used])
        return self._shift_px(Ks, Ts) <= MAX_SHIFT_PX

    def _shift_px(self, Ks: Array, Ts_world_cam: Array) -> float:
        """Return the largest shift of a share of the points in the other images with other cameras [px]."""
        rows, columns = np.nonzero(self.inverse_depth > 0.0)
        if not len(rows):
            return 0.0
        some = np.linspace(0, len(rows) - 1, min(SAMPLES, len(rows))).astype(np.int64)
        pixels = np.stack([columns[some], rows[some], np.ones(len(some))], axis=1).astype(np.float64)
        depth = 1.0 / self.inverse_depth[rows[some], columns[some]].astype(np.float64)
        before, after = (
            _in_others(pixels, depth, *cameras) for cameras in ((self.Ks, self.Ts_world_cam), (Ks, Ts_world_cam))
        )
        shifts = np.linalg.norm(after - before, axis=-1).max(axis=0)
        return float(np.quantile(shifts, SHIFT_SHARE))


_FIELDS = ("settings", "names", "contents", "Ks", "Ts_world_cam", "inverse_depth")


def _in_others(pixels: Array, depth: Array, Ks: Array, Ts_world_cam: Array) -> Array:
    """Return the pixels (S, N, 2) in the other cameras of pixels (N, 3) of the first one with depths (N,)."""
    in_first = depth[:, None] * (pixels @ np.linalg.inv(Ks[0]).T)
    Ts_other_first = np.linalg.inv(Ts_world_cam[1:]) @ Ts_world_cam[0]
    in_other = in_first @ np.swapaxes(Ts_other_first[:, :3, :3], 1, 2) + Ts_other_first[:, None, :3, 3]
    projected = in_other @ np.swapaxes(Ks[1:], 1, 2)
    return np.asarray(projected[..., :2] / np.maximum(projected[..., 2:], 1e-9))


def settings_hash(config: DenseConfig) -> str:
    """Return the hash of the settings on which the depth maps depend."""
    return digest(config.depth, config.consistency.min_correlation)


def reusable_depths(
    load: ViewLoader, names: Sequence[str], finished: Mapping[str, FinishedDepth], config: DenseConfig
) -> dict[int, FinishedDepth]:
    """Return the depth maps of an earlier result that hold, by the indices of their images.

    Args:
        load: Returns undistorted images.
        names: (I,) Names of the images.
        finished: Depth maps of an earlier result by the names of their images.
        config: Settings.
    """
    row, settings = {name: i for i, name in enumerate(names)}, settings_hash(config)
    known = {row[name]: depth for name, depth in finished.items() if set(depth.names) <= set(row)}
    return {
        i: depth
        for i, depth in sorted(known.items())
        if depth.holds(settings, {name: load(row[name]) for name in depth.names})
    }


def read_finished(folder: Path) -> dict[str, FinishedDepth]:
    """Return the depth maps in a folder by the names of their images.

    Raises:
        InputError: There is no such folder, it holds no depth maps, or one of them is damaged.
    """
    paths = sorted(folder.glob("depth-*.npz")) if folder.is_dir() else []
    if not paths:
        raise InputError(folder, "no depth maps", "the result of `dronevio dense --keep-depths`")
    return {depth.names[0]: depth for depth in map(_read, paths)}


def _read(path: Path) -> FinishedDepth:
    """Return the depth map in a file.

    Raises:
        InputError: It is damaged.
    """
    arrays = load_arrays(path)
    if arrays is None or not set(_FIELDS) <= set(arrays):
        raise InputError(path, "a damaged file", "a depth map of `dronevio dense --keep-depths`")
    names, contents = (tuple(str(text) for text in np.atleast_1d(arrays[field])) for field in ("names", "contents"))
    numbers = Ks, Ts, inverse_depth = tuple(arrays[field] for field in ("Ks", "Ts_world_cam", "inverse_depth"))
    count = len(names)
    is_right = len(contents) == count > 0 and Ks.shape == (count, 3, 3) and Ts.shape == (count, 4, 4)
    is_right = is_right and inverse_depth.ndim == 2
    if not is_right or not all(array.dtype.kind == "f" and np.isfinite(array).all() for array in numbers):
        raise InputError(path, "arrays that are no depth map", "a depth map of `dronevio dense --keep-depths`")
    return FinishedDepth(str(arrays["settings"]), names, contents, Ks, Ts, inverse_depth.astype(np.float32))
