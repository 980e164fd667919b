"""Visual SLAM: the odometry, and a map around it that corrects it when places are seen again.

The odometry does not depend on the map: its estimates are those of `VisualInertialOdometry`, to the bit. The map
receives the keyframes of the odometry and returns the pose of the odometry frame in the map frame, `T_map_odom`. It is
applied a fixed number of frames after the keyframe that caused it, so that results do not depend on the speed of the
machine. A pose in the map frame is causal, and it jumps when a loop is closed; the pose in the odometry frame is
continuous.
"""

from collections import deque
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from dronevio.estimator.backend.departure import Departure
from dronevio.estimator.config import VioConfig
from dronevio.estimator.keyframe_observer import OdometryKeyframe
from dronevio.estimator.slam.config import SlamConfig
from dronevio.estimator.slam.correction import MapCorrection
from dronevio.estimator.slam.features import PlaceFeatureExtractor
from dronevio.estimator.slam.localization import KeyframeImages
from dronevio.estimator.slam.mapping import Correction, Mapper, MapSummary, WaitingKeyframe
from dronevio.estimator.slam.recognizer import PlaceRecognizer
from dronevio.estimator.types import Integers
from dronevio.estimator.vio import VisualInertialOdometry
from dronevio.models.imu import ImuSamples
from dronevio.models.rig import Rig
from dronevio.models.state import CameraFrame, Estimate, NavState

Array = npt.NDArray[np.float64]

MIN_FEATURES = 8
"""Smallest number of common features that connect two keyframes; fewer may be tracked by mistake."""


class VisualSlam:
    """Estimates the motion of a rig in a map that it builds; implements `Estimator`.

    Example:
        >>> slam = VisualSlam(rig)
        >>> for measurement in measurements(recording):
        ...     if isinstance(measurement, ImuSamples):
        ...         slam.add_imu(measurement)
        ...     else:
        ...         T_map_imu = slam.add_frame(measurement).T_map_imu
    """

    def __init__(self, rig: Rig, odometry: VioConfig | None = None, config: SlamConfig | None = None) -> None:
        """Begin before the first measurement, with an empty map.

        Args:
            rig: The calibration of the cameras and the IMU.
            odometry: Settings of the odometry.
            config: Settings of the map.

        Raises:
            ConfigError: The rig has no camera.
        """
        self._config = c = config or SlamConfig()
        self._map = _MapOfOdometry(rig, c)
        self._odometry = VisualInertialOdometry(rig, odometry, observer=self._map)
        self._frames = 0
        self._due: deque[tuple[int, Correction]] = deque()
        self._T_map_odom: Array | None = np.eye(4)
        self._track = 0
        self._tracked = 0  # number of features that were tracked into the newest frame

    def add_imu(self, samples: ImuSamples) -> None:
        """Add the IMU samples since the last call; see `VisualInertialOdometry`."""
        self._odometry.add_imu(samples)

    def state_at(self, t_ns: int) -> NavState | None:
        """Return the newest state in the odometry frame, propagated by the IMU; see `Estimator`."""
        return self._odometry.state_at(t_ns)

    def add_frame(self, frame: CameraFrame) -> Estimate:
        """Add a frame and return the estimate at its time stamp, with the correction by the map.

        Raises:
            ConfigError: The frame is not later than the last one, or an image does not fit its camera.
        """
        self._map.begin_frame(frame, self._tracked)
        estimate = self._odometry.add_frame(frame)
        self._tracked = 0 if estimate.health_report is None else estimate.health_report.tracks
        self._frames += 1
        if self._map.track != self._track:
            self._track, self._T_map_odom = self._map.track, None
        events: list[str] = []
        while self._due and self._due[0][0] <= self._frames:
            correction = self._due.popleft()[1]
            if correction.track == self._track:
                self._T_map_odom = correction.T_map_odom
                events += _events(correction)
        self._due += [(self._frames + self._config.correction_delay, each) for each in self._map.take_corrections()]
        if estimate.state is None:
            return estimate
        return replace(estimate, T_map_odom=self._T_map_odom, events=(*estimate.events, *events))

    @property
    def mapper(self) -> Mapper:
        """The map of the flight so far."""
        return self._map.mapper

    @property
    def summary(self) -> MapSummary:
        """Size of the map."""
        return self._map.mapper.summary

    def final_correction(self) -> MapCorrection | None:
        """Return the correction of the whole flight by all loops; None if no keyframe has joined the map."""
        return self._map.mapper.final_correction()


