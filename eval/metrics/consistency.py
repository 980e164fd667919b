"""Consistency: whether errors agree with the covariances that an estimator computes.

The normalized estimation error squared (NEES) has an expected value of 3 each for position, orientation and velocity if
the covariance is right; larger values mean that the estimator is overconfident. The gauge, position and yaw, which are
unobservable for an odometry, is fixed at the first pose and not by a best fit, which would remove a part of the error.

Reference: Bar-Shalom, Li, Kirubarajan, "Estimation with applications to tracking and navigation", 2001, section 5.4.
"""

from dataclasses import dataclass, replace

import numpy as np

from dronevio.eval.metrics.alignment import Alignment, align
from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError, EvaluationError
from dronevio.models.imu import Times
from dronevio.models.rotation import cross, log_so3
from dronevio.models.state import Trajectory


@dataclass(frozen=True, eq=False)
class Consistency:
    """Errors with their estimated uncertainty, at all poses after the first, at which the gauge is fixed."""

    t_ns: Times
    """(N,) Time stamps of the poses [ns]."""
    position_error_m: Array
    """(N, 3) True minus estimated positions in the world frame of the truth [m]."""
    position_sigma_m: Array
    """(N, 3) Estimated standard deviations of the position errors [m]."""
    position_nees: Array
    """(N,) NEES of the position; 3 expected."""
    orientation_error_rad: Array
    """(N, 3) Rotation vectors from estimate to truth in the IMU frame [rad]."""
    orientation_sigma_rad: Array
    """(N, 3) Estimated standard deviations of the orientation errors [rad]."""
    orientation_nees: Array
    """(N,) NEES of the orientation; 3 expected."""
    velocity_nees: Array | None = None
    """(N,) NEES of the velocity in the world frame, 3 expected; None if truth or estimate has no velocities, or the
    estimate no covariances of them."""

    @property
    def position_exceedance(self) -> float:
        """Share, 0 to 1, of the position errors of all axes and poses beyond 3σ; 0.0027 expected."""
        return float(np.mean(np.abs(self.position_error_m) > 3.0 * self.position_sigma_m))

    @property
    def orientation_exceedance(self) -> float:
        """Share, 0 to 1, of the orientation errors of all axes and poses beyond 3σ; 0.0027 expected."""
        return float(np.mean(np.abs(self.orientation_error_rad) > 3.0 * self.orientation_sigma_rad))


@dataclass(frozen=True, eq=False)
class Anees:
    """The average NEES (ANEES) over runs at each time, with the bounds of a consistent estimator."""

    mean: Array
    """(N,) Mean NEES over the runs."""
    bounds: tuple[float, float]
    """Two-sided bounds of the mean of a consistent estimator."""
    inside_percent: float
    """Share of the times at which the mean is within the bounds [%]; 95 expected by default."""


def nees_bounds(degrees: int, runs: int = 1, probability: float = 0.95) -> tuple[float, float]:
    """Return the two-sided bounds of the mean of independent NEES values of a consistent estimator.

    The sum of the values of M runs at one instant is χ²-distributed with M times the degrees of freedom. Values along
    one run are correlated and do not satisfy this.

    Args:
        degrees: Dimension of the error: 3 for a position or an orientation.
        runs: Number of runs over which the mean is taken.
        probability: Probability with which the mean lies within the bounds.

    Raises:
        ConfigError: An argument is out of range.
    """
    if degrees < 1 or runs < 1 or not 0.0 < probability < 1.0:
        raise ConfigError(
            f"bounds of the mean NEES of {runs} runs with {degrees} degrees of freedom at probability {probability:g};"
            " expected at least one run and one degree, and a probability between 0 and 1"
        )
    from scipy.special import gammainccinv, gammaincinv  # imported late: it costs more than a whole evaluation

    half, tail = 0.5 * degrees * runs, 0.5 * (1.0 - probability)
    return 2.0 * float(gammaincinv(half, tail)) / runs, 2.0 * float(gammainccinv(half, tail)) / runs


def anees(nees_of_runs: Array, degrees: int = 3, probability: float = 0.95) -> Anees:
    """Return the NEES averaged over independent runs.

    Args:
        nees_of_runs: (M, N) NEES of M runs at the same N times.
        degrees: Dimension of the error: 3 for a position or an orientation.
        probability: Probability with which the mean of a consistent estimator lies within the bounds.

    Raises:
        ConfigError: An argument is out of range.
    """
    mean = np.mean(nees_of_runs, axis=0)
    low, high = nees_bounds(degrees, len(nees_of_runs), probability)
    return Anees(mean, (low, high), 100.0 * float(np.mean((mean >= low) & (mean <= high))))


def inside_percent(nees_of_run: Array, degrees: int = 3, probability: float = 0.95) -> float:
    """Return the share [%] of the NEES values (N,) of one run within the two-sided bounds of a single value."""
    return anees(nees_of_run[None], degrees, probability).inside_percent


def anchor_first(truth: Trajectory, estimate: Trajectory) -> Alignment:
    """Return the alignment of position and yaw at the first pose, which leaves roll and pitch unchanged."""
    return align(
        truth.p_world_imu,
        estimate.p_world_imu,
        "yaw",
        n=1,
        quat_truth_wxyz=truth.quat_wxyz,
        quat_estimate_wxyz=estimate.quat_wxyz,
    )


