"""Control allocation: rotor speeds from thrust and torques, and commands with lead compensation.

All functions broadcast over leading axes, for one vehicle or many.
"""

from math import exp
from typing import NamedTuple

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.quadrotor import Quadrotor

IDLE_SHARE = 0.1
"""Smallest speed of a rotor in flight relative to the largest; rotors never stop in the air."""


class Mixer:
    """Control allocation with priorities under the limits of the rotor speeds.

    Of the squared speeds of more than four rotors with the desired thrust and torques, those with the least sum of
    squares are taken. Thrust alone is then shared equally, as equal speeds do not turn a `Quadrotor`.
    """

    def __init__(self, quadrotor: Quadrotor) -> None:
        allocation = quadrotor.allocation
        self._inverse = np.linalg.inv(allocation) if len(allocation.T) == 4 else np.linalg.pinv(allocation)
        self._high = quadrotor.rotor_speed_max_rad_s**2
        self._low = IDLE_SHARE**2 * self._high

    def speeds(self, thrust_n: Array | float, torque_nm: Array) -> Array:
        """Return rotor speeds (…, R) [rad/s] for thrusts (…) and torques (…, 3) about x, y, z.

        Where a rotor would leave its range, yaw is reduced first, then thrust, and roll and pitch last, since the tilt
        determines the path.
        """
        low, high = self._low, self._high
        tilt = np.matvec(self._inverse[:, 1:3], torque_nm[..., :2])
        least, most = np.minimum.reduce(tilt, axis=-1), np.maximum.reduce(tilt, axis=-1)
        share = np.minimum(1.0, (high - low) / np.maximum(most - least, 1e-9))
        lift = np.minimum(np.maximum(self._inverse[0, 0] * thrust_n, low - share * least), high - share * most)
        base = lift[..., None] + share[..., None] * tilt
        yaw = self._inverse[:, 3] * torque_nm[..., 2:]
        room = np.where(yaw > 0.0, high - base, base - low)
        share = np.minimum(1.0, np.minimum.reduce(room / np.maximum(np.abs(yaw), 1e-9), axis=-1))
        return np.asarray(np.sqrt(np.minimum(np.maximum(base + share[..., None] * yaw, low), high)))


class DriveState(NamedTuple):
    """Modelled state of the rotors."""

    speeds_rad_s: Array
    """(…, R) Modelled speeds [rad/s]."""
    acceleration_rad_s2: Array
    """(…, R) Modelled mean accelerations until the next call [rad/s²]."""


class RotorDrive:
    """Lead compensation: commands for desired rotor speeds, by a model of the rotors' response.

    The command of rotors slower than desired exceeds the desired speed as far as their range allows.
    """

    def __init__(self, quadrotor: Quadrotor, response_s: float, interval_s: float) -> None:
        """Define the response.

        Args:
            quadrotor: Parameters of the rotors.
            response_s: Time constant of the compensated response, if rotors are slower [s].
            interval_s: Time between two commands [s].
        """
        lag_s = quadrotor.rotor_time_constant_s
        follows = 1.0 - exp(-interval_s / lag_s)
        self._lead = (1.0 - exp(-interval_s / min(response_s, lag_s))) / follows
        self._per_interval = follows / interval_s
        self._interval_s = interval_s
        self._fastest = quadrotor.rotor_speed_max_rad_s

    @staticmethod
    def at(speeds_rad_s: Array) -> DriveState:
        """Return the state of rotors at steady speeds (…, R) [rad/s]."""
        return DriveState(speeds_rad_s, np.zeros_like(speeds_rad_s))

    def towards(self, state: DriveState, wanted_rad_s: Array) -> tuple[Array, DriveState]:
        """Return commands (…, R) for the next interval toward desired speeds (…, R) [rad/s], and the state after it."""
        speeds = state.speeds_rad_s
        command = speeds + self._lead * (wanted_rad_s - speeds)
        command = np.minimum(np.maximum(command, 0.0), self._fastest)
        acceleration = self._per_interval * (command - speeds)
        return command, DriveState(speeds + self._interval_s * acceleration, acceleration)
