"""Rotation matrices and poses: the exponential map of SO(3), and conversions from and to quaternions.

MuJoCo and EuRoC order quaternions wxyz; TUM files, scipy and rerun order them xyzw. Names of functions and arrays
contain the order. All functions broadcast over leading axes. `dronevio.models.quaternions` multiplies and
interpolates quaternions.

Reference: Solà, Deray, Atchuthan, "A micro Lie theory for state estimation in robotics", 2018 (eq. 132 and 145).
"""

import math

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array

_IDENTITY = np.eye(3)
_SKEW = np.array([[0, 0, 0, 0, 0, -1, 0, 1, 0], [0, 0, 1, 0, 0, 0, -1, 0, 0], [0, -1, 0, 1, 0, 0, 0, 0, 0]], np.float64)
_TINY_ANGLE_RAD = 1e-150  # keeps sin(x) / x finite
_SMALL_ANGLE_RAD = 1e-7  # below it, the first terms of the series are exact to double precision


def skew(v: Array) -> Array:
    """Return [v]× (…, 3, 3) of v (…, 3), so that [v]× u = v × u."""
    K = np.zeros((*v.shape[:-1], 3, 3))
    for k, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
        K[..., j, i] = v[..., k]
        K[..., i, j] = -v[..., k]
    return K


def cross(a: Array, b: Array) -> Array:
    """Return a × b of vectors (…, 3), several times as fast as `np.cross`, with the same rounding."""
    if a.size == b.size == 3:
        ax, ay, az = a.ravel().tolist()
        bx, by, bz = b.ravel().tolist()
        product = np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])
        return product if a.ndim == b.ndim == 1 else product.reshape(np.broadcast_shapes(a.shape, b.shape))
    product = np.empty(np.broadcast_shapes(a.shape, b.shape))
    for k, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
        product[..., k] = a[..., i] * b[..., j] - a[..., j] * b[..., i]
    return product


def exp_so3(phi_rad: Array) -> Array:
    """Return the rotation matrices (…, 3, 3) of rotation vectors (…, 3) [rad].

    Rodrigues' formula cos|φ| I + a [φ]× + b φ φᵀ, with a = sin|φ| / |φ| and b = (1 − cos|φ|) / |φ|² by half the angle.
    """
    phi = np.asarray(phi_rad, dtype=np.float64)
    if phi.ndim == 1:  # several times as fast without arrays
        x, y, z = phi.tolist()
        half = 0.5 * math.sqrt(x * x + y * y + z * z)
        sine, cosine = math.sin(half), math.cos(half)
        ratio = sine / half if half else 1.0
        a, b, c = ratio * cosine, 0.5 * ratio * ratio, 1.0 - 2.0 * sine * sine
        return np.array(
            [
                [c + b * x * x, b * x * y - a * z, b * x * z + a * y],
                [b * x * y + a * z, c + b * y * y, b * y * z - a * x],
                [b * x * z - a * y, b * y * z + a * x, c + b * z * z],
            ]
        )
    halves = np.maximum(0.5 * np.sqrt(np.add.reduce(phi * phi, axis=-1, keepdims=True)), _TINY_ANGLE_RAD)
    sines = np.sin(halves)
    ratios = sines / halves
    R = (0.5 * ratios * ratios * phi)[..., :, None] * phi[..., None, :]
    R += ((ratios * np.cos(halves) * phi) @ _SKEW + (1.0 - 2.0 * sines * sines) * _IDENTITY.ravel()).reshape(R.shape)
    return R


