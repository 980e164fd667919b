"""Visual-inertial odometry: a camera and an IMU in, where the IMU is out.

The pipeline of a keyframe-based fixed-lag smoother (Leutenegger et al., IJRR 2015; Qin et al., T-RO 2018): corners are
followed from frame to frame, the IMU is preintegrated between keyframes, and every keyframe adds a state to a window
that GTSAM optimises. Between keyframes the newest state is carried forward by the IMU. What is returned for a frame is
never revised.
"""

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from dronevio.estimator.frontend import FrontEnd, Observations, TrackerConfig
from dronevio.estimator.inertial import ImuBuffer, Increments, InertialConfig, preintegration_params
from dronevio.estimator.initialiser import Initialiser, InitialiserConfig
from dronevio.estimator.keyframes import KeyframeConfig, KeyframePolicy
from dronevio.estimator.landmarks import LandmarkConfig
from dronevio.estimator.propagation import Propagation
from dronevio.estimator.rig_tracker import RigTracker
from dronevio.estimator.smoother import KeyframeSmoother, SmootherConfig
from dronevio.estimator.start import NotObservable
from dronevio.estimator.start_in_motion import Sighting
from dronevio.estimator.stillness import StillnessConfig, StillnessDetector
from dronevio.estimator.timing import FrameTimes
from dronevio.models.errors import ConfigError
from dronevio.models.imu import ImuSamples
from dronevio.models.rig import Rig
from dronevio.models.state import CameraFrame, Estimate, FeatureTracks, Health, NavState

Array = npt.NDArray[np.float64]

MIN_FEATURES_AT_START = 100  # with fewer, new ones are looked for while waiting for a start


@dataclass(frozen=True)
class VioConfig:
    """Settings of the visual-inertial odometry."""

    tracker: TrackerConfig = field(default_factory=TrackerConfig)
    inertial: InertialConfig = field(default_factory=InertialConfig)
    stillness: StillnessConfig = field(default_factory=StillnessConfig)
    start: InitialiserConfig = field(default_factory=InitialiserConfig)
    keyframe: KeyframeConfig = field(default_factory=KeyframeConfig)
    smoother: SmootherConfig = field(default_factory=SmootherConfig)
    landmarks: LandmarkConfig = field(default_factory=LandmarkConfig)
    min_tracks: int = 8
    """With fewer features, the estimate is called inertial-only."""


