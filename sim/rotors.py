"""The rotors: how their speeds follow the commands, and what force and torque they put on the body."""

import numpy as np
import numpy.typing as npt

from dronevio.models.quadrotor import Quadrotor

Array = npt.NDArray[np.float64]


class Rotors:
    """The rotor model of one vehicle type, for one simulation or many at once.

    Speeds follow commands with a first-order lag. A rotor at speed ω gives the thrust k ω² along its axis, the torque
    −s kₘ ω² about it (s = ±1 its sense of rotation) and, moving through the air, the drag −k_d ω v in its disc, where
    v is the in-plane velocity of its hub (Martin and Salaün 2010). Both methods broadcast over leading axes.
    """

    def __init__(self, quadrotor: Quadrotor) -> None:
        self._quadrotor = quadrotor
        self._allocation = quadrotor.allocation
        self._hubs = quadrotor.rotor_positions_m

    def next_speeds(self, speeds_rad_s: Array, commands_rad_s: Array, dt_s: float) -> Array:
        """Return the speeds (…, 4) [rad/s] that the rotors reach in ``dt_s`` under held commands (…, 4) [rad/s].

        Commands outside [0, greatest speed] are clipped; the lag is solved exactly.
        """
        target = np.clip(commands_rad_s, 0.0, self._quadrotor.rotor_speed_max_rad_s)
        return np.asarray(target + (speeds_rad_s - target) * np.exp(-dt_s / self._quadrotor.rotor_lag_s))

    def wrench(self, speeds_rad_s: Array, velocity_m_s: Array, rate_rad_s: Array) -> Array:
        """Return force [N] and torque [N m] (…, 6) on the centre of mass, in the vehicle frame.

        Args:
            speeds_rad_s: (…, 4) Rotor speeds [rad/s].
            velocity_m_s: (…, 3) Velocity of the centre of mass through the air, in the vehicle frame [m/s].
            rate_rad_s: (…, 3) Angular velocity in the vehicle frame [rad/s].
        """
        x, y, z = self._hubs.T
        vx, vy = velocity_m_s[..., 0, None], velocity_m_s[..., 1, None]
        wx, wy, wz = (rate_rad_s[..., k, None] for k in range(3))
        drag = -self._quadrotor.drag_n_s2_per_rad_m * speeds_rad_s
        fx = drag * (vx + wy * z - wz * y)  # the hub moves with v + ω × r
        fy = drag * (vy + wz * x - wx * z)
        thrust_and_torque = np.square(speeds_rad_s) @ self._allocation.T
        wrench = np.empty((*thrust_and_torque.shape[:-1], 6))
        wrench[..., 0] = fx.sum(axis=-1)
        wrench[..., 1] = fy.sum(axis=-1)
        wrench[..., 2:] = thrust_and_torque
        wrench[..., 3] -= (z * fy).sum(axis=-1)
        wrench[..., 4] += (z * fx).sum(axis=-1)
        wrench[..., 5] += (x * fy - y * fx).sum(axis=-1)
        return wrench
