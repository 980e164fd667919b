"""The next state of the odometry: initialized, published, lost, or begun anew with another time offset."""

from dataclasses import replace

from dronevio.estimator.calibration.rotation_offset import RotationOffset
from dronevio.estimator.calibration.uncertainty import Origin
from dronevio.estimator.initialization.gauge import LastPublished
from dronevio.estimator.initialization.not_observable import NotObservable
from dronevio.estimator.monitoring.causes import Cause, Reason
from dronevio.estimator.monitoring.health import Assessment
from dronevio.estimator.monitoring.plausibility import MotionLimits, reason_against
from dronevio.estimator.odometry_parts import OdometryParts
from dronevio.estimator.odometry_state import Initializing, OdometryState, Tracking
from dronevio.estimator.types import FramePacket
from dronevio.models.arrays import Array
from dronevio.models.state import HealthQuantities, NavState


def initialize(parts: OdometryParts, state: OdometryState, phase: Initializing, packet: FramePacket) -> OdometryState:
    """Return the state after a frame before the estimate is initialized, which it is if the motion is observable.

    Args:
        parts: The parts of the odometry.
        state: The state, propagated to the frame.
        phase: Its phase.
        packet: The frame.
    """
    if phase.initializer.needs_features(packet):
        packet = parts.pipeline.replenish(packet, parts.calibration)

    # Gravity, velocity and biases of the first keyframes
    rest_s = packet.stationary_s
    smoother = phase.initializer.add(packet, rest_s, parts.calibration, state.gauge, parts.noise)
    if isinstance(smoother, NotObservable):
        return replace(state, estimate=parts.publisher.not_initialized(packet, smoother))

    # A start in motion presumes that the clocks agree
    offset = None if rest_s else parts.calibrator.other_offset(at_once=True)
    if offset is not None:
        withheld = parts.publisher.without_state(packet, Reason.of(Cause.TIME_OFFSET))
        return with_offset(parts, replace(state, estimate=withheld), packet, offset)

    # Health of the first state
    monitor = parts.monitor(is_consistent=phase.is_consistent and not parts.publisher.has_stated_cause)
    if not rest_s:
        monitor.begin_in_motion(smoother.state)
    propagator = parts.propagator(smoother, monitor, packet.observations)
    origin = Origin(smoother.state.T_world_imu[:3, 3])
    tracking = Tracking(smoother, monitor, propagator, origin, track=phase.track)
    assessment = monitor.assess(packet.observations, smoother.state, rest_s > 0.0, parts.calibration)
    return publish(parts, state, tracking, packet, smoother.state, assessment)


def publish(
    parts: OdometryParts,
    state: OdometryState,
    tracking: Tracking,
    packet: FramePacket,
    estimated: NavState,
    assessment: Assessment,
    events: tuple[str, ...] = (),
    landmarks_odom: Array | None = None,
) -> OdometryState:
    """Return the state after a frame with an estimate, whose pose is the gauge after a loss if landmarks agree with it.

    Args:
        parts: The parts of the odometry.
        state: The state, propagated to the frame.
        tracking: Its phase after the frame.
        packet: The frame.
        estimated: The estimate.
        assessment: What was known about it before the update.
        events: Events at the frame, as texts for people.
        landmarks_odom: (L, 3) Landmarks that constrain the estimate [m]; only on keyframes.
    """
    # Motion that a vehicle cannot have had since the last frame
    implausible = reason_against(estimated, tracking.limits)
    if implausible is not None:
        return lose(parts, state, tracking, packet, implausible, assessment)

    # Health after the update
    assessment = replace(
        assessment,
        is_consistent=tracking.monitor.is_consistent,
        is_calibration_plausible=parts.calibrator.is_plausible,
        is_calibration_known=parts.calibrator.is_known,
        is_noise_excessive=parts.noise.is_excessive,
        is_noise_aliased=parts.noise.is_aliased,
    )
    estimate = parts.publisher.estimate(packet, estimated, assessment, events, landmarks_odom)
    if estimate.state is None:
        return replace(state, phase=tracking, estimate=estimate)

    # Limits and gauge of the next states
    published = parts.with_calibration_sigmas(estimated, tracking.origin)
    agrees = (assessment.innovation_px or 0.0) <= parts.config.health.max_innovation_px
    return OdometryState(
        replace(tracking, limits=MotionLimits(estimated)),
        LastPublished.of(published) if agrees else state.gauge,
        replace(estimate, state=published),
    )


def lose(
    parts: OdometryParts,
    state: OdometryState,
    tracking: Tracking,
    packet: FramePacket,
    reason: Reason,
    quantities: HealthQuantities,
) -> OdometryState:
    """Return the state after a loss: another initialization, which continues from the last published pose.

    If the images show another place, it uses all frames that do.

    Args:
        parts: The parts of the odometry.
        state: The state, propagated to the frame.
        tracking: Its phase.
        packet: The frame.
        reason: Why the estimate is lost.
        quantities: What has been measured of it.
    """
    is_consistent = tracking.monitor.is_consistent
    initializer = tracking.restart or parts.initializer(state.gauge if is_consistent else parts.origin)
    parts.calibrator.restart()
    parts.set_gravity()
    if parts.observer is not None:
        parts.observer.lost()
    estimate = parts.publisher.lost(packet, reason, quantities)
    return replace(state, phase=Initializing(initializer, is_consistent, tracking.track + 1), estimate=estimate)


def with_offset(
    parts: OdometryParts, state: OdometryState, packet: FramePacket, offset: RotationOffset
) -> OdometryState:
    """Return the state after another time offset of camera and IMU is adopted: an initialization without priors.

    Args:
        parts: The parts of the odometry.
        state: The state after the frame by the offset in use.
        packet: The frame.
        offset: The offset, relative to that in use.
    """
    if isinstance(state.phase, Tracking):
        quantities = state.estimate.health_report or HealthQuantities()
        state = lose(parts, state, state.phase, packet, Reason.of(Cause.TIME_OFFSET), quantities)
    from_given_s, event = parts.calibrator.adopt(offset)
    parts.set_gravity()
    parts.queue.shift(from_given_s)
    parts.publisher.withdraw_causes()
    estimate = replace(state.estimate, events=(*state.estimate.events, event))
    phase = Initializing(parts.initializer(parts.origin), track=state.phase.track)
    return replace(state, phase=phase, estimate=estimate)