def cumulative_rotations(steps: Array) -> Array:
    """Return the products (…, N, 3, 3) of the first 1, 2, …, N of sequences of rotations (…, N, 3, 3).

    The sequences are divided into √N blocks: products within all blocks at once, then products of the blocks. This
    takes 2 √N operations on large arrays instead of N on small ones.
    """
    *runs, n = steps.shape[:-2]
    length = int(np.ceil(np.sqrt(n)))
    blocks = -(-n // max(length, 1))
    products = np.empty((*runs, blocks * length, 3, 3))
    products[..., :n, :, :], products[..., n:, :, :] = steps, _IDENTITY
    products = products.reshape(*runs, blocks, length, 3, 3)
    for i in range(1, length):
        products[..., i, :, :] = products[..., i - 1, :, :] @ products[..., i, :, :]
    for block in range(1, blocks):
        products[..., block, :, :, :] = products[..., block - 1, -1:, :, :] @ products[..., block, :, :, :]
    return products.reshape(*runs, blocks * length, 3, 3)[..., :n, :, :]


def integrated_rotations(phi_rad: Array) -> Array:
    """Return the products (…, N + 1, 3, 3) of the rotations of N successive rotation vectors (…, N, 3) [rad].

    The first is the identity; row k is exp(φ₀) exp(φ₁) … exp(φₖ₋₁), the rotation over the first k increments of a
    gyroscope.
    """
    R = np.empty((*phi_rad.shape[:-2], phi_rad.shape[-2] + 1, 3, 3))
    R[..., 0, :, :], R[..., 1:, :, :] = _IDENTITY, cumulative_rotations(exp_so3(phi_rad))
    return R


def log_so3(R: Array) -> Array:
    """Return the rotation vectors (…, 3) [rad], of length ≤ π, of rotation matrices (…, 3, 3)."""
    q = quat_wxyz_from_matrix(R)
    w, v = q[..., :1], q[..., 1:]
    n = np.sqrt(np.add.reduce(v * v, axis=-1, keepdims=True))
    # 2 atan2(|v|, w) / |v| → 2 / w as |v| → 0
    scale = np.where(
        n < _SMALL_ANGLE_RAD, 2.0 / np.where(w == 0.0, 1.0, w), 2.0 * np.arctan2(n, w) / np.where(n == 0.0, 1.0, n)
    )
    return np.asarray(scale * v)


def quat_wxyz_from_matrix(R: Array) -> Array:
    """Return unit quaternions (…, 4) with w ≥ 0 of rotation matrices (…, 3, 3).

    The function selects the best conditioned of Shepperd's four forms (1978).
    """
    R = np.asarray(R, dtype=np.float64)
    if R.ndim == 2:  # several times as fast without arrays
        (a, b, c), (d, e, f), (g, h, i) = R.tolist()
        wx, wy, wz, xy, xz, yz = h - f, c - g, d - b, d + b, c + g, h + f
        four = (
            (1 + a + e + i, wx, wy, wz),
            (wx, 1 + a - e - i, xy, xz),
            (wy, xy, 1 - a + e - i, yz),
            (wz, xz, yz, 1 - a - e + i),
        )
        w, x, y, z = four[max(range(4), key=lambda k: four[k][k])]
        norm = math.sqrt(w * w + x * x + y * y + z * z)
        return np.array([w, x, y, z]) / (-norm if w < 0.0 else norm)
    m00, m11, m22 = R[..., 0, 0], R[..., 1, 1], R[..., 2, 2]
    forms = np.empty((*R.shape[:-2], 4, 4))
    forms[..., 0, 0], forms[..., 1, 1] = 1 + m00 + m11 + m22, 1 + m00 - m11 - m22
    forms[..., 2, 2], forms[..., 3, 3] = 1 - m00 + m11 - m22, 1 - m00 - m11 + m22
    forms[..., 0, 1] = forms[..., 1, 0] = R[..., 2, 1] - R[..., 1, 2]
    forms[..., 0, 2] = forms[..., 2, 0] = R[..., 0, 2] - R[..., 2, 0]
    forms[..., 0, 3] = forms[..., 3, 0] = R[..., 1, 0] - R[..., 0, 1]
    forms[..., 1, 2] = forms[..., 2, 1] = R[..., 1, 0] + R[..., 0, 1]
    forms[..., 1, 3] = forms[..., 3, 1] = R[..., 0, 2] + R[..., 2, 0]
    forms[..., 2, 3] = forms[..., 3, 2] = R[..., 2, 1] + R[..., 1, 2]
    best = np.argmax(np.diagonal(forms, axis1=-2, axis2=-1), axis=-1).ravel()
    q = forms.reshape(-1, 4, 4)[np.arange(best.size), best].reshape(*R.shape[:-2], 4)
    q = q / np.sqrt(np.add.reduce(q * q, axis=-1, keepdims=True))
    return np.asarray(np.where(q[..., :1] < 0.0, -q, q))


def rotation_z(angle_rad: npt.ArrayLike) -> Array:
    """Return the rotation matrices (…, 3, 3) about z by angles (…) [rad]."""
    angle = np.asarray(angle_rad, dtype=np.float64)
    R = np.zeros((*angle.shape, 3, 3))
    R[..., 0, 0] = R[..., 1, 1] = np.cos(angle)
    R[..., 1, 0] = np.sin(angle)
    R[..., 0, 1] = -R[..., 1, 0]
    R[..., 2, 2] = 1.0
    return R


def yaw_rad_from_matrix(R: Array) -> Array:
    """Return the angles (…) [rad], −π to π, of the rotations about z that are nearest to rotations (…, 3, 3).

    The angle maximizes tr(Rz(θ)ᵀ R). It is 0 where R reverses z and every angle is a solution.
    """
    return np.asarray(np.arctan2(R[..., 1, 0] - R[..., 0, 1], R[..., 0, 0] + R[..., 1, 1]))


def nearest_rotations(R: Array) -> Array:
    """Return the rotations (…, 3, 3) nearest to matrices (…, 3, 3) that deviate from rotations by rounding.

    Newton's iteration for the polar factor, R ← (R + R⁻ᵀ)/2, converges quadratically: a deviation of a few hundredths
    is below rounding after four steps (Higham, "Computing the polar decomposition", 1986).
    """
    R = np.asarray(R, dtype=np.float64)
    for _ in range(4):
        a, b, c = R[..., 0, :], R[..., 1, :], R[..., 2, :]
        cofactors = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=-2)
        determinant = np.sum(a * cofactors[..., 0, :], axis=-1)[..., None, None]
        R = 0.5 * (
            R + cofactors / determinant
        )  # the transposed inverse is the cofactor matrix divided by the determinant
    return R


