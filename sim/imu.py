"""The errors of a real IMU: white noise, and biases that are there at switch-on and then walk."""

import numpy as np
import numpy.typing as npt

from dronevio.models.imu import ImuModel, ImuSamples

Array = npt.NDArray[np.float64]


def with_errors(perfect: ImuSamples, model: ImuModel, rng: np.random.Generator) -> tuple[ImuSamples, Array, Array]:
    """Return what a real IMU measures where a perfect one would measure ``perfect``.

    A continuous white noise of density σ, sampled at a rate f, has the standard deviation σ √f; a bias that is a
    random walk of density σ_b grows by σ_b √dt a step (Crassidis, "Sigma-point Kalman filtering for integrated GPS and
    inertial navigation", 2006; the conventions of Kalibr). Densities of zero give the perfect samples back.

    Args:
        perfect: N noise-free samples, points or increments.
        model: Rate and densities.
        rng: Source of the errors; the same state gives the same bytes.

    Returns:
        The noisy samples, the gyroscope's biases (N, 3) [rad/s] and the accelerometer's (N, 3) [m/s²].
    """
    n = len(perfect)
    dt_s = np.diff(perfect.t_ns, prepend=perfect.t_ns[:1]) * 1e-9  # 0 for the first sample: no walk yet
    gyro_bias = _bias(model.gyro_turn_on_bias_rad_s, model.gyro_random_walk, dt_s, rng)
    accel_bias = _bias(model.accel_turn_on_bias_m_s2, model.accel_random_walk, dt_s, rng)
    root_rate = np.sqrt(model.rate_hz)
    gyro_noise = model.gyro_noise_density * root_rate * rng.standard_normal((n, 3))
    accel_noise = model.accel_noise_density * root_rate * rng.standard_normal((n, 3))
    noisy = ImuSamples(
        perfect.t_ns,
        perfect.gyro_rad_s + gyro_bias + gyro_noise,
        perfect.accel_m_s2 + accel_bias + accel_noise,
        perfect.sampling,
    )
    return noisy, gyro_bias, accel_bias


def _bias(turn_on: float, random_walk: float, dt_s: Array, rng: np.random.Generator) -> Array:
    """Return (N, 3) biases: a constant drawn at switch-on plus a random walk."""
    start = turn_on * rng.standard_normal(3)
    steps = random_walk * np.sqrt(dt_s)[:, None] * rng.standard_normal((len(dt_s), 3))
    return np.asarray(start + np.cumsum(steps, axis=0))
