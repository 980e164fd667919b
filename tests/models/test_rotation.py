"""Rotations against scipy and against the laws of the group."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from dronevio.models.arrays import Array
from dronevio.models.rotation import (
    adjoint,
    cross,
    exp_so3,
    integrated_rotations,
    inverse_pose,
    log_so3,
    matrix_from_quat_wxyz,
    pose_matrix,
    quat_wxyz_from_matrix,
    quat_wxyz_from_xyzw,
    quat_xyzw_from_wxyz,
    rotation_z,
    skew,
    yaw_rad_from_matrix,
)

ANGLES_RAD = [0.0, 1e-12, 1e-8, 0.9e-7, 1.1e-7, 1e-6, 1e-4, 0.1, 1.0, 3.0, np.pi - 1e-3, np.pi - 1e-6]
vectors = st.lists(st.floats(-3.0, 3.0), min_size=3, max_size=3).map(np.array)


def directions(n: int) -> Array:
    v = np.random.default_rng(n).normal(size=(n, 3))
    return np.asarray(v / np.linalg.norm(v, axis=1, keepdims=True))


@given(vectors, vectors)
@settings(max_examples=50, deadline=None)
def test_skew_is_the_cross_product(a: Array, b: Array) -> None:
    np.testing.assert_allclose(skew(a) @ b, np.cross(a, b), atol=1e-14)
    np.testing.assert_array_equal(skew(a), -skew(a).T)


@pytest.mark.parametrize("angle_rad", [*ANGLES_RAD, np.pi, 5.0, 20.0])
def test_exponential_agrees_with_scipy(angle_rad: float) -> None:
    phi = angle_rad * directions(20)
    R = exp_so3(phi)
    np.testing.assert_allclose(R, Rotation.from_rotvec(phi).as_matrix(), atol=1e-14)
    np.testing.assert_allclose(R[0], expm(skew(phi[0])), atol=1e-13)
    np.testing.assert_allclose(R @ np.swapaxes(R, 1, 2), np.broadcast_to(np.eye(3), R.shape), atol=1e-14)
    np.testing.assert_allclose(np.linalg.det(R), 1.0, atol=1e-14)


@pytest.mark.parametrize("angle_rad", [*ANGLES_RAD, np.pi, 5.0, 20.0])
def test_exponential_of_a_single_vector_is_that_of_several(angle_rad: float) -> None:
    phi = angle_rad * directions(20)
    np.testing.assert_allclose(np.stack([exp_so3(each) for each in phi]), exp_so3(phi), atol=1e-15)


@pytest.mark.parametrize("n", [0, 1, 2, 9, 10, 50])
def test_integrated_rotations_are_products_in_order(n: int) -> None:
    phi = np.random.default_rng(n).normal(size=(3, n, 3))
    products = integrated_rotations(phi)
    assert products.shape == (3, n + 1, 3, 3)
    for run in range(3):
        R = np.eye(3)
        for k in range(n + 1):
            np.testing.assert_allclose(products[run, k], R, atol=1e-13)
            R = R @ exp_so3(phi[run, k]) if k < n else R


@pytest.mark.parametrize("angle_rad", ANGLES_RAD)
def test_logarithm_inverts_the_exponential(angle_rad: float) -> None:
    phi = angle_rad * directions(50)
    np.testing.assert_allclose(log_so3(exp_so3(phi)), phi, rtol=1e-9, atol=1e-15)


def test_logarithm_of_rotations_by_pi() -> None:
    axes = np.vstack([np.eye(3), -np.eye(3), directions(50)])
    found = log_so3(exp_so3(np.pi * axes))
    np.testing.assert_allclose(np.abs(np.sum(found * axes, axis=1)), np.pi, atol=1e-7)
    np.testing.assert_allclose(exp_so3(found), exp_so3(np.pi * axes), atol=1e-7)


def test_logarithm_is_the_shortest_rotation() -> None:
    phi = 5.0 * directions(20)
    np.testing.assert_allclose(np.linalg.norm(log_so3(exp_so3(phi)), axis=1), 2.0 * np.pi - 5.0, atol=1e-12)


def test_quaternions_of_all_four_forms_are_exact() -> None:
    large = [Rotation.from_rotvec(3.1 * axis) for axis in np.eye(3)]  # each selects another form
    R = np.concatenate([Rotation.random(500, random_state=1).as_matrix(), [r.as_matrix() for r in large], [np.eye(3)]])
    q = quat_wxyz_from_matrix(R)
    np.testing.assert_allclose(np.linalg.norm(q, axis=1), 1.0, atol=1e-14)
    assert np.all(q[:, 0] >= 0.0)
    np.testing.assert_allclose(matrix_from_quat_wxyz(q), R, atol=1e-13)
    theirs = Rotation.from_matrix(R).as_quat(canonical=True)
    np.testing.assert_allclose(quat_xyzw_from_wxyz(q), theirs, atol=1e-12)


def test_matrices_ignore_length_and_sign_of_quaternions() -> None:
    q = quat_wxyz_from_matrix(Rotation.random(20, random_state=2).as_matrix())
    np.testing.assert_allclose(matrix_from_quat_wxyz(-3.7 * q), matrix_from_quat_wxyz(q), atol=1e-14)


def test_reordering_is_inverted() -> None:
    np.testing.assert_array_equal(quat_xyzw_from_wxyz(np.array([1.0, 2.0, 3.0, 4.0])), [2.0, 3.0, 4.0, 1.0])
    q = np.random.default_rng(7).normal(size=(5, 2, 4))
    np.testing.assert_array_equal(quat_wxyz_from_xyzw(quat_xyzw_from_wxyz(q)), q)


def test_rotations_about_z_have_their_yaw() -> None:
    yaw = np.array([[-3.0, -0.1, 0.0], [1e-9, 2.0, np.pi]])
    R = rotation_z(yaw)
    expected = Rotation.from_euler("z", yaw.reshape(-1, 1)).as_matrix().reshape(2, 3, 3, 3)
    np.testing.assert_allclose(R, expected, atol=1e-15)
    np.testing.assert_allclose(yaw_rad_from_matrix(R), yaw, rtol=1e-15)


@given(vectors)
@settings(max_examples=50, deadline=None)
def test_yaw_is_that_of_the_nearest_rotation_about_z(phi: Array) -> None:
    R = exp_so3(phi)
    best = np.trace(rotation_z(yaw_rad_from_matrix(R)).T @ R)
    others = np.trace(rotation_z(np.linspace(-np.pi, np.pi, 721)).transpose(0, 2, 1) @ R, axis1=1, axis2=2)
    assert best >= others.max() - 1e-12  # the nearest of the others may be the same rotation, rounded


def test_inverse_poses_are_inverse_matrices() -> None:
    p = np.random.default_rng(7).normal(size=(30, 3))
    T = pose_matrix(Rotation.random(30, random_state=3).as_matrix(), p)
    np.testing.assert_array_equal(T[:, 3], np.tile([0.0, 0.0, 0.0, 1.0], (30, 1)))
    np.testing.assert_allclose(inverse_pose(T), np.linalg.inv(T), atol=1e-13)
    np.testing.assert_allclose(inverse_pose(T[4]) @ T[4], np.eye(4), atol=1e-14)


def test_functions_broadcast_over_leading_axes() -> None:
    phi = np.random.default_rng(7).normal(size=(2, 3, 3))
    R = exp_so3(phi)
    q = quat_wxyz_from_matrix(R)
    for i, j in np.ndindex(2, 3):
        np.testing.assert_allclose(R[i, j], exp_so3(phi[i, j]), atol=1e-15)
        np.testing.assert_array_equal(q[i, j], quat_wxyz_from_matrix(R[i, j]))
        np.testing.assert_array_equal(log_so3(R)[i, j], log_so3(R[i, j]))
        np.testing.assert_array_equal(matrix_from_quat_wxyz(q)[i, j], matrix_from_quat_wxyz(q[i, j]))


def test_cross_products_of_any_shape_are_exact() -> None:
    a, b = np.random.default_rng(2).standard_normal((2, 6, 3))
    np.testing.assert_array_equal(cross(a, b), np.cross(a, b))
    np.testing.assert_array_equal(cross(a[0], b[0]), np.cross(a[0], b[0]))
    np.testing.assert_array_equal(cross(a[:2, None], b), np.cross(a[:2, None], b))
    np.testing.assert_array_equal(cross(a[:1], b[0]), np.cross(a[:1], b[0]))


def test_adjoint_maps_perturbations_between_frames() -> None:
    rng = np.random.default_rng(5)
    T = pose_matrix(exp_so3(rng.normal(size=3)), rng.normal(size=3))
    delta = 1e-6 * rng.normal(size=6)
    mapped = adjoint(T) @ delta
    perturbed = T @ pose_matrix(exp_so3(delta[:3]), delta[3:])
    np.testing.assert_allclose(pose_matrix(exp_so3(mapped[:3]), mapped[3:]) @ T, perturbed, atol=1e-11)
