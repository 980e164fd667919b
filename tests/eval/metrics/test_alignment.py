"""Alignments: recovery of known motions, optimality, invariance, and transformation of trajectories."""

from typing import get_args

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from dronevio.eval.metrics import Alignment, AlignmentMode, align, ate, umeyama
from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError, EvaluationError
from dronevio.models.rotation import exp_so3, rotation_z
from dronevio.models.state import Trajectory

BY_FREEDOM: tuple[AlignmentMode, ...] = ("none", "yaw", "se3", "sim3")
"""Alignments by least squares, each a special case of the next."""

seeds = st.integers(0, 2**32 - 1)
rotations = st.tuples(*[st.floats(-3, 3)] * 3).map(lambda phi: exp_so3(np.array(phi)))
shifts = st.tuples(*[st.floats(-50, 50)] * 3).map(np.array)


def random_path(seed: int, n: int = 30) -> Array:
    """Return the positions (n, 3) of a random walk [m]."""
    return np.cumsum(np.random.default_rng(seed).normal(size=(n, 3)), axis=0)


@settings(max_examples=50, deadline=None)
@given(seeds, st.floats(-3.1, 3.1), rotations, shifts, st.floats(0.2, 5.0))
def test_alignment_recovers_the_applied_motion(seed: int, yaw: float, R: Array, t: Array, s: float) -> None:
    truth = random_path(seed)
    motions: list[tuple[AlignmentMode, Array, float]] = [
        ("yaw", rotation_z(yaw), 1.0),
        ("se3", R, 1.0),
        ("sim3", R, s),
    ]
    for mode, rotation, scale in motions:
        estimate = ((truth - t) / scale) @ rotation  # so that truth = scale · R · estimate + t
        found = align(truth, estimate, mode)
        np.testing.assert_allclose(found.R_truth_estimate, rotation, atol=1e-9)
        np.testing.assert_allclose(found.t_m, t, atol=1e-7)
        assert found.scale == pytest.approx(scale, rel=1e-9)
        assert ate(truth, estimate, mode).rmse < 1e-9 * (1 + np.abs(truth).max() + np.abs(t).max())


@settings(max_examples=50, deadline=None)
@given(seeds, rotations, shifts, st.floats(-3.1, 3.1))
def test_errors_do_not_depend_on_the_gauge(seed: int, R: Array, t: Array, yaw: float) -> None:
    truth = random_path(seed)
    estimate = truth + 0.1 * np.random.default_rng(seed + 1).normal(size=truth.shape)
    rotated = estimate @ rotation_z(yaw).T + t
    assert ate(truth, rotated, "yaw").rmse == pytest.approx(ate(truth, estimate, "yaw").rmse, rel=1e-8)
    assert ate(truth, estimate @ R.T + t, "se3").max == pytest.approx(ate(truth, estimate, "se3").max, rel=1e-8)
    both = ate(truth @ R.T + t, estimate @ R.T + t, "none").median
    assert both == pytest.approx(ate(truth, estimate, "none").median, rel=1e-8)
    # An alignment by an isometry gives the same error if the two trajectories change places.
    for mode in BY_FREEDOM[:3]:
        assert ate(truth, estimate, mode).rmse == pytest.approx(ate(estimate, truth, mode).rmse, rel=1e-8)


@settings(max_examples=20, deadline=None)
@given(seeds)
def test_the_closed_form_is_as_good_as_a_numerical_minimum(seed: int) -> None:
    truth, rng = random_path(seed, 12), np.random.default_rng(seed)
    estimate = truth @ exp_so3(rng.normal(size=3)) + rng.normal(size=truth.shape)

    def cost(x: Array, mode: AlignmentMode) -> float:
        R = rotation_z(x[0]) if mode == "yaw" else exp_so3(x[:3])
        scale = np.exp(x[6]) if mode == "sim3" else 1.0
        t = x[1:4] if mode == "yaw" else x[3:6]
        return float(np.mean(np.sum((truth - scale * estimate @ R.T - t) ** 2, axis=1)))

    for mode, size in zip(BY_FREEDOM[1:], (4, 6, 7), strict=True):
        found = align(truth, estimate, mode)
        ours = float(np.mean(np.sum((truth - found.positions(estimate)) ** 2, axis=1)))
        starts = [np.zeros(size), *0.5 * rng.normal(size=(2, size))]
        theirs = min(minimize(cost, start, args=(mode,), method="BFGS").fun for start in starts)
        assert ours <= theirs * (1 + 1e-9)


