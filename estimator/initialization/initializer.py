"""Initialization, static or in motion, whichever is possible first.

The initializer collects frame packets until gravity and velocity are observable, and starts a smoother over them with
an initial bundle adjustment. What is uncertain then, above all the scale, stays a variable of the smoother, as in
DM-VIO (von Stumberg and Cremers, RA-L 2022), and no state is published before its covariance is small enough.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np

from dronevio.estimator.backend.config import SmootherConfig
from dronevio.estimator.backend.keyframes import KeyframePolicy
from dronevio.estimator.backend.landmarks import LandmarkConfig
from dronevio.estimator.backend.smoother import Keyframe, KeyframeSmoother
from dronevio.estimator.imu.buffer import joined
from dronevio.estimator.imu.noise import ImuNoiseEstimator
from dronevio.estimator.imu.preintegration import Preintegration, PreintegrationParams
from dronevio.estimator.initialization.dynamic import (
    DynamicInitializationConfig,
    DynamicStart,
    ObservedRotation,
    dynamic_start,
    is_stereo,
    observed_rotation,
)
from dronevio.estimator.initialization.gauge import BiasPrior, Gauge
from dronevio.estimator.initialization.not_observable import (
    NotObservable,
    implausible_imu,
    rounded_down,
    too_short,
    uncertain_velocity,
)
from dronevio.estimator.initialization.static import InitialSigmas, initialize_static, mean_angular_velocity
from dronevio.estimator.initialization.zero_velocity import MOTION_DETECTION_DELAY_S
from dronevio.estimator.types import Calibration, FramePacket
from dronevio.models.ranges import Range, Settings
from dronevio.models.state import NavState

MIN_FEATURES = 100
"""Below this number of features, new ones are detected in every frame during initialization."""
MAX_HOVER_VELOCITY_SIGMA_M_S = 0.03
"""Standard deviation of the velocity that suffices at any speed [m/s]; a relative one means nothing at hover."""
REST_GYRO_BIAS_SIGMA_RAD_S = 0.01
"""Standard deviation of the gyroscope bias that a stationary interval has determined [rad/s]; a short interval may
contain a slow rotation."""
NO_SOLUTION = "images and IMU do not determine the motion: motion sideways past near objects helps"
"""Reason where the smoother finds no solution."""
EARLY_ATTEMPTS = 16
"""Number of attempts in motion, within four seconds, after which they become rarer, and each has one of the windows.
Where measurements belong together, nearly all starts succeed within them."""
LATE_INTERVAL_RATIO = 4.0
"""Ratio of the time between late attempts to that between early ones."""
NOISE_ROUNDS = 4
"""Largest number of initial adjustments in motion, each with the noise of the IMU that the one before has shown."""
NOISY_ACCEL_BIAS_SIGMA_M_S2 = 0.03
"""Standard deviation of the accelerometer bias in a start that is repeated with more noise [m/s²]."""
TIME_TOLERANCE_NS = 1_000_000
"""Tolerance of time spans, because time stamps jitter [ns]."""


@dataclass(frozen=True)
class InitializerConfig(Settings):
    """Settings of the initialization."""

    static_window_s: Annotated[float, Range(0.05, 60.0)] = 0.8
    """Time for which the vehicle must be stationary for a static initialization [s]."""
    static_sigmas: InitialSigmas = field(default_factory=InitialSigmas)
    """Standard deviations of a static initialization."""
    dynamic: DynamicInitializationConfig = field(default_factory=DynamicInitializationConfig)
    """Settings of the dynamic initialization."""
    dynamic_sigmas: InitialSigmas = field(
        default_factory=lambda: InitialSigmas(
            tilt_rad=0.05, velocity_m_s=0.3, gyro_bias_rad_s=0.02, accel_bias_m_s2=0.1
        )
    )
    """Standard deviations of a dynamic initialization."""
    max_velocity_sigma: Annotated[float, Range(low=0.0)] = 0.05
    """Largest standard deviation of the velocity, relative to the speed, of the first state that is published."""
    gyro_bias_sigma_rad_s: Annotated[float, Range(1e-6, 10.0)] = 0.05
    """Standard deviation of the gyroscope bias before it is estimated [rad/s]; that of EuRoC is 0.08."""

    @property
    def longest_window_s(self) -> float:
        """Longest time between the first frame of an initialization and its last one [s]."""
        return max(self.static_window_s, self.dynamic.max_window_s)


@dataclass(frozen=True, eq=False)
class _BegunAttempt:
    """The first half of an attempt in motion; the second one follows with the next frame."""

    window: list[FramePacket]
    """Its frames."""
    rotation: ObservedRotation
    """Rotation of the frames, and gyroscope bias."""
    has_longer: bool
    """Whether a longer window is tried if it fails."""


def not_ready_reason(state: NavState, config: InitializerConfig) -> NotObservable | None:
    """Return why a state is too uncertain to be published, or None where it is not.

    A dynamic initialization leaves the scale uncertain, and the velocity with it. The smoother reduces both.
    """
    P = state.covariance
    speed_m_s = float(np.linalg.norm(state.velocity_m_s))
    sigma_m_s = float(np.sqrt(np.linalg.eigvalsh(P[6:9, 6:9])[-1])) if P is not None else 0.0
    allowed_m_s = max(MAX_HOVER_VELOCITY_SIGMA_M_S, config.max_velocity_sigma * speed_m_s)
    return None if sigma_m_s <= allowed_m_s else uncertain_velocity(speed_m_s, sigma_m_s, allowed_m_s)


class Initializer:
    """Waits until the vehicle is stationary for a while, or moves so that its velocity is observable."""

    def __init__(
        self,
        config: InitializerConfig,
        smoother: SmootherConfig,
        landmarks: LandmarkConfig,
        keyframes: KeyframePolicy,
        gauge: Gauge,
    ) -> None:
        """Begin without frames.

        Args:
            config: Settings.
            smoother: Settings of the smoother that is started.
            landmarks: Settings of its landmarks.
            keyframes: Determines the intervals between keyframes.
            gauge: Provides the priors of the biases.
        """
        self._config, self._keyframes = config, keyframes
        self._smoother_config, self._landmark_config = smoother, landmarks
        self._gyro_bias, self._accel_bias = gauge.gyro_bias, gauge.accel_bias
        self._window: list[FramePacket] = []
        self._last_attempt_ns: int | None = None
        self._attempts = 0
        self._needs_longer_window = False
        self._begun: _BegunAttempt | None = None
        self._is_busy = False  # whether the last frame had the second half of an attempt
        self._replenished_ns: int | None = None
        self._last_reason = NotObservable("no images so far")

    @property
    def gyro_bias(self) -> BiasPrior:
        """What is known of the gyroscope bias so far [rad/s]."""
        return self._gyro_bias

    @property
    def is_contradicted(self) -> bool:
        """Whether IMU and images contradicted each other at the last attempt."""
        return bool(self._last_reason.cause)

    @property
    def searches_offset(self) -> bool:
        """Whether the time offset of camera and IMU should be searched for, since they contradict each other.

        The second half of an attempt, which takes longer, has its frame for itself.
        """
        return self.is_contradicted and not self._is_busy

    def needs_features(self, packet: FramePacket) -> bool:
        """Return whether new features should be detected in a frame: if there are few, or at the keyframe interval."""
        if not packet.has_image:
            return False
        since_ns, frame_s = self._replenished_ns, packet.increments.duration_s
        due = since_ns is None or self._keyframes.is_interval_over(
            (packet.t_ns - since_ns) * 1e-9, frame_s, stationary=False
        )
        due &= self._begun is None  # otherwise, the time of the frame is that of an attempt
        if due or len(packet.observations) < MIN_FEATURES:
            self._replenished_ns = packet.t_ns
            return True
        return False

    def collect(self, packet: FramePacket) -> None:
        """Add a frame without an attempt to initialize."""
        *before, last = self._window or [packet]
        if last is not packet and not last.has_image:  # as if there were no such frame
            packet, self._window = replace(packet, increments=joined([last.increments, packet.increments])), before
        self._window = [*self._window, packet]
        self._window = self._since(packet.t_ns, self._config.longest_window_s)

    def add(
        self, packet: FramePacket, stationary_s: float, calibration: Calibration, gauge: Gauge, noise: ImuNoiseEstimator
    ) -> KeyframeSmoother | NotObservable:
        """Add a frame and return an initialized smoother, or the reason why there is none yet.

        Args:
            packet: The frame and the IMU increments before it.
            stationary_s: Time for which no motion has been detected [s].
            calibration: The calibration in use.
            gauge: Position and yaw of the initial state.
            noise: Estimator of the noise of the IMU; a static initialization adds its stationary interval.
        """
        c, t_ns = self._config, packet.t_ns
        self.collect(packet)
        self._is_busy = False
        if not packet.has_image:
            return self._last_reason
        begun, self._begun = self._begun, None
        if stationary_s >= MOTION_DETECTION_DELAY_S:  # a shorter time is that between two frames of a slow motion
            return self._static(self._since(t_ns, stationary_s), calibration, gauge, noise)
        if begun is not None:  # the second half of an attempt
            self._is_busy = True
            result = self._dynamic([*begun.window, self._window[-1]], begun.rotation, calibration, gauge, noise)
            return self._noted(result, has_longer=begun.has_longer)
        stereo = is_stereo(self._window, c.dynamic)
        needed_s = c.dynamic.stereo_window_s if stereo else c.dynamic.window_s
        window, longest = self._since(t_ns, needed_s), self._since(t_ns, c.dynamic.max_window_s)
        span_s = (t_ns - window[0].t_ns) * 1e-9
        if span_s < needed_s - TIME_TOLERANCE_NS * 1e-9:
            return too_short(span_s, c.static_window_s, needed_s)
        last_ns, is_late = self._last_attempt_ns, self._attempts >= EARLY_ATTEMPTS
        is_longest = self._needs_longer_window
        if not is_longest:
            if last_ns is not None and t_ns - last_ns < self._attempt_interval_s * 1e9:
                return self._last_reason
            self._last_attempt_ns, self._attempts = t_ns, self._attempts + 1
            is_longest = is_late and not stereo and self._attempts % 2 == 0
        window = longest if is_longest else window
        # Early attempts have both windows, late ones one; after the first, each takes two frames if there are enough
        has_longer = not stereo and len(longest) > len(window)
        rotation = self._rotation(window, calibration, noise)
        are_enough = 4.0 * packet.increments.duration_s <= c.dynamic.attempt_interval_s
        if (is_late or (are_enough and self._attempts > 1)) and not isinstance(rotation, NotObservable):
            self._begun = _BegunAttempt(window, rotation, has_longer and not is_late)
            self._needs_longer_window = False
            return self._last_reason
        return self._noted(self._dynamic(window, rotation, calibration, gauge, noise), has_longer=has_longer)

    def _noted(self, result: KeyframeSmoother | NotObservable, *, has_longer: bool) -> KeyframeSmoother | NotObservable:
        """Note the result of an attempt, and return it; if it fails, the longer window is next, where there is one."""
        self._needs_longer_window = False
        if isinstance(result, NotObservable):
            self._last_reason, self._needs_longer_window = result, has_longer
        return result

    def _static(
        self, window: Sequence[FramePacket], calibration: Calibration, gauge: Gauge, noise: ImuNoiseEstimator
    ) -> KeyframeSmoother | NotObservable:
        needed_s = self._config.static_window_s
        if len(window) < 2:
            return NotObservable(f"one frame since the start of the initialization; at rest {needed_s:g} s are needed")
        increments = [packet.increments for packet in window[1:]]
        self._gyro_bias = BiasPrior(mean_angular_velocity(increments), 0.0)
        span_s = (window[-1].t_ns - window[0].t_ns) * 1e-9
        if span_s < needed_s - TIME_TOLERANCE_NS * 1e-9:
            known = rounded_down(span_s)
            return NotObservable(f"stationary for {known} s; for a start at rest {needed_s:g} s are needed")
        whole = joined(increments)
        implausible = implausible_imu(whole.gyro_rad_s, whole.accel_m_s2, noise.params.gravity_m_s2)
        if implausible is not None:
            return implausible
        noise.add_stationary(increments)
        start = initialize_static(window[0].t_ns, increments)
        sigmas = self._config.static_sigmas
        smoother, _ = self._adjusted(start, sigmas, window, calibration, gauge, noise.params, stationary=True)
        return smoother or NotObservable(NO_SOLUTION)

    @property
    def _gyro_bias_in_motion(self) -> BiasPrior:
        """What is known of the gyroscope bias in a window in motion."""
        return replace(self._gyro_bias, sigma=max(self._gyro_bias.sigma, REST_GYRO_BIAS_SIGMA_RAD_S))

    def _rotation(
        self, window: Sequence[FramePacket], calibration: Calibration, noise: ImuNoiseEstimator
    ) -> ObservedRotation | NotObservable:
        """Return the first half of an attempt in motion."""
        Ts_imu_cam, focal_px = calibration.Ts_imu_cam, float(calibration.focal_px[0])
        bias, gravity_m_s2 = self._gyro_bias_in_motion, noise.params.gravity_m_s2
        return observed_rotation(window, Ts_imu_cam, focal_px, self._config.dynamic, bias, gravity_m_s2)

    def _dynamic(
        self,
        window: Sequence[FramePacket],
        rotation: ObservedRotation | NotObservable,
        calibration: Calibration,
        gauge: Gauge,
        noise: ImuNoiseEstimator,
    ) -> KeyframeSmoother | NotObservable:
        """Return the result of an attempt in motion, whose first half is the rotation."""
        if isinstance(rotation, NotObservable):
            return rotation
        c = self._config
        focal_px, gravity_m_s2 = float(calibration.focal_px[0]), noise.params.gravity_m_s2

        def start_of(accel_bias: BiasPrior) -> DynamicStart | NotObservable:
            bias = self._gyro_bias_in_motion
            return dynamic_start(rotation, focal_px, c.dynamic, bias, accel_bias, gravity_m_s2)

        start = start_of(self._accel_bias)
        if isinstance(start, NotObservable):
            return start
        if start.clocks is not None and not self._is_window_full:
            return start.clocks
        noise.begin_in_motion()
        agreeing = [replace(packet, observations=packet.observations.without(start.outliers)) for packet in window]
        for _ in range(NOISE_ROUNDS):
            smoother, error_px = self._adjusted(
                start.state, c.dynamic_sigmas, agreeing, calibration, gauge, noise.params, stationary=False
            )
            if smoother is None or not noise.raise_initial(smoother.initial_imu_variances):
                break
            # The start takes the IMU as exact but for its biases, so that it has taken the noise for one.
            again = start_of(replace(self._accel_bias, sigma=NOISY_ACCEL_BIAS_SIGMA_M_S2))
            start = start if isinstance(again, NotObservable) else again
        allowed_px = c.dynamic.max_residual_sigmas * c.dynamic.pixel_sigma
        if smoother is None:
            return NotObservable(NO_SOLUTION)
        if error_px <= allowed_px:
            return smoother
        return NotObservable(
            f"images and IMU agree within {error_px:.1f} px only, {allowed_px:g} px are needed: steady motion past near"
            " objects that do not move helps"
        )

    @property
    def _attempt_interval_s(self) -> float:
        """Time between two attempts in motion [s]."""
        return self._config.dynamic.attempt_interval_s * (
            LATE_INTERVAL_RATIO if self._attempts >= EARLY_ATTEMPTS else 1.0
        )

    @property
    def _is_window_full(self) -> bool:
        span_s = (self._window[-1].t_ns - self._window[0].t_ns) * 1e-9
        return span_s >= self._config.longest_window_s - TIME_TOLERANCE_NS * 1e-9

    def _since(self, t_ns: int, span_s: float) -> list[FramePacket]:
        """Return the fewest packets that span the last ``span_s`` seconds, or all that there are."""
        begin_ns = t_ns - span_s * 1e9 + TIME_TOLERANCE_NS
        first = sum(packet.t_ns <= begin_ns for packet in self._window) - 1  # at any frame rate, the last one before
        return self._window[max(first, 0) :]

    def _adjusted(
        self,
        start: NavState,
        sigmas: InitialSigmas,
        packets: Sequence[FramePacket],
        calibration: Calibration,
        gauge: Gauge,
        params: PreintegrationParams,
        *,
        stationary: bool,
    ) -> tuple[KeyframeSmoother | None, float]:
        """Start a smoother at the first of some packets, with an initial bundle adjustment over all of them.

        Returns:
            The smoother, or None without a solution, and the median reprojection error of the landmarks [px].
        """
        first, *later = packets
        start = gauge.align(start, joined([packet.increments for packet in later]))
        covariance = gauge.covariance(start, sigmas)
        smoother = KeyframeSmoother(
            calibration, self._smoother_config, self._landmark_config, start, covariance, first.observations
        )
        keyframes: list[Keyframe] = []
        bias = smoother.gtsam_state[1]
        preintegration = Preintegration(params, bias)
        # At rest, matches in further cameras are the only observation of depth, and not all frames have them.
        needs_matches = stationary and any(len(packet.observations.matches) for packet in later)
        for packet in later:
            preintegration.integrate(packet.increments)
            if needs_matches:
                is_due = len(packet.observations.matches) > 0
            else:
                frame_s = packet.increments.duration_s
                is_due = self._keyframes.is_interval_over(preintegration.duration_s, frame_s, stationary=stationary)
            if is_due or packet is later[-1]:
                rate = packet.increments.angular_velocity(bias.gyroscope())
                measured, seen = preintegration.measurements, packet.observations
                keyframes.append(Keyframe(packet.t_ns, measured, seen, stationary, rate))
                preintegration = Preintegration(params, bias)
        error_px = smoother.initial_adjustment(keyframes)
        return (None, float("inf")) if error_px is None else (smoother, error_px)
