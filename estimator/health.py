"""Health of the estimate: what constrains it, how well it fits the measurements, and whether it can be trusted.

The number of tracked features is no measure of health: in front of a distant wall, or while hovering after a rotation,
many tracks may leave the motion to the IMU alone. What counts are landmarks of known position that are observed again,
and whether they are where the prediction puts them: the innovation of a filter and its chi-squared test (Bar-Shalom,
Li, Kirubarajan, "Estimation with applications to tracking and navigation", 2001, section 5.4).

The states of health, in the order of their tests:

lost           The state is not finite; or its speed or a bias is implausible; or most landmarks have contradicted it
               for too long, by their distance or by its ratio to the standard deviation, or soon after images that
               no feature connects with the earlier ones; or the IMU alone has
               propagated it until its position, by its own covariance, is useless. It stays lost
               until the odometry is initialized again, with another monitor.
inertial-only  Too few landmarks constrain the estimate, and the vehicle is not stationary; or the innovations, or the
               change of the position by a correction of the calibration, have recently contradicted their covariance.
tracking       Landmarks constrain the estimate, or the vehicle is stationary or has only begun to move.
"""

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import numpy.typing as npt

from dronevio.estimator.backend.landmarks import TriangulatedLandmarks
from dronevio.estimator.innovation import Innovation, PredictionUncertainty, innovation
from dronevio.estimator.optimization.linear_fit import median
from dronevio.estimator.trust import Trust, TrustLimits
from dronevio.estimator.types import Calibration, Observations
from dronevio.models.imu import ImuModel
from dronevio.models.ranges import Range, Settings
from dronevio.models.state import Health, HealthReport, NavState

Array = npt.NDArray[np.float64]


INCONSISTENT = "images and prediction have recently been inconsistent"
"""Reason of the health of an estimate that is not trusted."""
IMAGE_VARIANCES = 10
"""Number of keyframes from which the variance of image observations is taken."""


