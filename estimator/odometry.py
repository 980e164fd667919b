"""Visual-inertial odometry: the state of the IMU from cameras and an IMU.

The pipeline of a keyframe-based fixed-lag smoother (Leutenegger et al., IJRR 2015; Qin et al., T-RO 2018): features are
tracked from frame to frame, the IMU is preintegrated between keyframes, and each keyframe adds a state to a window that
is optimized by Gauss-Newton. Between keyframes the newest state is propagated by the IMU. A published state is causal
and is never revised.
"""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from dronevio.estimator.backend.keyframes import KeyframePolicy
from dronevio.estimator.backend.smoother import Keyframe, KeyframeResult, KeyframeSmoother
from dronevio.estimator.calibration.offset_search import OffsetSearch
from dronevio.estimator.calibration.online import OnlineCalibration
from dronevio.estimator.calibration.rotation_offset import RotationOffset
from dronevio.estimator.calibration.unverified import unverified_covariance
from dronevio.estimator.config import VioConfig
from dronevio.estimator.frame_queue import FrameQueue
from dronevio.estimator.frontend.protocol import FrontEnd
from dronevio.estimator.frontend.rig import RigTracker
from dronevio.estimator.imu.forward_propagation import ImuRatePropagator
from dronevio.estimator.imu.noise import ImuNoiseEstimator
from dronevio.estimator.imu.preintegration import PreintegrationParams
from dronevio.estimator.initialization.gauge import Gauge, LastPublished, WorldOrigin
from dronevio.estimator.initialization.initializer import Initializer
from dronevio.estimator.initialization.not_observable import NotObservable
from dronevio.estimator.initialization.zero_velocity import ZeroVelocityDetector
from dronevio.estimator.keyframe_observer import KeyframeObserver, OdometryKeyframe
from dronevio.estimator.monitoring.health import INCONSISTENT, HealthMonitor
from dronevio.estimator.monitoring.image_connection import ImageConnection
from dronevio.estimator.monitoring.plausibility import MotionLimits, reason_against
from dronevio.estimator.monitoring.saturated_rotation import (
    ITERATIONS,
    missing_rotation,
    saturated_sigma_rad,
    with_rotation,
)
from dronevio.estimator.monitoring.stamp_error import StampCorrection
from dronevio.estimator.output import Publisher
from dronevio.estimator.pipeline import MeasurementPipeline
from dronevio.estimator.propagator import Propagator, propagated, velocity_may_be_zero
from dronevio.estimator.threads import single_threaded
from dronevio.estimator.types import Calibration, FramePacket, Observations
from dronevio.models.imu import ImuSamples
from dronevio.models.measurement_checks import check_imu, check_rig
from dronevio.models.rig import Rig
from dronevio.models.state import CameraFrame, Estimate, Health, HealthReport, NavState

Array = npt.NDArray[np.float64]


TIME_OFFSET_FOUND = "time offset of camera and IMU estimated from their rotation:"
"""Beginning of the event at which another time offset is adopted."""
WRONG_TIME_OFFSET = "the time offset of camera and IMU is another one"
"""Reason of a loss at which another time offset is adopted."""
MAX_EXTRAPOLATION_S = 0.01
"""Longest time over which a state is extrapolated without its covariance [s]: the error of third order is .01 mm."""
EXCESSIVE_NOISE = (
    "vibration makes the IMU many times noisier than its data sheet: check its mount, its range and filter, and that no"
    " samples are left out without averaging"
)
"""Cause that is stated once, where `ImuNoiseEstimator.is_excessive` or `is_aliased`."""

IMPLAUSIBLE_CALIBRATION = (
    "images and calibration do not belong together: check the camera-IMU extrinsics, the lens model, the order of the"
    " cameras, and the time stamps"
)
"""Cause that is stated after a correction beyond `CalibrationConfig.max_correction_sigmas`."""


@dataclass(frozen=True, eq=False)
class Initializing:
    """The state of the odometry without an estimate: before the first initialization, or after a loss."""

    initializer: Initializer
    """Collects frames until the state is observable."""
    is_trusted: bool = True
    """Whether the next state counts as consistent from its beginning: unless an inconsistent one was lost before."""


@dataclass(frozen=True, eq=False)
class Tracking:
    """The state of the odometry with an estimate."""

    smoother: KeyframeSmoother
    """Estimates the states of the keyframes."""
    monitor: HealthMonitor
    """Assesses the estimate."""
    propagator: Propagator
    """Predicts the state since the newest keyframe."""


