r"""Estimators whose tracks contain simulated outliers, to measure the robustness of the back end, in benchmarks.

    PYTHONPATH=benchmarks dronevio benchmark --suite room --estimators vio a=python:corrupted_tracks:outliers
    PYTHONPATH=benchmarks dronevio benchmark --recordings MH_01_easy --starts-s 0 1 2 \
        --estimators a=python:corrupted_tracks:random_30 b=python:corrupted_tracks:object_30_stereo

The names are those of `CORRUPTED_FRONT_ENDS` with underscores, for the first camera; for all cameras with ``_stereo``.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from dronevio.estimator.config import VioConfig
from dronevio.estimator.frontend.protocol import AtExposure, FrontEnd
from dronevio.estimator.frontend.rig import RigTracker
from dronevio.estimator.odometry import VisualInertialOdometry
from dronevio.estimator.types import Calibration, Observations
from dronevio.models.arrays import Array
from dronevio.models.imu import ImuSamples
from dronevio.models.rig import Rig
from dronevio.models.state import CameraFrame, Estimate, NavState

OUTLIER_SHARE = 0.2
_JUMP = 0.1  # standard deviation of independent errors relative to depth, 46 px at EuRoC's focal length
_DRIFT = 0.003  # standard deviation of the drift per frame relative to depth, 1.4 px: a person at some metres' distance
_FOCAL_PX = 458.0


class OutlierFrontEnd:
    """Adds errors to a share of the tracks of another front end; is a `FrontEnd`.

    The tracks are selected by their identity, for as long as they last. One half of them has independent errors in
    every frame. The other half drifts at a constant rate, as tracks on moving objects do, which is harder to detect.
    """

    def __init__(self, inner: FrontEnd, share: float = OUTLIER_SHARE, seed: int = 0) -> None:
        """Wrap a front end.

        Args:
            inner: The front end that tracks.
            share: Share of the tracks that become outliers, 0 to 1.
            seed: Seed of the selection and of the errors.
        """
        self._inner, self._share, self._seed = inner, share, seed
        self._frames = 0

    def __getattr__(self, name: str) -> Any:
        return getattr(self._inner, name)

    def track(self, frame: CameraFrame, *motion: Any, **options: Any) -> Observations:
        """Track the features into a frame, and add errors to some of them."""
        self._frames += 1
        return self._corrupted(self._inner.track(frame, *motion, **options))

    def replenish(
        self, calibration: Calibration | None = None, at_exposure_of: AtExposure | None = None
    ) -> Observations:
        """Detect new features with a calibration, and add the same errors as in `track`."""
        return self._corrupted(self._inner.replenish(calibration, at_exposure_of))

    def discard(self, ids: npt.NDArray[np.int64]) -> None:
        """Stop tracking features with the given identities (N,)."""
        self._inner.discard(ids)

    def _corrupted(self, observed: Observations) -> Observations:
        offset = self.offsets(observed.ids, observed.ages)
        return replace(observed, xy=observed.xy + offset, pixels=observed.pixels + _FOCAL_PX * offset)

    def offsets(self, ids: npt.NDArray[np.int64], ages: npt.NDArray[np.int64]) -> Array:
        """Return the errors (N, 2) of features in the current frame in normalized image coordinates.

        Args:
            ids: (N,) Identities of the features.
            ages: (N,) Number of frames in which each feature has been observed.
        """
        size = int(ids.max(initial=0)) + 1
        selection = np.random.default_rng([self._seed, 0]).random((size, 2))[ids, 0]
        return np.asarray(np.where(selection[:, None] < self._share, self.errors(size, ids, ages), 0.0))

    def errors(self, size: int, ids: npt.NDArray[np.int64], ages: npt.NDArray[np.int64]) -> Array:
        """Return the errors (N, 2) of outliers in normalized image coordinates.

        Args:
            size: Number of features since the beginning.
            ids: (N,) Identities of the features.
            ages: (N,) Number of frames in which each feature has been observed.
        """
        kind = np.random.default_rng([self._seed, 0]).random((size, 2))[ids, 1]
        drift = np.random.default_rng([self._seed, 1]).normal(size=(size, 2))[ids]
        jump = np.random.default_rng([self._seed, 2, self._frames]).normal(size=(size, 2))[ids]
        return np.asarray(np.where(kind[:, None] < 0.5, _JUMP * jump, _DRIFT * drift * (ages[:, None] - 1)))


class RandomTracks(OutlierFrontEnd):
    """Outliers with independent errors in every frame."""

    def errors(self, size: int, ids: npt.NDArray[np.int64], ages: npt.NDArray[np.int64]) -> Array:
        """Return the errors (N, 2) of outliers."""
        return np.asarray(_JUMP * np.random.default_rng([self._seed, 2, self._frames]).normal(size=(size, 2))[ids])


class MovingObjectTracks(OutlierFrontEnd):
    """Outliers that drift in the same direction at the same rate, as the tracks on one moving object do."""

    def errors(self, size: int, ids: npt.NDArray[np.int64], ages: npt.NDArray[np.int64]) -> Array:
        """Return the errors (N, 2) of outliers."""
        angle_rad = np.random.default_rng([self._seed, 3]).uniform(0.0, 2.0 * np.pi)
        return np.asarray(_DRIFT * np.array([np.cos(angle_rad), np.sin(angle_rad)]) * (ages[:, None] - 1))


class SlidingTracks(OutlierFrontEnd):
    """Outliers that slide along edges: each has a direction and a rate of its own."""

    def errors(self, size: int, ids: npt.NDArray[np.int64], ages: npt.NDArray[np.int64]) -> Array:
        """Return the errors (N, 2) of outliers."""
        angle_rad = np.random.default_rng([self._seed, 4]).uniform(0.0, 2.0 * np.pi, size)[ids]
        rate = _DRIFT * np.abs(np.random.default_rng([self._seed, 5]).normal(size=size))[ids]
        return np.asarray(np.stack([np.cos(angle_rad), np.sin(angle_rad)], axis=1) * (rate * (ages - 1))[:, None])


_KINDS = {"random": RandomTracks, "object": MovingObjectTracks, "sliding": SlidingTracks}

CORRUPTED_FRONT_ENDS: dict[str, Callable[[FrontEnd], FrontEnd]] = {
    "outliers": OutlierFrontEnd,
    **{
        f"{name}-{percent}": partial(kind, share=0.01 * percent)
        for name, kind in _KINDS.items()
        for percent in (10, 20, 30)
    },
}
"""Functions that wrap the front end of the estimator, by name; a number is the share of outliers in percent."""
_STEREO = "_stereo"


class CorruptedOdometry:
    """The odometry with a corrupted front end; is an `Estimator`."""

    def __init__(self, rig: Rig, corrupt: Callable[[FrontEnd], FrontEnd], cameras: int | None = 1) -> None:
        """Make the estimator.

        Args:
            rig: Calibration of the recording.
            corrupt: Function that wraps the front end.
            cameras: Number of cameras to use; None for all.
        """
        self._cameras, config = cameras, VioConfig()
        used = replace(rig, cameras=rig.cameras[:cameras])
        self._inner = VisualInertialOdometry(used, config, corrupt(RigTracker(used, config.tracker)))

    def add_imu(self, samples: ImuSamples) -> None:
        """Add the IMU samples since the last call."""
        self._inner.add_imu(samples)

    def add_frame(self, frame: CameraFrame) -> Estimate:
        """Return the estimate for a frame, from the images of the cameras that are used."""
        return self._inner.add_frame(replace(frame, images=frame.images[: self._cameras]))

    def state_at(self, t_ns: int) -> NavState | None:
        """Return the newest state, propagated by the IMU."""
        return self._inner.state_at(t_ns)


def __getattr__(name: str) -> Callable[[Rig], CorruptedOdometry]:
    """Return the function that makes an estimator from a rig, by its name in ``dronevio benchmark``."""
    front_end = name.removesuffix(_STEREO).replace("_", "-")
    if front_end not in CORRUPTED_FRONT_ENDS:
        raise AttributeError(f"no estimator {name}; expected one of {', '.join(CORRUPTED_FRONT_ENDS)}")
    cameras = None if name.endswith(_STEREO) else 1
    return partial(CorruptedOdometry, corrupt=CORRUPTED_FRONT_ENDS[front_end], cameras=cameras)
