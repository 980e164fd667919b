"""Feature tracker of one camera.

Corners are tracked from frame to frame by pyramidal Lucas-Kanade (Bouguet 2001), starting at the positions that the
gyroscope's rotation predicts. At keyframes, each is aligned with the patch of the frame in which it was first observed
(`dronevio.estimator.frontend.patches`), so that tracking errors do not accumulate; at the frames between them, it is
compared with that patch. RANSAC rejects the features that are not consistent with one rigid motion.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import count, islice
from typing import Annotated, Self

import numpy as np
import numpy.typing as npt

from dronevio.estimator.frontend import klt
from dronevio.estimator.frontend.corners import CornerConfig, detect_corners
from dronevio.estimator.frontend.patches import WALK_S, PatchAligner, PatchConfig, Patches, ScaleSpace
from dronevio.estimator.frontend.protocol import AtExposure, image_of, is_inside
from dronevio.estimator.frontend.ransac import MIN_MATCHES, epipolar_inliers, essential_inliers
from dronevio.estimator.types import Calibration, ExpectedFeatures, Observations, common_rows
from dronevio.models.arrays import Array, Image
from dronevio.models.camera import CameraModel
from dronevio.models.ranges import Range, Settings
from dronevio.models.state import CameraFrame

OUTSIDE_PX = 1e4  # a finite coordinate outside any image, for predictions behind the camera
RETRY_LEVELS = 2  # additional pyramid levels for features that the prediction did not lead to
MAX_CORRECTION_PX = 2.0  # largest distance between the results of Lucas-Kanade and of the patch alignment
MAX_ROTATION_SIGMA_RAD = 0.01
"""Standard deviation of the gyroscope's rotation above which the essential matrix replaces it [rad]; the tolerance of
the two-point method grows with that deviation and would admit outliers."""
MIN_AGREEING = 0.95
"""Share of the features that agree with one motion up to which patches are aligned between keyframes, too: in fast
motion, errors of Lucas-Kanade exceed the tolerance."""
MIN_SHARE = 0.1
"""Smallest share of the features that is still observed, if they are too few for a significant consensus. Fewer of them
agree by chance, as after a gap of the images: some patches are similar, and any two fit some translation."""


@dataclass(frozen=True)
class TrackerConfig(Settings):
    """Settings of the feature tracker."""

    corners: CornerConfig = field(default_factory=CornerConfig)
    """Settings of the corner detection."""
    patches: PatchConfig = field(default_factory=PatchConfig)
    """Settings of the patch alignment."""
    window_px: Annotated[int, Range(5, 41, odd=True)] = 11
    """Side of the Lucas-Kanade window for tracking from frame to frame [px]."""
    pyramid_levels: Annotated[int, Range(0, 6)] = 3
    """Number of pyramid levels above the image. The prediction may be off by about window / 2 · 2^levels pixels."""
    border_px: Annotated[int, Range(1, 200)] = 12
    """Distance from the image border below which features are dropped [px]."""
    min_tracked_ratio: Annotated[float, Range(0.0, 1.0)] = 0.5
    """Smallest ratio of tracked features to those predicted inside the image. Below it, the prediction is regarded as
    wrong, and the remaining features are searched again in a larger neighbourhood of their previous positions."""
    ransac_threshold_px: Annotated[float, Range(above=0.0, high=100.0)] = 0.5
    """Largest distance of an inlier from its epipolar line [px]."""
    min_inlier_ratio: Annotated[float, Range(0.0, 1.0)] = 0.5
    """Smallest ratio of inliers with the gyroscope's rotation. Below it, that rotation is regarded as wrong if the
    essential matrix has a larger ratio of inliers than this."""
    seed: Annotated[int, Range(0, 2**32 - 1)] = 0
    """Seed of the random generator of RANSAC."""


@dataclass(frozen=True, eq=False)
class _Features:
    """The N tracked features, sorted by identity."""

    ids: npt.NDArray[np.int64]
    ages: npt.NDArray[np.int64]
    pixels: Array
    xy: Array
    zncc: Array
    patches: Patches

    def __getitem__(self, rows: slice | npt.NDArray[np.int64] | npt.NDArray[np.bool_]) -> Self:
        return type(self)(
            self.ids[rows], self.ages[rows], self.pixels[rows], self.xy[rows], self.zncc[rows], self.patches[rows]
        )

    def joined(self, others: Self) -> Self:
        """Return these features followed by others."""
        return type(self)(
            np.concatenate([self.ids, others.ids]),
            np.concatenate([self.ages, others.ages]),
            np.concatenate([self.pixels, others.pixels]),
            np.concatenate([self.xy, others.xy]),
            np.concatenate([self.zncc, others.zncc]),
            self.patches.joined(others.patches),
        )


class FeatureTracker:
    """Tracks features in the images of one camera; satisfies the `FrontEnd` protocol."""

    def __init__(
        self, camera: CameraModel, config: TrackerConfig, index: int = 0, identities: Iterator[int] | None = None
    ) -> None:
        """Create a tracker without features.

        Args:
            camera: Intrinsics of the camera.
            config: Settings of the tracker.
            index: Index of the camera in the rig.
            identities: Source of the identities of new features, in increasing order; counts from 0 if not given.
        """
        self._camera = camera
        self._index = index
        self._identities = count() if identities is None else identities
        self._config = config
        self._aligner = PatchAligner(config.patches)
        self._iterations_between = max(config.patches.tracking_iterations, 1)  # if they are aligned between keyframes
        self._rng = np.random.default_rng(config.seed)
        self._image: Image | None = None  # the last image
        self._image_ns = self._aligned_ns = 0  # its time, and that of the last image with which patches were aligned
        self._elapsed_s = WALK_S  # between it and the image with which they were aligned before
        self._unseen: tuple[Array, float] | None = None  # rotation and its σ since then; None if it is of this frame
        self._last_levels = self._aligner.scale_space(np.zeros((camera.height, camera.width), np.uint8))
        self._features = self._new_features(np.zeros((0, 2)))

    def track(
        self,
        frame: CameraFrame,
        R_cur_prev: Array,
        rotation_sigma_rad: float = 0.0,
        calibration: Calibration | None = None,
        expected: ExpectedFeatures | None = None,
    ) -> Observations:
        """Track the features into a frame.

        Args:
            frame: The new frame. Without an image of this camera, the features are kept for the next image.
            R_cur_prev: (3, 3) Rotation of this camera from the previous frame to this one, by the gyroscope.
            rotation_sigma_rad: Standard deviation of that rotation [rad].
            calibration: Not used; extrinsics and corrections have no influence.
            expected: Where features are expected, if the frames before have been left out.

        Returns:
            The features that are still observed and agree with one rigid motion.

        Raises:
            ConfigError: The image is missing, is not uint8, or has not the camera's size.
        """
        # Rotation since the last image
        if self._unseen is not None:
            R_cur_prev, rotation_sigma_rad = R_cur_prev @ self._unseen[0], rotation_sigma_rad + self._unseen[1]
        image = image_of(frame, self._index, self._camera)
        self._unseen = (R_cur_prev, rotation_sigma_rad) if image is None else None
        if image is None:
            return self._observations()
        # The new image
        previous, self._image = self._image, image
        if previous is not None:
            self._elapsed_s = (frame.t_ns - self._aligned_ns) * 1e-9
        self._image_ns = frame.t_ns
        # Tracking, and rejection of outliers by the epipolar geometry
        if previous is not None and len(self._features.ids):
            previous = klt.match_brightness(previous, self._image)
            agreeing = self._tracked(previous, self._image, R_cur_prev, rotation_sigma_rad, expected)
            is_chance = len(agreeing.ids) < min(MIN_MATCHES, MIN_SHARE * len(self._features.ids))
            self._features = agreeing[:0] if is_chance else agreeing
        return self._observations()

    def verified(self, frame: CameraFrame, expected: ExpectedFeatures, R_cur_prev: Array) -> tuple[Observations, int]:
        """Return the features that a frame shows where they are expected, and the number of those that are expected.

        Args:
            frame: The frame after the last one. Without an image of this camera, it shows none.
            expected: Where the features are expected.
            R_cur_prev: (3, 3) Rotation of this camera from the last frame to this one.

        Raises:
            ConfigError: As `track`.
        """
        image, f = image_of(frame, self._index, self._camera), self._features
        columns, rows = common_rows(expected.ids, f.ids)
        if image is None:
            return self._observed(f[:0]), len(rows)
        # Those inside the image, and among them those whose patches resemble it
        count, rays = len(rows), expected.rays[self._index, columns]
        pixels = self._camera.project(rays)
        seen = np.flatnonzero(is_inside(pixels, self._camera, self._config.border_px))
        R = R_cur_prev if self._unseen is None else R_cur_prev @ self._unseen[0]
        patches, noise = f.patches[rows[seen]].rolled(R), self._last_levels.noise
        zncc, is_similar = self._aligner.compare(image, noise, patches, pixels[seen])
        seen, zncc = seen[is_similar], zncc[is_similar]
        rows, xy = rows[seen], rays[seen, :2] / rays[seen, 2:]
        camera = np.full(len(rows), self._index)
        return Observations(f.ids[rows], pixels[seen], xy, f.ages[rows], camera, zncc=zncc), count

    def replenish(
        self, calibration: Calibration | None = None, at_exposure_of: AtExposure | None = None
    ) -> Observations:
        """Add the best new corner of each grid cell without a feature, and return all features of the frame.

        The patches of the tracked features are aligned with the frame.
        """
        if self._image is not None and self._unseen is None:
            self._features = self._refined(self._features)
            c, noise, occupied = self._config, self._levels.noise, self._features.pixels
            corners = detect_corners(self._image, noise, occupied, c.border_px, c.corners)
            self._features = self._features.joined(self._new_features(corners))
            self._aligned_ns = self._image_ns
        return self._observations()

    def discard(self, ids: npt.NDArray[np.int64]) -> None:
        """Remove features from the tracker."""
        self._features = self._features[~np.isin(self._features.ids, ids)]

    def _observations(self) -> Observations:
        return self._observed(self._features if self._unseen is None else self._features[:0])

    def _observed(self, f: _Features) -> Observations:
        """Return features as observations of this camera."""
        camera = np.full(len(f.ids), self._index)
        return Observations(f.ids, f.pixels, f.xy, f.ages, camera, zncc=f.zncc, scale=f.patches.scale)

    def _new_features(self, pixels: Array) -> _Features:
        """Return new features at pixels (N, 2) of the current image."""
        n = len(pixels)
        ids = np.fromiter(islice(self._identities, n), np.int64)
        patches = self._aligner.extract(self._levels, pixels)
        return _Features(ids, np.ones(n, np.int64), pixels, self._camera.normalize(pixels), np.ones(n), patches)

    @property
    def _levels(self) -> ScaleSpace:
        """The scale space of the last image, computed when it is used, which is not in every frame."""
        if self._image is not None and self._last_levels.image is not self._image:
            self._last_levels = self._aligner.scale_space(self._image)
        return self._last_levels

    def _tracked(
        self,
        previous: Image,
        image: Image,
        R_cur_prev: Array,
        rotation_sigma_rad: float,
        expected: ExpectedFeatures | None,
    ) -> _Features:
        """Return the features that are found in the current image and agree with one motion, at their new pixels.

        Their patches are compared with the image, or aligned with it if most do not resemble it or some do not agree.
        If most cannot be aligned, the prediction is regarded as wrong, and the others are searched in a larger
        neighbourhood of their previous positions.
        """
        # Prediction by the gyroscope, and by the landmarks where it is given
        c, features = self._config, self._features
        bearings = np.column_stack([features.xy, np.ones(len(features.xy))]) @ R_cur_prev.T
        if expected is not None:
            columns, rows = common_rows(expected.ids, features.ids)
            bearings[rows] = expected.rays[self._index, columns]
        # A prediction behind the camera has no pixel; OpenCV needs a finite one.
        predicted = self._camera.project(bearings)
        predicted = np.where(np.isnan(predicted), -OUTSIDE_PX, predicted).clip(-OUTSIDE_PX, OUTSIDE_PX)
        enough = c.min_tracked_ratio * is_inside(predicted, self._camera, c.border_px).sum()
        # Lucas-Kanade from there, and comparison of the patches
        features = replace(features, patches=features.patches.rolled(R_cur_prev))
        found = self._found(previous, image, features, predicted, c.pyramid_levels)
        if not c.patches.tracking_iterations:
            zncc, is_similar = self._aligner.compare(image, self._last_levels.noise, found.patches, found.pixels)
            resembling = replace(found, zncc=zncc)[is_similar]
            agreeing = self._inliers(resembling, R_cur_prev, rotation_sigma_rad)
            if len(resembling.ids) > enough and len(agreeing.ids) > MIN_AGREEING * len(resembling.ids):
                return agreeing
        # Alignment of the patches
        tracked = self._aligned(found)
        if len(tracked.ids) <= enough:
            lost = features[~np.isin(features.ids, tracked.ids)]
            found = self._found(previous, image, lost, lost.pixels, c.pyramid_levels + RETRY_LEVELS)
            tracked = tracked.joined(self._aligned(found))
            tracked = tracked[np.argsort(tracked.ids)]
        return self._inliers(tracked, R_cur_prev, rotation_sigma_rad)

    def _found(self, previous: Image, image: Image, features: _Features, start: Array, levels: int) -> _Features:
        """Return the features that Lucas-Kanade finds in an image from starting points (N, 2) [px], at their pixels."""
        c = self._config
        pixels, is_tracked = klt.track(previous, image, features.pixels, start, c.window_px, levels)
        return replace(features, pixels=pixels)[is_tracked & is_inside(pixels, self._camera, c.border_px)]

    def _aligned(self, features: _Features) -> _Features:
        """Return the features whose patches can be aligned with the current image."""
        self._aligned_ns = self._image_ns
        return self._moved(features, self._iterations_between)

    def _refined(self, features: _Features) -> _Features:
        """Return the features with the remaining iterations of the alignment in the current image."""
        taken = self._iterations_between if self._aligned_ns == self._image_ns else 0
        remaining = self._config.patches.iterations - taken
        if remaining <= 0:
            return features
        refined = self._moved(features, remaining)
        return replace(refined, xy=self._camera.normalize(refined.pixels))

    def _moved(self, features: _Features, iterations: int) -> _Features:
        """Return the features whose patches can be aligned near their pixels, by some iterations."""
        result = self._aligner.align(self._levels, features.patches, features.pixels, iterations, self._elapsed_s)
        correction_px = np.linalg.norm(result.pixels - features.pixels, axis=1)
        valid = result.valid & (correction_px < MAX_CORRECTION_PX)
        valid &= is_inside(result.pixels, self._camera, self._config.border_px)
        return replace(features, pixels=result.pixels, zncc=result.zncc, patches=result.patches)[valid]

    def _inliers(self, features: _Features, R_cur_prev: Array, rotation_sigma_rad: float) -> _Features:
        """Return the features that are consistent with one motion since the previous frame, with new coordinates.

        The features enter with their coordinates ``xy`` in the previous frame.
        """
        xy = self._camera.normalize(features.pixels)
        if not len(xy):
            return features
        threshold = self._config.ransac_threshold_px / self._camera.central_focal_px[0]
        min_ratio = self._config.min_inlier_ratio
        if rotation_sigma_rad > MAX_ROTATION_SIGMA_RAD:
            inliers = essential_inliers(features.xy, xy, threshold, min_ratio)
            if inliers.mean() > min_ratio:
                return replace(features, xy=xy, ages=features.ages + 1)[inliers]
        threshold += rotation_sigma_rad
        inliers = epipolar_inliers(features.xy, xy, R_cur_prev, threshold, self._rng)
        if inliers.mean() < min_ratio:  # the rotation may be wrong
            without_rotation = essential_inliers(features.xy, xy, threshold, min_ratio)
            if without_rotation.mean() > min_ratio:
                inliers = without_rotation
        return replace(features, xy=xy, ages=features.ages + 1)[inliers]