@dataclass(frozen=True)
class HealthConfig(Settings):
    """Settings of the health monitor."""

    min_landmarks: Annotated[int, Range(1, 1000)] = 8
    """Smallest number of landmarks that constrain an estimate; with fewer, a single outlier dominates."""
    settling_s: Annotated[float, Range(0.0, 60.0)] = 0.42
    """Time for which tracked features suffice instead of landmarks [s], as at the end of a stationary interval. Three
    keyframes with parallax are needed to triangulate landmarks."""
    max_innovation_px: Annotated[float, Range(above=0.0, infinite=True)] = 12.0
    """Median innovation beyond which the landmarks contradict the estimate [px]. A time offset of 5 ms at 300 °/s
    causes it with the lens of EuRoC."""
    max_contradiction_s: Annotated[float, Range(low=0.0, infinite=True)] = 1.0
    """Time for which landmarks may contradict the estimate before it is lost [s]. Jolts and large passing objects take
    less."""
    consistency_window_s: Annotated[float, Range(0.05, 60.0)] = 0.6
    """Length of the window over which the median NIS of the innovations is taken [s]. A jolt or a passing object
    disturbs fewer frames."""
    max_consistent_nis: Annotated[float, Range(above=0.0, infinite=True)] = 12.0
    """Largest such median, in units of its expectation, at which the estimate counts as consistent. On rendered
    flights it reaches 10, on real images 4."""
    min_innovation_px: Annotated[float, Range(low=0.0)] = 0.3
    """Median innovation of a frame up to which it counts as consistent, whatever its NIS [px]. Motion blur and the
    errors of landmarks exceed the assumed noise in fast flight."""
    max_frame_nis: Annotated[float, Range(above=0.0, infinite=True)] = 45.0
    """Largest NIS of a frame at which the estimate counts as consistent."""
    distrust_s: Annotated[float, Range(low=0.0, infinite=True)] = 10.0
    """Time for which an estimate must be consistent again before its health is tracking [s]."""
    established_s: Annotated[float, Range(low=0.0, infinite=True)] = 10.0
    """Time of consistent motion after which an estimate is established [s]: what contradicts it later is more probably
    a disturbance than a wrong calibration."""
    established_nis_ratio: Annotated[float, Range(1.0, 100.0)] = 2.0
    """Ratio by which the largest NIS of an established estimate may be larger, in a frame and in the median."""
    disturbance_s: Annotated[float, Range(low=0.0, infinite=True)] = 0.6
    """Longest contradiction of an established estimate that counts as a disturbance, and the time for which the
    estimate must be consistent after it before its health is tracking [s]."""
    max_change_sigmas: Annotated[float, Range(above=0.0, infinite=True)] = 5.0
    """Largest change of the position by a correction of the calibration, in standard deviations of the published
    position, at which the estimate counts as consistent."""
    disconnected_s: Annotated[float, Range(low=0.0, infinite=True)] = 5.0
    """Time after a keyframe without a common feature with the one before, in which inconsistent innovations mean a loss
    [s]: the images show another place, as when they are exchanged or the vehicle is carried away."""
    max_bias_change_sigmas: Annotated[float, Range(above=0.0, infinite=True)] = 3.0
    """Largest change of the accelerometer bias in that time, in standard deviations before it, to which
    `max_accel_bias_change_m_s2` is added. A larger one hides that the direction of gravity is another one."""
    max_accel_bias_change_m_s2: Annotated[float, Range(above=0.0, infinite=True)] = 0.1
    """Largest change of an accelerometer bias that is known exactly [m/s²]; 0.1 m/s² are 0.6° of inclination."""
    max_nis: Annotated[float, Range(above=0.0, infinite=True)] = 60.0
    """Median NIS over the window beyond which the estimate is lost."""
    image_variance_bounds: Annotated[tuple[float, float], Range(1e-6, 1e6)] = (0.1, 10.0)
    """Bounds of the variance of image observations, relative to that of the smoother, in the covariance of innovations.
    It is the median over the last keyframes."""
    max_noise_ratio: Annotated[float, Range(above=0.0, infinite=True)] = 3.0
    """Largest ratio of the IMU's noise densities, as estimated in flight, to those of the data sheet in the covariance
    of innovations. A wrong calibration increases the estimates without bound. What the samples themselves show, at rest
    or by their spectrum, counts in full."""
    max_inertial_sigma_m: Annotated[float, Range(above=0.0, infinite=True)] = 1.0
    """Largest increase of the position's standard deviation while the IMU alone propagates the estimate [m]. The IMU of
    EuRoC reaches it in some 10 s."""
    max_speed_m_s: Annotated[float, Range(above=0.0, infinite=True)] = 60.0
    """Largest plausible speed [m/s], beyond that of racing drones."""
    gyro_bias_sigma_rad_s: Annotated[float, Range(1e-6, 10.0)] = 0.05
    """Lower bound of the standard deviation of the gyroscope bias [rad/s]. The bias of EuRoC is 0.08, where the data
    sheet states 0.01."""
    accel_bias_sigma_m_s2: Annotated[float, Range(1e-6, 100.0)] = 0.2
    """Lower bound of the standard deviation of the accelerometer bias [m/s²]. The bias of EuRoC reaches 0.5."""
    max_bias_sigmas: Annotated[float, Range(above=0.0, infinite=True)] = 10.0
    """Largest plausible bias, in these standard deviations."""
    max_first_bias_sigmas: Annotated[float, Range(above=0.0, infinite=True)] = 2.5
    """Largest bias by an initialization in motion, in these standard deviations, at which its estimate counts as
    consistent from the beginning. A bias of the gyroscope explains wrong rotations for some tenths of a second."""


