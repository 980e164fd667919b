"""Quaternion algebra against scipy and against the laws of the group."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from dronevio.models.arrays import Array
from dronevio.models.quaternions import (
    angles_rad,
    components,
    conjugate,
    euler_zyx_rad,
    product,
    quat_product_wxyz,
    quat_wxyz_from_components,
    rotate,
    select,
    slerp_quat_wxyz,
    yaw_rad,
)
from dronevio.models.rotation import (
    exp_so3,
    log_so3,
    matrix_from_quat_wxyz,
    quat_wxyz_from_matrix,
    quat_wxyz_from_xyzw,
    quat_xyzw_from_wxyz,
    rotation_z,
    yaw_rad_from_matrix,
)

seeds = st.integers(0, 2**32 - 1)


def random_quaternions(seed: int, n: int) -> Array:
    """Return unit quaternions wxyz (n, 4) of both signs of w."""
    q = np.random.default_rng(seed).normal(size=(n, 4))
    return np.asarray(q / np.linalg.norm(q, axis=1, keepdims=True))


def as_scipy(quat_wxyz: Array) -> Rotation:
    return Rotation.from_quat(quat_xyzw_from_wxyz(quat_wxyz))


def assert_same_rotation(a: Array, b: Array, atol: float = 1e-12) -> None:
    """Compare quaternions up to their sign, because both signs are the same rotation."""
    np.testing.assert_allclose(np.abs(np.sum(a * b, axis=-1)), 1.0, atol=atol)


@settings(max_examples=50, deadline=None)
@given(seeds)
def test_product_agrees_with_matrices(seed: int) -> None:
    q, r = np.random.default_rng(seed).normal(size=(2, 5, 4))  # of arbitrary length
    expected = matrix_from_quat_wxyz(q) @ matrix_from_quat_wxyz(r)
    np.testing.assert_allclose(matrix_from_quat_wxyz(quat_product_wxyz(q, r)), expected, atol=1e-12)
    found = quat_wxyz_from_components(product(components(q), components(r)))
    np.testing.assert_array_equal(found, quat_product_wxyz(q, r))


@settings(max_examples=30, deadline=None)
@given(seeds)
def test_rotation_of_vectors_agrees_with_matrices(seed: int) -> None:
    rng = np.random.default_rng(seed)
    q, v = 3.0 * random_quaternions(seed, 6), rng.normal(size=(6, 3))
    expected = np.einsum("nij,nj->ni", matrix_from_quat_wxyz(q), v)
    np.testing.assert_allclose(np.stack(rotate(components(q), tuple(v.T)), axis=1), expected, atol=1e-12)
    back = rotate(conjugate(components(q)), tuple(expected.T))
    np.testing.assert_allclose(np.stack(back, axis=1), v, atol=1e-12)


@pytest.mark.parametrize("angle_rad", [0.0, 1e-12, 1e-8, 1e-3, 1.0, 3.0, np.pi])
def test_small_angles_are_exact(angle_rad: float) -> None:
    axes = np.random.default_rng(1).normal(size=(20, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    half = 0.5 * angle_rad
    q = np.concatenate([np.full((20, 1), np.cos(half)), np.sin(half) * axes], axis=1)
    np.testing.assert_allclose(angles_rad(components(-2.0 * q)), angle_rad, rtol=1e-14)


@settings(max_examples=30, deadline=None)
@given(seeds)
def test_euler_angles_compose_to_the_rotation(seed: int) -> None:
    q = random_quaternions(seed, 6)
    yaw, pitch, roll = euler_zyx_rad(components(3.0 * q))
    expected = Rotation.from_euler("ZYX", np.stack([yaw, pitch, roll], axis=1))
    assert_same_rotation(quat_wxyz_from_xyzw(expected.as_quat()), q, 1e-9)


@settings(max_examples=30, deadline=None)
@given(seeds)
def test_yaw_leaves_a_rotation_about_a_horizontal_axis(seed: int) -> None:
    q = random_quaternions(seed, 6)
    yaw = yaw_rad(components(q))
    rest = quat_product_wxyz(quat_wxyz_from_matrix(rotation_z(-yaw)), q)
    np.testing.assert_allclose(rest[:, 3], 0.0, atol=1e-9)
    difference = np.remainder(yaw - yaw_rad_from_matrix(matrix_from_quat_wxyz(q)) + np.pi, 2.0 * np.pi) - np.pi
    np.testing.assert_allclose(difference, 0.0, atol=1e-9)


@settings(max_examples=50, deadline=None)
@given(st.floats(-0.5, 1.5), seeds)
def test_slerp_follows_the_shorter_arc(fraction: float, seed: int) -> None:
    q0, q1 = random_quaternions(seed, 2)
    found = slerp_quat_wxyz(q0, q1, np.array(fraction))
    assert np.linalg.norm(found) == pytest.approx(1.0, abs=1e-14)
    R0, R1, R = map(matrix_from_quat_wxyz, (q0, q1, found))
    np.testing.assert_allclose(R, R0 @ exp_so3(fraction * log_so3(R0.T @ R1)), atol=1e-9)
    np.testing.assert_allclose(slerp_quat_wxyz(q0, -q1, np.array(fraction)), found, atol=1e-12)


def test_slerp_agrees_with_scipy() -> None:
    q = random_quaternions(3, 2)
    fraction = np.linspace(0.0, 1.0, 11)
    expected = Slerp([0.0, 1.0], as_scipy(q))(fraction)
    found = slerp_quat_wxyz(np.tile(q[0], (11, 1)), np.tile(q[1], (11, 1)), fraction)
    np.testing.assert_allclose((as_scipy(found).inv() * expected).magnitude(), 0.0, atol=1e-12)


@pytest.mark.parametrize("angle_rad", [0.0, 1e-13, 1e-11, 1e-7])
def test_slerp_between_nearly_equal_orientations(angle_rad: float) -> None:
    q0 = random_quaternions(4, 1)[0]
    q1 = quat_product_wxyz(q0, quat_wxyz_from_matrix(exp_so3(np.array([0.0, angle_rad, 0.0]))))
    middle = slerp_quat_wxyz(q0, q1, np.array(0.5))
    error = angles_rad(product(conjugate(components(q0)), components(middle)))
    assert error == pytest.approx(0.5 * angle_rad, rel=1e-2, abs=1e-15)


def test_components_preserve_the_quaternions() -> None:
    q = random_quaternions(5, 4)
    np.testing.assert_array_equal(quat_wxyz_from_components(components(q)), q)
    np.testing.assert_array_equal(quat_wxyz_from_components(select(components(q), slice(1, 3))), q[1:3])
    assert all(part.flags.c_contiguous for part in components(q))
