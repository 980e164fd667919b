"""The front end of a rig of cameras: some cameras track features, in the others the same features are matched.

A camera that mostly sees what an earlier one sees has no tracker of its own: on keyframes, the earlier camera's
features are matched in it. A camera with another field of view tracks features of its own. Defective pixels of all
cameras are corrected before.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce
from itertools import count

import numpy as np

from dronevio.estimator.frontend.defective_pixels import DefectivePixels
from dronevio.estimator.frontend.protocol import AtExposure, image_of
from dronevio.estimator.frontend.stereo import StereoConfig, StereoMatcher, shared_view
from dronevio.estimator.frontend.tracker import FeatureTracker, TrackerConfig
from dronevio.estimator.types import NO_MATCHES, Calibration, ExpectedFeatures, Matches, Observations
from dronevio.models.arrays import Array, Image, Integers
from dronevio.models.measurement_checks import check_image_count, check_rig
from dronevio.models.rig import Rig
from dronevio.models.state import NO_IMAGE, CameraFrame

MAX_SHARED_VIEW = 0.5  # a camera that shares more of its image with earlier ones has no tracker of its own
MIN_VERIFIED, VERIFIED_SHARE = 20, 0.8
"""Smallest number of expected features by which an image is verified, and share of them that it must show: images that
agree with the prediction show 95 %, after a jump of the camera by 14 cm 30 %."""
MIN_SHARED_VIEW = 0.1  # cameras that share less of their images are not matched


@dataclass(frozen=True, eq=False)
class _Pair:
    """Two cameras with a common field of view."""

    tracker: int
    """Index of the tracker of the first camera."""
    first: int
    """Index of the camera that tracks the features."""
    second: int
    """Index of the camera in which they are matched."""


@dataclass(frozen=True, eq=False)
class _InverseDepths:
    """The inverse depths of the features that were matched last."""

    ids: Integers
    """(K,) Feature identities in increasing order."""
    inverse_depth: Array
    """(K,) Inverse depths [1/m]."""

    def of(self, ids: Integers) -> Array:
        """Return the inverse depths (N,) of features; NaN where unknown."""
        if not len(self.ids):
            return np.full(len(ids), np.nan)
        rows = np.minimum(np.searchsorted(self.ids, ids), len(self.ids) - 1)
        return np.where(self.ids[rows] == ids, self.inverse_depth[rows], np.nan)


@dataclass(frozen=True, eq=False)
class _Extrinsics:
    """What the front end derives from a calibration of the rig."""

    calibration: Calibration
    Rs_cam_first: tuple[Array, ...]  # (3, 3) rotation from the first camera to that of each tracker
    matchers: tuple[StereoMatcher, ...]  # of each pair


class RigTracker:
    """Turns the frames of a rig into observations; satisfies the `FrontEnd` protocol."""

    def __init__(self, rig: Rig, config: TrackerConfig, stereo: StereoConfig | None = None) -> None:
        """Begin before the first frame.

        Args:
            rig: The calibration, with at least one camera.
            config: Settings of the trackers.
            stereo: Settings of the matching between cameras.

        Raises:
            ConfigError: The rig has no camera.
        """
        check_rig(rig)
        cameras, ids, self._stereo = rig.cameras, count(), stereo or StereoConfig()
        self._tracking = _tracking_cameras(rig)
        self._trackers = [FeatureTracker(cameras[i].model, config, i, ids) for i in self._tracking]
        self._pairs = _matched_pairs(rig)
        nothing = _InverseDepths(np.zeros(0, np.int64), np.zeros(0))
        self._depths = [nothing] * len(self._pairs)
        self._extrinsics = self._derived(Calibration(rig))
        self._cameras = [camera.model for camera in cameras]
        self._defects = tuple(DefectivePixels() for _ in cameras)
        self._images: tuple[Image | None, ...] = ()  # of the last frame, without defective pixels

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
            frame: The new frame. A camera without an image observes nothing.
            R_cur_prev: (3, 3) Rotation of the first camera from the previous frame to this one.
            rotation_sigma_rad: Standard deviation of that rotation [rad].
            calibration: The calibration in use; by default the last one.
            expected: Where features are expected, if the frames before have been left out.

        Raises:
            ConfigError: There are fewer or more images than cameras, or an image is not uint8 or has not its camera's
                size.
        """
        extrinsics = self._use(calibration)
        check_image_count(frame, extrinsics.calibration.rig)
        given = [image_of(frame, i, camera) for i, camera in enumerate(self._cameras)]
        self._images = tuple(
            defects.corrected(image, R_cur_prev) for image, defects in zip(given, self._defects, strict=True)
        )
        frame = replace(frame, images=tuple(NO_IMAGE if image is None else image for image in self._images))
        return _merged(
            [
                tracker.track(frame, R_cam_first @ R_cur_prev @ R_cam_first.T, rotation_sigma_rad, expected=expected)
                for tracker, R_cam_first in zip(self._trackers, extrinsics.Rs_cam_first, strict=True)
            ]
        )

    def verified(
        self,
        frame: CameraFrame,
        expected: ExpectedFeatures,
        R_cur_prev: Array,
        calibration: Calibration | None = None,
    ) -> Observations | None:
        """Return the features that a frame shows where they are expected; see `PredictingFrontEnd.verified`.

        Raises:
            ConfigError: As `track`.
        """
        extrinsics = self._use(calibration)
        check_image_count(frame, extrinsics.calibration.rig)
        by_camera = [
            tracker.verified(frame, expected, R_cam_first @ R_cur_prev @ R_cam_first.T)
            for tracker, R_cam_first in zip(self._trackers, extrinsics.Rs_cam_first, strict=True)
        ]
        known = sum(count for _, count in by_camera)
        seen = _merged([observations for observations, _ in by_camera])
        return seen if known >= MIN_VERIFIED and len(seen) >= VERIFIED_SHARE * known else None

    def replenish(
        self, calibration: Calibration | None = None, at_exposure_of: AtExposure | None = None
    ) -> Observations:
        """Detect new features in the last frame, and match all features in the cameras that share the view.

        Args:
            calibration: The calibration in use; by default the last one.
            at_exposure_of: Moves features to the exposure of another camera; by default all cameras are exposed at one
                time.
        """
        extrinsics = self._use(calibration)
        observations = [tracker.replenish() for tracker in self._trackers]
        if not self._images:
            return _merged(observations)
        for image, defects in zip(self._images, self._defects, strict=True):
            if image is not None:
                defects.examine(image)
        by_pair = [
            self._match(k, extrinsics.matchers[k], observations, at_exposure_of) for k in range(len(self._pairs))
        ]
        miscalibrated = [matcher.is_miscalibrated for matcher in extrinsics.matchers]
        return replace(
            _merged(observations),
            matches=_joined([matches for matches, bad in zip(by_pair, miscalibrated, strict=True) if not bad]),
            miscalibrated=_joined([matches for matches, bad in zip(by_pair, miscalibrated, strict=True) if bad]),
        )

    def discard(self, ids: Integers) -> None:
        """Stop tracking the given features."""
        for tracker in self._trackers:
            tracker.discard(ids)

    def _use(self, calibration: Calibration | None) -> _Extrinsics:
        """Return what is derived from the calibration in use, computed anew where the calibration has changed."""
        if calibration is not None and calibration is not self._extrinsics.calibration:
            self._extrinsics = self._derived(calibration)
        return self._extrinsics

    def _derived(self, calibration: Calibration) -> _Extrinsics:
        Rs = calibration.Ts_imu_cam[:, :3, :3]
        return _Extrinsics(
            calibration,
            tuple(Rs[i].T @ Rs[0] for i in self._tracking),
            tuple(StereoMatcher(calibration, pair.first, pair.second, self._stereo) for pair in self._pairs),
        )

    def _match(
        self,
        index: int,
        matcher: StereoMatcher,
        observations: Sequence[Observations],
        at_exposure_of: AtExposure | None,
    ) -> Matches:
        """Match the features of a pair's first camera in its second, and keep their inverse depths."""
        pair, depths = self._pairs[index], self._depths[index]
        tracked = observations[pair.tracker]
        first, second = self._images[pair.first], self._images[pair.second]
        if first is None or second is None:
            return NO_MATCHES
        calibration = self._extrinsics.calibration
        if at_exposure_of is None:
            xy = calibration.corrected_xy(tracked.xy, tracked.camera)
        else:
            xy = at_exposure_of(pair.second, tracked)
        matched = matcher.match(first, second, tracked.pixels, xy, depths.of(tracked.ids))
        ids = tracked.ids[matched.rows]
        self._depths[index] = _InverseDepths(ids, matched.inverse_depth)
        return Matches(ids, np.full(len(ids), pair.second), matched.xy)