class _MapOfOdometry:
    """Gives the keyframes of the odometry to the mapper; implements `KeyframeObserver`."""

    def __init__(self, rig: Rig, config: SlamConfig) -> None:
        """Begin with an empty map."""
        self.mapper = Mapper(PlaceRecognizer(rig, config.places), config.mapping)
        self._extractor = PlaceFeatureExtractor(config.places.features)
        self._frame: CameraFrame | None = None
        self._corrections: list[Correction] = []
        self._tracked = 0
        self._keyframe_ids = np.zeros(0, np.int64)
        self.track = 0
        """Number of the odometry frame; each loss begins another one."""

    def begin_frame(self, frame: CameraFrame, tracked: int) -> None:
        """Keep the images of the newest frame, which may become a keyframe.

        Args:
            frame: The frame.
            tracked: Number of features that were tracked into the frame before it.
        """
        self._frame, self._tracked = frame, tracked

    def take_corrections(self) -> list[Correction]:
        """Return the corrections since the last call."""
        corrections, self._corrections = self._corrections, []
        return corrections

    def added(self, keyframe: OdometryKeyframe) -> None:
        """Let a keyframe of the odometry wait until it leaves the window, unless its images are those of an earlier
        frame. If no image connects it with the earlier ones, another track begins.
        """
        connected = are_connected(self._keyframe_ids, keyframe.observations.ids, self._tracked)
        if keyframe.is_of_newest_frame and not connected:
            self.lost()
        self._keyframe_ids = keyframe.observations.ids
        frame = self._frame
        if frame is None or not keyframe.is_of_newest_frame:
            return
        rig, R_odom_imu = keyframe.calibration.rig, keyframe.state.T_world_imu[:3, :3]
        features = self._extractor.extract(frame.images, rig, R_odom_imu, keyframe.observations)
        images, landmarks = KeyframeImages(frame.images, rig), (keyframe.landmark_ids, keyframe.landmarks_odom)
        waiting = WaitingKeyframe(keyframe.t_ns, features, images, keyframe.state, *landmarks)
        correction = self.mapper.add(waiting, keyframe.window_times_ns)
        if correction is not None:
            self._corrections.append(correction)

    def departed(self, departure: Departure) -> None:
        """Let a keyframe of the odometry join the map."""
        correction = self.mapper.depart(departure)
        if correction is not None:
            self._corrections.append(correction)

    def lost(self) -> None:
        """Begin another track: later keyframes are in another odometry frame."""
        self.track += 1
        self.mapper.start_track(0 if self._frame is None else self._frame.t_ns)


def _events(correction: Correction) -> list[str]:
    """Return the events of a correction, as texts for users."""
    joined = ["track joined with the map"] if correction.is_joined else []
    return [*joined, *(f"loop closed with keyframe {k}" for k in sorted({loop.first for loop in correction.loops}))]


def are_connected(before: Integers, ids: Integers, tracked: int) -> bool:
    """Return whether images connect two successive keyframes.

    They do not where features were tracked into the frame before the second one, and suddenly all are others, as when
    the vehicle is carried away between two frames. After darkness, the IMU connects the keyframes.

    Args:
        before: (N,) Identities of the features of the first keyframe.
        ids: (M,) Identities of the features of the second keyframe.
        tracked: Number of features that were tracked into the frame before the second keyframe.
    """
    has_changed = min(len(before), len(ids), tracked) >= MIN_FEATURES
    return not has_changed or len(np.intersect1d(before, ids)) >= MIN_FEATURES
