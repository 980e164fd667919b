"""True motion of many vehicles and noise-free samples of their IMUs, at one time.

Arrays have one column a vehicle, so that numpy computes each component for all vehicles at once. Motion (13, n)
holds positions [m], orientations quat_wxyz, velocities in the world [m/s] and angular velocities in the vehicle frame
[rad/s], all of one time, which poses and twists in MuJoCo are not.
"""

from collections.abc import Iterable
from typing import Any

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.imu import GRAVITY_M_S2
from dronevio.models.rotation import quat_wxyz_from_matrix
from dronevio.sim.physics.vehicle_states import VehicleStates

POSITION, QUATERNION, VELOCITY, RATE = slice(0, 3), slice(3, 7), slice(7, 10), slice(10, 13)
"""Rows of a block of motion."""


def motion_of(states: VehicleStates) -> Array:
    """Return the motion (13, n) of vehicles."""
    quaternion = quat_wxyz_from_matrix(states.R_world_vehicle)
    return np.concatenate([states.position_m.T, quaternion.T, states.velocity_m_s.T, states.rate_rad_s.T])


def rotations(quaternion: Array) -> Array:
    """Return rotations (3, 3, n) of quaternions quat_wxyz (4, n), which need not be of unit length."""
    w, x, y, z = _components(quaternion)
    scale = 2.0 / (w * w + x * x + y * y + z * z)
    xs, ys, zs = x * scale, y * scale, z * scale
    wx, wy, wz = w * xs, w * ys, w * zs
    xx, xy, xz = x * xs, x * ys, x * zs
    yy, yz, zz = y * ys, y * zs, z * zs
    R = np.empty((3, 3, quaternion.shape[1]))
    R[0, 0], R[0, 1], R[0, 2] = 1.0 - (yy + zz), xy - wz, xz + wy
    R[1, 0], R[1, 1], R[1, 2] = xy + wz, 1.0 - (xx + zz), yz - wx
    R[2, 0], R[2, 1], R[2, 2] = xz - wy, yz + wx, 1.0 - (xx + yy)
    return R


def rotated(R: Array, vectors: Array) -> Array:
    """Return R v (3, n) of rotations (3, 3, n) and vectors (3, n)."""
    return np.asarray((R * vectors).sum(axis=1))


def rotated_back(R: Array, vectors: Array) -> Array:
    """Return Rᵀ v (3, n) of rotations (3, 3, n) and vectors (3, n)."""
    return np.asarray((R * vectors[:, None]).sum(axis=0))


def velocities_of(lever: Array, motion: Array) -> Array:
    """Return velocities (3, n) in the world of a point fixed to each vehicle [m/s].

    Args:
        lever: (3,) Position of the point in the vehicle frame [m].
        motion: (13, n) Motion.
    """
    x, y, z = _components(motion[RATE])
    a, b, c = lever.tolist()
    relative = np.empty((3, motion.shape[1]))
    relative[0], relative[1], relative[2] = y * c - z * b, z * a - x * c, x * b - y * a
    return motion[VELOCITY] + rotated(rotations(motion[QUATERNION]), relative)


def specific_forces(R: Array, before: Array, after: Array, interval_s: Array | float) -> Array:
    """Return mean specific forces (3, n) over one interval centred on a time [m/s²].

    Args:
        R: (3, 3, n) Rotations from the frame of the result to the world at this time.
        before: (3, n) Velocities of the IMU half an interval earlier, in the world [m/s].
        after: (3, n) Velocities half an interval later [m/s].
        interval_s: Length of the interval, or of each (n,) [s].
    """
    force = (after - before) / interval_s
    force[2] += GRAVITY_M_S2
    return rotated_back(R, force)


def _components(vectors: Array) -> Iterable[Any]:
    """Return the rows (n,) of vectors (d, n), or d numbers for n = 1, with which Python computes faster than numpy."""
    return vectors[:, 0].tolist() if vectors.shape[1] == 1 else vectors