@settings(max_examples=20, deadline=None)
@given(seeds)
def test_more_degrees_of_freedom_never_increase_the_error(seed: int) -> None:
    truth = random_path(seed)
    estimate = 1.1 * truth @ exp_so3(np.array([0.02, -0.03, 1.0])) + np.random.default_rng(seed).normal(size=(30, 3))
    errors = [ate(truth, estimate, mode).rmse for mode in BY_FREEDOM]
    assert errors == sorted(errors, reverse=True)


def test_a_mirror_image_is_aligned_by_a_proper_rotation() -> None:
    truth = random_path(0)
    found = umeyama(truth, truth * [1.0, 1.0, -1.0], with_scale=True)
    assert np.linalg.det(found.R_truth_estimate) == pytest.approx(1.0)


def test_yaw_alignment_keeps_the_vertical() -> None:
    truth = random_path(1)
    tilted = truth @ exp_so3(np.array([0.1, 0.0, 0.0]))
    assert ate(truth, tilted, "yaw").rmse > 0.1
    assert ate(truth, tilted, "se3").rmse < 1e-12
    np.testing.assert_array_equal(align(truth, tilted, "yaw").R_truth_estimate[2], [0.0, 0.0, 1.0])


def test_the_error_of_a_square_with_one_wrong_corner() -> None:
    """One of four corners is 4 m too high; the best shift lowers each by 1 m: √((3·1² + 3²)/4) = √3."""
    truth = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    estimate = truth + [[0, 0, 4], [0, 0, 0], [0, 0, 0], [0, 0, 0]]
    errors = ate(truth, estimate, "yaw")
    assert errors.rmse == pytest.approx(np.sqrt(3.0))
    assert (errors.mean, errors.median, errors.max) == pytest.approx((1.5, 1.0, 3.0))


def test_a_straight_path_determines_no_rotation() -> None:
    line = np.outer(np.linspace(0, 1, 20), [1.0, 2.0, 3.0])
    for degenerate in (line, np.ones((20, 3)), np.ones((1, 3))):
        for mode in BY_FREEDOM[2:]:
            with pytest.raises(EvaluationError, match="straight line"):
                align(degenerate, degenerate, mode)
        assert ate(degenerate, degenerate + 1.0, "yaw").max < 1e-12


def test_unknown_modes_and_unequal_shapes_are_refused() -> None:
    p = random_path(0)
    with pytest.raises(ConfigError, match=", ".join(get_args(AlignmentMode))):
        align(p, p, "affine")  # type: ignore[arg-type]
    for a, b in ((p, p[:-1]), (np.zeros((0, 3)), np.zeros((0, 3))), (np.zeros(3), np.zeros(3))):
        with pytest.raises(EvaluationError, match="expected"):
            align(a, b)


def test_alignments_apply_to_poses_velocities_and_covariances() -> None:
    """A covariance L Lᵀ is that of errors L x with independent x; rotation and scale of the world apply to L."""
    rng = np.random.default_rng(0)
    L = rng.normal(size=(15, 15))
    q = Rotation.from_rotvec([0.3, -0.2, 0.9]).as_quat()[[3, 0, 1, 2]]
    estimate = Trajectory(
        np.array([0]), np.array([[1.0, 2, 3]]), q[None], np.array([[4.0, 5, 6]]), covariance=(L @ L.T)[None]
    )
    motion = Alignment(exp_so3(np.array([0.1, 0.7, -0.4])), np.array([7.0, 8.0, 9.0]), 2.0)
    transformed = motion.apply(estimate)
    R = motion.R_truth_estimate
    np.testing.assert_allclose(transformed.p_world_imu[0], 2.0 * R @ [1, 2, 3] + [7, 8, 9])
    np.testing.assert_allclose(transformed.rotations[0], R @ estimate.rotations[0], atol=1e-12)
    assert transformed.velocity_m_s is not None and transformed.covariance is not None
    np.testing.assert_allclose(transformed.velocity_m_s[0], 2.0 * R @ [4, 5, 6])
    L[3:6], L[6:9] = 2.0 * R @ L[3:6], 2.0 * R @ L[6:9]
    np.testing.assert_allclose(transformed.covariance[0], L @ L.T, atol=1e-12)
