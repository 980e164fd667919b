"""Visual-inertial odometry: cameras and an IMU in, where the IMU is out.

The pipeline of a keyframe-based fixed-lag smoother (Leutenegger et al., IJRR 2015; Qin et al., T-RO 2018): corners are
followed from frame to frame, the IMU is preintegrated between keyframes, and every keyframe adds a state to a window
that is optimized by Gauss-Newton. Between keyframes the newest state is carried forward by the IMU. What is returned
for a frame is never revised.
"""

import numpy as np
import numpy.typing as npt

from dronevio.estimator.backend.keyframes import KeyframePolicy
from dronevio.estimator.backend.smoother import KeyframeResult, KeyframeSmoother
from dronevio.estimator.calibration.online import OnlineCalibration
from dronevio.estimator.config import VioConfig
from dronevio.estimator.frontend.protocol import FrontEnd
from dronevio.estimator.frontend.rig import RigTracker
from dronevio.estimator.health import HealthMonitor
from dronevio.estimator.imu.noise import ImuNoiseEstimator
from dronevio.estimator.initialization.initializer import Initializer
from dronevio.estimator.initialization.static import NotObservable
from dronevio.estimator.initialization.zero_velocity import ZeroVelocityDetector
from dronevio.estimator.output import Answers
from dronevio.estimator.pipeline import Intake
from dronevio.estimator.propagator import Interval
from dronevio.estimator.types import FramePacket, Observations
from dronevio.models.imu import ImuSamples
from dronevio.models.rig import Rig
from dronevio.models.state import CameraFrame, Estimate, Health, HealthReport, NavState

