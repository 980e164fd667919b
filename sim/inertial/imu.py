"""Error model of an IMU, applied to noise-free samples."""

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.imu import ImuConstants, ImuModel, ImuSamples
from dronevio.sim.inertial.bias import Biases
from dronevio.sim.inertial.vibration import RotorHarmonics


class ImuErrors:
    """Errors of one IMU unit from switch-on, added to consecutive batches of noise-free samples.

    The model follows the signal path: vibration of the airframe is added to the motion; scale errors, misalignment and
    g-sensitivity distort it (`ImuModel` has the equations); biases and white noise are added; the result is quantized
    and clipped to the measurement range. Errors that are zero in the model leave the samples bit-identical.

    White noise of density σ has the standard deviation σ √f in point samples at a rate f, whose filter is matched to
    the rate, and σ / √dt in increments over dt, which are means of the continuous noise (Crassidis 2006). Biases are
    evaluated at the time stamps; within an interval, a random walk changes by about a thousandth of the noise.
    """

    def __init__(self, model: ImuModel, rng: np.random.Generator, vibration: RotorHarmonics | None = None) -> None:
        """Draw the constant errors and the initial biases.

        Args:
            model: Rate, noise densities and standard deviations of the constant errors.
            rng: Generator of all errors; the same state and the same batches give the same bytes.
            vibration: Vibration of the airframe; none by default.
        """
        self._model = model
        self._rng = rng
        self._vibration = vibration
        constants_rng, flicker_rng = rng.spawn(2)
        self._biases = Biases(model, rng, flicker_rng)
        self._density = noise_density(model)
        self._t_ns: int | None = None
        self.constants = _drawn_constants(model, constants_rng, self._biases.turn_on)

    def add_to(self, perfect: ImuSamples, rotor_speeds_rad_s: Array | None = None) -> tuple[ImuSamples, Array, Array]:
        """Return the measurements of this IMU for noise-free samples.

        Args:
            perfect: N noise-free samples, points or increments, later than those of the last call.
            rotor_speeds_rad_s: (N, R) Rotor speeds for the vibration [rad/s] (see
                `RotorHarmonics.sensed`); standstill by default.

        Returns:
            The measured samples, the gyroscope biases (N, 3) [rad/s] and the accelerometer biases (N, 3) [m/s²].
        """
        n = len(perfect)
        if n == 0:
            return perfect, np.zeros((0, 3)), np.zeros((0, 3))
        gyro, accel = perfect.gyro_rad_s, perfect.accel_m_s2
        if self._vibration is not None:
            turning, shaking = self._vibration.sensed(perfect, rotor_speeds_rad_s)
            gyro, accel = gyro + turning, accel + shaking
        gyro, accel = self.constants.response(gyro, accel)
        bias = self._biases.advance_to(perfect.t_ns)
        errors = bias + self._density * self._root_rate(perfect) * self._rng.standard_normal((n, 6))
        gyro, accel = read_out(self._model, gyro + errors[:, :3], accel + errors[:, 3:])
        return ImuSamples(perfect.t_ns, gyro, accel, perfect.sampling), bias[:, :3], bias[:, 3:]

    def _root_rate(self, samples: ImuSamples) -> Array | float:
        """Return the square root of the noise bandwidth [√Hz]: a scalar, or one value (N, 1) per interval."""
        if samples.sampling == "point":
            return float(np.sqrt(self._model.rate_hz))
        interval_ns = round(1e9 / self._model.rate_hz)
        start_ns = int(samples.t_ns[0]) - interval_ns if self._t_ns is None else self._t_ns
        self._t_ns = int(samples.t_ns[-1])
        return np.asarray(1.0 / np.sqrt(np.diff(samples.t_ns, prepend=start_ns)[:, None] * 1e-9))


def noise_density(model: ImuModel) -> Array:
    """Return the densities (6,) of the white noise of gyroscope [rad/s/√Hz] and accelerometer [m/s²/√Hz]."""
    return np.repeat([model.gyro_noise_density, model.accel_noise_density], 3)


def matrix_deviations(model: ImuModel) -> tuple[Array, Array]:
    """Return the standard deviations (3, 3) of scale errors and misalignments of gyroscope and accelerometer."""
    diagonal = np.eye(3) > 0.0
    return (
        np.where(diagonal, model.gyro_scale_error, model.gyro_misalignment_rad),
        np.where(diagonal, model.accel_scale_error, model.accel_misalignment_rad),
    )


def read_out(model: ImuModel, gyro: Array, accel: Array) -> tuple[Array, Array]:
    """Return angular velocities and specific forces (N, 3), quantized and clipped to their ranges."""
    return (
        _digitized(gyro, model.gyro_resolution_rad_s, model.gyro_range_rad_s),
        _digitized(accel, model.accel_resolution_m_s2, model.accel_range_m_s2),
    )


def _drawn_constants(model: ImuModel, rng: np.random.Generator, turn_on: Array) -> ImuConstants:
    """Return the constant errors of one unit, drawn from a model."""
    scale_and_tilt = rng.standard_normal((2, 3, 3))
    spread_gyro, spread_accel = matrix_deviations(model)
    return ImuConstants(
        gyro_matrix=np.eye(3) + spread_gyro * scale_and_tilt[0],
        accel_matrix=np.eye(3) + spread_accel * scale_and_tilt[1],
        gyro_g_sensitivity=model.gyro_g_sensitivity_rad_s_per_m_s2 * rng.standard_normal((3, 3)),
        gyro_turn_on_bias_rad_s=turn_on[:3],
        accel_turn_on_bias_m_s2=turn_on[3:],
    )


def _digitized(value: Array, step: float, limit: float) -> Array:
    """Return values quantized to a step, if it is positive, and clipped at ± a limit."""
    rounded = step * np.rint(value / step) if step > 0.0 else value
    return np.clip(rounded, -limit, limit)
