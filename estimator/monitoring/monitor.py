"""The health monitor: it assesses an estimate frame by frame, from its initialization to its loss."""

from dataclasses import dataclass, replace

import numpy as np

from dronevio.estimator.backend.landmarks import TriangulatedLandmarks
from dronevio.estimator.monitoring.causes import Cause, Reason
from dronevio.estimator.monitoring.config import HealthConfig
from dronevio.estimator.monitoring.consistency import ConsistencyMonitor
from dronevio.estimator.monitoring.health import Assessment
from dronevio.estimator.monitoring.innovation import Innovation
from dronevio.estimator.monitoring.reference import Reference
from dronevio.estimator.optimization.linear_fit import median
from dronevio.estimator.types import Calibration, CalibrationSigmas, ExpectedFeatures, Observations
from dronevio.models.imu import ImuModel
from dronevio.models.state import HealthQuantities, NavState

MAX_BIAS_SIGMAS = 10.0
"""Largest plausible bias, in standard deviations of the bias."""
KNOWN = CalibrationSigmas()
"""A calibration without errors."""
IMAGE_VARIANCES = 10
"""Number of keyframes from which the variance of image observations is taken."""


@dataclass(frozen=True)
class _Since:
    """Times at which the estimate was constrained."""

    constrained_ns: int
    """Last time at which more than the IMU constrained the estimate."""
    constrained_sigma_m: float
    """Standard deviation of the position at that time."""
    consistent_ns: int
    """Last time at which landmarks did not contradict the estimate."""


@dataclass(frozen=True, eq=False)
class _Disconnection:
    """The last time at which no feature connected the images, which may show another place since."""

    t_ns: int
    """Time of the first image after it."""
    before: NavState
    """The keyframe before."""


