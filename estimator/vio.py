"""Visual-inertial odometry: one camera and an IMU in, where the IMU is out.

The pipeline of a keyframe-based fixed-lag smoother (Leutenegger et al., IJRR 2015; Qin et al., T-RO 2018): corners are
followed from frame to frame, the IMU is preintegrated between keyframes, and every keyframe adds a state to a window
that GTSAM optimises. Between keyframes the newest state is carried forward by the IMU. What is returned for a frame is
never revised.
"""

from dataclasses import dataclass, field

import gtsam
import numpy as np
import numpy.typing as npt

from dronevio.estimator.covariance import propagate
from dronevio.estimator.frontend import FeatureTracker, FrontEnd, Observations, TrackerConfig
from dronevio.estimator.inertial import ImuBuffer, Increments, InertialConfig, integrate, preintegration_params
from dronevio.estimator.landmarks import LandmarkConfig
from dronevio.estimator.smoother import Keyframe, KeyframeSmoother, SmootherConfig
from dronevio.estimator.start import StartSigmas, mean_gyro, start_from_rest
from dronevio.estimator.start_in_motion import MotionStartConfig, Sighting, start_in_motion
from dronevio.estimator.stillness import StillnessConfig, StillnessDetector
from dronevio.models.errors import ConfigError
from dronevio.models.imu import ImuSamples
from dronevio.models.rig import Rig
from dronevio.models.state import CameraFrame, Estimate, FeatureTracks, Health, NavState

Array = npt.NDArray[np.float64]

MIN_FEATURES_AT_START = 100  # with fewer, new ones are looked for while waiting for a rest
HALF_TICK_S, HALF_TICK_NS = 0.001, 1_000_000  # time stamps jitter; an interval of 0.2 s may come as 0.1999 s


@dataclass(frozen=True)
class KeyframeConfig:
    """When a frame becomes a keyframe."""

    interval_s: float = 0.2
    """In motion, at the latest after this time [s]."""
    still_interval_s: float = 0.5
    """At rest, after this time [s]."""
    min_tracked: float = 0.6
    """Earlier, when less than this share of the last keyframe's features is left."""


