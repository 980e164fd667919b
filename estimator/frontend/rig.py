"""The front end of a whole rig: some cameras follow features, the others are searched for the same ones.

A camera that sees mostly what an earlier one sees is not worth a tracker: on keyframes, the earlier one's features are
looked for in it. A camera that looks elsewhere follows features of its own.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import count

import numpy as np
import numpy.typing as npt

from dronevio.estimator.frontend.protocol import image_of
from dronevio.estimator.frontend.stereo import StereoConfig, StereoMatcher, shared_view
from dronevio.estimator.frontend.tracker import FeatureTracker, TrackerConfig
from dronevio.estimator.types import NO_MATCHES, Matches, Observations
from dronevio.models.rig import Rig
from dronevio.models.state import CameraFrame

Array = npt.NDArray[np.float64]
Image = npt.NDArray[np.uint8]

FOLLOWED_BY_ANOTHER = 0.5  # of its image; from this share on, a camera has no features of its own
WORTH_MATCHING = 0.1  # of its image; below, two cameras have too little in common


@dataclass(eq=False)
class _Pair:
    """Two cameras that see the same, and the depths that they have told."""

    tracker: int  # which of the trackers
    first: int  # which of the cameras it is
    second: int  # which of the cameras is searched
    matcher: StereoMatcher
    ids: npt.NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))
    """(K,) Of the features that were matched last, in increasing order."""
    inverse_depth: Array = field(default_factory=lambda: np.zeros(0))
    """(K,) Theirs [1/m]."""

    def known(self, ids: npt.NDArray[np.int64]) -> Array:
        """Return the inverse depths (N,) of features; NaN where they are not known."""
        if not len(self.ids):
            return np.full(len(ids), np.nan)
        rows = np.minimum(np.searchsorted(self.ids, ids), len(self.ids) - 1)
        return np.where(self.ids[rows] == ids, self.inverse_depth[rows], np.nan)


class RigTracker:
    """Turns the frames of a rig into observations; satisfies the `FrontEnd` protocol."""

    def __init__(self, rig: Rig, config: TrackerConfig, stereo: StereoConfig | None = None) -> None:
        """Prepare for a rig.

        Args:
            rig: The calibration, at least one camera.
            config: How features are followed.
            stereo: How they are found in further cameras.
        """
        cameras, ids, self._stereo = rig.cameras, count(), stereo or StereoConfig()
        followed = _cameras_that_follow(rig)
        self._followed = followed
        self._trackers = [FeatureTracker(cameras[i].model, config, i, ids) for i in followed]
        self._Rs_cam_main = _turns(rig, followed)
        self._pairs = [
            _Pair(k, i, j, StereoMatcher(cameras[i], cameras[j], self._stereo))
            for k, i in enumerate(followed)
            for j in range(i + 1, len(cameras))
            if shared_view(cameras[j], cameras[i]) > WORTH_MATCHING
        ]
        self._cameras = [camera.model for camera in cameras]
        self._images: tuple[Image, ...] = ()  # of the last frame

    def track(self, frame: CameraFrame, R_cur_prev: Array, rotation_sigma_rad: float = 0.0) -> Observations:
        """Follow the features into a frame.

        Args:
            frame: The new frame, with an image of each camera.
            R_cur_prev: (3, 3) Rotation of the previous frame of the rig's first camera into this one.
            rotation_sigma_rad: How far it may be off.

        Raises:
            ConfigError: An image is missing, or is not a grey one of its camera's size.
        """
        self._images = tuple(image_of(frame, i, camera) for i, camera in enumerate(self._cameras))
        return _merged(
            [
                tracker.track(frame, R_cam_main @ R_cur_prev @ R_cam_main.T, rotation_sigma_rad)
                for tracker, R_cam_main in zip(self._trackers, self._Rs_cam_main, strict=True)
            ]
        )

    def replenish(self) -> Observations:
        """Look for new features in the last frame, and for all of them in the cameras that see them too."""
        observations = [tracker.replenish() for tracker in self._trackers]
        if not self._images:
            return _merged(observations)
        found = [self._match(pair, observations[pair.tracker]) for pair in self._pairs]
        miscalibrated = [pair.matcher.is_miscalibrated for pair in self._pairs]
        return replace(
            _merged(observations),
            matches=_joined([matches for matches, wrong in zip(found, miscalibrated, strict=True) if not wrong]),
            miscalibrated=_joined([matches for matches, wrong in zip(found, miscalibrated, strict=True) if wrong]),
        )

    def discard(self, ids: npt.NDArray[np.int64]) -> None:
        """Follow some features no further."""
        for tracker in self._trackers:
            tracker.discard(ids)

    def recalibrate(self, rig: Rig) -> None:
        """Take over a better calibration of the cameras' mounting, by which the next matches are looked for."""
        self._Rs_cam_main = _turns(rig, self._followed)
        for pair in self._pairs:
            pair.matcher = StereoMatcher(rig.cameras[pair.first], rig.cameras[pair.second], self._stereo)

    def _match(self, pair: _Pair, seen: Observations) -> Matches:
        first, second = self._images[pair.first], self._images[pair.second]
        found = pair.matcher.match(first, second, seen.pixels, seen.xy, pair.known(seen.ids))
        pair.ids, pair.inverse_depth = seen.ids[found.rows], found.inverse_depth
        return Matches(pair.ids, np.full(len(pair.ids), pair.second), found.xy)


def _cameras_that_follow(rig: Rig) -> list[int]:
    """Return the cameras of a rig that see something that no earlier one of them sees."""
    chosen: list[int] = []
    for i, camera in enumerate(rig.cameras):
        if all(shared_view(camera, rig.cameras[j]) < FOLLOWED_BY_ANOTHER for j in chosen):
            chosen.append(i)
    return chosen


def _turns(rig: Rig, followed: Sequence[int]) -> list[Array]:
    """Return the rotations R_cam_main (3, 3) from the first camera's axes into those of some cameras."""
    R_imu_main = rig.cameras[0].T_imu_cam[:3, :3]
    return [rig.cameras[i].T_imu_cam[:3, :3].T @ R_imu_main for i in followed]


def _merged(observations: Sequence[Observations]) -> Observations:
    """Return what several cameras see as one, the identities in increasing order."""
    ids = np.concatenate([seen.ids for seen in observations])
    order = np.argsort(ids)
    return Observations(
        ids[order],
        np.concatenate([seen.pixels for seen in observations])[order],
        np.concatenate([seen.xy for seen in observations])[order],
        np.concatenate([seen.ages for seen in observations])[order],
        np.concatenate([seen.camera for seen in observations])[order],
        zncc=np.concatenate([seen.zncc for seen in observations])[order],
        scale=np.concatenate([seen.scale for seen in observations])[order],
    )


def _joined(matches: Sequence[Matches]) -> Matches:
    if not matches:
        return NO_MATCHES
    ids, camera, xy = ([getattr(found, name) for found in matches] for name in ("ids", "camera", "xy"))
    return Matches(np.concatenate(ids), np.concatenate(camera), np.concatenate(xy))
