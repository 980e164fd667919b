"""Visual-inertial odometry: a camera and an IMU in, where the IMU is out.

The pipeline of a keyframe-based fixed-lag smoother (Leutenegger et al., IJRR 2015; Qin et al., T-RO 2018): corners are
followed from frame to frame, the IMU is preintegrated between keyframes, and every keyframe adds a state to a window
that GTSAM optimises. Between keyframes the newest state is carried forward by the IMU. What is returned for a frame is
never revised.
"""

from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from dronevio.estimator.calibration import CalibrationConfig, OnlineCalibration
from dronevio.estimator.frontend import FrontEnd, Observations
from dronevio.estimator.health import HealthConfig, HealthMonitor
from dronevio.estimator.inertial import ImuBuffer, Increments, InertialConfig, preintegration_params
from dronevio.estimator.initialiser import Initialiser, InitialiserConfig
from dronevio.estimator.keyframes import KeyframeConfig, KeyframePolicy
from dronevio.estimator.landmarks import LandmarkConfig
from dronevio.estimator.propagation import Propagation, settled_and_recent
from dronevio.estimator.rig_tracker import RigTracker
from dronevio.estimator.smoother import KeyframeResult, KeyframeSmoother, SmootherConfig
from dronevio.estimator.start import NotObservable
from dronevio.estimator.start_in_motion import Sighting
from dronevio.estimator.stillness import StillnessConfig, StillnessDetector
from dronevio.estimator.timing import FrameTimes
from dronevio.estimator.tracker import TrackerConfig
from dronevio.models.errors import ConfigError
from dronevio.models.imu import ImuSamples
from dronevio.models.rig import Rig
from dronevio.models.state import CameraFrame, Estimate, FeatureTracks, Health, HealthReport, NavState

Array = npt.NDArray[np.float64]

