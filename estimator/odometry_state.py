"""What the odometry knows between two frames.

The values are immutable; their parts that are filters over time (the smoother, the health monitor, the propagator and
the initializer) change in place.
"""

from dataclasses import dataclass, replace

from dronevio.estimator.backend.smoother import KeyframeSmoother
from dronevio.estimator.calibration.uncertainty import Origin
from dronevio.estimator.imu.buffer import Increments
from dronevio.estimator.initialization.gauge import BiasPrior, Gauge
from dronevio.estimator.initialization.initializer import Initializer
from dronevio.estimator.monitoring.monitor import HealthMonitor
from dronevio.estimator.monitoring.plausibility import MotionLimits
from dronevio.estimator.propagator import Propagator, velocity_may_be_zero
from dronevio.models.state import Estimate, Health

NO_ESTIMATE = Estimate(0, Health.INITIALIZING, None)
"""The estimate before the first frame."""


@dataclass(frozen=True, eq=False)
class Initializing:
    """The phase without an estimate: before the first initialization, or after a loss."""

    initializer: Initializer
    """Collects frames until the state is observable."""
    is_consistent: bool = True
    """Whether the next state counts as consistent from its beginning: unless an inconsistent one was lost before."""
    track: int = 0
    """Number of the odometry frame of the next state."""

    @property
    def is_contradicted(self) -> bool:
        """Whether images and IMU contradict each other."""
        return self.initializer.is_contradicted

    @property
    def searches_offset(self) -> bool:
        """Whether another time offset of camera and IMU is searched for."""
        return self.initializer.searches_offset

    @property
    def gyro_bias(self) -> BiasPrior:
        """What is known of the gyroscope bias [rad/s]."""
        return self.initializer.gyro_bias


@dataclass(frozen=True, eq=False)
class Tracking:
    """The phase with an estimate."""

    smoother: KeyframeSmoother
    """Estimates the states of the keyframes."""
    monitor: HealthMonitor
    """Assesses the estimate."""
    propagator: Propagator
    """Predicts the state since the newest keyframe."""
    origin: Origin
    """Where the displacement begins by the calibration in use."""
    limits: MotionLimits | None = None
    """Limits of the next published state; None before the first."""
    restart: Initializer | None = None
    """Collects frames since no feature connected images with earlier ones; None as long as features do."""
    track: int = 0
    """Number of the odometry frame, which another one replaces at a loss and where no feature connects keyframes."""

    @property
    def is_contradicted(self) -> bool:
        """Whether images and IMU contradict each other."""
        return not self.monitor.is_consistent

    @property
    def searches_offset(self) -> bool:
        """Whether another time offset of camera and IMU is searched for."""
        return self.is_contradicted

    @property
    def gyro_bias(self) -> BiasPrior:
        """The estimated gyroscope bias [rad/s], taken as certain."""
        return BiasPrior(self.smoother.state.gyro_bias_rad_s, 0.0)


@dataclass(frozen=True, eq=False)
class OdometryState:
    """The state of the odometry after a frame."""

    phase: Initializing | Tracking
    """Whether there is an estimate, and what continues it."""
    gauge: Gauge
    """Position and yaw at which a next initialization begins."""
    estimate: Estimate
    """The estimate of the frame, at its time by the clock of the IMU."""

    @property
    def moves(self) -> bool:
        """Whether the velocity at the frame was certainly not zero."""
        return self.estimate.state is not None and not velocity_may_be_zero(self.estimate.state)

    @property
    def since_keyframe_s(self) -> float | None:
        """Time from the newest keyframe to the frame [s]; None unless the vehicle moves and the estimate tracks."""
        phase = self.phase
        if not isinstance(phase, Tracking) or self.estimate.health is not Health.TRACKING or not self.moves:
            return None
        return phase.propagator.elapsed_s

    def propagated(self, increments: Increments, gravity_m_s2: float) -> "OdometryState":
        """Return the state after the IMU increments up to the next frame."""
        phase = self.phase
        if isinstance(phase, Tracking) and phase.limits is not None:
            phase = replace(phase, limits=phase.limits.after(increments, gravity_m_s2))
        return replace(self, phase=phase, gauge=self.gauge.propagated(increments))
