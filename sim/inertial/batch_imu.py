"""Errors of many IMUs of one model, sample by sample."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array
from dronevio.models.imu import ImuModel
from dronevio.models.quadrotor import Quadrotor
from dronevio.models.rig import Rig
from dronevio.models.vibration import NO_VIBRATION
from dronevio.sim.inertial.batch_vibration import BatchHarmonics, HarmonicsState
from dronevio.sim.inertial.bias import BiasModel
from dronevio.sim.inertial.imu import matrix_deviations, noise_density, read_out

Rows = npt.NDArray[np.intp]

_GYRO, _ACCEL = slice(0, 3), slice(3, 6)


@dataclass(frozen=True, eq=False)
class BatchImuState:
    """Complete state of a `BatchImuErrors`."""

    walked: Array
    """(n, 6) Turn-on biases with their random walks, of gyroscopes [rad/s] and accelerometers [m/s²]."""
    flicker: Array
    """(n, P, 6) States of the processes of bias instability."""
    response: Array
    """(n, 6, 6) Constant errors; see `BatchImuErrors.response`."""
    vibration: HarmonicsState | None
    """State of the vibration; None without vibration."""
    generators: tuple[Mapping[str, Any], Mapping[str, Any]]
    """States of the generators of samples and of resets."""


@dataclass(frozen=True, eq=False)
class _Steps:
    """Standard deviations of the errors of an IMU, at a reset and from one sample to the next."""

    biases: BiasModel
    """Biases at a reset."""
    response: Array | None
    """(6, 6) Of scale errors, misalignments and g-sensitivity; None without any."""
    noise: Array
    """(6,) Of the white noise of a sample."""
    walk: Array
    """(6,) Of the step of a random walk."""
    decay: Array
    """(P, 1) Factors of the processes of bias instability in a step."""
    flicker: Array
    """(P, 6) Of their noise in a step."""

    @classmethod
    def of(cls, model: ImuModel) -> Self:
        """Return the errors of an IMU."""
        biases, response = BiasModel.of(model), np.zeros((6, 6))
        response[_GYRO, _GYRO], response[_ACCEL, _ACCEL] = matrix_deviations(model)
        response[_GYRO, _ACCEL] = model.gyro_g_sensitivity_rad_s_per_m_s2
        decay = np.exp(-1.0 / (model.rate_hz * biases.times_s[:, None]))
        return cls(
            biases=biases,
            response=response if response.any() else None,
            noise=noise_density(model) * np.sqrt(model.rate_hz),
            walk=biases.walk / np.sqrt(model.rate_hz),
            decay=decay,
            flicker=biases.flicker * np.sqrt(1.0 - decay**2),
        )


class BatchImuErrors:
    """Errors of n IMUs of one model, each from its switch-on, added to one noise-free point sample of each at a time.

    The model is that of `ImuErrors`. Samples and resets draw from two generators, so that the
    errors of a unit do not depend on the times at which others are reset. An error that is zero in the model leaves
    the samples bit-identical.
    """

    def __init__(
        self, model: ImuModel, count: int, rng: np.random.Generator, vibration: BatchHarmonics | None = None
    ) -> None:
        """Switch on all units.

        Args:
            model: Rate, noise densities and standard deviations of the constant errors.
            count: Number of units.
            rng: Generator of all errors.
            vibration: Vibration of the airframes (see `vibration_of`); none by default.
        """
        self._model = model
        self._vibration = vibration
        self._rng, self._reset_rng = rng.spawn(2)
        self._steps = _Steps.of(model)
        self._walked = np.zeros((count, 6))
        self._flicker = np.zeros((count, len(self._steps.decay), 6))
        self._response = np.tile(np.eye(6), (count, 1, 1))
        self.reset(np.ones(count, dtype=bool))

    @property
    def response(self) -> Array:
        """(n, 6, 6) Matrices from true angular velocities and specific forces to those without biases and noise."""
        return self._response.copy()

    def reseed(self, rng: np.random.Generator) -> None:
        """Draw from streams of another generator from now on."""
        self._rng, self._reset_rng = rng.spawn(2)

    def reset(self, mask: npt.NDArray[np.bool_]) -> None:
        """Replace the units in a mask (n,) by others that have just been switched on."""
        rows = np.flatnonzero(mask)
        k, rng, steps = len(rows), self._reset_rng, self._steps
        self._walked[rows] = steps.biases.turn_on * rng.standard_normal((k, 6))
        self._flicker[rows] = steps.biases.flicker * rng.standard_normal((k, len(steps.decay), 6))
        if steps.response is not None:
            self._response[rows] = np.eye(6) + steps.response * rng.standard_normal((k, 6, 6))
        if self._vibration is not None:
            self._vibration.renew(rows, rng)

    def add_to(self, perfect: Array, rotor_speeds_rad_s: Array | None = None) -> tuple[Array, Array]:
        """Return the measurements (n, 6) of all units one sample later, and their biases (n, 6).

        Args:
            perfect: (n, 6) Noise-free angular velocities [rad/s] and specific forces [m/s²] in the IMU frame.
            rotor_speeds_rad_s: (n, R) Speeds of the rotors from this sample on, for the vibration [rad/s]; standstill
                by default.
        """
        if self._vibration is not None:
            perfect = perfect + self._vibration.following(rotor_speeds_rad_s)
        steps = self._steps
        walk, white = self._rng.standard_normal((2, *perfect.shape))
        self._walked += steps.walk * walk
        if len(steps.decay):
            self._flicker = steps.decay * self._flicker
            self._flicker += steps.flicker * self._rng.standard_normal(self._flicker.shape)
        bias = self._walked + self._flicker.sum(axis=1)
        return self._measured(perfect, slice(None), bias, white), bias

    def first(self, perfect: Array, rows: Rows, rotor_speeds_rad_s: Array | None = None) -> tuple[Array, Array]:
        """Return the measurements (k, 6) of some units at their reset, and their biases (k, 6).

        Args:
            perfect: (k, 6) Noise-free angular velocities [rad/s] and specific forces [m/s²] in the IMU frame.
            rows: (k,) Indices of the units.
            rotor_speeds_rad_s: (k, R) Speeds of the rotors, for the vibration [rad/s]; standstill by default.
        """
        if self._vibration is not None:
            perfect = perfect + self._vibration.first(rotor_speeds_rad_s, rows)
        bias = self._walked[rows] + self._flicker[rows].sum(axis=1)
        white = self._reset_rng.standard_normal(perfect.shape)
        return self._measured(perfect, rows, bias, white), bias

    def save(self) -> BatchImuState:
        """Return the state of errors and random numbers."""
        generators = (self._rng.bit_generator.state, self._reset_rng.bit_generator.state)
        vibration = None if self._vibration is None else self._vibration.state
        return BatchImuState(self._walked.copy(), self._flicker.copy(), self._response.copy(), vibration, generators)

    def restore(self, saved: BatchImuState) -> None:
        """Return to a state of as many units of the same model."""
        self._walked[:], self._flicker, self._response[:] = saved.walked, saved.flicker.copy(), saved.response
        self._rng.bit_generator.state, self._reset_rng.bit_generator.state = saved.generators
        if self._vibration is not None and saved.vibration is not None:
            self._vibration.state = saved.vibration

    def _measured(self, perfect: Array, rows: Rows | slice, bias: Array, white: Array) -> Array:
        """Return the measurements (k, 6) of the selected units, given biases and standard normal numbers (k, 6)."""
        responding = perfect if self._steps.response is None else np.matvec(self._response[rows], perfect)
        value = responding + (bias + self._steps.noise * white)
        return np.concatenate(read_out(self._model, value[:, _GYRO], value[:, _ACCEL]), axis=1)


def vibration_of(quadrotor: Quadrotor, rig: Rig, count: int) -> BatchHarmonics | None:
    """Return the vibration at the IMUs of ``count`` vehicles; None if their rotors cause none."""
    return None if quadrotor.vibration == NO_VIBRATION else BatchHarmonics(quadrotor, rig, count)