class VisualInertialOdometry:
    """Estimates the motion of a rig from what is pushed into it, in time order.

    Example:
        >>> vio = VisualInertialOdometry(rig)
        >>> for measurement in measurements(recording):
        ...     if isinstance(measurement, ImuSamples):
        ...         vio.add_imu(measurement)
        ...     else:
        ...         estimate = vio.add_frame(measurement)
    """

    def __init__(self, rig: Rig, config: VioConfig | None = None, front_end: FrontEnd | None = None) -> None:
        """Prepare for a rig, of which the first camera is used.

        Args:
            rig: The calibration.
            config: Settings.
            front_end: Where feature observations come from; by default the images.
        """
        self._rig, self._config = rig, config or VioConfig()
        c, camera = self._config, rig.cameras[0]
        self._params = preintegration_params(rig.imu, c.inertial)
        self._buffer = ImuBuffer()
        self._times = FrameTimes(rig)
        self._front_end = front_end or RigTracker(rig, c.tracker)
        self._stillness = StillnessDetector(c.stillness)
        self._keyframes = KeyframePolicy(c.keyframe)
        self._initialiser = Initialiser(camera, c.start, self._keyframes, self._params, self._new_smoother)
        self._smoother: KeyframeSmoother | None = None
        self._propagation: Propagation
        self._last_frame_ns: int | None = None

    def add_imu(self, samples: ImuSamples) -> None:
        """Take the IMU samples since the last call."""
        self._buffer.add(samples)

    def add_frame(self, frame: CameraFrame) -> Estimate:
        """Take a frame and say where the IMU is.

        Raises:
            ConfigError: The frame is not later than the last one, or its image is not one of the rig's camera.
        """
        if self._last_frame_ns is not None and frame.t_ns <= self._last_frame_ns:
            raise ConfigError(f"frame at {frame.t_ns} ns after one at {self._last_frame_ns} ns; expected a later one")
        self._last_frame_ns = frame.t_ns
        t_ns = self._times.imu_time_ns(frame.t_ns)
        increments = self._buffer.take_until(t_ns)
        gyro_bias, bias_sigma = self._gyro_bias
        self._times.begin(increments, self._buffer.ahead(self._times.reach_s), gyro_bias)
        rotation, rotation_sigma = self._camera_rotation(increments, gyro_bias), bias_sigma * increments.dt_s.sum()
        observations = self._times.moved(self._front_end.track(frame, rotation, float(rotation_sigma)))
        self._stillness.update(t_ns, observations, increments)
        if self._smoother is None:
            estimate = self._start(Sighting(t_ns, increments, observations))
        else:
            estimate = self._go_on(self._smoother, t_ns, increments, observations)
        return self._times.stamped(estimate, frame.t_ns)

    def _start(self, sighting: Sighting) -> Estimate:
        """Start if that is possible by now; look for features if there are few."""
        if len(sighting.observations) < MIN_FEATURES_AT_START:
            self._times.moved(self._front_end.replenish())
        started = self._initialiser.add(sighting, self._stillness.still_for_s)
        if isinstance(started, NotObservable):
            tracks = _feature_tracks(sighting.observations)
            return Estimate(sighting.t_ns, Health.INITIALISING, None, tracks, events=(str(started),))
        self._smoother = started
        self._begin_interval(started, sighting.observations)
        return self._estimate(started.state, sighting.observations, ("initialised",))

    def _go_on(
        self, smoother: KeyframeSmoother, t_ns: int, increments: Increments, observations: Observations
    ) -> Estimate:
        """Carry the newest state forward to a frame, or make the frame a keyframe."""
        self._propagation.add(increments)
        elapsed_s, still_for_s = self._propagation.elapsed_s, self._stillness.still_for_s
        if not self._keyframes.is_due(elapsed_s, still_for_s, observations):
            return self._estimate(self._propagation.state_at(t_ns), observations)
        observations = self._times.moved(self._front_end.replenish())
        still = self._keyframes.is_still(elapsed_s, still_for_s)
        result = smoother.add_keyframe(t_ns, self._propagation.preintegrated, observations, still)
        self._front_end.discard(result.rejected)
        self._begin_interval(smoother, observations)
        return self._estimate(smoother.state, observations, ("keyframe", *result.events), smoother.landmarks)

    def _new_smoother(self, start: NavState, covariance: Array, observations: Observations) -> KeyframeSmoother:
        c = self._config
        return KeyframeSmoother(self._rig.cameras, c.smoother, c.landmarks, start, covariance, observations)

    def _begin_interval(self, smoother: KeyframeSmoother, observations: Observations) -> None:
        """Start preintegration at the newest keyframe, with its biases."""
        self._propagation = Propagation(self._params, self._rig.imu, smoother.state, smoother.gtsam_state)
        self._keyframes.begin(observations)

    @property
    def _gyro_bias(self) -> tuple[Array, float]:
        """What is known of the gyroscope's bias (3,), and how well [rad/s]."""
        if self._smoother is None:
            return self._initialiser.gyro_bias_rad_s, self._initialiser.gyro_bias_sigma_rad_s
        return self._smoother.state.gyro_bias_rad_s, 0.0

    def _camera_rotation(self, increments: Increments, gyro_bias: Array) -> Array:
        """Return R_cur_prev (3, 3) of the camera over some increments."""
        R_imu_cam = self._rig.cameras[0].T_imu_cam[:3, :3]
        return np.asarray(R_imu_cam.T @ increments.rotation(gyro_bias).T @ R_imu_cam)

    def _estimate(
        self,
        state: NavState,
        observations: Observations,
        events: tuple[str, ...] = (),
        landmarks_world: Array | None = None,
    ) -> Estimate:
        enough = len(observations) >= self._config.min_tracks
        health = Health.TRACKING if enough else Health.INERTIAL_ONLY
        return Estimate(state.t_ns, health, state, _feature_tracks(observations), landmarks_world, events)


def _feature_tracks(observations: Observations) -> FeatureTracks:
    return FeatureTracks(observations.ids, observations.pixels, observations.ages)
