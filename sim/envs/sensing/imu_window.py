"""The IMU samples of n environments since their last actions, with randomized errors."""

from typing import Any

import numpy as np

from dronevio.models.arrays import Array, Mask
from dronevio.models.quadrotor import Quadrotor
from dronevio.models.rig import Rig
from dronevio.sim.inertial.batch_imu import BatchImuErrors, vibration_of
from dronevio.sim.physics.batch_plant import BatchPlant


class ImuWindow:
    """Measures the IMUs of the vehicles of a plant."""

    def __init__(self, plant: BatchPlant, rig: Rig, quadrotor: Quadrotor, samples: int) -> None:
        """Switch on all IMUs.

        Args:
            plant: The vehicles.
            rig: Model of the IMU.
            quadrotor: Type of the vehicles, for their vibration.
            samples: Number N of samples per action.
        """
        self._plant = plant
        vibration = vibration_of(quadrotor, rig, plant.count)
        self._errors = BatchImuErrors(rig.imu, plant.count, np.random.default_rng(0), vibration)
        self.samples = np.zeros((plant.count, samples, 6))
        """(n, N, 6) Angular velocities [rad/s] and specific forces [m/s²] since the last actions, in time order."""
        self.bias = np.zeros((plant.count, 6))
        """(n, 6) Biases of gyroscope [rad/s] and accelerometer [m/s²]."""

    def reseed(self, rng: np.random.Generator) -> None:
        """Draw from streams of another generator from now on."""
        self._errors.reseed(rng)

    def reset(self, mask: Mask, factor: Array) -> None:
        """Switch on the IMUs in a mask (n,) anew, and fill their windows with the first sample.

        Args:
            mask: (n,) The environments to reset.
            factor: (n,) Factors of the errors.
        """
        rows = np.flatnonzero(mask)
        self._errors.reset(mask)
        perfect = self._perfect()[rows]
        sensed = self._errors.first(perfect, rows, self._plant.now.rotors.speed_rad_s[rows])
        first, bias = _scaled(perfect, *sensed, factor[rows])
        self.samples[rows], self.bias[rows] = first[:, None], bias

    def measure(self, interval: int, factor: Array) -> Array:
        """Return the samples (n, 6) at the current time, which enter the window at an index.

        Args:
            interval: Index in the window.
            factor: (n,) Factors of the errors.
        """
        perfect = self._perfect()
        sensed = self._errors.add_to(perfect, self._plant.now.rotors.speed_rad_s)
        sample, self.bias = _scaled(perfect, *sensed, factor)
        self.samples[:, interval] = sample
        return sample

    def repeat_last(self) -> None:
        """Fill the windows with their last samples."""
        self.samples[:] = self.samples[:, -1:]

    def save(self) -> dict[str, Any]:
        """Return the state of window, errors and random numbers, with arrays of its own."""
        return {"errors": self._errors.save(), "samples": self.samples.copy(), "bias": self.bias.copy()}

    def restore(self, saved: dict[str, Any]) -> None:
        """Return to a state of `save`."""
        self._errors.restore(saved["errors"])
        self.samples, self.bias = saved["samples"].copy(), saved["bias"].copy()

    def _perfect(self) -> Array:
        """Return the noise-free IMU samples (n, 6) of the current time."""
        samples = self._plant.now.samples
        return np.concatenate([samples.gyro_rad_s, samples.accel_m_s2], axis=1)


def _scaled(perfect: Array, measured: Array, bias: Array, factor: Array) -> tuple[Array, Array]:
    """Return IMU samples (n, 6) and biases (n, 6) whose errors are multiplied by factors (n,)."""
    return perfect + factor[:, None] * (measured - perfect), factor[:, None] * bias
