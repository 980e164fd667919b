"""Visual-inertial odometry: the state of the IMU from cameras and an IMU.

A keyframe-based fixed-lag smoother (Leutenegger et al., IJRR 2015; Qin et al., T-RO 2018): features are tracked from
frame to frame, the IMU is preintegrated between keyframes, and each keyframe adds a state to a window that is optimized
by Gauss-Newton. Between keyframes the newest state is propagated by the IMU. A published state is causal and is never
revised.
"""

from dataclasses import replace

from dronevio.estimator.backend.smoother import Keyframe
from dronevio.estimator.config import VioConfig
from dronevio.estimator.frontend.protocol import FrontEnd
from dronevio.estimator.imu.buffer import Increments
from dronevio.estimator.imu.preintegration import PreintegrationParams
from dronevio.estimator.keyframe_observer import KeyframeObserver, odometry_keyframe
from dronevio.estimator.monitoring.saturated_rotation import with_rotation_by_image
from dronevio.estimator.odometry_parts import OdometryParts
from dronevio.estimator.odometry_state import NO_ESTIMATE, Initializing, OdometryState, Tracking
from dronevio.estimator.threads import single_threaded
from dronevio.estimator.transitions import initialize, lose, publish, with_offset
from dronevio.estimator.types import ExpectedFeatures, FramePacket
from dronevio.models.imu import ImuSamples
from dronevio.models.measurement_checks import check_imu, check_rig
from dronevio.models.rig import Rig
from dronevio.models.state import CameraFrame, Estimate, NavState


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
        self._parts = OdometryParts.of(rig, config or VioConfig(), front_end, observer)
        origin = self._parts.origin
        self._state = OdometryState(Initializing(self._parts.initializer(origin)), origin, NO_ESTIMATE)

    def add_imu(self, samples: ImuSamples) -> None:
        """Add the IMU samples since the last call.

        Raises:
            ConfigError: A sample is not finite, or not later than the last one.
        """
        check_imu(samples)
        self._parts.samples.add(samples)
        self._parts.imu_rate.push(samples)

    @single_threaded()
    def add_frame(self, frame: CameraFrame) -> Estimate:
        """Add a frame and return the estimate at its time stamp.

        Meanwhile, linear algebra and OpenCV use one thread; see `single_threaded`.

        Raises:
            ConfigError: The frame is not later than the last one, or an image does not fit its camera.
        """
        parts = self._parts
        # IMU samples up to the end of the exposure
        samples = parts.samples.take(frame)
        if samples is not None:
            parts.noise.add_imu(parts.pipeline.add_imu(samples))
        # Estimates of the frames up to whose exposure the IMU samples have come
        events = tuple(event for due in parts.queue.add(frame) for event in self._process(due).events)
        # The newest of them at the time stamp of the frame, by the clock of the cameras
        newest = replace(self._state.estimate, events=events, track=self._state.phase.track)
        estimate = parts.pipeline.published(newest, frame, parts.calibration, parts.noise.params)
        # States between frames continue from it
        if estimate.state is not None:
            parts.imu_rate.correct(estimate)
        else:
            parts.imu_rate.skip(estimate.t_ns)
        return estimate

    def state_at(self, t_ns: int) -> NavState | None:
        """Return the newest state, propagated by the IMU to its last sample not after a time; see `Estimator`."""
        return self._parts.imu_rate.state_at(t_ns)

    @property
    def imu_noise(self) -> PreintegrationParams:
        """The noise of the IMU as it has been estimated so far."""
        return self._parts.noise.params

    @property
    def time_offset_s(self) -> float:
        """The time offset of camera and IMU in use, t_imu = t_cam + offset [s]."""
        return self._parts.calibrator.time_offset_s

    def _process(self, frame: CameraFrame) -> Estimate:
        """Return the estimate of a frame at its time by the clock of the IMU."""
        parts, last, phase = self._parts, self._state, self._state.phase
        # Measurements: tracked features, and the IMU since the frame before
        packet = parts.pipeline.process(
            frame,
            parts.calibration,
            phase.gyro_bias,
            moves=last.moves,
            contradicted=phase.is_contradicted,
            since_keyframe_s=last.since_keyframe_s,
            expected=self._expected if isinstance(phase, Tracking) else None,
        )
        parts.calibrator.add_frame(packet)
        # Estimate
        state = last.propagated(packet.increments, parts.config.gravity_m_s2)
        if isinstance(state.phase, Tracking):
            state = self._track(state, state.phase, packet, frame)
        else:
            state = initialize(parts, state, state.phase, packet)
        # Another time offset of camera and IMU, if they contradict each other
        offset = parts.calibrator.other_offset() if state.phase.searches_offset else None
        self._state = state if offset is None else with_offset(parts, state, packet, offset)
        return self._state.estimate

    def _track(
        self, state: OdometryState, tracking: Tracking, packet: FramePacket, frame: CameraFrame
    ) -> OdometryState:
        """Propagate the newest state to a frame, or make the frame a keyframe."""
        parts, monitor, events = self._parts, tracking.monitor, tuple[str, ...]()
        # Images of another place: an initialization would begin with them
        if not monitor.is_disconnected(packet.t_ns):
            tracking = replace(tracking, restart=None)
        elif tracking.restart is not None:
            tracking.restart.collect(packet)
        # Zero velocity; at the end of a rest, its last frame becomes a keyframe
        stationary = tracking.propagator.would_be_stationary(packet)
        if not stationary:
            tracking, events = self._end_stationary(tracking)
        # Prediction by the IMU, with the rotation that a saturated gyroscope lacks
        propagator = tracking.propagator
        increments = with_rotation_by_image(
            packet.increments,
            lambda increments: monitor.innovation(
                packet.observations, propagator.predicted(packet.t_ns, increments), parts.calibration
            ),
        )
        packet = replace(packet, increments=increments)
        propagator.add(packet, stationary)
        predicted = propagator.state_at(packet.t_ns)
        # Innovation: errors of the time stamp, and health
        observations, calibration = packet.observations, parts.calibration
        parts.pipeline.compare_stamps(lambda: monitor.innovation(observations, predicted, calibration), predicted)
        assessment = monitor.assess(
            observations,
            predicted,
            stationary,
            calibration,
            has_image=packet.has_image,
            is_left_out=packet.is_left_out,
        )
        if assessment.loss is not None:
            return lose(parts, state, tracking, packet, assessment.loss, assessment)
        # Update by the window, if the frame becomes a keyframe
        if not (propagator.is_keyframe_due(packet, assessment.innovation_px) and packet.has_image):
            tracking.smoother.complete()
            parts.calibrator.step()
            return publish(parts, state, tracking, packet, predicted, assessment, events)
        packet = parts.pipeline.replenish(packet, calibration)
        tracking, update_events = self._add_keyframe(tracking, packet, stationary, frame)
        events, smoother = ("keyframe", *events, *update_events), tracking.smoother
        return publish(parts, state, tracking, packet, smoother.state, assessment, events, smoother.landmarks)

    def _expected(self, t_ns: int, increments: Increments) -> ExpectedFeatures:
        """Return where features are expected at a time [ns], after IMU increments since the last frame."""
        tracking = self._state.phase
        assert isinstance(tracking, Tracking)
        predicted = tracking.propagator.predicted(t_ns, increments)
        return tracking.monitor.expected(predicted, self._parts.calibration)

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
        self, tracking: Tracking, packet: FramePacket, stationary: bool, frame: CameraFrame | None = None
    ) -> tuple[Tracking, tuple[str, ...]]:
        """Add a keyframe at the end of the propagation, begin the next one there, and return events.

        Args:
            tracking: The phase.
            packet: The frame that becomes a keyframe.
            stationary: Whether the vehicle is stationary since the last keyframe.
            frame: Its images; None if it is not the newest frame.
        """
        parts, smoother, monitor, propagator = self._parts, tracking.smoother, tracking.monitor, tracking.propagator
        # Features that connect it with the keyframe before, unless the images show another place
        is_connected = frame is None or parts.pipeline.is_connected(packet)
        if not is_connected:
            restart = parts.initializer(self._state.gauge if monitor.is_consistent else parts.origin)
            restart.collect(packet)
            monitor.disconnect(packet.t_ns)
            tracking = replace(tracking, restart=restart, track=tracking.track + 1)
        # Optimization of the window, and marginalization
        rate = packet.increments.angular_velocity(smoother.state.gyro_bias_rad_s)
        keyframe = Keyframe(packet.t_ns, propagator.preintegrated, packet.observations, stationary, rate)
        result = smoother.add_keyframe(keyframe, report_marginalized=parts.observer is not None)
        keyframe = replace(keyframe, observations=packet.observations.without(result.rejected))
        parts.pipeline.discard(result.rejected)
        parts.noise.update(result.imu_variance)
        # Keyframes for a map
        if parts.observer is not None:
            if result.marginalized is not None:
                parts.observer.marginalized(result.marginalized)
            parts.observer.added(odometry_keyframe(smoother, keyframe, parts.calibration, is_connected, frame))
        # Online calibration
        published, given = parts.with_calibration_sigmas(smoother.state, tracking.origin), parts.calibrator.sigmas
        correction = parts.calibrator.add_keyframe(
            smoother,
            keyframe,
            parts.pipeline.angular_velocity_rad_s,
            is_restored=bool(result.events),
            is_degraded=propagator.is_degraded,
        )
        events = result.events
        if correction is not None:
            if parts.observer is not None and not correction.has_kept_window:
                for estimate in smoother.keyframe_estimates():
                    parts.observer.marginalized(estimate)
            if not correction.corrects_displacement:
                tracking = replace(tracking, origin=tracking.origin.corrected(smoother.state, given))
            smoother, events = correction.smoother, (*events, *correction.events)
            monitor.correct(published, smoother.state)
            parts.set_gravity()
        parts.noise.add_biases(smoother.state, are_corrected=correction is not None)
        # The interval to the next keyframe
        propagator = parts.propagator(smoother, monitor, packet.observations)
        return replace(tracking, smoother=smoother, propagator=propagator), events