IMU_GAP = 4.0
"""Intervals of the IMU that have to pass without a sample to be worth an event."""


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
    calibration: CalibrationConfig = field(default_factory=CalibrationConfig)
    health: HealthConfig = field(default_factory=HealthConfig)


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
        c = self._config
        self._params = preintegration_params(rig.imu, c.inertial)
        self._buffer = ImuBuffer()
        self._times = FrameTimes(rig)
        self._calibration = OnlineCalibration(rig, c.calibration)
        self._front_end = front_end or RigTracker(rig, c.tracker)
        self._stillness = StillnessDetector(c.stillness)
        self._keyframes = KeyframePolicy(c.keyframe)
        self._initialiser = Initialiser(rig.cameras, c.start, self._keyframes, self._params, self._new_smoother)
        self._smoother: KeyframeSmoother | None = None
        self._propagation: Propagation  # these two: since there is a smoother
        self._monitor: HealthMonitor
        self._waiting = Health.INITIALISING  # what it is called to be without a state
        self._rest: list[Sighting]  # frames since the newest keyframe, if the drone has not moved since
        self._is_told = False  # whether the state is certain enough to be told
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
        observations = self._sighted(self._front_end.track(frame, rotation, float(rotation_sigma)))
        self._stillness.update(t_ns, observations, increments)
        self._initialiser.origin.turn(increments)
        sighting = Sighting(t_ns, increments, observations)
        estimate = self._start(sighting) if self._smoother is None else self._go_on(self._smoother, sighting)
        if increments.longest_s * self._rig.imu.rate_hz > IMU_GAP:
            estimate = replace(estimate, events=(*estimate.events, f"no IMU for {increments.longest_s:.2f} s"))
        return self._times.stamped(estimate, frame.t_ns)

    def _start(self, sighting: Sighting) -> Estimate:
        """Start if that is possible by now."""
        if self._initialiser.wants_features(sighting):
            sighting = replace(sighting, observations=self._sighted(self._front_end.replenish()))
        started = self._initialiser.add(sighting, self._stillness.still_for_s)
        if isinstance(started, NotObservable):
            return self._not_told(sighting, str(started))
        self._smoother, self._is_told = started, False
        self._monitor = HealthMonitor(self._rig, self._config.health, self._config.smoother.pixel_sigma)
        self._begin_interval(started, sighting.observations)
        report = self._monitor.judge(sighting.observations, started.state, self._stillness.still_for_s > 0.0)
        return self._told(sighting, started.state, report)

    def _go_on(self, smoother: KeyframeSmoother, sighting: Sighting) -> Estimate:
        """Carry the newest state forward to a frame, or make the frame a keyframe."""
        elapsed_s = self._propagation.elapsed_s + float(sighting.increments.dt_s.sum())
        still = self._keyframes.is_still(elapsed_s, self._stillness.still_for_s)
        events = () if still else self._end_rest(smoother)
        self._propagation.add(sighting.increments)
        elapsed_s = self._propagation.elapsed_s
        if still:
            self._rest.append(sighting)
        predicted = self._propagation.state_at(sighting.t_ns, self._rest)
        report = self._monitor.judge(sighting.observations, predicted, still)
        if report.state is Health.LOST:
            return self._lose(sighting, report)
        still_for_s, seen = self._stillness.still_for_s, sighting.observations
        if not self._keyframes.is_due(elapsed_s, still_for_s, seen, report.innovation_px):
            return self._told(sighting, predicted, report, events)
        sighting = replace(sighting, observations=self._sighted(self._front_end.replenish()))
        events = ("keyframe", *events, *self._add_keyframe(smoother, sighting, still))
        return self._told(sighting, smoother.state, report, events, smoother.landmarks)

    def _end_rest(self, smoother: KeyframeSmoother) -> tuple[str, ...]:
        """Keep what the rest since the newest keyframe tells, if there was one: its last settled frame is a keyframe.

        Returns:
            What happened.
        """
        settled, recent = settled_and_recent(self._rest)
        self._rest = []
        if not settled:
            return ()
        self._propagation.restart([sighting.increments for sighting in settled])
        events = self._add_keyframe(smoother, settled[-1], still=True)
        for sighting in recent:
            self._propagation.add(sighting.increments)
        return events

    def _add_keyframe(self, smoother: KeyframeSmoother, sighting: Sighting, still: bool) -> tuple[str, ...]:
        """Add a keyframe where the propagation has come to, and begin again from it; return what happened."""
        result = smoother.add_keyframe(sighting.t_ns, self._propagation.preintegrated, sighting.observations, still)
        self._front_end.discard(result.rejected)
        events = (*result.events, *self._calibrate(smoother, sighting, result))
        self._begin_interval(smoother, sighting.observations)
        return events

    def _calibrate(self, smoother: KeyframeSmoother, sighting: Sighting, result: KeyframeResult) -> tuple[str, ...]:
        """Learn from a keyframe what of the calibration is wrong, and go on with what is right; say so."""
        calibration, times = self._calibration, self._times
        if result.events:
            calibration.restart()
        seen = sighting.observations.without(result.rejected)
        if not calibration.add(smoother.state, times.rate_rad_s, self._propagation.preintegrated, seen):
            return ()
        self._rig = calibration.rig
        times.late_s = calibration.applied.time_offset_s
        self._monitor.recalibrate(self._rig)
        self._initialiser.recalibrate(self._rig.cameras)
        smoother.recalibrate(self._rig.cameras, calibration.doubt)
        return (f"calibration corrected: {calibration.applied}",)

    def _sighted(self, seen: Observations) -> Observations:
        """Return what a frame shows by the best calibration, at the frame's time."""
        return self._times.moved(self._calibration.corrected(seen))

    def _lose(self, sighting: Sighting, report: HealthReport) -> Estimate:
        """Give the estimate up, and look for a new start, from where the drone was last believed to be."""
        self._smoother, self._waiting = None, Health.LOST
        self._initialiser.begin_anew()
        self._calibration.restart()
        return self._not_told(sighting, report.reason, report, (f"lost: {report.reason}",))

    def _new_smoother(self, start: NavState, covariance: Array, observations: Observations) -> KeyframeSmoother:
        c = self._config
        return KeyframeSmoother(self._rig.cameras, c.smoother, c.landmarks, start, covariance, observations)

    def _begin_interval(self, smoother: KeyframeSmoother, observations: Observations) -> None:
        """Start preintegration at the newest keyframe, with its biases."""
        self._propagation = Propagation(self._params, self._rig.imu, smoother.state, smoother.gtsam_state)
        self._monitor.hold(smoother.state, smoother.known_landmarks)
        self._keyframes.begin(observations)
        self._rest = []

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

    def _told(
        self,
        sighting: Sighting,
        state: NavState,
        report: HealthReport,
        events: tuple[str, ...] = (),
        landmarks_world: Array | None = None,
    ) -> Estimate:
        """Return what is known at a frame, if it is certain enough to be told."""
        if not self._is_told:
            doubt = self._initialiser.doubt(state)
            if doubt is not None:
                return self._not_told(sighting, str(doubt), report)
            self._is_told = True
            events = ("initialised" if self._waiting is Health.INITIALISING else "recovered", *events)
        if (report.innovation_px or 0.0) <= self._config.health.max_innovation_px:
            self._initialiser.believe(state)
        tracks = _feature_tracks(sighting.observations)
        return Estimate(sighting.t_ns, report.state, state, tracks, landmarks_world, events, report)

    def _not_told(
        self, sighting: Sighting, why: str, report: HealthReport | None = None, events: tuple[str, ...] = ()
    ) -> Estimate:
        """Return an estimate without a state, and why there is none."""
        known = report or HealthReport(self._waiting, why, tracks=len(sighting.observations))
        report = replace(known, state=self._waiting, reason=why)
        tracks = _feature_tracks(sighting.observations)
        return Estimate(sighting.t_ns, self._waiting, None, tracks, events=events, health_report=report)


def _feature_tracks(observations: Observations) -> FeatureTracks:
    """Return the features that the main camera follows."""
    main = observations.camera == 0
    return FeatureTracks(observations.ids[main], observations.pixels[main], observations.ages[main])