def matrix_from_quat_wxyz(quat_wxyz: Array) -> Array:
    """Return the rotation matrices (…, 3, 3) of quaternions (…, 4), which are normalized first."""
    q = np.asarray(quat_wxyz, dtype=np.float64)
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    w, v = q[..., 0, None, None], q[..., 1:]
    K = skew(v)
    return np.asarray(np.eye(3) + 2.0 * (w * K + K @ K))


def quat_xyzw_from_wxyz(quat_wxyz: Array) -> Array:
    """Return quaternions (…, 4) in the order xyzw, given those in the order wxyz."""
    return np.roll(np.asarray(quat_wxyz), -1, axis=-1)


def quat_wxyz_from_xyzw(quat_xyzw: Array) -> Array:
    """Return quaternions (…, 4) in the order wxyz, given those in the order xyzw."""
    return np.roll(np.asarray(quat_xyzw), 1, axis=-1)


def pose_matrix(R: Array, p: Array) -> Array:
    """Return homogeneous poses (…, 4, 4) of rotations (…, 3, 3) and positions (…, 3)."""
    T = np.zeros((*R.shape[:-2], 4, 4))
    T[..., :3, :3] = R
    T[..., :3, 3] = p
    T[..., 3, 3] = 1.0
    return T


def inverse_pose(T: Array) -> Array:
    """Return the inverse poses T_b_a (…, 4, 4) of poses T_a_b (…, 4, 4)."""
    R_inv = np.swapaxes(T[..., :3, :3], -1, -2)
    return pose_matrix(R_inv, -(R_inv @ T[..., :3, 3, None])[..., 0])


def adjoint(T: Array) -> Array:
    """Return the adjoint (6, 6) of a pose T_a_b (4, 4): it maps perturbations (δθ, δp) in frame b to those in a."""
    R, A = T[:3, :3], np.zeros((6, 6))
    A[:3, :3] = A[3:, 3:] = R
    A[3:, :3] = skew(T[:3, 3]) @ R
    return A
