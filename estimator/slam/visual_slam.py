"""Visual SLAM: the odometry, and a map around it that corrects it when places are seen again.

The odometry does not depend on the map: its estimates are those of `VisualInertialOdometry`, to the bit. The map
receives the keyframes of the odometry and returns the pose of the odometry frame in the map frame, `T_map_odom`. It is
applied a fixed number of frames after the keyframe that caused it, so that results do not depend on how fast the machine
is. A pose in the map frame is causal, and it jumps when a loop is closed; the pose in the odometry frame is continuous.
"""

from collections import deque
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from dronevio.estimator.backend.departure import Departure
from dronevio.estimator.keyframe_observer import OdometryKeyframe
from dronevio.estimator.slam.config import SlamConfig
from dronevio.estimator.slam.features import PlaceFeatureExtractor
from dronevio.estimator.slam.localization import KeyframeImages
from dronevio.estimator.slam.mapping import Correction, Mapper, Recognizer, WaitingKeyframe
from dronevio.estimator.slam.recognizer import PlaceRecognizer
from dronevio.estimator.vio import VisualInertialOdometry
from dronevio.models.imu import ImuSamples
from dronevio.models.rig import Rig
from dronevio.models.state import CameraFrame, Estimate, NavState

Array = npt.NDArray[np.float64]


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

    def __init__(self, rig: Rig, config: SlamConfig | None = None, recognizer: Recognizer | None = None) -> None:
        """Begin before the first measurement, with an empty map.

        Args:
            rig: The calibration of the cameras and the IMU.
            config: Settings.
            recognizer: Recognizes places; by default by binary descriptors.

        Raises:
            ConfigError: The rig has no camera.
        """
        self._config = c = config or SlamConfig()
        self._odometry = VisualInertialOdometry(rig, c.odometry, observer=self)
        self._extractor = PlaceFeatureExtractor(c.places.features)
        self._mapper = Mapper(recognizer or PlaceRecognizer(rig, c.places), c.mapping)
        self._frame: CameraFrame | None = None
        self._frames = 0
        self._due: deque[tuple[int, Correction]] = deque()
        self._correction: Correction | None = None

    @property
    def mapper(self) -> Mapper:
        """The map of the flight so far."""
        return self._mapper

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
        self._frame = frame
        estimate = self._odometry.add_frame(frame)
        self._frames += 1
        events: tuple[str, ...] = ()
        while self._due and self._due[0][0] <= self._frames:
            self._correction = self._due.popleft()[1]
            events += tuple(f"loop closed with keyframe {loop.first}" for loop in self._correction.loops)
        T_map_odom = np.eye(4) if self._correction is None else self._correction.T_map_odom
        if estimate.state is None:
            return estimate
        return replace(estimate, T_map_odom=T_map_odom, events=(*estimate.events, *events))

    def added(self, keyframe: OdometryKeyframe) -> None:
        """Receive a keyframe of the odometry."""
        frame = self._frame
        assert frame is not None
        R_odom_imu = keyframe.state.T_world_imu[:3, :3]
        features = self._extractor.extract(frame.images, keyframe.calibration.rig, R_odom_imu, keyframe.observations)
        images = KeyframeImages(frame.images, keyframe.calibration.rig)
        self._mapper.add(WaitingKeyframe(keyframe.t_ns, features, images), keyframe.window_times_ns)

    def departed(self, departure: Departure) -> None:
        """Receive the final estimate of a keyframe of the odometry."""
        correction = self._mapper.depart(departure)
        if correction is not None:
            self._due.append((self._frames + 1 + self._config.correction_delay, correction))

    def lost(self) -> None:
        """Notice that the odometry is lost."""
