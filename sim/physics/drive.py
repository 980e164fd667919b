"""Control allocation: rotor speeds from thrust and torques, and commands with lead compensation."""

from math import exp

import numpy as np
import numpy.typing as npt

from dronevio.models.quadrotor import Quadrotor

Array = npt.NDArray[np.float64]

IDLE_SHARE = 0.1
"""Smallest speed of a rotor in flight relative to the largest; rotors never stop in the air."""


class Mixer:
    """Control allocation with priorities under the limits of the rotor speeds."""

    def __init__(self, quadrotor: Quadrotor) -> None:
        self._inverse = np.linalg.inv(quadrotor.allocation)
        self._high = quadrotor.rotor_speed_max_rad_s**2
        self._low = IDLE_SHARE**2 * self._high

    def speeds(self, thrust_n: float, torque_nm: Array) -> Array:
        """Return rotor speeds (4,) [rad/s] for a thrust and torques (3,) about x, y, z.

        Where a rotor would leave its range, yaw is reduced first, then thrust, and roll and pitch last, since the tilt
        determines the path.
        """
        low, high = self._low, self._high
        tilt = self._inverse[:, 1:3] @ torque_nm[:2]
        least, most = float(tilt.min()), float(tilt.max())
        share = min(1.0, (high - low) / max(most - least, 1e-9))
        tilt = share * tilt
        lift = min(max(self._inverse[0, 0] * thrust_n, low - share * least), high - share * most)
        base = lift + tilt
        yaw = self._inverse[:, 3] * torque_nm[2]
        room = np.where(yaw > 0.0, high - base, base - low)
        share = min(1.0, float((room / np.maximum(np.abs(yaw), 1e-9)).min()))
        return np.asarray(np.sqrt(np.minimum(np.maximum(base + share * yaw, low), high)))


class RotorDrive:
    """Lead compensation: commands for desired rotor speeds, by a model of the rotors' response.

    The command of rotors slower than desired exceeds the desired speed as far as their range allows.
    """

    def __init__(self, quadrotor: Quadrotor, response_s: float, speed_rad_s: float = 0.0) -> None:
        """Start the model at a speed of all rotors.

        Args:
            quadrotor: Parameters of the rotors.
            response_s: Time constant of the compensated response, if rotors are slower [s].
            speed_rad_s: Initial speed [rad/s].
        """
        self._lag_s = quadrotor.rotor_time_constant_s
        self._response_s = min(response_s, quadrotor.rotor_time_constant_s)
        self._fastest = quadrotor.rotor_speed_max_rad_s
        self.speeds_rad_s = np.full(4, speed_rad_s)
        self.acceleration_rad_s2 = np.zeros(4)

    def towards(self, wanted_rad_s: Array, dt_s: float) -> Array:
        """Return commands (4,) for the next ``dt_s`` toward desired speeds (4,) of the rotors [rad/s]."""
        follows = 1.0 - exp(-dt_s / self._lag_s)
        lead = (1.0 - exp(-dt_s / self._response_s)) / follows
        command = self.speeds_rad_s + lead * (wanted_rad_s - self.speeds_rad_s)
        command = np.minimum(np.maximum(command, 0.0), self._fastest)
        self.acceleration_rad_s2 = (follows / dt_s) * (command - self.speeds_rad_s)
        self.speeds_rad_s = self.speeds_rad_s + dt_s * self.acceleration_rad_s2
        return np.asarray(command)
