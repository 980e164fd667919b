"""Quaternion algebra on many orientations at once: product, rotation of vectors, angles, interpolation.

Quaternions follow Hamilton's convention with w first. The functions work on `Components`, that is on w, x, y and z as
four arrays, because numpy's cross products and products of small matrices cost several times as much for a million
orientations. `components` and `quat_wxyz_from_components` convert from and to arrays (…, 4); `quat_product_wxyz` and
`slerp_quat_wxyz` take such arrays directly. `dronevio.models.rotation` converts to and from matrices.

All functions broadcast. Quaternions need not be of unit length, except where they are interpolated.
"""

from typing import Any

import numpy as np

from dronevio.models.arrays import Array

Components = tuple[Array, Array, Array, Array]
"""w, x, y and z, each (…)."""

_SMALL = 1e-12  # sine of half an angle below which arc and chord are equal in double precision


def components(quat_wxyz: Array) -> Components:
    """Return the components of quaternions (…, 4), each contiguous in memory."""
    w, x, y, z = np.ascontiguousarray(np.moveaxis(np.asarray(quat_wxyz, dtype=np.float64), -1, 0))
    return w, x, y, z


def quat_wxyz_from_components(q: Components) -> Array:
    """Return quaternions as an array (…, 4)."""
    return np.stack(q, axis=-1)


def select(q: Components, index: Any) -> Components:
    """Return the quaternions at a numpy index, which each component is indexed with."""
    w, x, y, z = (component[index] for component in q)
    return w, x, y, z


def conjugate(q: Components) -> Components:
    """Return the conjugates, which are the inverse rotations."""
    return q[0], -q[1], -q[2], -q[3]


def product(q: Components, r: Components) -> Components:
    """Return the products q r: the rotation r followed by the rotation q."""
    qw, qx, qy, qz = q
    rw, rx, ry, rz = r
    return (
        qw * rw - qx * rx - qy * ry - qz * rz,
        qw * rx + qx * rw + qy * rz - qz * ry,
        qw * ry - qx * rz + qy * rw + qz * rx,
        qw * rz + qx * ry - qy * rx + qz * rw,
    )


def quat_product_wxyz(q: Array, r: Array) -> Array:
    """Return the products q r (…, 4) of quaternions (…, 4): the rotation r followed by the rotation q."""
    q, r = np.broadcast_arrays(np.asarray(q, dtype=np.float64), np.asarray(r, dtype=np.float64))
    return quat_wxyz_from_components(product(components(q), components(r)))


def rotate(q: Components, v: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
    """Return rotated vectors: v + 2 (w u×v + u×(u×v)) / |q|², with u the vector part of q."""
    w, x, y, z = q
    twice = 2.0 / (w * w + x * x + y * y + z * z)
    vx, vy, vz = v
    cx, cy, cz = y * vz - z * vy, z * vx - x * vz, x * vy - y * vx
    return (
        vx + twice * (w * cx + y * cz - z * cy),
        vy + twice * (w * cy + z * cx - x * cz),
        vz + twice * (w * cz + x * cy - y * cx),
    )


def angles_rad(q: Components) -> Array:
    """Return the rotation angles (…) [rad], 0 to π.

    They are computed from the vector part, which is exact for small angles, where the arc cosine of w loses half of the
    digits.
    """
    w, x, y, z = q
    return np.asarray(2.0 * np.arctan2(np.sqrt(x * x + y * y + z * z), np.abs(w)))


def yaw_rad(q: Components) -> Array:
    """Return the angles (…) [rad], −π to π, of the rotations about z that are nearest to the given ones.

    This is the part about z when a rotation is split into one about z and one about a horizontal axis.
    `dronevio.models.rotation.yaw_rad_from_matrix` computes the same for matrices.
    """
    return np.asarray(np.remainder(2.0 * np.arctan2(q[3], q[0]) + np.pi, 2.0 * np.pi) - np.pi)


def euler_zyx_rad(q: Components) -> tuple[Array, Array, Array]:
    """Return yaw, pitch and roll (…) [rad], such that the rotation is Rz(yaw) Ry(pitch) Rx(roll)."""
    w, x, y, z = q
    n = w * w + x * x + y * y + z * z
    yaw = np.arctan2(2.0 * (w * z + x * y), w * w + x * x - y * y - z * z)
    pitch = np.arcsin(np.clip(2.0 * (w * y - x * z) / n, -1.0, 1.0))
    roll = np.arctan2(2.0 * (w * x + y * z), w * w - x * x - y * y + z * z)
    return yaw, pitch, roll


def slerp(q: Components, r: Components, fraction: Array) -> Components:
    """Return unit quaternions on the shorter arcs from unit quaternions q (fraction 0) to r (fraction 1).

    Fractions (…) outside 0 to 1 extrapolate with the same axis and rate (Shoemake, "Animating rotation with quaternion
    curves", 1985).
    """
    w, x, y, z = product(conjugate(q), r)
    sign = np.where(w < 0.0, -1.0, 1.0)
    sine = np.sqrt(x * x + y * y + z * z)
    half = np.arctan2(sine, np.abs(w))
    straight = sine < _SMALL
    part = sign * np.where(straight, fraction, np.sin(fraction * half) / np.where(straight, 1.0, sine))
    return product(q, (np.cos(fraction * half), part * x, part * y, part * z))


def slerp_quat_wxyz(quat0_wxyz: Array, quat1_wxyz: Array, fraction: Array) -> Array:
    """Return unit quaternions (…, 4) on the shorter arcs between unit quaternions (…, 4); see `slerp`."""
    return quat_wxyz_from_components(slerp(components(quat0_wxyz), components(quat1_wxyz), np.asarray(fraction)))
