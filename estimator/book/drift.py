"""The drift of dead reckoning: its spread over many flights, and the spread that theory predicts.

Section 7.4.1 of the book (Dellaert and Hutchinson, *Introduction to Robotics*) states that an estimate from the IMU
alone drifts. Here many flights on the same circle measure by how much. They differ in their IMU errors only, white
noise and the random walks of the biases, as the IMU factors model them. All begin with an exactly known state and bias;
bias instability, scale errors and quantization are left out. The same flights are also integrated with unknown turn-on
biases, as of an IMU without calibration. Dead reckoning is the solution of the graph of IMU factors, so that its errors
are those of that graph.

The prediction propagates the covariance of the state forward in time (Forster et al., "On-manifold preintegration for
real-time visual-inertial odometry", T-RO 2017, eq. 44; `dronevio.estimator.imu.covariance`), as a Kalman filter does
between its updates. For an IMU at rest the horizontal position has the variance

    σ_a² t³/3 + σ_ba² t⁵/20 + g² (σ_g² t⁵/20 + σ_bg² t⁷/252)

with the noise densities of accelerometer and gyroscope σ_a, σ_g and of their biases σ_ba, σ_bg: the errors of the
gyroscope tilt the estimated vertical, so that a part of gravity is integrated twice.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dronevio.estimator.book.loop import LoopFlight
from dronevio.estimator.imu.covariance import propagate_covariance
from dronevio.models.arrays import Array
from dronevio.models.imu import GRAVITY_M_S2, ImuModel
from dronevio.models.progress import Progress, silent
from dronevio.models.rotation import cumulative_rotations, exp_so3

GRAVITY_WORLD_M_S2 = np.array([0.0, 0.0, -GRAVITY_M_S2])
"""(3,) Gravity in the world frame [m/s²]."""
SOURCES = ("gyro_noise_density", "accel_noise_density", "gyro_random_walk", "accel_random_walk")
"""Fields of `ImuModel` with the noise densities that cause the drift."""

STEP_S = 0.05
"""Step of the covariance propagation [s]; after a minute the result differs by 0.2 % from that of shorter steps."""

_REPORT_S = 1.0  # interval between the reported times
_RUNS_AT_ONCE = 10  # limits memory


@dataclass(frozen=True, eq=False)
class DriftStudy:
    """Errors of dead reckoning with one IMU, measured over R flights at M times, and predicted."""

    imu: ImuModel
    """The IMU, of which only the four noise densities of `SOURCES` and the turn-on biases have an effect."""
    t_s: Array
    """(M,) Times since the start [s]."""
    error_m: Array
    """(R, M, 3) Errors of the position in the world frame [m]."""
    covariance_m2: Array
    """(M, 3, 3) Predicted covariances of the position [m²]."""
    source_sigma_m: Array
    """(4,) Predicted standard deviations of the last position if only one of `SOURCES` existed [m]."""
    uncalibrated_rms_m: float
    """Measured spread of the last position if each flight has an unknown turn-on bias as well [m]."""

    @property
    def rms_m(self) -> Array:
        """(M,) Measured spread: root mean square distance from the true position over all flights [m]."""
        return np.asarray(np.sqrt(np.mean(np.sum(self.error_m**2, axis=2), axis=0)))

    @property
    def sigma_m(self) -> Array:
        """(M,) Predicted spread: root of the trace of the predicted covariance [m]."""
        return np.asarray(np.sqrt(np.trace(self.covariance_m2, axis1=1, axis2=2)))

    @property
    def ratio(self) -> Array:
        """(M,) Ratio of the measured to the predicted spread."""
        return np.asarray(self.rms_m / self.sigma_m)

    @property
    def ratio_sigma(self) -> float:
        """Standard deviation of the last ratio due to the finite number of flights, if the prediction is correct.

        The mean of R squared lengths of a Gaussian vector with covariance P has the relative variance
        2 tr(P²) / (R tr(P)²), and its root half the relative standard deviation.
        """
        P = self.covariance_m2[-1]
        return float(np.sqrt(0.5 * np.trace(P @ P) / len(self.error_m)) / np.trace(P))


def run_drift_study(
    imu: ImuModel, rng: np.random.Generator, *, runs: int, duration_s: float = 60.0, progress: Progress = silent
) -> DriftStudy:
    """Simulate and integrate many flights, and predict the spread of their positions.

    Args:
        imu: Rate and noise densities of the IMU.
        rng: Random generator of the IMU errors.
        runs: Number of flights R.
        duration_s: Duration of each flight [s].
        progress: Reports the number of integrated flights.
    """
    flight = LoopFlight(duration_s=duration_s, imu_rate_hz=imu.rate_hz)
    t_s = np.arange(_REPORT_S, duration_s + 0.5 * _REPORT_S, _REPORT_S)
    rows = np.round(t_s * imu.rate_hz).astype(int) - 1
    true_m, errors, uncalibrated = flight.states(t_s).p_world_imu, [], []
    bias_rng = rng.spawn(1)[0]
    for start in range(0, runs, _RUNS_AT_ONCE):
        gyro, accel = simulate_increments(flight, imu, rng, min(_RUNS_AT_ONCE, runs - start))
        errors.append(dead_reckoning(flight, gyro, accel)[:, rows] - true_m)
        gyro_bias, accel_bias = bias_rng.standard_normal((2, len(gyro), 1, 3))
        gyro += imu.gyro_turn_on_bias_rad_s * gyro_bias
        accel += imu.accel_turn_on_bias_m_s2 * accel_bias
        uncalibrated.append(dead_reckoning(flight, gyro, accel)[:, rows[-1]] - true_m[-1])
        progress(start + len(gyro), runs)
    last = [predicted_covariance(flight, _with_only(imu, source), t_s)[-1, 3:6, 3:6] for source in SOURCES]
    return DriftStudy(
        imu=imu,
        t_s=t_s,
        error_m=np.concatenate(errors),
        covariance_m2=predicted_covariance(flight, imu, t_s)[:, 3:6, 3:6],
        source_sigma_m=np.sqrt(np.trace(last, axis1=1, axis2=2)),
        uncalibrated_rms_m=float(np.sqrt(np.mean(np.sum(np.concatenate(uncalibrated) ** 2, axis=1)))),
    )


def _with_only(imu: ImuModel, source: str) -> ImuModel:
    """Return the IMU with one of its four noise densities, the others being zero."""
    others: dict[str, Any] = {other: 0.0 for other in SOURCES if other != source}
    return replace(imu, **others)


def simulate_increments(flight: LoopFlight, imu: ImuModel, rng: np.random.Generator, runs: int) -> tuple[Array, Array]:
    """Return the measurements of R flights: means over the N sampling intervals.

    Args:
        flight: Motion and IMU rate.
        imu: Noise densities; the biases are zero at the start.
        rng: Random generator of white noise and random walks.
        runs: Number of flights R.

    Returns:
        (R, N, 3) angular velocities [rad/s], and (R, N, 3) specific forces in the IMU frame at the start of the
        interval [m/s²].
    """
    dt_s, n = flight.dt_s, flight.samples
    states = flight.states(np.arange(n + 1, dtype=np.float64) * dt_s)
    true_gyro = np.array([0.0, -flight.pitch_rate_rad_s, 0.0])
    accel_world = np.diff(states.velocity_m_s, axis=0) / dt_s - GRAVITY_WORLD_M_S2
    true_accel = np.einsum("nji,nj->ni", states.R_world_imu[:-1], accel_world)
    noise = np.repeat([imu.gyro_noise_density, imu.accel_noise_density], 3) / np.sqrt(dt_s)
    walk = np.repeat([imu.gyro_random_walk, imu.accel_random_walk], 3) * np.sqrt(dt_s)
    bias = np.cumsum(walk * rng.standard_normal((runs, n, 6)), axis=1)
    errors = bias + noise * rng.standard_normal((runs, n, 6))
    return true_gyro + errors[..., :3], true_accel + errors[..., 3:]


def dead_reckoning(flight: LoopFlight, gyro_rad_s: Array, accel_m_s2: Array) -> Array:
    """Return the positions (R, N, 3) of R flights after each of N samples, from the true first state [m].

    Args:
        flight: Motion and IMU rate.
        gyro_rad_s: (R, N, 3) Mean angular velocities over the intervals [rad/s].
        accel_m_s2: (R, N, 3) Mean specific forces in the IMU frame at the start of the intervals [m/s²].
    """
    dt_s, start = flight.dt_s, flight.states(np.zeros(1))
    R_start_end = start.R_world_imu @ cumulative_rotations(exp_so3(gyro_rad_s * dt_s))
    accel_world = accel_m_s2 + GRAVITY_WORLD_M_S2  # the first orientation is the identity
    accel_world[:, 1:] = (R_start_end[:, :-1] @ accel_m_s2[:, 1:, :, None])[..., 0] + GRAVITY_WORLD_M_S2
    velocity = start.velocity_m_s + np.cumsum(accel_world * dt_s, axis=1)
    # The mean of the velocities at both ends: v dt + ½ a dt², with the velocity v at the start of the interval
    return np.asarray(start.p_world_imu + np.cumsum((velocity - 0.5 * dt_s * accel_world) * dt_s, axis=1))


def predicted_covariance(
    flight: LoopFlight, imu: ImuModel, t_s: Array, initial: Array | None = None, step_s: float = STEP_S
) -> Array:
    """Return the covariances (M, 15, 15) of dead reckoning at M times, in the order of `NavState`.

    Args:
        flight: The motion.
        imu: Noise densities.
        t_s: (M,) Increasing times, multiples of the step [s].
        initial: (15, 15) Covariance of the first state and the biases; they are exactly known by default.
        step_s: Step of the propagation [s].
    """
    steps, h = round(float(t_s[-1]) / step_s), step_s
    states = flight.states(np.arange(steps + 1, dtype=np.float64) * h)
    R, p, v = states.R_world_imu, states.p_world_imu, states.velocity_m_s
    covariances = np.empty((steps + 1, 15, 15))
    covariances[0] = np.zeros((15, 15)) if initial is None else initial
    for k in range(steps):
        covariances[k + 1] = propagate_covariance(
            covariances[k],
            R[k],
            dR=R[k].T @ R[k + 1],
            dp=R[k].T @ (p[k + 1] - p[k] - v[k] * h - 0.5 * GRAVITY_WORLD_M_S2 * h * h),
            dv=R[k].T @ (v[k + 1] - v[k] - GRAVITY_WORLD_M_S2 * h),
            dt_s=h,
            imu=imu,
        )
    return np.asarray(covariances[np.round(t_s / h).astype(int)])