def _tracking_cameras(rig: Rig) -> list[int]:
    """Return the indices of the cameras whose view is not mostly that of an earlier one."""
    chosen: list[int] = []
    for i, camera in enumerate(rig.cameras):
        if all(shared_view(camera, rig.cameras[j]) < MAX_SHARED_VIEW for j in chosen):
            chosen.append(i)
    return chosen


def _matched_pairs(rig: Rig) -> tuple[_Pair, ...]:
    """Return the pairs of a camera that tracks features and a later one in which they are matched."""
    cameras = rig.cameras
    return tuple(
        _Pair(k, i, j)
        for k, i in enumerate(_tracking_cameras(rig))
        for j in range(i + 1, len(cameras))
        if shared_view(cameras[j], cameras[i]) > MIN_SHARED_VIEW
    )


def measures_depth(rig: Rig) -> bool:
    """Return whether features are matched between cameras of a rig, so that single frames measure depths."""
    return bool(_matched_pairs(rig))


def _merged(observations: Sequence[Observations]) -> Observations:
    """Return the observations of several cameras as one, in increasing order of the identities."""
    if len(observations) == 1:  # they have that order
        return observations[0]
    ids = np.concatenate([o.ids for o in observations])
    order = np.argsort(ids)
    return Observations(
        ids[order],
        np.concatenate([o.pixels for o in observations])[order],
        np.concatenate([o.xy for o in observations])[order],
        np.concatenate([o.ages for o in observations])[order],
        np.concatenate([o.camera for o in observations])[order],
        zncc=np.concatenate([o.zncc for o in observations])[order],
        scale=np.concatenate([o.scale for o in observations])[order],
    )


def _joined(matches: Sequence[Matches]) -> Matches:
    """Return the matches of several pairs as one."""
    return reduce(Matches.joined, matches, NO_MATCHES)
