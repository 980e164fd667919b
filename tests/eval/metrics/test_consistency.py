"""Consistency of estimates: NEES of errors drawn from a covariance, anchoring, and invalid covariances."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2

from dronevio.eval.metrics import anchor_first, consistency, nees, relative_to_first
from dronevio.eval.metrics.alignment import Alignment
from dronevio.models.errors import EvaluationError
from dronevio.models.rotation import exp_so3, quat_wxyz_from_matrix, rotation_z
from dronevio.models.state import Trajectory


def flight(n: int, seed: int, covariance_factor: float = 1.0) -> tuple[Trajectory, Trajectory]:
    """Return a truth and an estimate with errors drawn from a covariance, of which it reports a multiple."""
    rng = np.random.default_rng(seed)
    t_ns = 50_000_000 * np.arange(n)
    p, R = np.cumsum(rng.normal(size=(n, 3)), axis=0), exp_so3(rng.normal(size=(n, 3)))
    L = 1e-3 * rng.normal(size=(n, 15, 15))
    error = (L @ rng.normal(size=(n, 15, 1)))[..., 0]
    error[0] = 0.0  # the estimate is anchored there
    truth = Trajectory(t_ns, p, quat_wxyz_from_matrix(R))
    R_estimate = R @ np.swapaxes(exp_so3(error[:, :3]), -1, -2)  # truth = estimate · exp(δθ)
    covariance = covariance_factor * L @ np.swapaxes(L, -1, -2)
    return truth, Trajectory(t_ns, p - error[:, 3:6], quat_wxyz_from_matrix(R_estimate), covariance=covariance)


def test_the_nees_of_a_consistent_estimate_is_three_on_average() -> None:
    result = consistency(*flight(20_001, 0))
    five_sigma = 5 * np.sqrt(6 / 20_000)  # of the mean of χ² variables with three degrees of freedom
    for values in (result.position_nees, result.orientation_nees):
        assert len(values) == 20_000
        assert abs(values.mean() - 3.0) < five_sigma
        assert np.mean(values > chi2.ppf(0.95, 3)) == pytest.approx(0.05, abs=0.01)
    assert result.position_exceedance == pytest.approx(0.0027, abs=0.001)


@pytest.mark.parametrize("covariance_factor", [0.1, 10.0])
def test_a_wrong_covariance_divides_the_nees_by_its_factor(covariance_factor: float) -> None:
    result = consistency(*flight(20_001, 1, covariance_factor))
    assert result.position_nees.mean() == pytest.approx(3.0 / covariance_factor, rel=0.1)
    assert result.orientation_nees.mean() == pytest.approx(3.0 / covariance_factor, rel=0.1)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(-3.1, 3.1), st.tuples(*[st.floats(-50, 50)] * 3))
def test_consistency_does_not_depend_on_the_gauge(seed: int, yaw: float, t: tuple[float, float, float]) -> None:
    truth, estimate = flight(20, seed)
    plain = consistency(truth, estimate)
    transformed = consistency(truth, Alignment(rotation_z(yaw), np.array(t)).apply(estimate))
    np.testing.assert_allclose(transformed.position_nees, plain.position_nees, rtol=1e-4)
    np.testing.assert_allclose(transformed.orientation_nees, plain.orientation_nees, rtol=1e-4)
    np.testing.assert_allclose(transformed.position_sigma_m, plain.position_sigma_m, rtol=1e-6)
    np.testing.assert_allclose(transformed.position_error_m, plain.position_error_m, atol=1e-8)


def test_the_anchor_aligns_the_first_pose_in_yaw_and_position() -> None:
    truth, estimate = flight(5, 3)
    tilted = Trajectory(
        estimate.t_ns, estimate.p_world_imu, quat_wxyz_from_matrix(exp_so3(np.array([0.1, 0, 0])) @ truth.rotations)
    )
    anchor = anchor_first(truth, Alignment(rotation_z(2.0), np.array([1.0, 2.0, 3.0])).apply(tilted))
    np.testing.assert_allclose(anchor.R_truth_estimate, rotation_z(-2.0), atol=1e-9)
    np.testing.assert_allclose(
        anchor.positions(rotation_z(2.0) @ estimate.p_world_imu[0] + [1, 2, 3]), truth.p_world_imu[0], atol=1e-9
    )


def test_the_uncertainty_of_the_first_pose_belongs_to_all_errors() -> None:
    """Many short flights with errors of 5 cm and 20 mrad of the first pose, and of 1 cm and 2 mrad of the others."""
    rng, runs = np.random.default_rng(4), 4000
    p, v = np.array([[1.0, 2.0, 3.0], [4.0, -3.0, 3.5]]), np.array([[0.5, 0.0, 0.0], [2.0, -1.0, 0.3]])
    R = exp_so3(np.array([[0.3, 0.1, 1.0], [-0.2, 0.4, 2.0]]))
    sigmas = np.array([[0.02, 0.05, 0.1], [0.002, 0.01, 0.05]])  # of yaw, position and velocity
    covariance = np.zeros((2, 15, 15))
    for P, R_world_imu, (yaw, position, velocity) in zip(covariance, R, sigmas, strict=True):
        up = R_world_imu.T[:, 2]
        P[:3, :3] = yaw**2 * np.outer(up, up) + 1e-12 * np.eye(3)
        P[3:6, 3:6], P[6:9, 6:9] = position**2 * np.eye(3), velocity**2 * np.eye(3)
    t_ns, truth_quat = np.array([0, 50_000_000]), quat_wxyz_from_matrix(R)
    truth = Trajectory(t_ns, p, truth_quat, velocity_m_s=v)
    plain, relative = list[list[float]](), list[list[float]]()
    for _ in range(runs):
        yaws = [rotation_z(yaw) for yaw in rng.normal(scale=sigmas[:, 0])]
        moved_p = p + rng.normal(scale=sigmas[:, 1:2], size=(2, 3))
        moved_v = v + rng.normal(scale=sigmas[:, 2:], size=(2, 3))
        quat = quat_wxyz_from_matrix(np.stack([turn @ each for turn, each in zip(yaws, R, strict=True)]))
        estimate = Trajectory(t_ns, moved_p, quat, velocity_m_s=moved_v, covariance=covariance)
        for found, values in ((estimate, plain), (relative_to_first(estimate), relative)):
            c = consistency(truth, found)
            assert c.velocity_nees is not None
            values.append([float(c.position_nees[0]), float(c.orientation_nees[0]), float(c.velocity_nees[0])])
    # Degrees of freedom: 3, 1 (the tilt has no error), 3; five standard deviations of the means
    degrees = np.array([3.0, 1.0, 3.0])
    assert (np.abs(np.mean(relative, axis=0) - degrees) < 5.0 * np.sqrt(2.0 * degrees / runs)).all()
    assert (np.mean(plain, axis=0) > [30.0, 50.0, 3.5]).all()


def test_a_certain_first_pose_adds_nothing() -> None:
    _, estimate = flight(5, 6)
    assert estimate.covariance is not None
    estimate.covariance[0] = 0.0
    np.testing.assert_array_equal(relative_to_first(estimate).covariance, estimate.covariance)
    with pytest.raises(EvaluationError, match="without covariances"):
        relative_to_first(Trajectory(estimate.t_ns, estimate.p_world_imu, estimate.quat_wxyz))


def test_nees_by_hand() -> None:
    """Errors of 3 and 4 with standard deviations of 3 and 2: 1² + 2² = 5."""
    np.testing.assert_allclose(nees(np.array([[3.0, 4.0]]), np.diag([9.0, 4.0])[None]), [5.0])


def test_missing_and_invalid_covariances_are_refused() -> None:
    truth, estimate = flight(5, 0)
    with pytest.raises(EvaluationError, match="without covariances"):
        consistency(truth, truth)
    with pytest.raises(EvaluationError, match="of one pose"):
        consistency(truth[:1], estimate[:1])
    assert estimate.covariance is not None
    for wrong, message in ((-estimate.covariance, "positive definite"), (0 * estimate.covariance, "positive definite")):
        broken = Trajectory(estimate.t_ns, estimate.p_world_imu, estimate.quat_wxyz, covariance=wrong)
        with pytest.raises(EvaluationError, match=message):
            consistency(truth, broken)
    with pytest.raises(EvaluationError, match="not finite"):
        nees(np.array([[np.nan]]), np.ones((1, 1, 1)))
