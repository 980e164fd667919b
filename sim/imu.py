"""The errors of a real IMU: white noise, and biases that are there at switch-on and then walk."""

import numpy as np
import numpy.typing as npt

from dronevio.models.imu import ImuModel, ImuSamples

Array = npt.NDArray[np.float64]


class ImuErrors:
    """One IMU from switch-on: adds its errors to what a perfect one would read, batch after batch.

    A continuous white noise of density σ, sampled at a rate f, has the standard deviation σ √f; a bias that is a random
    walk of density σ_b grows by σ_b √dt a step (Crassidis, "Sigma-point Kalman filtering for integrated GPS and
    inertial navigation", 2006; the conventions of Kalibr). Densities of zero add nothing.
    """

    def __init__(self, model: ImuModel, rng: np.random.Generator) -> None:
        """Switch the IMU on: draw its first biases.

        Args:
            model: Rate and densities.
            rng: Source of all errors; the same state and the same batches give the same bytes.
        """
        self._rng = rng
        root_rate = np.sqrt(model.rate_hz)
        self._noise = np.repeat([model.gyro_noise_density * root_rate, model.accel_noise_density * root_rate], 3)
        self._walk = np.repeat([model.gyro_random_walk, model.accel_random_walk], 3)
        turn_on = np.repeat([model.gyro_turn_on_bias_rad_s, model.accel_turn_on_bias_m_s2], 3)
        self._bias = turn_on * rng.standard_normal(6)
        self._t_ns: int | None = None

    def add_to(self, perfect: ImuSamples) -> tuple[ImuSamples, Array, Array]:
        """Return what this IMU measures where a perfect one would measure ``perfect``.

        Args:
            perfect: N noise-free samples, points or increments, later than those of the last call.

        Returns:
            The noisy samples, the gyroscope's biases (N, 3) [rad/s] and the accelerometer's (N, 3) [m/s²].
        """
        n = len(perfect)
        if n == 0:
            return perfect, np.zeros((0, 3)), np.zeros((0, 3))
        last_ns = int(perfect.t_ns[0]) if self._t_ns is None else self._t_ns  # no walk before the first sample
        dt_s = np.diff(perfect.t_ns, prepend=last_ns) * 1e-9
        steps = self._walk * np.sqrt(dt_s)[:, None] * self._rng.standard_normal((n, 6))
        bias = self._bias + np.cumsum(steps, axis=0)
        errors = bias + self._noise * self._rng.standard_normal((n, 6))
        self._bias, self._t_ns = bias[-1], int(perfect.t_ns[-1])
        gyro, accel = perfect.gyro_rad_s + errors[:, :3], perfect.accel_m_s2 + errors[:, 3:]
        return ImuSamples(perfect.t_ns, gyro, accel, perfect.sampling), bias[:, :3], bias[:, 3:]