def relative_to_first(estimate: Trajectory) -> Trajectory:
    """Return an estimate with the uncertainty that its errors have when they are measured from its first pose.

    An estimate that starts at rest begins with certain position and yaw, one that starts in motion does not, and the
    error of its first pose is then part of all others. The covariance of the first position and yaw is added to that of
    each pose; the correlation between both, which estimators do not publish, is neglected.

    Args:
        estimate: N > 0 poses with covariances, in a world frame whose z axis is up.

    Raises:
        EvaluationError: There are no covariances, or no pose.
    """
    P, n = estimate.covariance, len(estimate)
    if P is None or n < 1:
        raise EvaluationError("an estimate without covariances or poses; expected poses with covariances")
    R_imu_world = np.swapaxes(estimate.rotations, -1, -2)
    # Covariance of yaw and position of the first pose
    selection = np.zeros((4, 15))
    selection[0, :3] = R_imu_world[0, :, 2]
    selection[1:, 3:6] = np.eye(3)
    P_first = selection @ P[0] @ selection.T
    # Their effect on each pose, relative to the first
    J, up = np.zeros((n, 15, 4)), np.array([0.0, 0.0, 1.0])
    J[:, :3, 0] = R_imu_world[:, :, 2]
    J[:, 3:6, 0] = cross(up, estimate.p_world_imu - estimate.p_world_imu[0])
    J[:, 3:6, 1:] = np.eye(3)
    if estimate.velocity_m_s is not None and P[:, 6:9, 6:9].any():
        J[:, 6:9, 0] = cross(up, estimate.velocity_m_s)
    return replace(estimate, covariance=P + J @ P_first @ np.swapaxes(J, 1, 2))


def consistency(truth: Trajectory, estimate: Trajectory) -> Consistency:
    """Return errors with their estimated uncertainty. Position and yaw of the first pose are taken as exact.

    Args:
        truth: N true poses at the times of the estimate.
        estimate: N estimated poses, N > 1, with covariances, in any world frame whose z axis is up.

    Raises:
        EvaluationError: There are no covariances, or one of them is not positive definite.
    """
    covariance = estimate.covariance
    if covariance is None or len(estimate) < 2 or len(truth) != len(estimate):
        raise EvaluationError(
            "an estimate without covariances or of one pose; expected at least two poses with covariances"
        )
    anchor = anchor_first(truth, estimate)
    R = anchor.R_truth_estimate
    truth, estimate, covariance = truth[1:], estimate[1:], covariance[1:]
    position = truth.p_world_imu - anchor.positions(estimate.p_world_imu)
    orientation = log_so3(np.swapaxes(estimate.rotations, -1, -2) @ R.T @ truth.rotations)
    P_position, P_orientation = R @ covariance[:, 3:6, 3:6] @ R.T, covariance[:, :3, :3]
    position_nees, orientation_nees = nees(position, P_position), nees(orientation, P_orientation)
    return Consistency(
        estimate.t_ns,
        position,
        _sigma(P_position),
        position_nees,
        orientation,
        _sigma(P_orientation),
        orientation_nees,
        _velocity_nees(truth, estimate, R),
    )


def _velocity_nees(truth: Trajectory, estimate: Trajectory, R_truth_estimate: Array) -> Array | None:
    """Return the NEES (N,) of the velocity in the world frame.

    It is None if truth or estimate has no velocities, or if the estimate states no uncertainty of them: variances of 0.
    """
    if truth.velocity_m_s is None or estimate.velocity_m_s is None or estimate.covariance is None:
        return None
    R, covariance = R_truth_estimate, estimate.covariance[:, 6:9, 6:9]
    if not covariance.any():
        return None
    return nees(truth.velocity_m_s - estimate.velocity_m_s @ R.T, R @ covariance @ R.T)


def errors_and_sigmas_m(truth: Trajectory, estimate: Trajectory) -> tuple[Array, Array]:
    """Return the distances (N,) from the truth, and their standard deviations (N,) along the least certain axis [m].

    Args:
        truth: N true poses at the times of the estimate.
        estimate: N estimated poses with covariances; position and yaw of the first are taken from the truth.

    Raises:
        EvaluationError: There are no covariances, or no pose.
    """
    if estimate.covariance is None or len(estimate) < 1 or len(truth) != len(estimate):
        raise EvaluationError("an estimate without covariances or poses; expected poses with covariances")
    moved = anchor_first(truth, estimate).positions(estimate.p_world_imu)
    sigma_m = np.sqrt(np.linalg.eigvalsh(estimate.covariance[:, 3:6, 3:6])[:, -1])
    return np.linalg.norm(moved - truth.p_world_imu, axis=1), sigma_m


def nees(errors: Array, covariances: Array) -> Array:
    """Return the normalized squared errors eᵀP⁻¹e (N,) of errors (N, k) with covariances (N, k, k).

    Raises:
        EvaluationError: A covariance is not positive definite.
    """
    try:
        whitened = np.linalg.solve(np.linalg.cholesky(covariances), errors[..., None])[..., 0]
    except np.linalg.LinAlgError:
        raise EvaluationError("a covariance is not positive definite") from None
    if not np.isfinite(whitened).all():
        raise EvaluationError("an error or a covariance is not finite")
    return np.asarray(np.sum(whitened * whitened, axis=-1))


def _sigma(covariances: Array) -> Array:
    """Return the standard deviations (N, k) of covariances (N, k, k)."""
    return np.sqrt(np.diagonal(covariances, axis1=-2, axis2=-1))
