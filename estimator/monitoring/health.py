"""Health of the estimate: what constrains it, how well it fits the measurements, and whether it can be trusted.

The number of tracked features does not measure health: in front of a distant wall, or while hovering after a rotation,
many tracks may leave the motion to the IMU alone. The measure is the number of landmarks that are observed again, and
their distance from the predicted positions: the innovation of a filter and its chi-squared test (Bar-Shalom, Li,
Kirubarajan, "Estimation with applications to tracking and navigation", 2001, section 5.4).

The states of health, in the order of their tests:

lost           The state is not finite; or its speed or a bias is implausible; or most landmarks have contradicted it
               for too long, by their distance or by its ratio to the standard deviation, or soon after images that
               no feature connects with the earlier ones; or the IMU alone has propagated it until its position, by its
               own covariance, is useless; or a vehicle cannot have moved to it. It stays lost until the odometry is
               initialized again.
inertial-only  A correction of the calibration was implausible; or one leaves it unknown, which only motion can end, and
               the vehicle is not stationary; or the innovations, or the change of the position by a correction, have
               recently contradicted their covariance; or too few landmarks constrain the estimate, and the vehicle is
               not stationary; or vibration is aliased.
tracking       Landmarks constrain the estimate, or the vehicle is stationary or has only begun to move.
"""

from dataclasses import dataclass

from dronevio.estimator.monitoring.causes import Cause, Reason
from dronevio.estimator.monitoring.config import HealthConfig
from dronevio.models.state import Health, HealthQuantities, HealthReport


@dataclass(frozen=True, kw_only=True)
class Assessment(HealthQuantities):
    """What is known about the estimate at one frame."""

    loss: Reason | None = None
    """Why the estimate is lost; None if it is not."""
    is_consistent: bool = True
    """Whether innovations have agreed with their covariance for long enough."""
    is_calibration_plausible: bool = True
    """Whether all corrections of the calibration have been plausible."""
    is_calibration_known: bool = True
    """Whether the given calibration has not been refuted, or the calibration is known again."""
    is_noise_excessive: bool = False
    """Whether images and samples show that the noise of the IMU is far above that of its data sheet."""
    is_noise_aliased: bool = False
    """Whether vibration appears as slow motion, since samples of the IMU are left out."""
    stationary: bool = False
    """Whether the vehicle is stationary."""
    has_image: bool = True
    """Whether the frame has an image."""


def health_report(assessment: Assessment, config: HealthConfig) -> HealthReport:
    """Return the health of an estimate with its cause."""
    health, reason = _status(assessment, config)
    return report_of(health, reason, assessment)


def report_of(health: Health, reason: Reason, quantities: HealthQuantities) -> HealthReport:
    """Return the report of a given health."""
    return HealthReport(health, reason.text, reason.cause, **vars(quantities.quantities))


def _status(a: Assessment, c: HealthConfig) -> tuple[Health, Reason]:
    """Return the health and its cause, by the first test that fails or else by what constrains the estimate."""
    is_constrained = a.landmarks >= c.min_landmarks
    is_settling = a.inertial_only_s <= c.settling_s + 1e-6 and (not a.has_image or a.tracks >= c.min_landmarks)
    if a.loss is not None:
        return Health.LOST, a.loss
    if not a.is_calibration_plausible:
        return Health.INERTIAL_ONLY, Reason.of(Cause.IMPLAUSIBLE_CALIBRATION)
    if not (a.is_calibration_known or a.stationary):
        return Health.INERTIAL_ONLY, Reason.of(Cause.UNKNOWN_CALIBRATION)
    if not a.is_consistent:
        return Health.INERTIAL_ONLY, Reason.of(Cause.INCONSISTENT)
    if not (is_constrained or a.stationary or is_settling):
        return Health.INERTIAL_ONLY, Reason.of(
            Cause.FEW_LANDMARKS, landmarks=a.landmarks, min_landmarks=c.min_landmarks
        )
    if a.is_noise_aliased:
        return Health.INERTIAL_ONLY, Reason.of(Cause.EXCESSIVE_NOISE)
    if is_constrained:
        return Health.TRACKING, Reason.of(Cause.LANDMARKS, landmarks=a.landmarks)
    if a.stationary:
        return Health.TRACKING, Reason.of(Cause.STATIONARY)
    if not a.has_image:
        return Health.TRACKING, Reason.of(Cause.NO_IMAGE, inertial_only_s=a.inertial_only_s)
    return Health.TRACKING, Reason.of(Cause.NOT_TRIANGULATED)
