"""Follows the corners of one camera's images.

From one frame to the next by pyramidal Lucas-Kanade (Bouguet 2001), which starts where the gyroscope's rotation puts
the corners; then to where the patch fits best that was around each when it was first seen
(`dronevio.estimator.frontend.patches`), so that errors do not add up.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, fields, replace
from itertools import count, islice
from typing import Self

import numpy as np
import numpy.typing as npt

from dronevio.estimator.frontend.corners import CornerConfig, new_corners
from dronevio.estimator.frontend.klt import as_bright_as, follow
from dronevio.estimator.frontend.patches import PatchAligner, PatchConfig, Patches
from dronevio.estimator.frontend.protocol import image_of
from dronevio.estimator.frontend.ransac import epipolar_inliers, essential_inliers
from dronevio.estimator.types import Observations
from dronevio.models.camera import CameraModel
from dronevio.models.rig import Rig
from dronevio.models.state import CameraFrame

Array = npt.NDArray[np.float64]
Image = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]

OUTSIDE_PX = 1e4
WIDER = 2  # pyramid levels more where the prediction was wrong


@dataclass(frozen=True)
class TrackerConfig:
    """Settings of the feature tracker."""

    corners: CornerConfig = field(default_factory=CornerConfig)
    """Which corners are taken."""
    patches: PatchConfig = field(default_factory=PatchConfig)
    """How their patches are found again."""
    window_px: int = 11
    """Side of the patch that is followed from frame to frame [px]."""
    pyramid_levels: int = 3
    """Pyramid levels above the image: the prediction may be off by about window/2 · 2^levels pixels."""
    border_px: int = 12
    """Features nearer to the image's border are dropped [px]."""
    max_correction_px: float = 2.0
    """Largest distance between where a feature was followed to and where its patch fits [px]."""
    min_found: float = 0.5
    """Where a smaller share of the features in view is found, the prediction is taken for wrong."""
    ransac_px: float = 0.5
    """Largest distance from the epipolar line [px]."""
    min_agreeing: float = 0.5
    """Where a smaller share of the features agrees with the gyroscope's rotation, it is taken for wrong, if so many
    agree with another one."""
    max_rotation_sigma_rad: float = 0.01
    """Where the gyroscope's rotation is less certain, the features alone tell which of them agree [rad]: a tolerance of
    several pixels lets wrong ones pass."""
    seed: int = 0
    """Seed of the random draws."""