Array = npt.NDArray[np.float64]


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
        """Prepare for a rig.

        Args:
            rig: The calibration.
            config: Settings.
            front_end: Where feature observations come from; by default the images.
        """
        self._config = c = config or VioConfig()
        self._imu, self._noise = rig.imu, ImuNoiseEstimator(rig.imu, c.inertial, c.noise)
        self._calibration = OnlineCalibration(rig, c.calibration)
        self._intake = Intake(rig, front_end or RigTracker(rig, c.tracker), self._calibration)
        self._stillness = ZeroVelocityDetector(c.stillness)
        self._policy = KeyframePolicy(c.keyframe)
        self._initializer = Initializer(rig.cameras, c.start, self._policy, self._noise.params, self._new_smoother)
        self._answers = Answers(self._initializer, rig.imu.rate_hz, c.health.max_innovation_px)
        self._smoother: KeyframeSmoother | None = None
        self._monitor: HealthMonitor  # these two: since there is a smoother
        self._interval: Interval

    def add_imu(self, samples: ImuSamples) -> None:
        """Take the IMU samples since the last call."""
        self._intake.add_imu(samples)

    def add_frame(self, frame: CameraFrame) -> Estimate:
        """Take a frame and say where the IMU is.

        Raises:
            ConfigError: The frame is not later than the last one, or its image is not one of the rig's camera.
        """
        packet = self._intake.take(frame, *self._gyro_bias)
        self._stillness.update(packet.t_ns, packet.observations, packet.increments)
        self._initializer.origin.turn(packet.increments)
        estimate = self._start(packet) if self._smoother is None else self._go_on(self._smoother, packet)
        return self._intake.stamped(estimate, frame)

    def _start(self, packet: FramePacket) -> Estimate:
        """Start if that is possible by now."""
        if self._initializer.wants_features(packet):
            packet = self._intake.replenished(packet)
        started = self._initializer.add(packet, self._stillness.stationary_s)
        if isinstance(started, NotObservable):
            return self._answers.unknown(packet, str(started))
        c, self._smoother = self._config, started
        self._monitor = HealthMonitor(self._calibration.rig, c.health, c.smoother.pixel_sigma)
        self._begin_interval(started, packet.observations)
        report = self._monitor.judge(packet.observations, started.state, self._stillness.stationary_s > 0.0)
        return self._answers.known(packet, started.state, report)

    def _go_on(self, smoother: KeyframeSmoother, packet: FramePacket) -> Estimate:
        """Carry the newest state forward to a frame, or make the frame a keyframe."""
        stationary_s, seen = self._stillness.stationary_s, packet.observations
        still = self._interval.would_be_stationary(packet, stationary_s)
        events = () if still else self._end_rest(smoother)
        self._interval.add(packet, still)
        predicted = self._interval.state_at(packet.t_ns)
        report = self._monitor.judge(seen, predicted, still)
        if report.health is Health.LOST:
            return self._lose(packet, report)
        if not self._interval.is_over(stationary_s, seen, report.innovation_px):
            self._calibration.work()
            return self._answers.known(packet, predicted, report, events)
        packet = self._intake.replenished(packet)
        events = ("keyframe", *events, *self._add_keyframe(smoother, packet, still))
        return self._answers.known(packet, smoother.state, report, events, smoother.landmarks)

    def _end_rest(self, smoother: KeyframeSmoother) -> tuple[str, ...]:
        """Make the last settled frame of a rest a keyframe, if there was a rest; return what happened."""
        settled, recent = self._interval.cut_to_rest()
        if settled is None:
            return ()
        events = self._add_keyframe(smoother, settled, still=True)
        for packet in recent:
            self._interval.add(packet)
        return events

    def _add_keyframe(self, smoother: KeyframeSmoother, packet: FramePacket, still: bool) -> tuple[str, ...]:
        """Add a keyframe where the interval ends, and begin another one there; return what happened."""
        result = smoother.add_keyframe(packet.t_ns, self._interval.preintegrated, packet.observations, still)
        self._noise.update(result.imu_variance)
        self._intake.discard(result.rejected)
        events = (*result.events, *self._calibrate(smoother, packet, result))
        self._begin_interval(smoother, packet.observations)
        return events

    def _begin_interval(self, smoother: KeyframeSmoother, observations: Observations) -> None:
        """Go on from the newest keyframe."""
        self._interval = Interval(self._noise.params, self._imu, self._policy, smoother, observations)
        self._monitor.hold(smoother.state, smoother.known_landmarks)

    def _calibrate(self, smoother: KeyframeSmoother, packet: FramePacket, result: KeyframeResult) -> tuple[str, ...]:
        """Learn from a keyframe what of the calibration is wrong, and go on with what is right; say so."""
        calibration, seen = self._calibration, packet.observations.without(result.rejected)
        if result.events or self._interval.is_degraded:
            calibration.restart()
        if self._interval.is_degraded:
            return ()
        if not calibration.add(smoother.state, self._intake.rate_rad_s, self._interval.preintegrated, seen):
            return ()
        self._intake.recalibrate()
        self._monitor.recalibrate(calibration.rig)
        self._initializer.recalibrate(calibration.rig.cameras)
        smoother.recalibrate(calibration.rig.cameras, calibration.doubt)
        return (f"calibration corrected: {calibration.applied}",)

    def _lose(self, packet: FramePacket, report: HealthReport) -> Estimate:
        """Give the estimate up, and look for a new start, from where the drone was last believed to be."""
        self._smoother = None
        self._initializer.begin_anew()
        self._calibration.restart()
        return self._answers.lost(packet, report)

    def _new_smoother(self, start: NavState, covariance: Array, observations: Observations) -> KeyframeSmoother:
        c, cameras = self._config, self._calibration.rig.cameras
        return KeyframeSmoother(cameras, c.smoother, c.landmarks, start, covariance, observations)

    @property
    def _gyro_bias(self) -> tuple[Array, float]:
        """What is known of the gyroscope's bias (3,), and how well [rad/s]."""
        if self._smoother is None:
            return self._initializer.gyro_bias_rad_s, self._initializer.gyro_bias_sigma_rad_s
        return self._smoother.state.gyro_bias_rad_s, 0.0