class HealthMonitor:
    """Assesses an estimate frame by frame, from its initialization to its loss."""

    def __init__(
        self,
        imu: ImuModel,
        config: HealthConfig,
        pixel_sigma: float,
        *,
        is_trusted: bool = True,
    ) -> None:
        """Begin at an initialization.

        Args:
            imu: The sensor model.
            config: Settings.
            pixel_sigma: Standard deviation of an image observation [px].
            is_trusted: Whether the estimate counts as consistent from its beginning, not only after `distrust_s`.
        """
        self._config, self._imu = config, imu
        self._pixel_sigma, self._image_variances = pixel_sigma, tuple[float, ...]()
        self._image_variance = 1.0  # of image observations relative to the assumed one
        self._noise_densities = imu.gyro_noise_density, imu.accel_noise_density
        self._trust = Trust(_limits(config), is_trusted=is_trusted)
        self._bias_sigmas = np.repeat(
            [
                max(config.gyro_bias_sigma_rad_s, imu.gyro_turn_on_bias_rad_s),
                max(config.accel_bias_sigma_m_s2, imu.accel_turn_on_bias_m_s2),
            ],
            3,
        )
        self._keyframe: NavState | None = None
        self._landmarks = TriangulatedLandmarks(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros(0))
        self._constrained_ns: int | None = None  # last time at which more than the IMU constrained the estimate
        self._constrained_sigma_m = 0.0  # standard deviation of the position at that time
        self._consistent_ns: int | None = None  # last time at which landmarks did not contradict the estimate
        self._disconnected_ns: int | None = None  # last time at which no feature connected the images
        self._connected: NavState | None = None  # the keyframe before
        self._lost_reason: str | None = None

    @property
    def is_trusted(self) -> bool:
        """Whether the innovations have agreed with their covariance for long enough, or always."""
        return self._trust.is_trusted

    def begin_in_motion(self, state: NavState) -> None:
        """Note the state of an initialization in motion; a bias that was improbable contradicts the estimate."""
        if self._bias_in_sigmas(state) > self._config.max_first_bias_sigmas:
            self._trust.contradict(state.t_ns)

    def set_reference(
        self,
        keyframe: NavState,
        landmarks: TriangulatedLandmarks,
        image_variance: float | None,
        noise_densities: tuple[float, float],
        measured_densities: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        """Set what the next frames are compared with.

        Args:
            keyframe: The newest keyframe's state.
            landmarks: The landmarks that constrain the window.
            image_variance: Variance of the window's image observations relative to the assumed one; None if unknown.
            noise_densities: Estimates for gyroscope [rad/s/√Hz] and accelerometer [m/s²/√Hz].
            measured_densities: Those that the samples themselves show, which a wrong calibration does not increase.
        """
        sheet, ratio = (self._imu.gyro_noise_density, self._imu.accel_noise_density), self._config.max_noise_ratio
        known = zip(noise_densities, sheet, measured_densities, strict=True)
        # The estimate follows some seconds later, so that what the samples show counts at once.
        gyro, accel = (max(given, min(estimated, ratio * given), shown) for estimated, given, shown in known)
        self._noise_densities = gyro, accel
        self._keyframe, self._landmarks = keyframe, landmarks
        if image_variance is not None:
            self._image_variances = (*self._image_variances, image_variance)[-IMAGE_VARIANCES:]
            median_variance = float(np.median(self._image_variances))
            self._image_variance = float(np.clip(median_variance, *self._config.image_variance_bounds))

    def disconnect(self, t_ns: int) -> None:
        """Note that no feature connects the images with earlier ones: they may show another place.

        Args:
            t_ns: Time of the first image of the new ones [ns].
        """
        if self._trust.is_trusted:
            self._disconnected_ns, self._connected = t_ns, self._keyframe
        self._trust.restart_motion()

    def is_disconnected(self, t_ns: int) -> bool:
        """Return whether no feature has connected the images in the last `disconnected_s` before a time [ns]."""
        since_ns = None if self._disconnected_ns is None else t_ns - self._disconnected_ns
        return since_ns is not None and since_ns * 1e-9 <= self._config.disconnected_s

    def correct(self, before: NavState, after: NavState) -> None:
        """Note that another calibration has changed the state; a change that was improbable contradicts the estimate.

        Args:
            before: The published state by the previous calibration.
            after: The state at the same time by the other one.
        """
        change_m = float(np.linalg.norm(after.T_world_imu[:3, 3] - before.T_world_imu[:3, 3]))
        if change_m > self._config.max_change_sigmas * _sigmas(before)[0]:
            self._trust.contradict(after.t_ns)

    def assess(
        self,
        observations: Observations,
        predicted: NavState,
        stationary: bool,
        calibration: Calibration,
        *,
        has_image: bool = True,
    ) -> HealthReport:
        """Return the health of the estimate at a frame.

        Args:
            observations: The features tracked into the frame.
            predicted: The state that the IMU predicts for the frame from the newest keyframe.
            stationary: Whether the vehicle is stationary, which constrains the estimate.
            calibration: The calibration in use.
            has_image: Whether the frame has an image; one that lacks it says nothing about the landmarks.
        """
        if not _is_finite(predicted):
            self._lost_reason = self._lost_reason or "the state is not finite"
            return HealthReport(Health.LOST, self._lost_reason, tracks=len(observations))
        found = self.innovation(observations, predicted, calibration)
        rows, innovation_px, nis = found.rows, found.median_px, found.nis
        position_sigma_m, velocity_sigma_m_s = _sigmas(predicted)
        bias_sigmas = self._bias_in_sigmas(predicted)
        enough = len(rows) >= self._config.min_landmarks
        inertial_only_s = self._inertial_only_s(predicted.t_ns, enough or stationary, position_sigma_m)
        allowed_px = self._config.max_innovation_px + self._rotation_uncertainty_px(predicted, calibration)
        contradicted_s = self._contradicted_s(predicted.t_ns, enough and innovation_px > allowed_px)
        significant_nis = nis if innovation_px > self._config.min_innovation_px else 0.0
        self._trust.update(predicted.t_ns, significant_nis if enough else None, moves=not stationary)
        if self._lost_reason is None:
            self._lost_reason = self._reason_of_loss(predicted, bias_sigmas, position_sigma_m, contradicted_s)
        if self._lost_reason is not None:
            state, reason = Health.LOST, self._lost_reason
        elif not self._trust.is_trusted:
            state, reason = Health.INERTIAL_ONLY, INCONSISTENT
        elif enough:
            state, reason = Health.TRACKING, f"constrained by {len(rows)} landmarks"
        elif stationary:
            state, reason = Health.TRACKING, "stationary"
        elif not has_image and inertial_only_s <= self._config.settling_s + 1e-6:
            state, reason = Health.TRACKING, f"no image for {inertial_only_s:.2f} s"
        elif len(observations) >= self._config.min_landmarks and inertial_only_s <= self._config.settling_s + 1e-6:
            state, reason = Health.TRACKING, "features are tracked and not triangulated yet"
        else:
            few = f"constrained by {len(rows)} landmarks; {self._config.min_landmarks} are needed"
            state, reason = Health.INERTIAL_ONLY, few
        return HealthReport(
            state,
            reason,
            tracks=len(observations),
            landmarks=len(rows),
            median_parallax_rad=median(self._landmarks.parallax_rad[rows]) if len(rows) else None,
            innovation_px=innovation_px if len(rows) else None,
            innovation_nis=nis if len(rows) else None,
            bias_sigmas=bias_sigmas,
            position_sigma_m=position_sigma_m,
            velocity_sigma_m_s=velocity_sigma_m_s,
            inertial_only_s=inertial_only_s,
        )

    def innovation(self, observations: Observations, predicted: NavState, calibration: Calibration) -> Innovation:
        """Return the innovation of a frame by the newest keyframe's landmarks.

        Args:
            observations: The features tracked into the frame.
            predicted: The state that the IMU predicts for the frame from the newest keyframe.
            calibration: The calibration in use.
        """
        uncertainty = PredictionUncertainty(
            *self._prediction_covariance(predicted), self._pixel_sigma**2 * self._image_variance
        )
        landmarks = self._landmarks
        return innovation(landmarks.ids, landmarks.points, observations, predicted, uncertainty, calibration)

    def _bias_in_sigmas(self, state: NavState) -> float:
        """Return the largest bias in standard deviations of its prior."""
        bias = np.concatenate([state.gyro_bias_rad_s, state.accel_bias_m_s2])
        return float((np.abs(bias) / self._bias_sigmas).max())

    def _has_bias_changed(self, predicted: NavState) -> bool:
        """Return whether the accelerometer bias differs from that before the images were disconnected."""
        before, c = self._connected, self._config
        if before is None or before.covariance is None:
            return False
        sigma = np.sqrt(np.diag(before.covariance)[12:])
        change = np.abs(predicted.accel_bias_m_s2 - before.accel_bias_m_s2)
        return bool(np.any(change > c.max_accel_bias_change_m_s2 + c.max_bias_change_sigmas * sigma))

    def _prediction_covariance(self, predicted: NavState) -> tuple[Array, float]:
        """Return the uncertainty of the prediction since the newest keyframe.

        These are the leading terms of `propagate_covariance` over some tenths of a second.

        Returns:
            The covariance (3, 3) of the position [m²] and the variance of the orientation about any axis [rad²].
        """
        start = self._keyframe
        if start is None or start.covariance is None:
            return np.zeros((3, 3)), 0.0
        t, P = (predicted.t_ns - start.t_ns) * 1e-9, start.covariance
        gyro_bias, accel_bias = float(np.trace(P[9:12, 9:12])) / 3.0, float(np.trace(P[12:, 12:])) / 3.0
        gyro_density, accel_density = self._noise_densities
        accel_variance = 0.25 * t**4 * accel_bias + accel_density**2 * t**3 / 3.0
        return t * t * P[6:9, 6:9] + accel_variance * np.eye(3), t * t * gyro_bias + t * gyro_density**2

    def _rotation_uncertainty_px(self, predicted: NavState, calibration: Calibration) -> float:
        """Return the effect of the rotation's uncertainty since the newest keyframe on the image [px]."""
        start = self._keyframe
        if start is None or start.covariance is None or predicted.covariance is None:
            return 0.0
        both = np.stack([start.covariance[:3, :3], predicted.covariance[:3, :3]])
        variance_before, variance = np.linalg.eigvalsh(both)[:, -1].tolist()
        return float(calibration.focal_px[0]) * math.sqrt(max(variance - variance_before, 0.0))

    def _inertial_only_s(self, t_ns: int, constrained: bool, position_sigma_m: float) -> float:
        """Return the time for which the IMU alone has propagated the estimate [s]."""
        if constrained or self._constrained_ns is None:
            self._constrained_ns, self._constrained_sigma_m = t_ns, position_sigma_m
        return (t_ns - self._constrained_ns) * 1e-9

    def _contradicted_s(self, t_ns: int, contradicted: bool) -> float:
        """Return the time for which landmarks have contradicted the estimate [s]."""
        if not contradicted or self._consistent_ns is None:
            self._consistent_ns = t_ns
        return (t_ns - self._consistent_ns) * 1e-9

    def _reason_of_loss(
        self, predicted: NavState, bias_sigmas: float, position_sigma_m: float, contradicted_s: float
    ) -> str | None:
        """Return the reason why the estimate is lost, or None where it is not."""
        c, speed_m_s = self._config, float(np.linalg.norm(predicted.velocity_m_s))
        if speed_m_s > c.max_speed_m_s:
            return f"a speed of {speed_m_s:.0f} m/s"
        if bias_sigmas > c.max_bias_sigmas:
            return f"a bias of {bias_sigmas:.0f} standard deviations"
        if contradicted_s > c.max_contradiction_s:
            return f"landmarks have contradicted the estimate for {contradicted_s:.1f} s"
        if self._disconnected_ns is not None and self.is_disconnected(predicted.t_ns):
            since_s = (predicted.t_ns - self._disconnected_ns) * 1e-9
            if not self._trust.is_trusted or self._has_bias_changed(predicted):
                return f"no feature connects the images with those of {since_s:.1f} s ago, and they contradict the IMU"
        nis = self._trust.median_nis
        if nis > c.max_nis:
            return f"images and prediction are inconsistent: a NIS of {nis:.0f} over {c.consistency_window_s:g} s"
        grown_m = float(np.sqrt(max(position_sigma_m**2 - self._constrained_sigma_m**2, 0.0)))
        if grown_m > c.max_inertial_sigma_m:
            return f"the position has drifted by {grown_m:.1f} m (one sigma) on the IMU alone"
        return None


def _limits(config: HealthConfig) -> TrustLimits:
    """Return the limits of a trusted estimate."""
    return TrustLimits(
        config.consistency_window_s,
        config.max_consistent_nis,
        config.max_frame_nis,
        config.distrust_s,
        config.established_s,
        config.established_nis_ratio,
        config.disturbance_s,
    )


def _is_finite(state: NavState) -> bool:
    """Return whether all numbers of a state are finite."""
    known = () if state.covariance is None else (state.covariance,)
    parts = (state.T_world_imu, state.velocity_m_s, state.gyro_bias_rad_s, state.accel_bias_m_s2, *known)
    return all(bool(np.isfinite(part).all()) for part in parts)


def _sigmas(state: NavState) -> tuple[float, float]:
    """Return the standard deviations of position [m] and velocity [m/s] along their worst axes; infinite if unknown."""
    P = state.covariance
    if P is None:
        return float("inf"), float("inf")
    position, velocity = np.linalg.eigvalsh(np.stack([P[3:6, 3:6], P[6:9, 6:9]]))[:, -1]
    return float(np.sqrt(max(position, 0.0))), float(np.sqrt(max(velocity, 0.0)))
