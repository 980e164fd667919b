"""Scores of small trajectories, with values worked out by hand."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from dronevio.eval.metrics import PairRule, ScoreOptions, errors_by_length, rpe, score, score_trajectory
from dronevio.eval.metrics.lengths import drifts_m
from dronevio.eval.metrics.pairs import Source
from dronevio.models.arrays import Array
from dronevio.models.rotation import exp_so3, quat_wxyz_from_matrix, rotation_z
from dronevio.models.state import Trajectory

SECOND_NS = 1_000_000_000
START_NS = 1403715273262142976


def trajectory(p: npt.ArrayLike, phi: npt.ArrayLike = 0.0, first_pose_s: int = 0) -> Trajectory:
    """Return poses one second apart, from positions (N, 3) [m] and rotation vectors (N, 3) [rad]."""
    positions = np.asarray(p, dtype=np.float64)
    vectors = np.broadcast_to(np.asarray(phi, dtype=np.float64), positions.shape)
    t_ns = START_NS + SECOND_NS * (first_pose_s + np.arange(len(positions)))
    return Trajectory(t_ns, positions, quat_wxyz_from_matrix(exp_so3(vectors)))


def along_x(n: int, step_m: float = 1.0) -> Array:
    """Return positions (n, 3) along the x axis [m]."""
    return np.outer(np.arange(n), [step_m, 0.0, 0.0])


def test_orientation_errors_are_in_degrees() -> None:
    """An estimate that rolls by 5° per second: 0°, 5°, …, 20° at five poses, and 5° over every second."""
    roll_rad = np.outer(np.radians(5.0 * np.arange(5)), [1.0, 0.0, 0.0])
    scores = score(trajectory(along_x(5)), trajectory(along_x(5), roll_rad))
    ate_deg, rpe_deg = scores.ate_deg, scores.rpe_deg
    assert (ate_deg.n, ate_deg.mean, ate_deg.median, ate_deg.max) == pytest.approx((5, 10.0, 10.0, 20.0))
    assert ate_deg.rmse == pytest.approx(np.sqrt(150.0))
    assert rpe_deg is not None
    assert (rpe_deg.n, rpe_deg.min, rpe_deg.rmse, rpe_deg.max) == pytest.approx((4, 5.0, 5.0, 5.0))
    assert scores.ate_m.max == pytest.approx(0.0, abs=1e-12)


def test_yaw_alignment_does_not_remove_a_tilt() -> None:
    """A level square with corners at ±1 m, tilted by φ = 60° about x: every corner moves by 2 sin(φ/2) = 1 m."""
    square = np.array([[1.0, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]])
    R = exp_so3(np.array([np.pi / 3.0, 0.0, 0.0]))
    tilted = trajectory(square @ R.T, [np.pi / 3.0, 0.0, 0.0])
    scores = score(trajectory(square), tilted)
    assert scores.alignment == "yaw"
    assert (scores.ate_m.min, scores.ate_m.max, scores.ate_deg.min, scores.ate_deg.max) == pytest.approx((1, 1, 60, 60))
    rotated = replace(tilted, p_world_imu=tilted.p_world_imu @ rotation_z(0.7).T + [4.0, 5.0, 6.0])
    assert score(trajectory(square), rotated).ate_m.rmse == pytest.approx(1.0)
    by_se3 = score(trajectory(square), tilted, options=ScoreOptions("se3"))
    assert by_se3.ate_m.max == pytest.approx(0.0, abs=1e-12)
    assert by_se3.ate_deg.max == pytest.approx(0.0, abs=1e-5)


def test_times_are_those_of_the_compared_poses() -> None:
    """A truth of ten seconds, an estimate from 2 s to 6 s at twice the speed, with an error of 1 m over a second."""
    truth = trajectory(along_x(11))
    scored = score_trajectory(truth, trajectory(along_x(5, 2.0), first_pose_s=2), options=ScoreOptions("none"))
    scores = scored.scores
    assert (scores.first_pose_s, scores.last_pose_s, scores.longest_gap_s, scores.path_m) == pytest.approx(
        (2.0, 6.0, 1.0, 4.0)
    )
    assert ((scored.rpe_t_ns - START_NS) // SECOND_NS).tolist() == [2, 3, 4, 5]
    np.testing.assert_allclose(scored.rpe_m, 1.0)
    np.testing.assert_allclose(scored.translation_error_m, [2, 1, 0, 1, 2])


def test_pairs_are_selected_on_the_requested_path() -> None:
    """The truth moves 2 m in two seconds, the estimate, which is twice too large, in one."""
    truth, estimate = trajectory(along_x(11)), trajectory(along_x(11, 2.0))
    expected: list[tuple[Source, int, float]] = [("truth", 9, 2.0), ("estimate", 10, 1.0)]
    for source, pairs, error_m in expected:
        scores = score(truth, estimate, options=ScoreOptions(rpe=PairRule(2.0, "m", source=source)))
        assert scores.rpe_m is not None
        assert (scores.rpe_pairs, scores.rpe_m.mean) == pytest.approx((pairs, error_m))
        assert (scores.rpe_interval, scores.rpe_delta_s) == ("2 m", None)


def test_the_tolerance_of_pairs_is_a_share_of_their_distance() -> None:
    """Poses at 0 s, 1 s and 4 s: the first and the last miss 3.8 s by 0.2 s, the other two by 0.8 s."""
    t_ns = START_NS + SECOND_NS * np.array([0, 1, 4])
    for tolerance, pairs in ((0.04, 0), (0.06, 1), (0.3, 2)):
        found = PairRule(3.8, "s", tolerance=tolerance).select(t_ns, np.zeros((3, 3)), np.zeros((3, 4)))
        assert len(found[0]) == pairs


def test_relative_errors_of_arrays() -> None:
    """A roll of 5° per second; the estimate moves 2 m in one second and the truth in two."""
    roll_rad = np.outer(np.radians(5.0 * np.arange(5)), [1.0, 0.0, 0.0])
    truth, estimate = trajectory(along_x(5)), trajectory(along_x(5, 2.0), roll_rad)
    poses = truth.p_world_imu, truth.quat_wxyz, estimate.p_world_imu, estimate.quat_wxyz
    expected: list[tuple[Source, int, float]] = [("truth", 3, 10.0), ("estimate", 4, 5.0)]
    for source, pairs, error_deg in expected:
        found = rpe(*poses, 2.0, "m", source=source).rotation_deg
        assert (found.n, found.min, found.max) == pytest.approx((pairs, error_deg, error_deg))


def test_drift_aligns_the_yaw_at_the_beginning_of_a_pair() -> None:
    """An exact metre along x: alignment of a yaw that is wrong by 60° at its beginning moves its end by 1 m."""
    truth = trajectory(along_x(2))
    start, end = np.radians([[0, 0, 60], [0, 0, 0]]), np.radians([[0, 0, 0], [0, 0, 60]])
    for phi, drift_m in ((start, 1.0), (-start, 1.0), (end, 0.0)):
        estimate = trajectory(along_x(2), phi)
        pair = np.array([0]), np.array([1])
        found = drifts_m(truth.p_world_imu, truth.quat_wxyz, estimate.p_world_imu, estimate.quat_wxyz, pair)
        assert found == pytest.approx([drift_m], abs=1e-12)


def test_yaw_and_tilt_errors_of_a_drone_that_pitches() -> None:
    """An estimate that yaws by 0.1° per metre has no tilt error, also if the drone pitches."""
    yaw_rad, pitch_rad = np.radians(0.1 * np.arange(41)), 0.1 * np.arange(41)
    pitch = exp_so3(np.outer(pitch_rad, [0.0, 1.0, 0.0]))
    q_truth = quat_wxyz_from_matrix(pitch)
    q_estimate = quat_wxyz_from_matrix(exp_so3(np.outer(yaw_rad, [0.0, 0.0, 1.0])) @ pitch)
    [errors] = errors_by_length(along_x(41), q_truth, along_x(41), q_estimate, (10.0,))
    found = errors.yaw_deg.min, errors.tilt_deg.max, errors.rotation_deg.median
    assert found == pytest.approx((0.8, 0.0, 1.0), abs=1e-9)  # the last sub-trajectories lack two metres


def test_coverage_counts_poses_that_have_no_truth() -> None:
    """The truth ends after five of ten seconds; the estimate has a pose at every frame but the last."""
    frames = START_NS + SECOND_NS * np.arange(11)
    scores = score(trajectory(along_x(6)), trajectory(along_x(10)), frames)
    assert (scores.n_poses, scores.n_estimated) == (6, 10)
    assert scores.coverage_percent == pytest.approx(100.0 * 6 / 7)  # of the frames at 4 s to 10 s


def test_consistency_by_hand() -> None:
    """Three errors after an exact first pose, in a world frame that is rotated by 90° about the vertical.

    The standard deviations are 0.1, 0.2 and 0.5 m in the true world frame, and 0.01, 0.02 and 0.04 rad in the IMU
    frame. The x axis of the estimate's world frame is the true y axis, so that they are 0.2, 0.1 and 0.5 m there.
    """
    p_truth = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 1]])
    error_m = np.array([[0.0, 0, 0], [0.4, 0, 0], [0, -0.2, 0], [0, 0, 1.25]])
    error_rad = np.array([[0.0, 0, 0], [0.05, 0, 0], [0, -0.05, 0], [0, 0, 0.2]])
    R = rotation_z(-np.pi / 2.0)  # from the estimate's world frame to the true one
    phi = np.array([[0.0, 0, 0], [0.3, 0, 0], [0, 0.3, 0], [0, 0, 0.3]])
    R_estimate = R.T @ exp_so3(phi) @ np.swapaxes(exp_so3(error_rad), -1, -2)  # truth = R · estimate · exp(δθ)
    sigmas = np.r_[[0.01, 0.02, 0.04], [0.2, 0.1, 0.5], np.full(9, 100.0)]
    truth = trajectory(p_truth, phi)
    estimate = Trajectory(
        truth.t_ns,
        (p_truth - error_m) @ R + [3.0, 4.0, 5.0],
        quat_wxyz_from_matrix(R_estimate),
        covariance=np.tile(np.diag(sigmas**2), (4, 1, 1)),
    )
    scored = score_trajectory(truth, estimate)
    found, scores = scored.consistency, scored.scores
    assert found is not None
    np.testing.assert_array_equal(found.t_ns, truth.t_ns[1:])
    np.testing.assert_allclose(found.position_error_m, error_m[1:], atol=1e-12)
    np.testing.assert_allclose(found.orientation_error_rad, error_rad[1:], atol=1e-12)
    np.testing.assert_allclose(found.position_sigma_m, np.tile([0.1, 0.2, 0.5], (3, 1)))
    np.testing.assert_allclose(found.orientation_sigma_rad, np.tile([0.01, 0.02, 0.04], (3, 1)))
    np.testing.assert_allclose(found.position_nees, [16.0, 1.0, 6.25])
    np.testing.assert_allclose(found.orientation_nees, [25.0, 6.25, 25.0])
    assert (scores.nees_position, scores.nees_orientation) == pytest.approx((7.75, 18.75))
    # 95 % of a χ² variable with three degrees of freedom lie between 0.216 and 9.348.
    assert scores.nees_position_inside_percent == pytest.approx(100.0 * 2 / 3)
    assert scores.nees_orientation_inside_percent == pytest.approx(100.0 * 1 / 3)
    assert scores.position_beyond_3_sigma_percent == pytest.approx(100.0 * 1 / 9)  # 4σ, but not 1σ or 2.5σ
    assert scores.orientation_beyond_3_sigma_percent == pytest.approx(100.0 * 2 / 9)  # twice 5σ, but not 2.5σ


def test_the_nees_of_the_velocity_by_hand() -> None:
    """Velocity errors of 2, 1 and 3 standard deviations along one axis each, in a world frame rotated by 90°."""
    p_truth = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 1]])
    v_truth = np.array([[1.0, 0, 0], [0, 1, 0], [-1, 0, 0.5], [0, 0, 1]])
    error_m_s = np.array([[0.0, 0, 0], [0.2, 0, 0], [0, -0.2, 0], [0, 0, 1.5]])
    R = rotation_z(-np.pi / 2.0)  # from the estimate's world frame to the true one
    sigmas = np.r_[np.ones(6), [0.2, 0.1, 0.5], np.ones(6)]  # 0.1, 0.2 and 0.5 m/s in the true world frame
    truth = replace(trajectory(p_truth), velocity_m_s=v_truth)
    estimate = Trajectory(
        truth.t_ns,
        p_truth @ R,
        quat_wxyz_from_matrix(np.tile(R.T, (4, 1, 1))),
        velocity_m_s=(v_truth - error_m_s) @ R,
        covariance=np.tile(np.diag(sigmas**2), (4, 1, 1)),
    )
    scored = score_trajectory(truth, estimate)
    assert scored.consistency is not None
    assert scored.consistency.velocity_nees is not None
    np.testing.assert_allclose(scored.consistency.velocity_nees, [4.0, 1.0, 9.0])
    assert scored.scores.nees_velocity == pytest.approx(14.0 / 3.0)
    unknown = np.diag(np.r_[np.ones(6), np.zeros(3), np.ones(6)])
    assert score(truth, replace(estimate, covariance=np.tile(unknown, (4, 1, 1)))).nees_velocity is None
    assert score(trajectory(p_truth), estimate).nees_velocity is None


@pytest.mark.parametrize("factor", [0.1, 10.0])
def test_a_covariance_too_large_by_a_factor_divides_the_nees(factor: float) -> None:
    """Errors of two standard deviations along one axis give a NEES of 4, divided by the factor on the covariance."""
    truth = trajectory(along_x(5))
    error_m = np.outer([0, 1, 1, 1, 1], [0.0, 0.2, 0.0])
    variances = factor * np.full(15, 0.1**2)
    estimate = trajectory(along_x(5) - error_m, np.outer([0, 1, 1, 1, 1], [0.0, 0.2, 0.0]))
    scores = score(truth, replace(estimate, covariance=np.tile(np.diag(variances), (5, 1, 1))))
    assert scores.nees_position == pytest.approx(4.0 / factor)
    assert scores.nees_orientation == pytest.approx(4.0 / factor)
