"""The front end: follows image corners from frame to frame.

Corners are spread over a grid, one a cell (Shi and Tomasi 1994), and followed by pyramidal Lucas-Kanade (Bouguet 2001)
that starts where the gyroscope's rotation puts them.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import count, islice
from typing import Protocol

import cv2
import numpy as np
import numpy.typing as npt

from dronevio.estimator.epipolar import epipolar_inliers
from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError
from dronevio.models.state import CameraFrame

Array = npt.NDArray[np.float64]
Image = npt.NDArray[np.uint8]

OUTSIDE_PX = 1e4


@dataclass(frozen=True)
class TrackerConfig:
    """Settings of the feature tracker."""

    cell_px: int = 44
    """Side of the grid's cells [px]; each holds at most one new corner: 187 cells at 752×480."""
    min_corner_score: float = 4e-4
    """Smallest eigenvalue of the gradient matrix that makes a corner (image scaled to 0…1)."""
    window_px: int = 11
    """Side of the patch that is followed [px]."""
    pyramid_levels: int = 3
    """Pyramid levels above the image: the prediction may be off by about window/2 · 2^levels pixels."""
    border_px: int = 12
    """Corners nearer to the image's border are dropped [px]."""
    ransac_px: float = 0.5
    """Largest distance from the epipolar line [px]."""
    seed: int = 0
    """Seed of the random draws."""


@dataclass(frozen=True, eq=False)
class Matches:
    """Landmarks that further cameras of the rig see at the same instant as the one that follows them."""

    ids: npt.NDArray[np.int64]
    """(M,) Identities, each among those of the observations they belong to."""
    camera: npt.NDArray[np.int64]
    """(M,) Which camera of the rig sees each."""
    xy: Array
    """(M, 2) Undistorted and normalised: at depth 1 in that camera's frame."""

    def __len__(self) -> int:
        return len(self.ids)


NO_MATCHES = Matches(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 2)))
"""Of a single camera, and between keyframes."""


@dataclass(frozen=True, eq=False)
class Observations:
    """Where the tracked features are seen in one frame."""

    ids: npt.NDArray[np.int64]
    """(N,) Identities, in increasing order."""
    pixels: Array
    """(N, 2) In the image [px]."""
    xy: Array
    """(N, 2) Undistorted and normalised: at depth 1 in the camera frame."""
    ages: npt.NDArray[np.int64]
    """(N,) Number of frames in which each has been seen."""
    camera: npt.NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    """(N,) Which camera of the rig follows each; all the first one, if not given."""
    matches: Matches = NO_MATCHES
    """The same landmarks in further cameras; on keyframes."""

    def __post_init__(self) -> None:
        """Say that the first camera sees all, where nothing is said."""
        if len(self.camera) != len(self.ids):
            object.__setattr__(self, "camera", np.zeros(len(self.ids), np.int64))

    def __len__(self) -> int:
        return len(self.ids)


class FrontEnd(Protocol):
    """Turns frames into observations of features."""

    def track(self, frame: CameraFrame, R_cur_prev: Array, rotation_sigma_rad: float = 0.0) -> Observations:
        """Follow the features into a frame.

        Args:
            frame: The new frame.
            R_cur_prev: (3, 3) Rotation of the previous camera frame into this one, from the gyroscope.
            rotation_sigma_rad: How far it may be off.
        """

    def replenish(self) -> Observations:
        """Look for new features in the last frame, and return all that are seen in it."""

    def discard(self, ids: npt.NDArray[np.int64]) -> None:
        """Follow some features no further."""


