"""Free flight of many vehicles: rigid bodies under gravity, with constant forces and torques in their own frames.

The equations of motion are integrated to fourth order over a whole interval, with an exact rotation. Components are
computed one by one, for all vehicles at once, or as numbers if there is only one, which is ten times as fast.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from dronevio.models.arrays import Array, Mask
from dronevio.models.imu import GRAVITY_M_S2
from dronevio.sim.physics.vehicle_states import VehicleParameters

Triple = tuple[Any, Any, Any]
"""Components of a vector, each a number or an array (n,)."""
_LEAST = 1e-300  # avoids 0 / 0 without rotation


FASTEST = 1e4
"""Largest component of a position [m], velocity [m/s] or angular velocity [rad/s] that is not divergence."""


@dataclass(frozen=True, eq=False)
class Stepped:
    """One interval of k vehicles."""

    middle: Array
    """(13, k) Motion in the middle of the interval."""
    end: Array
    """(13, k) Motion at its end."""
    collided: Mask
    """(k,) Which vehicles touch something, otherwise than by standing on it."""
    diverged: Mask
    """(k,) Which vehicles have no valid motion at the end."""


@dataclass(frozen=True)
class FreeFlight:
    """Simulation of intervals of vehicles that touch nothing."""

    interval_s: float
    """Length of an interval [s]."""

    def run(self, motion: Array, wrench: Array, vehicles: VehicleParameters) -> Stepped:
        """Simulate an interval of k vehicles.

        Args:
            motion: (13, k) Motion at its start.
            wrench: (k, 6) Constant forces [N] and torques [N m].
            vehicles: Masses and moments of inertia of the k vehicles.
        """
        with np.errstate(over="ignore", invalid="ignore"):  # vehicles that diverge
            middle = free_flight(motion, wrench, vehicles, 0.5 * self.interval_s)
            end = free_flight(middle, wrench, vehicles, 0.5 * self.interval_s)
        return Stepped(middle, end, np.zeros(motion.shape[1], dtype=np.bool_), diverging(end))


def diverging(motion: Array) -> Mask:
    """Return which vehicles (k,) have a motion (13, k) that is not finite, or faster than any quadrotor."""
    return np.asarray(~(np.abs(motion) < FASTEST).all(axis=0))  # true for NaN


def free_flight(motion: Array, wrench: Array, vehicles: VehicleParameters, duration_s: float) -> Array:
    """Return the motion (13, n) of n vehicles after a time.

    The angular velocity ω follows Euler's equations I dω/dt = τ − ω × I ω, by the Runge-Kutta method of fourth order.
    The rotation vector of the interval h is ∫ω dt + h²/12 ω₀ × ω₁ (Bortz, "A new mathematical formulation for strapdown
    inertial navigation", 1971). The accelerations at both ends, and their derivatives R (ω × f) / m, give velocity and
    position by Hermite's quadrature.

    Args:
        motion: (13, n) Positions [m], orientations quat_wxyz, velocities [m/s], and angular velocities in the vehicle
            frame [rad/s], all of one time.
        wrench: (n, 6) Forces [N] and torques [N m] in the vehicle frame.
        vehicles: Masses and moments of inertia of the n vehicles.
        duration_s: The time [s].
    """
    h, (m,), (Ix, Iy, Iz) = duration_s, _components(vehicles.mass_kg[None]), _components(vehicles.inertia_kg_m2.T)
    x, y, z, *q, vx, vy, vz, p0, q0, r0 = _components(motion)
    fx, fy, fz, tx, ty, tz = _components(wrench.T)
    force, start = (fx / m, fy / m, fz / m), (p0, q0, r0)
    torque, gyroscopic = (tx / Ix, ty / Iy, tz / Iz), ((Iy - Iz) / Ix, (Iz - Ix) / Iy, (Ix - Iy) / Iz)

    def angular_acceleration(rate: Triple) -> Triple:
        p, q, r = rate
        return torque[0] + gyroscopic[0] * q * r, torque[1] + gyroscopic[1] * r * p, torque[2] + gyroscopic[2] * p * q

    # angular velocity at the end
    k1 = angular_acceleration(start)
    k2 = angular_acceleration(_sum(start, 0.5 * h, k1))
    k3 = angular_acceleration(_sum(start, 0.5 * h, k2))
    k4 = angular_acceleration(_sum(start, h, k3))
    end = _sum(_sum(start, h / 6.0, _sum(k1, 1.0, k4)), h / 3.0, _sum(k2, 1.0, k3))

    # rotation
    turn = _sum((0.0, 0.0, 0.0), 0.5 * h, _sum(start, 1.0, end))
    turn = _sum(turn, h * h / 12.0, _sum(_sum(k1, -1.0, angular_acceleration(end)), 1.0, _cross(start, end)))
    turned = quaternion_after(q, turn)

    # velocity and position
    a0, j0 = _rotated(q, force), _rotated(q, _cross(start, force))
    a1, j1 = _rotated(turned, force), _rotated(turned, _cross(end, force))
    change = _sum(_sum((0.0, 0.0, 0.0), 0.5 * h, _sum(a0, 1.0, a1)), h * h / 12.0, _sum(j0, -1.0, j1))
    way = _sum(_sum((h * vx, h * vy, h * vz), 0.35 * h * h, a0), 0.15 * h * h, a1)
    way = _sum(_sum(way, h**3 / 20.0, j0), -(h**3) / 30.0, j1)
    after = np.empty_like(motion)
    after[0], after[1], after[2] = x + way[0], y + way[1], z + way[2] - 0.5 * GRAVITY_M_S2 * h * h
    after[3], after[4], after[5], after[6] = turned
    after[7], after[8], after[9] = vx + change[0], vy + change[1], vz + change[2] - GRAVITY_M_S2 * h
    after[10], after[11], after[12] = end
    return after


def quaternion_after(quaternion: Sequence[Any], turn: Triple) -> tuple[Any, Any, Any, Any]:
    """Return the components of a quaternion wxyz after a rotation by a vector in its own frame [rad]."""
    (w, x, y, z), (p, q, r) = quaternion, turn
    angle = np.sqrt(p * p + q * q + r * r)
    scale, d = np.sin(0.5 * angle) / np.maximum(angle, _LEAST), np.cos(0.5 * angle)
    a, b, c = scale * p, scale * q, scale * r
    return (
        w * d - x * a - y * b - z * c,
        w * a + x * d + y * c - z * b,
        w * b - x * c + y * d + z * a,
        w * c + x * b - y * a + z * d,
    )


def _rotated(quaternion: Sequence[Any], vector: Triple) -> Triple:
    """Return a vector rotated by a unit quaternion wxyz."""
    w, x, y, z = quaternion
    across = _cross((x, y, z), vector)
    twice = _sum(_cross((x, y, z), across), w, across)
    return _sum(vector, 2.0, twice)


def _cross(a: Triple, b: Triple) -> Triple:
    """Return a × b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def _sum(a: Triple, s: Any, b: Triple) -> Triple:
    """Return a + s b."""
    return a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]


def _components(vectors: Array) -> Any:
    """Return the components of vectors (d, n): d arrays (n,), or d numbers for n = 1."""
    return vectors[:, 0].tolist() if vectors.shape[1] == 1 else np.ascontiguousarray(vectors)
