"""Plausibility of a state after the last published one: the last check before publication.

The limits depend neither on the rig nor on the vehicle. The speed has a limit; between two published states, velocity
and orientation change by no more than the IMU has measured, and the position by no more than these velocities explain.
Corrections by landmarks come on top: they are allowed in proportion to the standard deviations, up to a few metres.
A larger change is no estimate of a flight, whatever its covariance, but the result of inconsistent measurements.
"""

from dataclasses import dataclass

import numpy as np

from dronevio.estimator.imu.buffer import Increments
from dronevio.estimator.monitoring.causes import Cause, Reason
from dronevio.models.arrays import Array
from dronevio.models.rotation import log_so3
from dronevio.models.state import NavState

MAX_SPEED_M_S = 200.0
"""Largest speed of a vehicle that flies by images [m/s]; the fastest quadrotor has flown at 180 m/s."""
CORRECTION_SIGMAS = 4.0
"""Correction of a state by landmarks that is allowed, in standard deviations of the published states."""
MAX_SIGMAS = (0.2, 1.0, 2.0)
"""Standard deviations of orientation [rad], position [m] and velocity [m/s] beyond which they allow no more."""
LEAST_CORRECTIONS = (0.35, 1.0, 3.0)
"""Corrections of orientation [rad], position [m] and velocity [m/s] that are allowed where the state is certain."""


@dataclass(frozen=True, eq=False)
class MotionLimits:
    """The last published state, and how far the IMU has changed it since."""

    state: NavState
    """The last published state."""
    turned_rad: float = 0.0
    """Sum of the measured rotations since, without regard to their axes [rad]."""
    accelerated_m_s: float = 0.0
    """Sum of the measured changes of velocity, without regard to their directions [m/s]."""

    def after(self, increments: Increments, gravity_m_s2: float) -> "MotionLimits":
        """Return the limits after further IMU increments."""
        turned = np.linalg.norm(increments.gyro_rad_s - self.state.gyro_bias_rad_s, axis=1)
        force = np.linalg.norm(increments.accel_m_s2 - self.state.accel_bias_m_s2, axis=1)
        dt_s = increments.dt_s
        return MotionLimits(
            self.state,
            self.turned_rad + float(dt_s @ turned),
            self.accelerated_m_s + float(dt_s @ (force + gravity_m_s2)),
        )

    def reason_against(self, state: NavState) -> Reason | None:
        """Return why a state cannot follow the last published one, or None where it can."""
        reason = self._reason_beyond(np.array(LEAST_CORRECTIONS), state)
        return None if reason is None else self._reason_beyond(_allowed_corrections(self.state, state), state)

    def _reason_beyond(self, corrections: Array, state: NavState) -> Reason | None:
        """Return why a state cannot follow with corrections (3,) of orientation [rad], position [m], velocity [m/s]."""
        last, dt_s = self.state, (state.t_ns - self.state.t_ns) * 1e-9
        R_change = last.T_world_imu[:3, :3].T @ state.T_world_imu[:3, :3]
        turned_rad = float(np.linalg.norm(log_so3(R_change)))
        change_m_s = float(np.linalg.norm(state.velocity_m_s - last.velocity_m_s))
        displacement_m = state.T_world_imu[:3, 3] - last.T_world_imu[:3, 3]
        mean_m_s = 0.5 * (last.velocity_m_s + state.velocity_m_s)
        jump_m = float(np.linalg.norm(displacement_m - dt_s * mean_m_s))
        if turned_rad > self.turned_rad + corrections[0]:
            return Reason.of(Cause.ROTATION_JUMP, turned_deg=float(np.degrees(turned_rad)), dt_s=dt_s)
        if change_m_s > self.accelerated_m_s + corrections[2]:
            return Reason.of(Cause.VELOCITY_JUMP, change_m_s=change_m_s, dt_s=dt_s)
        if jump_m > 0.5 * dt_s * self.accelerated_m_s + corrections[1]:
            return Reason.of(Cause.POSITION_JUMP, jump_m=jump_m)
        return None


def reason_against(state: NavState, last: MotionLimits | None) -> Reason | None:
    """Return why a state cannot be that of a vehicle, or None where it can.

    Args:
        state: The state.
        last: The last published state and the motion since; None if there is none.
    """
    speed_m_s = float(np.linalg.norm(state.velocity_m_s))
    if not (np.isfinite(state.T_world_imu).all() and np.isfinite(speed_m_s)):
        return Reason.of(Cause.NOT_FINITE)
    if speed_m_s > MAX_SPEED_M_S:
        return Reason.of(Cause.SPEED, speed_m_s=speed_m_s)
    return None if last is None else last.reason_against(state)


def _allowed_corrections(last: NavState, state: NavState) -> Array:
    """Return the corrections (3,) of orientation [rad], position [m] and velocity [m/s] that the covariances allow."""
    sigmas = np.zeros(3)
    for P in (last.covariance, state.covariance):
        if P is not None and np.isfinite(P).all():
            variances = np.linalg.eigvalsh(np.stack([P[i : i + 3, i : i + 3] for i in (0, 3, 6)]))[:, -1]
            sigmas = np.maximum(sigmas, np.sqrt(np.maximum(variances, 0.0)))
    return np.asarray(np.array(LEAST_CORRECTIONS) + CORRECTION_SIGMAS * np.minimum(sigmas, MAX_SIGMAS))