class FeatureTracker:
    """Follows corners in the images of one camera."""

    def __init__(
        self, camera: CameraModel, config: TrackerConfig, index: int = 0, identities: Iterator[int] | None = None
    ) -> None:
        """Prepare for a camera.

        Args:
            camera: Its model.
            config: Settings.
            index: Which camera of the rig it is.
            identities: Where features get their identities from, in increasing order; from 0 on if not given.
        """
        self._camera = camera
        self._index = index
        self._identities = count() if identities is None else identities
        self._config = config
        self._rng = np.random.default_rng(config.seed)
        self._image: Image | None = None
        self._ids = np.zeros(0, np.int64)
        self._ages = np.zeros(0, np.int64)
        self._pixels = np.zeros((0, 2))
        self._xy = np.zeros((0, 2))

    def track(self, frame: CameraFrame, R_cur_prev: Array, rotation_sigma_rad: float = 0.0) -> Observations:
        """Follow the features into a frame.

        Args:
            frame: The new frame, with an image of this camera.
            R_cur_prev: (3, 3) Rotation of the previous camera frame into this one, from the gyroscope.
            rotation_sigma_rad: How far it may be off.

        Returns:
            The features that are still seen and agree with one rigid motion.

        Raises:
            ConfigError: The image is not a grey one of the camera's size.
        """
        previous, self._image = self._image, image_of(frame, self._index, self._camera)
        if previous is not None and len(self._ids):
            self._follow(
                previous, self._image, R_cur_prev, self._config.ransac_px / self._camera.fx + rotation_sigma_rad
            )
        return self._observations()

    def replenish(self) -> Observations:
        """Take the best new corner of each grid cell that holds no feature, and return all features of the frame."""
        if self._image is None:
            return self._observations()
        corners = self._new_corners(self._image)
        n = len(corners)
        self._ids = np.concatenate([self._ids, np.fromiter(islice(self._identities, n), np.int64)])
        self._ages = np.concatenate([self._ages, np.ones(n, np.int64)])
        self._pixels = np.concatenate([self._pixels, corners])
        self._xy = np.concatenate([self._xy, self._camera.normalise(corners)])
        return self._observations()

    def discard(self, ids: npt.NDArray[np.int64]) -> None:
        """Follow some features no further."""
        kept = ~np.isin(self._ids, ids)
        self._ids, self._ages = self._ids[kept], self._ages[kept]
        self._pixels, self._xy = self._pixels[kept], self._xy[kept]

    def _observations(self) -> Observations:
        return Observations(
            self._ids, self._pixels, self._xy, self._ages, np.full(len(self._ids), self._index, np.int64)
        )

    def _follow(self, previous: Image, image: Image, R_cur_prev: Array, max_distance: float) -> None:
        c = self._config
        bearings = np.column_stack([self._xy, np.ones(len(self._xy))]) @ R_cur_prev.T
        # Far outside, and finite, is where OpenCV can be told to look for what is behind the camera.
        predicted = np.nan_to_num(self._camera.project(bearings), nan=-OUTSIDE_PX).clip(-OUTSIDE_PX, OUTSIDE_PX)
        moved, status, _ = cv2.calcOpticalFlowPyrLK(
            previous,
            image,
            self._pixels.astype(np.float32),
            np.ascontiguousarray(predicted, dtype=np.float32),
            winSize=(c.window_px, c.window_px),
            maxLevel=c.pyramid_levels,
            criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 0.01),
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )
        pixels = moved.reshape(-1, 2).astype(np.float64)
        height, width = image.shape
        low, high = c.border_px, np.array([width, height]) - 1 - c.border_px
        seen = (status[:, 0] == 1) & np.all((pixels >= low) & (pixels <= high), axis=1)
        kept = np.flatnonzero(seen)
        xy = self._camera.normalise(pixels[kept])
        inliers = epipolar_inliers(self._xy[kept], xy, R_cur_prev, max_distance, self._rng)
        kept = kept[inliers]
        self._ids, self._pixels, self._xy = self._ids[kept], pixels[kept], xy[inliers]
        self._ages = self._ages[kept] + 1

    def _new_corners(self, image: Image) -> Array:
        """Return (N, 2) the best corner of each empty cell [px]."""
        side, border = self._config.cell_px, self._config.border_px
        score = cv2.cornerMinEigenVal(image, blockSize=5, ksize=3)
        score[:border] = score[-border:] = 0.0
        score[:, :border] = score[:, -border:] = 0.0
        for u, v in self._pixels.astype(int).tolist():
            cv2.circle(score, (u, v), side // 2, 0.0, -1)
        # The grid is centred; strips narrower than a cell are left at the image's borders.
        rows, columns = image.shape[0] // side, image.shape[1] // side
        top, left = (image.shape[0] - rows * side) // 2, (image.shape[1] - columns * side) // 2
        cells = score[top : top + rows * side, left : left + columns * side]
        cells = cells.reshape(rows, side, columns, side).transpose(0, 2, 1, 3).reshape(rows * columns, side * side)
        best = cells.argmax(axis=1)
        strong = np.take_along_axis(cells, best[:, None], axis=1)[:, 0] > self._config.min_corner_score
        occupied = np.zeros((rows, columns), dtype=np.bool_)
        row, column = ((self._pixels[:, ::-1] - [top, left]) // side).astype(int).T
        occupied[np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)] = True
        row, column = np.divmod(np.arange(rows * columns), columns)
        corners = np.stack([left + column * side + best % side, top + row * side + best // side], axis=1)
        return corners[strong & ~occupied.ravel()].astype(np.float64)


def image_of(frame: CameraFrame, index: int, camera: CameraModel) -> Image:
    """Return the image that a camera of the rig has in a frame; OpenCV would wait for ever for one that is none.

    Raises:
        ConfigError: There is no grey one of the camera's size.
    """
    image: object = frame.images[index] if index < len(frame.images) else None
    shape = (camera.height, camera.width)
    if isinstance(image, np.ndarray) and image.shape == shape and image.dtype == np.uint8:
        return image
    found = type(image).__name__
    if isinstance(image, np.ndarray):
        found = f"{image.dtype} array of shape {image.shape}"
    raise ConfigError(f"frame at {frame.t_ns} ns whose image {index} is {found}; expected uint8 of shape {shape}")
