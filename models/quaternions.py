"""Quaternions in bulk: what the metrics do with a million orientations at once.

Everything is written out in components, because numpy's cross product and small matrices cost several times as much.
Quaternions need not be of unit length, except where they are interpolated.
"""

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Components = tuple[Array, Array, Array, Array]
"""w, x, y and z, each (…)."""

_SMALL = 1e-12  # sine of half an angle below which the arc is a chord to double precision


def components(quat_wxyz: Array) -> Components:
    """Return the components of quaternions (…, 4), each contiguous in memory."""
    w, x, y, z = np.ascontiguousarray(np.moveaxis(np.asarray(quat_wxyz, dtype=np.float64), -1, 0))
    return w, x, y, z


def conjugate(q: Components) -> Components:
    """Return the inverse rotations."""
    return q[0], -q[1], -q[2], -q[3]


def product(q: Components, r: Components) -> Components:
    """Return the products: first turned by r, then by q."""
    qw, qx, qy, qz = q
    rw, rx, ry, rz = r
    return (
        qw * rw - qx * rx - qy * ry - qz * rz,
        qw * rx + qx * rw + qy * rz - qz * ry,
        qw * ry - qx * rz + qy * rw + qz * rx,
        qw * rz + qx * ry - qy * rx + qz * rw,
    )


def angles_rad(q: Components) -> Array:
    """Return the angles (…) [rad], 0 to π.

    From the vector part: exact for small angles, where the arc cosine of w loses half the digits.
    """
    w, x, y, z = q
    return np.asarray(2.0 * np.arctan2(np.sqrt(x * x + y * y + z * z), np.abs(w)))


def turned(q: Components, v: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
    """Return vectors after the rotations: v + 2 (w u×v + u×(u×v)) / |q|², u being the vector part."""
    w, x, y, z = q
    twice = 2.0 / (w * w + x * x + y * y + z * z)
    vx, vy, vz = v
    cx, cy, cz = y * vz - z * vy, z * vx - x * vz, x * vy - y * vx
    return (
        vx + twice * (w * cx + y * cz - z * cy),
        vy + twice * (w * cy + z * cx - x * cz),
        vz + twice * (w * cz + x * cy - y * cx),
    )


def yaw_rad(q: Components) -> Array:
    """Return the angles (…) [rad], −π to π, about the vertical that bring the rotations closest to none.

    It is the part about z if a rotation is split into one about z and one about a level axis.
    """
    return np.asarray(np.remainder(2.0 * np.arctan2(q[3], q[0]) + np.pi, 2.0 * np.pi) - np.pi)


def euler_zyx_rad(q: Components) -> tuple[Array, Array, Array]:
    """Return yaw, pitch and roll (…) [rad], so that the rotation is Rz(yaw) Ry(pitch) Rx(roll)."""
    w, x, y, z = q
    n = w * w + x * x + y * y + z * z
    yaw = np.arctan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)
    pitch = np.arcsin(np.clip(2.0 * (w * y - x * z) / n, -1.0, 1.0))
    roll = np.arctan2(2.0 * (w * x + y * z), w * w - x * x - y * y + z * z)
    return yaw, pitch, roll


def slerp(q: Components, r: Components, fraction: Array) -> Components:
    """Return unit quaternions on the shorter arcs from unit quaternions q (fraction 0) to r (fraction 1)."""
    w, x, y, z = product(conjugate(q), r)
    sign = np.where(w < 0.0, -1.0, 1.0)
    sine = np.sqrt(x * x + y * y + z * z)
    half = np.arctan2(sine, np.abs(w))
    straight = sine < _SMALL
    part = sign * np.where(straight, fraction, np.sin(fraction * half) / np.where(straight, 1.0, sine))
    return product(q, (np.cos(fraction * half), part * x, part * y, part * z))


def quat_product_wxyz(q: Array, r: Array) -> Array:
    """Return the products (…, 4) of quaternions (…, 4): first turned by r, then by q."""
    q, r = np.broadcast_arrays(np.asarray(q, dtype=np.float64), np.asarray(r, dtype=np.float64))
    return np.stack(product(components(q), components(r)), axis=-1)
