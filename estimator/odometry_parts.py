"""The parts of the odometry that change in place: the front end, the filters of its sensors, and its output."""

from dataclasses import dataclass
from typing import Self

from dronevio.estimator.backend.keyframes import KeyframePolicy
from dronevio.estimator.backend.smoother import KeyframeSmoother
from dronevio.estimator.calibration.calibrator import Calibrator
from dronevio.estimator.calibration.uncertainty import Origin
from dronevio.estimator.config import VioConfig
from dronevio.estimator.frame_queue import FrameQueue, SampleQueue
from dronevio.estimator.frontend.protocol import FrontEnd
from dronevio.estimator.frontend.rig import RigTracker
from dronevio.estimator.imu.forward_propagation import ImuRatePropagator
from dronevio.estimator.imu.noise import ImuNoiseEstimator
from dronevio.estimator.imu.outliers import OutlierFilter
from dronevio.estimator.initialization.gauge import Gauge, WorldOrigin
from dronevio.estimator.initialization.initializer import Initializer
from dronevio.estimator.keyframe_observer import KeyframeObserver
from dronevio.estimator.monitoring.monitor import HealthMonitor
from dronevio.estimator.output import Publisher
from dronevio.estimator.pipeline import MeasurementPipeline
from dronevio.estimator.propagator import Propagator
from dronevio.estimator.types import Calibration, Observations
from dronevio.models.rig import Rig
from dronevio.models.state import NavState


@dataclass(frozen=True, eq=False)
class OdometryParts:
    """Parts of the odometry with a state of their own, and what they are made from."""

    rig: Rig
    """The given calibration."""
    config: VioConfig
    """Settings."""
    queue: FrameQueue
    """Frames that wait for the IMU samples of their exposure."""
    samples: SampleQueue
    """IMU samples that wait for a frame."""
    pipeline: MeasurementPipeline
    """Makes packets of the measurements."""
    calibrator: Calibrator
    """Holds the calibration in use."""
    noise: ImuNoiseEstimator
    """Estimates the noise of the IMU."""
    keyframe_policy: KeyframePolicy
    """Decides which frames become keyframes."""
    publisher: Publisher
    """Makes the published estimates."""
    imu_rate: ImuRatePropagator
    """Propagates the published states at the rate of the IMU. It has a filter of outliers of its own, since it does not
    wait for frames."""
    observer: KeyframeObserver | None
    """Receives the keyframes."""

    @classmethod
    def of(cls, rig: Rig, config: VioConfig, front_end: FrontEnd | None, observer: KeyframeObserver | None) -> Self:
        """Return the parts before the first measurement; see `VisualInertialOdometry`."""
        c = config
        return cls(
            rig,
            config,
            FrameQueue(),
            SampleQueue(rig),
            MeasurementPipeline(rig, config, front_end or RigTracker(rig, c.tracker)),
            Calibrator(rig, c.calibration, c.gravity_m_s2),
            ImuNoiseEstimator(rig.imu, c.preintegration, c.noise, c.gravity_m_s2),
            KeyframePolicy(c.keyframe),
            Publisher(c.initialization, c.health, rig.imu.rate_hz),
            ImuRatePropagator(rig.imu, c.preintegration, c.gravity_m_s2, OutlierFilter(rig.imu)),
            observer,
        )

    @property
    def calibration(self) -> Calibration:
        """The calibration in use."""
        return self.calibrator.calibration

    @property
    def origin(self) -> WorldOrigin:
        """The gauge of an initialization of which nothing is known."""
        c = self.config.initialization
        return WorldOrigin(c.gyro_bias_sigma_rad_s, c.dynamic.accel_bias_sigma_m_s2)

    def initializer(self, gauge: Gauge) -> Initializer:
        """Return an initializer with the priors of the biases by a gauge."""
        c = self.config
        return Initializer(c.initialization, c.smoother, c.landmarks, self.keyframe_policy, gauge)

    def monitor(self, *, is_consistent: bool) -> HealthMonitor:
        """Return the monitor of an estimate, and whether that is consistent from its beginning."""
        pixel_sigma = self.config.smoother.image_sigma_px(len(self.rig.cameras))
        return HealthMonitor(self.rig.imu, self.config.health, pixel_sigma, is_consistent=is_consistent)

    def propagator(self, smoother: KeyframeSmoother, monitor: HealthMonitor, observations: Observations) -> Propagator:
        """Return the propagation from the newest keyframe, with which a monitor compares the next frames."""
        noise, landmarks = self.noise, smoother.triangulated_landmarks
        monitor.set_reference(
            smoother.state,
            landmarks,
            smoother.image_variance,
            noise.densities,
            noise.measured,
            self.calibrator.sigmas,
        )
        return Propagator(noise.params, self.rig.imu, self.keyframe_policy, smoother, observations)

    def with_calibration_sigmas(self, state: NavState, origin: Origin) -> NavState:
        """Return a state at the newest frame with the uncertainty of the calibration.

        Args:
            state: The state.
            origin: Where its displacement begins.
        """
        return self.calibrator.with_uncertainty(state, origin, self.pipeline.angular_velocity_rad_s)

    def set_gravity(self) -> None:
        """Propagate with the magnitude of gravity in use."""
        self.noise.set_gravity(self.calibrator.gravity_m_s2)
        self.imu_rate.set_gravity(self.calibrator.gravity_m_s2)