class HealthMonitor:
    """Assesses an estimate frame by frame."""

    def __init__(
        self,
        imu: ImuModel,
        config: HealthConfig,
        pixel_sigma: float,
        *,
        is_consistent: bool = True,
    ) -> None:
        """Begin at an initialization.

        Args:
            imu: The sensor model.
            config: Settings.
            pixel_sigma: Standard deviation of an image observation [px].
            is_consistent: Whether the estimate counts as consistent from its beginning, not only after `recovery_s`.
        """
        self._config, self._imu, self._pixel_sigma = config, imu, pixel_sigma
        self._consistency = ConsistencyMonitor(config, is_consistent=is_consistent)
        self._image_variances: tuple[float, ...] = ()  # of the last keyframes, relative to the assumed one
        self._reference: Reference | None = None  # None before the first keyframe
        self._since: _Since | None = None  # None before the first frame
        self._disconnection: _Disconnection | None = None
        self._loss: Reason | None = None
        self._assessment: Assessment | None = None  # of the last frame whose images were tracked

    @property
    def is_consistent(self) -> bool:
        """Whether the innovations have agreed with their covariance for long enough, or always."""
        return self._consistency.is_consistent

    def begin_in_motion(self, state: NavState) -> None:
        """Note the state of an initialization in motion; a bias that was improbable contradicts the estimate."""
        if self._bias_in_sigmas(state) > self._config.max_first_bias_sigmas:
            self._consistency.add_contradiction(state.t_ns)

    def set_reference(
        self,
        keyframe: NavState,
        landmarks: TriangulatedLandmarks,
        image_variance: float | None,
        noise_densities: tuple[float, float],
        measured_densities: tuple[float, float] = (0.0, 0.0),
        calibration: CalibrationSigmas = KNOWN,
    ) -> None:
        """Set what the next frames are compared with.

        Args:
            keyframe: The newest keyframe's state.
            landmarks: The landmarks that constrain the window.
            image_variance: Variance of the window's image observations relative to the assumed one; None if unknown.
            noise_densities: Estimates for gyroscope [rad/s/√Hz] and accelerometer [m/s²/√Hz].
            measured_densities: Those that the samples themselves show, which a wrong calibration does not increase.
            calibration: Standard deviations of the calibration in use.
        """
        sheet, ratio = (self._imu.gyro_noise_density, self._imu.accel_noise_density), self._config.max_noise_ratio
        known = zip(noise_densities, sheet, measured_densities, strict=True)
        # The estimate follows some seconds later, so that what the samples show counts at once.
        gyro, accel = (max(given, min(estimated, ratio * given), shown) for estimated, given, shown in known)
        if image_variance is not None:
            self._image_variances = (*self._image_variances, image_variance)[-IMAGE_VARIANCES:]
        bounds, variance = self._config.image_variance_bounds, 1.0
        if self._image_variances:
            variance = float(np.clip(float(np.median(self._image_variances)), *bounds))
        self._reference = Reference(keyframe, landmarks, self._pixel_sigma**2 * variance, gyro, accel, calibration)

    def disconnect(self, t_ns: int) -> None:
        """Note that no feature connects the images with earlier ones: they may show another place.

        Args:
            t_ns: Time of the first image of the new ones [ns].
        """
        if self.is_consistent and self._reference is not None:
            self._disconnection = _Disconnection(t_ns, self._reference.keyframe)
        self._consistency.restart_motion()

    def is_disconnected(self, t_ns: int) -> bool:
        """Return whether no feature has connected the images in the last `disconnected_s` before a time [ns]."""
        last = self._disconnection
        return last is not None and (t_ns - last.t_ns) * 1e-9 <= self._config.disconnected_s

    def correct(self, before: NavState, after: NavState) -> None:
        """Note that another calibration has changed the state; a change that was improbable contradicts the estimate.

        Args:
            before: The published state by the previous calibration.
            after: The state at the same time by the other one.
        """
        change_m = float(np.linalg.norm(after.T_world_imu[:3, 3] - before.T_world_imu[:3, 3]))
        if change_m > self._config.max_change_sigmas * _sigmas(before)[0]:
            self._consistency.add_contradiction(after.t_ns)

    def assess(
        self,
        observations: Observations,
        predicted: NavState,
        stationary: bool,
        calibration: Calibration,
        *,
        has_image: bool = True,
        is_left_out: bool = False,
    ) -> Assessment:
        """Return what is known about the estimate at a frame.

        Args:
            observations: The features tracked into the frame.
            predicted: The state that the IMU predicts for the frame from the newest keyframe.
            stationary: Whether the vehicle is stationary, which constrains the estimate.
            calibration: The calibration in use.
            has_image: Whether the frame has an image; one that lacks it says nothing about the landmarks.
            is_left_out: Whether its image was not tracked, because it shows what is expected. Otherwise, what the last
                one said still holds.
        """
        c, t_ns = self._config, predicted.t_ns
        if not _is_finite(predicted):
            self._loss = self._loss or Reason.of(Cause.NOT_FINITE)
            return Assessment(tracks=len(observations), loss=self._loss)

        position_sigma_m, velocity_sigma_m_s = _sigmas(predicted)
        if is_left_out and self._assessment is not None:
            self._consistency.update(t_ns, 0.0, moves=not stationary)  # the image agrees with the prediction
            return replace(self._assessment, position_sigma_m=position_sigma_m, velocity_sigma_m_s=velocity_sigma_m_s)

        # Innovation of the landmarks of known position
        innovation = self.innovation(observations, predicted, calibration)
        count, innovation_px, nis = len(innovation), innovation.median_px, innovation.nis
        is_constrained = count >= c.min_landmarks

        # Since when the IMU alone, or against the landmarks, propagates the estimate
        since = self._since or _Since(t_ns, position_sigma_m, t_ns)
        if is_constrained or stationary:
            since = replace(since, constrained_ns=t_ns, constrained_sigma_m=position_sigma_m)
        reference = self._required_reference
        excess_px = innovation_px - c.max_innovation_px if is_constrained else 0.0
        if excess_px <= 0.0 or excess_px <= reference.rotation_uncertainty_px(predicted, calibration):
            since = replace(since, consistent_ns=t_ns)
        self._since = since

        # Consistency of innovations and covariance
        significant_nis = nis if innovation_px > c.min_innovation_px else 0.0
        self._consistency.update(t_ns, significant_nis if is_constrained else None, moves=not stationary)

        quantities = HealthQuantities(
            tracks=len(observations),
            landmarks=count,
            median_parallax_rad=median(reference.landmarks.parallax_rad[innovation.rows]) if count else None,
            innovation_px=innovation_px if count else None,
            innovation_nis=nis if count else None,
            bias_sigmas=self._bias_in_sigmas(predicted),
            position_sigma_m=position_sigma_m,
            velocity_sigma_m_s=velocity_sigma_m_s,
            inertial_only_s=(t_ns - since.constrained_ns) * 1e-9,
        )
        self._loss = self._loss or self._reason_of_loss(predicted, quantities, since)
        self._assessment = Assessment(
            **vars(quantities),
            loss=self._loss,
            is_consistent=self.is_consistent,
            stationary=stationary,
            has_image=has_image,
        )
        return self._assessment

    def innovation(self, observations: Observations, predicted: NavState, calibration: Calibration) -> Innovation:
        """Return the innovation of a frame by the newest keyframe's landmarks; see `Reference.innovation`."""
        return self._required_reference.innovation(observations, predicted, calibration)

    def expected(self, predicted: NavState, calibration: Calibration) -> ExpectedFeatures:
        """Return where a predicted state expects the newest keyframe's landmarks in the images."""
        landmarks, T = self._required_reference.landmarks, predicted.T_world_imu
        return ExpectedFeatures(landmarks.ids, calibration.rays((landmarks.points - T[:3, 3]) @ T[:3, :3]))

    @property
    def _required_reference(self) -> Reference:
        assert self._reference is not None  # `set_reference` comes first
        return self._reference

    def _bias_in_sigmas(self, state: NavState) -> float:
        """Return the largest bias in standard deviations of its prior."""
        c, imu = self._config, self._imu
        gyro_sigma = max(c.gyro_bias_sigma_rad_s, imu.gyro_turn_on_bias_rad_s)
        accel_sigma = max(c.accel_bias_sigma_m_s2, imu.accel_turn_on_bias_m_s2)
        in_sigmas = np.concatenate([state.gyro_bias_rad_s / gyro_sigma, state.accel_bias_m_s2 / accel_sigma])
        return float(np.abs(in_sigmas).max())

    def _is_another_place(self, predicted: NavState, before: NavState) -> bool:
        """Return whether images that no feature connects contradict the IMU, also by another accelerometer bias."""
        if not self.is_consistent:
            return True
        if before.covariance is None:
            return False
        c, sigma = self._config, np.sqrt(np.diag(before.covariance)[12:])
        change = np.abs(predicted.accel_bias_m_s2 - before.accel_bias_m_s2)
        return bool(np.any(change > c.max_accel_bias_change_m_s2 + c.max_bias_change_sigmas * sigma))

    def _reason_of_loss(self, predicted: NavState, known: HealthQuantities, since: _Since) -> Reason | None:
        """Return the reason why the estimate is lost, or None where it is not."""
        c, t_ns, last = self._config, predicted.t_ns, self._disconnection
        speed_m_s = float(np.linalg.norm(predicted.velocity_m_s))
        if speed_m_s > c.max_speed_m_s:
            return Reason.of(Cause.SPEED, speed_m_s=speed_m_s)
        bias_sigmas = known.bias_sigmas or 0.0
        if bias_sigmas > MAX_BIAS_SIGMAS:
            return Reason.of(Cause.BIAS, bias_sigmas=bias_sigmas)
        contradicted_s = (t_ns - since.consistent_ns) * 1e-9
        if contradicted_s > c.max_contradiction_s:
            return Reason.of(Cause.CONTRADICTED, contradicted_s=contradicted_s)
        if self.is_disconnected(t_ns) and last is not None and self._is_another_place(predicted, last.before):
            return Reason.of(Cause.DISCONNECTED, disconnected_s=(t_ns - last.t_ns) * 1e-9)
        nis = self._consistency.median_nis
        if nis > c.max_nis:
            return Reason.of(Cause.INNOVATIONS, nis=nis, window_s=c.consistency_window_s)
        sigma_m = known.position_sigma_m or 0.0
        drift_m = float(np.sqrt(max(sigma_m**2 - since.constrained_sigma_m**2, 0.0)))
        return Reason.of(Cause.DRIFT, drift_m=drift_m) if drift_m > c.max_inertial_sigma_m else None


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