@dataclass(frozen=True, eq=False)
class _Features:
    """What is followed: N features, in the order of their identities."""

    ids: npt.NDArray[np.int64]
    ages: npt.NDArray[np.int64]
    pixels: Array
    xy: Array
    zncc: Array
    patches: Patches

    def __getitem__(self, rows: npt.NDArray[np.int64] | npt.NDArray[np.bool_]) -> Self:
        return type(self)(*(getattr(self, each.name)[rows] for each in fields(self)))

    def joined(self, others: Self) -> Self:
        """Return these features and others after them."""
        return type(self)(
            np.concatenate([self.ids, others.ids]),
            np.concatenate([self.ages, others.ages]),
            np.concatenate([self.pixels, others.pixels]),
            np.concatenate([self.xy, others.xy]),
            np.concatenate([self.zncc, others.zncc]),
            self.patches.joined(others.patches),
        )


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
        self._aligner = PatchAligner(config.patches)
        self._rng = np.random.default_rng(config.seed)
        self._image: Image | None = None
        self._prepared = self._aligner.prepare(np.zeros((camera.height, camera.width), np.uint8))
        self._features = self._new_features(np.zeros((0, 2)))

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
        self._prepared = self._aligner.prepare(self._image)
        if previous is not None and len(self._features.ids):
            found = self._found(as_bright_as(self._image, previous), self._image, R_cur_prev)
            self._features = self._agreeing(found, R_cur_prev, rotation_sigma_rad)
        return self._observations()

    def replenish(self) -> Observations:
        """Take the best new corner of each grid cell that holds no feature, and return all features of the frame."""
        if self._image is not None:
            corners = new_corners(
                self._image, self._prepared.noise, self._features.pixels, self._config.border_px, self._config.corners
            )
            self._features = self._features.joined(self._new_features(corners))
        return self._observations()

    def discard(self, ids: npt.NDArray[np.int64]) -> None:
        """Follow some features no further."""
        self._features = self._features[~np.isin(self._features.ids, ids)]

    def recalibrate(self, rig: Rig) -> None:
        """Do nothing: how the camera is mounted does not matter to what it sees."""

    def _observations(self) -> Observations:
        f = self._features
        camera = np.full(len(f.ids), self._index)
        return Observations(f.ids, f.pixels, f.xy, f.ages, camera, zncc=f.zncc, scale=f.patches.scale)

    def _new_features(self, pixels: Array) -> _Features:
        """Return new features at pixels (N, 2) of the last image."""
        n = len(pixels)
        ids = np.fromiter(islice(self._identities, n), np.int64)
        patches = self._aligner.cut(self._prepared, pixels)
        return _Features(ids, np.ones(n, np.int64), pixels, self._camera.normalize(pixels), np.ones(n), patches)

    def _found(self, previous: Image, image: Image, R_cur_prev: Array) -> _Features:
        """Return the features that are found in the next image, where they are found.

        Where most are not found, what was predicted is wrong: then they are looked for in a wider neighbourhood of
        where they were.
        """
        c, features = self._config, self._features
        bearings = np.column_stack([features.xy, np.ones(len(features.xy))]) @ R_cur_prev.T
        # Far outside, and finite, is where OpenCV can be told to look for what is behind the camera.
        predicted = np.nan_to_num(self._camera.project(bearings), nan=-OUTSIDE_PX).clip(-OUTSIDE_PX, OUTSIDE_PX)
        patches = features.patches.rolled(R_cur_prev)
        features = replace(features, patches=patches)
        moved, there = follow(previous, image, features.pixels, predicted, c.window_px, c.pyramid_levels)
        found = self._aligned(features, moved, there)
        if len(found.ids) > c.min_found * self._inside(predicted).sum():
            return found
        lost = features[~np.isin(features.ids, found.ids)]
        moved, there = follow(previous, image, lost.pixels, lost.pixels, c.window_px, c.pyramid_levels + WIDER)
        both = found.joined(self._aligned(lost, moved, there))
        return both[np.argsort(both.ids)]

    def _aligned(self, features: _Features, pixels: Array, there: Mask) -> _Features:
        """Return the features whose patches fit, where they fit, given where they were followed to (N, 2)."""
        there = there & self._inside(pixels)
        features, pixels = features[there], pixels[there]
        fit = self._aligner.align(self._prepared, features.patches, pixels)
        moved = np.linalg.norm(fit.pixels - pixels, axis=1)
        good = fit.good & (moved < self._config.max_correction_px) & self._inside(fit.pixels)
        return replace(features, pixels=fit.pixels, zncc=fit.zncc, patches=fit.patches)[good]

    def _agreeing(self, features: _Features, R_cur_prev: Array, rotation_sigma_rad: float) -> _Features:
        """Return the features that agree with one motion since the previous frame; theirs are its coordinates."""
        xy = self._camera.normalize(features.pixels)
        if not len(xy):
            return features
        distance = self._config.ransac_px / self._camera.fx
        if rotation_sigma_rad > self._config.max_rotation_sigma_rad:
            inliers = essential_inliers(features.xy, xy, distance)
            if inliers.mean() > self._config.min_agreeing:
                return replace(features, xy=xy, ages=features.ages + 1)[inliers]
        distance += rotation_sigma_rad
        inliers = epipolar_inliers(features.xy, xy, R_cur_prev, distance, self._rng)
        if inliers.mean() < self._config.min_agreeing:  # is the rotation wrong?
            without = essential_inliers(features.xy, xy, distance)
            inliers = without if without.mean() > self._config.min_agreeing else inliers
        return replace(features, xy=xy, ages=features.ages + 1)[inliers]

    def _inside(self, pixels: Array) -> Mask:
        border, size = self._config.border_px, np.array([self._camera.width, self._camera.height])
        return np.asarray(np.all((pixels >= border) & (pixels <= size - 1 - border), axis=1))