@dataclass(frozen=True)
class VioConfig:
    """Settings of the visual-inertial odometry."""

    tracker: TrackerConfig = field(default_factory=TrackerConfig)
    inertial: InertialConfig = field(default_factory=InertialConfig)
    stillness: StillnessConfig = field(default_factory=StillnessConfig)
    smoother: SmootherConfig = field(default_factory=SmootherConfig)
    landmarks: LandmarkConfig = field(default_factory=LandmarkConfig)
    keyframe: KeyframeConfig = field(default_factory=KeyframeConfig)
    rest_s: float = 0.8
    """How long the drone must stand still for a start from rest [s]."""
    rest_sigmas: StartSigmas = field(default_factory=StartSigmas)
    """How sure a start from rest is."""
    motion: MotionStartConfig = field(default_factory=MotionStartConfig)
    """When a start in motion is tried and believed."""
    motion_sigmas: StartSigmas = field(
        default_factory=lambda: StartSigmas(tilt_rad=0.05, velocity_m_s=0.3, gyro_bias_rad_s=0.02, accel_bias_m_s2=0.1)
    )
    """How sure a start in motion is."""
    unknown_gyro_bias_sigma: float = 0.05
    """How large the gyroscope's bias may be before anything is known of it [rad/s]; EuRoC's is 0.08."""
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

        Raises:
            ConfigError: The rig has a time offset between camera and IMU, which is not supported.
        """
        if rig.time_offset_s != 0.0:
            raise ConfigError(
                f"a rig with a time offset of {rig.time_offset_s:g} s; expected stamps on one clock, offset 0"
            )
        self._config = config or VioConfig()
        self._rig = rig
        self._T_imu_cam = rig.cameras[0].T_imu_cam
        self._front_end = front_end or FeatureTracker(rig.cameras[0].model, self._config.tracker)
        self._buffer = ImuBuffer()
        self._stillness = StillnessDetector(self._config.stillness)
        self._params = preintegration_params(rig.imu, self._config.inertial)
        self._window: list[Sighting] = []  # what was sensed lately, before the start
        self._last_try_ns = 0
        self._last_frame_ns: int | None = None
        self._gyro_bias = np.zeros(3)
        self._gyro_bias_sigma = self._config.unknown_gyro_bias_sigma
        self._smoother: KeyframeSmoother | None = None

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
        increments = self._buffer.take_until(frame.t_ns)
        rotation_sigma_rad = self._gyro_bias_sigma * float(increments.dt_s.sum())
        observations = self._front_end.track(frame, self._camera_rotation(increments), rotation_sigma_rad)
        self._stillness.update(frame.t_ns, observations, increments)
        if self._smoother is None:
            return self._start(frame.t_ns, observations, increments)
        integrate(self._preintegrated, increments)
        if not self._is_keyframe(observations):
            return self._estimate(self._carried_forward(frame.t_ns), observations)
        observations = self._front_end.replenish()
        still = self._stillness.still_for_s >= self._preintegrated.deltaTij()
        result = self._smoother.add_keyframe(frame.t_ns, self._preintegrated, observations, still)
        self._front_end.discard(result.rejected)
        self._begin_interval(observations)
        return self._estimate(
            self._smoother.state, observations, ("keyframe", *result.events), self._smoother.landmarks
        )

    def _start(self, t_ns: int, observations: Observations, increments: Increments) -> Estimate:
        """Wait until the drone stands still for a while, or moves so that its velocity can be told."""
        c = self._config
        self._window.append(Sighting(t_ns, increments, observations))
        while t_ns - self._window[0].t_ns > max(c.rest_s, c.motion.window_s) * 1e9 + HALF_TICK_NS:
            self._window.pop(0)
        if len(observations) < MIN_FEATURES_AT_START:
            self._front_end.replenish()
        if self._try_start(t_ns):
            assert self._smoother is not None
            return self._estimate(self._smoother.state, observations, ("initialised",))
        return Estimate(t_ns, Health.INITIALISING, None, _feature_tracks(observations))

    def _try_start(self, t_ns: int) -> bool:
        """Start from rest or in motion, where either is possible by now."""
        c, still_for_s = self._config, self._stillness.still_for_s
        if still_for_s > 0.0:
            rest = self._since(t_ns, still_for_s)
            increments = [sighting.increments for sighting in rest[1:]]
            self._gyro_bias, self._gyro_bias_sigma = mean_gyro(increments), 0.0
            if still_for_s < c.rest_s:
                return False
            start = start_from_rest(rest[0].t_ns, increments)
            return self._launch(start, c.rest_sigmas, rest, c.keyframe.still_interval_s)
        window = self._since(t_ns, c.motion.window_s)
        too_short = t_ns - window[0].t_ns < c.motion.window_s * 1e9 - HALF_TICK_NS
        if too_short or t_ns - self._last_try_ns < c.motion.every_s * 1e9:
            return False
        self._last_try_ns = t_ns
        found = start_in_motion(window, self._T_imu_cam, self._rig.cameras[0].model.fx, c.motion)
        return found is not None and self._launch(found, c.motion_sigmas, window, c.keyframe.interval_s)

    def _since(self, t_ns: int, span_s: float) -> list[Sighting]:
        """Return the sightings of the last ``span_s`` seconds."""
        return [s for s in self._window if t_ns - s.t_ns <= span_s * 1e9 + HALF_TICK_NS]

    def _launch(
        self, start: NavState, sigmas: StartSigmas, sightings: list[Sighting], keyframe_interval_s: float
    ) -> bool:
        """Start the smoother at the first of some sightings; say whether what came of it is to be believed."""
        still = self._stillness.still_for_s > 0.0
        first, *later = sightings
        smoother = KeyframeSmoother(
            self._rig.cameras,
            self._config.smoother,
            self._config.landmarks,
            start,
            sigmas.covariance(start.T_world_imu[:3, :3]),
            first.observations,
        )
        keyframes: list[Keyframe] = []
        preintegrated = self._new_preintegration(smoother)
        for sighting in later:
            integrate(preintegrated, sighting.increments)
            if sighting is later[-1] or preintegrated.deltaTij() >= keyframe_interval_s - HALF_TICK_S:
                keyframes.append(Keyframe(sighting.t_ns, preintegrated, sighting.observations, still))
                preintegrated = self._new_preintegration(smoother)
        error_px = smoother.launch(keyframes)
        if error_px is None or (not still and error_px > self._config.motion.max_residual_px):
            return False
        self._smoother = smoother
        self._begin_interval(later[-1].observations)
        self._window.clear()
        return True

    def _new_preintegration(self, smoother: KeyframeSmoother) -> gtsam.PreintegratedCombinedMeasurements:
        return gtsam.PreintegratedCombinedMeasurements(self._params, smoother.gtsam_state[1])

    def _begin_interval(self, observations: Observations) -> None:
        """Start preintegration at the newest keyframe, with its biases."""
        assert self._smoother is not None
        self._preintegrated = self._new_preintegration(self._smoother)
        self._gyro_bias, self._gyro_bias_sigma = self._smoother.state.gyro_bias_rad_s, 0.0
        self._keyframe_ids = observations.ids

    def _is_keyframe(self, observations: Observations) -> bool:
        c, elapsed_s = self._config.keyframe, self._preintegrated.deltaTij()
        if self._stillness.still_for_s >= elapsed_s:
            return elapsed_s >= c.still_interval_s - HALF_TICK_S
        left = np.isin(self._keyframe_ids, observations.ids).mean() if len(self._keyframe_ids) else 0.0
        return elapsed_s >= c.interval_s - HALF_TICK_S or left < c.min_tracked

    def _camera_rotation(self, increments: Increments) -> Array:
        """Return R_cur_prev (3, 3) of the camera over some increments."""
        R_imu_cam = self._T_imu_cam[:3, :3]
        return np.asarray(R_imu_cam.T @ increments.rotation(self._gyro_bias).T @ R_imu_cam)

    def _carried_forward(self, t_ns: int) -> NavState:
        """Return the newest keyframe's state, dead-reckoned to now."""
        assert self._smoother is not None
        start, pim = self._smoother.state, self._preintegrated
        nav, bias = self._smoother.gtsam_state
        now = pim.predict(nav, bias)
        covariance = start.covariance
        if covariance is not None:
            covariance = propagate(
                covariance,
                start.T_world_imu[:3, :3],
                dR=pim.deltaRij().matrix(),
                dp=pim.deltaPij(),
                dv=pim.deltaVij(),
                dt_s=pim.deltaTij(),
                imu=self._rig.imu,
            )
        return NavState(
            t_ns, now.pose().matrix(), now.velocity(), start.gyro_bias_rad_s, start.accel_bias_m_s2, covariance
        )

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