class VisualInertialOdometry:
    """Estimates the motion of a rig from measurements that are pushed into it, in time order.

    Example:
        >>> vio = VisualInertialOdometry(rig)
        >>> for measurement in measurements(recording):
        ...     if isinstance(measurement, ImuSamples):
        ...         vio.add_imu(measurement)
        ...     else:
        ...         estimate = vio.add_frame(measurement)
    """

    def __init__(
        self,
        rig: Rig,
        config: VioConfig | None = None,
        front_end: FrontEnd | None = None,
        observer: KeyframeObserver | None = None,
    ) -> None:
        """Begin before the first measurement.

        Args:
            rig: The calibration of the cameras and the IMU.
            config: Settings.
            front_end: Detects and tracks the features; by default in the images of all cameras.
            observer: Receives the keyframes; it does not change the estimates.

        Raises:
            ConfigError: The rig has no camera.
        """
        check_rig(rig)
        self._config = c = config or VioConfig()
        self._rig, self._imu = rig, rig.imu
        self._noise = ImuNoiseEstimator(rig.imu, c.preintegration, c.noise, c.gravity_m_s2)
        self._online_calibration = OnlineCalibration(rig, c.calibration, c.gravity_m_s2)
        self._pipeline = MeasurementPipeline(rig.imu, front_end or RigTracker(rig, c.tracker), c.gravity_m_s2)
        self._stamps = StampCorrection(rig.cameras[0].rate_hz, c.stamps)
        self._zero_velocity = ZeroVelocityDetector(c.zero_velocity, c.gravity_m_s2)
        self._keyframe_policy = KeyframePolicy(c.keyframe)
        self._publisher = Publisher(c.initialization, rig.imu.rate_hz)
        self._imu_rate = ImuRatePropagator(rig.imu, c.preintegration, c.gravity_m_s2)
        self._observer = observer
        self._connection = ImageConnection()
        self._queue, self._offset_search = FrameQueue(), OffsetSearch()
        self._limits: MotionLimits | None = None  # of the next published state; None before the first, or after a loss
        self._is_noise_stated = False  # whether `EXCESSIVE_NOISE` has been stated
        self._estimate: Estimate | None = None  # of the last processed frame, at its time by the clock of the IMU
        self._frame: CameraFrame | None = None  # the last processed one
        self._newest_ns: int | None = None  # its time by the clock of the IMU
        self._origin = WorldOrigin(
            c.initialization.gyro_bias_sigma_rad_s, c.initialization.dynamic.accel_bias_sigma_m_s2
        )
        self._gauge: Gauge = self._origin
        self._state: Initializing | Tracking = Initializing(self._initializer(is_trusted=True))
        self._restart: Initializer | None = None  # collects frames since no feature connected images
        self._origin_m = np.zeros(3)  # position at the last initialization

    def add_imu(self, samples: ImuSamples) -> None:
        """Add the IMU samples since the last call.

        Raises:
            ConfigError: A sample is not finite, or not later than the last one.
        """
        check_imu(samples)
        used = self._pipeline.add_imu(samples)
        self._noise.add_imu(used)
        self._imu_rate.push(used)

    def state_at(self, t_ns: int) -> NavState | None:
        """Return the newest state, propagated by the IMU to its last sample not after a time; see `Estimator`."""
        return self._imu_rate.state_at(t_ns)

    @property
    def imu_noise(self) -> PreintegrationParams:
        """The noise of the IMU as it has been estimated so far."""
        return self._noise.params

    @single_threaded()
    def add_frame(self, frame: CameraFrame) -> Estimate:
        """Add a frame and return the estimate at its time stamp.

        Meanwhile, linear algebra and OpenCV use one thread; see `single_threaded`.

        Raises:
            ConfigError: The frame is not later than the last one, or an image does not fit its camera.
        """
        estimates = [self._process(due) for due in self._queue.add(frame)]
        events = tuple(event for estimate in estimates for event in estimate.events)
        newest = estimates[-1] if estimates else self._estimate
        assert newest is not None  # the first frame is processed at once
        self._estimate = newest
        estimate = self._at_stamp(replace(newest, events=events), frame)
        if estimate.state is not None:
            self._imu_rate.correct(estimate)
        else:
            self._imu_rate.skip(estimate.t_ns)
        return estimate

    @property
    def time_offset_s(self) -> float:
        """The time offset of camera and IMU in use, t_imu = t_cam + offset [s]."""
        return self._calibration.rig.time_offset_s + self._calibration.time_offset_correction_s

    def _process(self, frame: CameraFrame) -> Estimate:
        """Return the estimate of a frame at its time by the clock of the IMU."""
        delay_s = self._stamps.add_stamp(frame.t_ns)
        packet = self._pipeline.process(
            frame, self._calibration, *self._gyro_bias, delay_s, moves=self._moves, contradicted=self._is_contradicted
        )
        self._frame, self._newest_ns = frame, packet.t_ns
        features = packet.observations if packet.has_image else None
        self._zero_velocity.update(packet.t_ns, features, packet.increments)
        self._gauge = self._gauge.propagated(packet.increments)
        if self._limits is not None:
            self._limits = self._limits.after(packet.increments, self._config.gravity_m_s2)
        self._offset_search.add(packet)
        match self._state:
            case Initializing():
                estimate = self._initialize(self._state, packet)
            case Tracking():
                estimate = self._track(self._state, packet)
        if packet.has_image:
            self._connection.end_frame(packet.observations)
        offset = self._offset_search.offset(self._calibration.Ts_imu_cam) if self._is_contradicted else None
        if offset is not None:
            estimate = self._adopted(offset, packet, estimate)
        return estimate

    def _at_stamp(self, estimate: Estimate, frame: CameraFrame) -> Estimate:
        """Return the estimate of the last processed frame at the time stamp of the newest one."""
        state, later_s = estimate.state, (frame.t_ns - estimate.t_ns) * 1e-9
        if state is None or later_s <= MAX_EXTRAPOLATION_S:
            return self._pipeline.at_stamp(estimate, frame)
        state = propagated(state, self._pipeline.since_frame(later_s), self._noise.params, self._imu)
        return replace(estimate, t_ns=frame.t_ns, state=replace(state, t_ns=frame.t_ns))

    @property
    def _moves(self) -> bool:
        """Whether the velocity at the last frame was certainly not zero."""
        state = None if self._estimate is None else self._estimate.state
        return state is not None and not velocity_may_be_zero(state)

    @property
    def _is_contradicted(self) -> bool:
        """Whether images and IMU contradict each other."""
        match self._state:
            case Initializing():
                return self._state.initializer.is_contradicted
            case Tracking():
                return not self._state.monitor.is_trusted

    def _adopted(self, found: RotationOffset, packet: FramePacket, estimate: Estimate) -> Estimate:
        """Begin anew with another time offset of camera and IMU, and return the estimate of the frame with an event."""
        before_ms, sigma_ms = 1e3 * self.time_offset_s, 1e3 * found.sigma_s
        offset_s = self.time_offset_s + found.offset_s
        event = f"{TIME_OFFSET_FOUND} {1e3 * offset_s:+.1f} ± {sigma_ms:.1f} ms instead of {before_ms:+.1f} ms"
        if isinstance(self._state, Tracking):
            report = estimate.health_report or HealthReport(Health.LOST, "")
            estimate = self._lose(self._state, packet, replace(report, health=Health.LOST, reason=WRONG_TIME_OFFSET))
        self._begin_calibration(offset_s)
        self._queue.shift(offset_s - self._rig.time_offset_s)
        self._restart = None
        self._publisher.withdraw_causes()
        self._state = Initializing(self._initializer(is_trusted=False), is_trusted=True)
        return replace(estimate, events=(*estimate.events, event))

    def _begin_calibration(self, offset_s: float) -> None:
        """Begin with the given calibration, without corrections, and a time offset of camera and IMU [s]."""
        c, rig = self._config, replace(self._rig, time_offset_s=offset_s)
        self._online_calibration = OnlineCalibration(rig, c.calibration, c.gravity_m_s2)
        self._noise.set_gravity(c.gravity_m_s2)
        self._imu_rate.set_gravity(c.gravity_m_s2)
        self._offset_search = OffsetSearch()

    def _initialize(self, state: Initializing, packet: FramePacket) -> Estimate:
        """Initialize the estimate if it is observable."""
        initializer, stationary_s = state.initializer, self._zero_velocity.stationary_s
        if initializer.needs_features(packet):
            packet = self._pipeline.replenish(packet, self._calibration)
        smoother = initializer.add(packet, stationary_s, self._calibration, self._gauge, self._noise)
        if isinstance(smoother, NotObservable):
            return self._publisher.not_initialized(packet, smoother)
        offset = None if stationary_s else self._offset_search.offset(self._calibration.Ts_imu_cam, at_once=True)
        if offset is not None:
            estimate = self._publisher.without_state(packet, WRONG_TIME_OFFSET)
            return self._adopted(offset, packet, estimate)
        self._origin_m = smoother.state.T_world_imu[:3, 3]
        c, is_trusted = self._config, state.is_trusted and not self._publisher.has_stated_cause
        pixel_sigma = c.smoother.image_sigma_px(len(self._calibration.rig.cameras))
        monitor = HealthMonitor(self._imu, c.health, pixel_sigma, is_trusted=is_trusted)
        if not stationary_s:
            monitor.begin_in_motion(smoother.state)
        self._state = self._tracking(smoother, monitor, packet.observations)
        report = monitor.assess(packet.observations, smoother.state, stationary_s > 0.0, self._calibration)
        return self._publish(packet, smoother.state, report)

    def _track(self, tracking: Tracking, packet: FramePacket) -> Estimate:
        """Propagate the newest state to a frame, or make the frame a keyframe."""
        if not tracking.monitor.is_disconnected(packet.t_ns):
            self._restart = None
        if self._restart is not None:
            self._restart.collect(packet)
        stationary_s = self._zero_velocity.stationary_s
        stationary = tracking.propagator.would_be_stationary(packet, stationary_s)
        events: tuple[str, ...] = ()
        if not stationary:
            tracking, events = self._end_stationary(tracking)
        propagator = tracking.propagator
        packet = self._with_missing_rotation(tracking, packet)
        propagator.add(packet, stationary)
        predicted = propagator.state_at(packet.t_ns)
        if self._stamps.is_irregular:
            innovation = tracking.monitor.innovation(packet.observations, predicted, self._calibration)
            self._stamps.compare(innovation, predicted, self._pipeline.angular_velocity_rad_s)
        report = tracking.monitor.assess(
            packet.observations, predicted, stationary, self._calibration, has_image=packet.has_image
        )
        if report.health is Health.LOST:
            return self._lose(tracking, packet, report)
        frame_s = packet.increments.duration_s
        due = propagator.is_keyframe_due(frame_s, stationary_s, packet.observations, report.innovation_px)
        if not (due and packet.has_image):
            tracking.smoother.complete()
            self._online_calibration.step()
            return self._publish(packet, predicted, report, events)
        packet = self._pipeline.replenish(packet, self._calibration)
        tracking, keyframe_events = self._add_keyframe(tracking, packet, stationary)
        smoother, events = tracking.smoother, ("keyframe", *events, *keyframe_events)
        return self._publish(packet, smoother.state, report, events, smoother.landmarks)

    def _with_missing_rotation(self, tracking: Tracking, packet: FramePacket) -> FramePacket:
        """Return a frame with the rotation that a saturated gyroscope has not measured, if the image shows it."""
        measured = packet.increments
        sigma_rad = saturated_sigma_rad(measured)
        if not sigma_rad.any():
            return packet
        for _ in range(ITERATIONS):
            predicted = tracking.propagator.predicted(packet)
            innovation = tracking.monitor.innovation(packet.observations, predicted, self._calibration)
            found = missing_rotation(innovation, sigma_rad)
            if found is None:
                break
            packet = replace(packet, increments=with_rotation(packet.increments, measured, *found))
        return packet

    def _end_stationary(self, tracking: Tracking) -> tuple[Tracking, tuple[str, ...]]:
        """Make the last certainly stationary frame a keyframe, if there is one since the last keyframe."""
        settled, recent = tracking.propagator.end_stationary()
        if settled is None:
            return tracking, ()
        tracking, events = self._add_keyframe(tracking, settled, stationary=True)
        for packet in recent:
            tracking.propagator.add(packet)
        return tracking, events

    def _add_keyframe(
        self, tracking: Tracking, packet: FramePacket, stationary: bool
    ) -> tuple[Tracking, tuple[str, ...]]:
        """Add a keyframe at the end of the propagation, begin the next one there, and return events."""
        smoother, propagator = tracking.smoother, tracking.propagator
        is_connected = packet.t_ns != self._newest_ns or self._connection.add_keyframe(packet.observations)
        if not is_connected:
            self._restart = self._initializer(tracking.monitor.is_trusted)
            self._restart.collect(packet)
            tracking.monitor.disconnect(packet.t_ns)
        rate = packet.increments.angular_velocity(smoother.state.gyro_bias_rad_s)
        keyframe = Keyframe(packet.t_ns, propagator.preintegrated, packet.observations, stationary, rate)
        result = smoother.add_keyframe(keyframe, report_marginalized=self._observer is not None)
        self._noise.update(result.imu_variance)
        self._pipeline.discard(result.rejected)
        events = result.events
        self._report_keyframe(smoother, packet, result, is_connected)
        before, was_plausible = self._with_unverified_calibration(smoother.state), self._online_calibration.is_plausible
        if self._calibrate(tracking, packet, result, stationary):
            smoother, self._offset_search = self._recalibrated(smoother), OffsetSearch()
            tracking.monitor.correct(before, smoother.state)
            gravity_m_s2 = self._config.gravity_m_s2 + self._calibration.gravity_correction_m_s2
            self._noise.set_gravity(gravity_m_s2)
            self._imu_rate.set_gravity(gravity_m_s2)
            events = (*events, f"calibration corrected: {self._online_calibration.applied}")
            if was_plausible and not self._online_calibration.is_plausible:
                events = (*events, f"probable cause: {IMPLAUSIBLE_CALIBRATION}")
        self._state = tracking = self._tracking(smoother, tracking.monitor, packet.observations)
        return tracking, events

    def _report_keyframe(
        self, smoother: KeyframeSmoother, packet: FramePacket, result: KeyframeResult, is_connected: bool
    ) -> None:
        """Report a new keyframe, and the one that leaves the window, to the observer."""
        if self._observer is None:
            return
        if result.marginalized is not None:
            self._observer.marginalized(result.marginalized)
        observations = packet.observations.without(result.rejected)
        landmarks = smoother.triangulated_landmarks
        ids, rows, _ = np.intersect1d(landmarks.ids, observations.ids, return_indices=True)
        self._observer.added(
            OdometryKeyframe(
                packet.t_ns,
                smoother.state,
                observations,
                self._calibration,
                packet.t_ns == self._newest_ns,
                is_connected,
                smoother.keyframe_times_ns,
                ids,
                landmarks.points[rows],
                self._frame if packet.t_ns == self._newest_ns else None,
            )
        )

    def _report_keyframe_estimates(self, smoother: KeyframeSmoother) -> None:
        """Report all keyframes but the newest to the observer, since the window ends."""
        if self._observer is not None:
            for estimate in smoother.keyframe_estimates():
                self._observer.marginalized(estimate)

    def _calibrate(self, tracking: Tracking, packet: FramePacket, result: KeyframeResult, stationary: bool) -> bool:
        """Add a keyframe to the online calibration and return whether the calibration has changed."""
        propagator = tracking.propagator
        if result.events or propagator.is_degraded:
            self._online_calibration.restart()
        if propagator.is_degraded:
            return False
        observations = packet.observations.without(result.rejected)
        angular_velocity = self._pipeline.angular_velocity_rad_s
        return self._online_calibration.add(
            tracking.smoother.state, angular_velocity, propagator.preintegrated, observations, stationary
        )

    def _recalibrated(self, smoother: KeyframeSmoother) -> KeyframeSmoother:
        """Return the smoother with the calibration in use.

        It keeps its window, unless the correction determines the newest state by itself, or the window cannot be kept.
        """
        inflation, state = self._online_calibration.covariance_inflation, self._online_calibration.corrected_state
        if state is None and smoother.recalibrate(self._calibration, inflation):
            return smoother
        self._report_keyframe_estimates(smoother)
        return smoother.restarted(self._calibration, inflation, state)

    def _lose(self, tracking: Tracking, packet: FramePacket, report: HealthReport) -> Estimate:
        """Discard the estimate and begin another initialization, which continues from the last published pose.

        If the images show another place, it uses all frames that do.
        """
        monitor = tracking.monitor
        self._limits = None
        initializer, self._restart = self._restart or self._initializer(monitor.is_trusted), None
        self._state = Initializing(initializer, monitor.is_trusted)
        if self._online_calibration.is_plausible:
            self._online_calibration.restart()
        else:  # its corrections are not, either
            self._begin_calibration(self._calibration.rig.time_offset_s)
        if self._observer is not None:
            self._observer.lost()
        return self._publisher.lost(packet, report)

    def _publish(
        self,
        packet: FramePacket,
        state: NavState,
        report: HealthReport,
        events: tuple[str, ...] = (),
        landmarks_world: Array | None = None,
    ) -> Estimate:
        """Return the estimate of a frame, and keep its pose as the gauge after a loss if landmarks agree with it."""
        report = self._with_corrected_calibration(report)
        implausible = reason_against(state, self._limits)
        if implausible is not None and isinstance(self._state, Tracking):
            return self._lose(self._state, packet, replace(report, health=Health.LOST, reason=implausible))
        estimate = self._publisher.estimate(packet, state, report, events, landmarks_world)
        if estimate.state is None:
            return estimate
        self._limits = MotionLimits(state)
        published = self._with_unverified_calibration(estimate.state)
        if (report.innovation_px or 0.0) <= self._config.health.max_innovation_px:
            self._gauge = LastPublished.of(published)
        return self._with_noise(replace(estimate, state=published))

    def _with_noise(self, estimate: Estimate) -> Estimate:
        """Return an estimate whose health is not tracking if vibration is aliased, with the cause of the noise, once.

        Such an estimate is no contradiction, for which a first state is withheld; events of withheld states are lost.
        """
        report = estimate.health_report
        if self._noise.is_aliased and estimate.health is Health.TRACKING and report is not None:
            report = replace(report, health=Health.INERTIAL_ONLY, reason=EXCESSIVE_NOISE)
            estimate = replace(estimate, health=report.health, health_report=report)
        if self._is_noise_stated or not (self._noise.is_excessive or self._noise.is_aliased):
            return estimate
        self._is_noise_stated = True
        return replace(estimate, events=(*estimate.events, f"probable cause: {EXCESSIVE_NOISE}"))

    def _with_corrected_calibration(self, report: HealthReport) -> HealthReport:
        """Return a health that is not tracking if a correction of the calibration contradicts it."""
        if report.health is not Health.TRACKING:
            return report
        if not self._online_calibration.is_plausible:
            return replace(report, health=Health.INERTIAL_ONLY, reason=IMPLAUSIBLE_CALIBRATION)
        if isinstance(self._state, Tracking) and not self._state.monitor.is_trusted:
            return replace(report, health=Health.INERTIAL_ONLY, reason=INCONSISTENT)
        return report

    def _with_unverified_calibration(self, state: NavState) -> NavState:
        """Return a state with the uncertainty of a calibration that has not been verified."""
        online = self._online_calibration
        if online.is_verified or state.covariance is None:
            return state
        displacement_m = state.T_world_imu[:3, 3] - self._origin_m
        rate, sigmas = self._pipeline.angular_velocity_rad_s, online.newest_sigmas
        added = unverified_covariance(
            state, displacement_m, rate, sigmas.time_offset_s, float(sigmas.rotation_rad[0].max())
        )
        return replace(state, covariance=state.covariance + added)

    def _initializer(self, is_trusted: bool) -> Initializer:
        """Return an initializer, which knows the biases of an estimate that is trusted."""
        c, known = self._config, self._gauge if is_trusted else self._origin
        return Initializer(c.initialization, c.smoother, c.landmarks, self._keyframe_policy, known)

    def _tracking(self, smoother: KeyframeSmoother, monitor: HealthMonitor, observations: Observations) -> Tracking:
        """Return the tracking state at the smoother's newest keyframe."""
        monitor.set_reference(
            smoother.state,
            smoother.triangulated_landmarks,
            smoother.image_variance,
            self._noise.densities,
            self._noise.measured,
        )
        propagator = Propagator(self._noise.params, self._imu, self._keyframe_policy, smoother, observations)
        return Tracking(smoother, monitor, propagator)

    @property
    def _calibration(self) -> Calibration:
        return self._online_calibration.calibration

    @property
    def _gyro_bias(self) -> tuple[Array, float]:
        """The estimated gyroscope bias (3,) and its standard deviation [rad/s]."""
        if isinstance(self._state, Initializing):
            known = self._state.initializer.gyro_bias
            return known.mean, known.sigma
        return self._state.smoother.state.gyro_bias_rad_s, 0.0
