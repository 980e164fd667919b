"""Alignments over some poses, χ² bounds, time offsets, scores of runs, and the public names."""

import subprocess
import sys
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2

import dronevio.eval
from dronevio.eval import align, anees, ate, estimate_time_offset_s, nees, nees_bounds, rpe, score, score_run
from dronevio.eval.metrics import Alignment, AlignmentMode, Association, ScoreOptions, associate, interpolate
from dronevio.eval.metrics.consistency import inside_percent
from dronevio.eval.metrics.pairs import Selection, Unit
from dronevio.eval.run import EstimatorRun
from dronevio.models.errors import ConfigError, EvaluationError
from dronevio.models.rotation import (
    exp_so3,
    matrix_from_quat_wxyz,
    nearest_rotations,
    quat_wxyz_from_matrix,
    rotation_z,
)
from dronevio.models.state import Health, Trajectory

if TYPE_CHECKING:
    from tests.eval.conftest import SyntheticFlight

seeds = st.integers(0, 2**32 - 1)


def smooth_trajectory(seed: int = 0, n: int = 400) -> Trajectory:
    """Return a trajectory of 20 s at 20 Hz with velocities and biases."""
    rng = np.random.default_rng(seed)
    t = 0.05 * np.arange(n)
    phase = rng.uniform(0, 6, 3)
    p = np.stack([3 * np.sin(0.7 * t + phase[0]), 2 * np.sin(1.1 * t + phase[1]), np.sin(0.5 * t + phase[2])], axis=1)
    R = exp_so3(np.stack([0.3 * np.sin(t), 0.2 * np.cos(1.3 * t), 0.5 * t], axis=1))
    velocity = np.gradient(p, t, axis=0)
    bias = np.outer(np.ones(n), [0.01, -0.02, 0.03])
    return Trajectory(50_000_000 * np.arange(n), p, quat_wxyz_from_matrix(R), velocity, bias, 10 * bias)


def align_poses(truth: Trajectory, estimate: Trajectory, mode: AlignmentMode, n: int | None = None) -> Alignment:
    """Return the alignment of trajectories by positions and orientations."""
    return align(
        truth.p_world_imu,
        estimate.p_world_imu,
        mode,
        n=n,
        quat_truth_wxyz=truth.quat_wxyz,
        quat_estimate_wxyz=estimate.quat_wxyz,
    )


@settings(max_examples=20, deadline=None)
@given(seeds, st.tuples(*[st.floats(-3, 3)] * 3), st.tuples(*[st.floats(-9, 9)] * 3), st.floats(0.3, 3.0))
def test_alignment_of_the_first_pose_and_of_the_scale(
    seed: int, phi: tuple[float, ...], t: tuple[float, ...], scale: float
) -> None:
    truth = smooth_trajectory(seed, 50)
    estimate = Alignment(exp_so3(np.array(phi)), np.array(t), scale).apply(truth)
    found = align_poses(truth, estimate, "scale")
    assert found.scale == pytest.approx(1.0 / scale, rel=1e-9)
    np.testing.assert_allclose(found.positions(estimate.p_world_imu), truth.p_world_imu, atol=1e-8)
    first = align_poses(truth, estimate, "first")
    np.testing.assert_allclose(first.positions(estimate.p_world_imu)[0], truth.p_world_imu[0], atol=1e-9)
    np.testing.assert_allclose(
        matrix_from_quat_wxyz(first.orientations(estimate.quat_wxyz))[0], truth.rotations[0], atol=1e-9
    )
    same = align_poses(truth, estimate, "se3", n=1)
    np.testing.assert_array_equal(same.R_truth_estimate, first.R_truth_estimate)


def test_only_the_first_poses_are_aligned() -> None:
    """The second half of the estimate is shifted by 1 m relative to the first half."""
    truth = smooth_trajectory()
    shift = np.where(np.arange(400)[:, None] < 200, 0.0, [1.0, 0.0, 0.0])
    estimate = Alignment(rotation_z(1.0), np.array([1.0, 2.0, 3.0])).apply(
        replace(truth, p_world_imu=truth.p_world_imu + shift)
    )
    modes: tuple[AlignmentMode, ...] = ("yaw", "se3", "sim3")
    for mode in modes:
        errors = ate(truth.p_world_imu, estimate.p_world_imu, mode, n=200)
        assert errors.rmse == pytest.approx(np.sqrt(0.5)) and errors.max == pytest.approx(1.0)
        whole = ate(truth.p_world_imu, estimate.p_world_imu, mode)
        assert whole.rmse < 0.6 and whole.max < 0.95
    assert score(truth, estimate, options=ScoreOptions(align_poses=200)).ate_m.rmse == pytest.approx(np.sqrt(0.5))
    assert score(truth, estimate, options=ScoreOptions(align_poses=1)).ate_m.rmse == pytest.approx(np.sqrt(0.5))
    assert score(truth, estimate, options=ScoreOptions("first")).ate_m.rmse == pytest.approx(np.sqrt(0.5))


def test_invalid_alignments_are_refused() -> None:
    truth = smooth_trajectory()
    p = truth.p_world_imu
    with pytest.raises(ConfigError, match="at least one"):
        align(p, p, n=0)
    without_orientations: list[tuple[AlignmentMode, int | None]] = [
        ("first", None),
        ("scale", None),
        ("yaw", 1),
        ("se3", 1),
    ]
    for mode, n in without_orientations:
        with pytest.raises(EvaluationError, match="orientations"):
            align(p, p, mode, n=n)
    for p_estimate in (0.0 * p, p[0] - (p - p[0])):
        with pytest.raises(EvaluationError, match="does not determine a scale"):
            align_poses(truth, replace(truth, p_world_imu=p_estimate), "scale")


@settings(max_examples=200, deadline=None)
@given(st.floats(1e-6, 1 - 1e-6), st.integers(1, 6), st.integers(1, 2000))
def test_bounds_of_the_nees_leave_equal_tails(probability: float, degrees: int, runs: int) -> None:
    low, high = nees_bounds(degrees, runs, probability)
    tail = 0.5 * (1.0 - probability)
    assert chi2.cdf(low * runs, degrees * runs) == pytest.approx(tail, rel=1e-9)
    assert chi2.sf(high * runs, degrees * runs) == pytest.approx(tail, rel=1e-9)


@given(st.floats(1e-6, 1 - 1e-6))
def test_bounds_of_the_nees_in_closed_form(probability: float) -> None:
    """With two degrees of freedom, χ² is exponential: P(x > a) = exp(−a / 2)."""
    tail = 0.5 * (1.0 - probability)
    expected = -2.0 * np.log1p(-tail), -2.0 * np.log(tail)
    assert nees_bounds(2, 1, probability) == pytest.approx(expected, rel=1e-9)


def test_bounds_of_the_nees_agree_with_the_literature() -> None:
    """Example 5.4.2 of Bar-Shalom: the mean of 50 runs with two degrees of freedom lies between 1.5 and 2.6."""
    assert nees_bounds(2, 50) == pytest.approx((1.4844, 2.5912), abs=1e-4)
    assert nees_bounds(3) == pytest.approx((0.2158, 9.3484), abs=1e-4)
    for degrees, runs, probability in ((0, 1, 0.95), (3, 0, 0.95), (3, 1, 0.0), (3, 1, 1.0)):
        with pytest.raises(ConfigError):
            nees_bounds(degrees, runs, probability)


@pytest.mark.parametrize(("covariance_factor", "inside"), [(1.0, 95.0), (0.5, None), (2.0, None)])
def test_nees_averaged_over_runs(covariance_factor: float, inside: float | None) -> None:
    rng = np.random.default_rng(0)
    L = rng.normal(size=(3, 3))
    errors = rng.normal(size=(20, 4000, 3)) @ L.T
    values = np.stack([nees(run, np.tile(covariance_factor * L @ L.T, (4000, 1, 1))) for run in errors])
    found = anees(values)
    assert found.bounds == nees_bounds(3, 20)
    assert found.mean.shape == (4000,) and found.mean.mean() == pytest.approx(3.0 / covariance_factor, rel=0.02)
    if inside is None:
        assert found.inside_percent < 30.0
    else:
        assert found.inside_percent == pytest.approx(inside, abs=1.5)
        assert inside_percent(values[0]) == pytest.approx(95.0, abs=1.5)


@settings(max_examples=10, deadline=None)
@given(seeds, st.floats(-0.4, 0.4))
def test_the_time_offset_is_estimated_on_request_only(seed: int, offset_s: float) -> None:
    truth = smooth_trajectory(seed)
    noise = np.random.default_rng(seed).normal(0.0, 0.01, (400, 3))
    transformed = Alignment(rotation_z(0.7), np.array([1.0, -2.0, 3.0])).apply(
        replace(truth, p_world_imu=truth.p_world_imu + noise, t_ns=truth.t_ns - round(offset_s * 1e9))
    )
    found = estimate_time_offset_s(truth, transformed)
    assert found == pytest.approx(offset_s, abs=3e-3)
    corrected = score(truth, transformed, options=ScoreOptions(time_offset_s=found))
    assert corrected.time_offset_s == found and corrected.ate_m.rmse < 0.02
    assert score(truth, transformed).time_offset_s == 0.0
    if abs(offset_s) > 0.05:
        assert score(truth, transformed).ate_m.rmse > 2.0 * corrected.ate_m.rmse


def test_a_time_offset_that_cannot_be_estimated_is_refused() -> None:
    truth = smooth_trajectory()
    stationary = replace(truth, p_world_imu=0.0 * truth.p_world_imu)
    with pytest.raises(EvaluationError, match="expected motion"):
        estimate_time_offset_s(stationary, stationary)
    later = replace(truth, t_ns=truth.t_ns + 10**11)
    with pytest.raises(EvaluationError, match="too little in time"):
        estimate_time_offset_s(truth, later)
    with pytest.raises(EvaluationError, match="or more"):
        estimate_time_offset_s(truth, truth[:5])
    invalid: list[tuple[AlignmentMode, float]] = [("first", 1.0), ("yaw", 0.0), ("yaw", float("nan"))]
    for mode, search_s in invalid:
        with pytest.raises(ConfigError):
            estimate_time_offset_s(truth, truth, mode, search_s)


def test_velocities_and_biases_are_scored_if_both_have_them() -> None:
    truth = smooth_trajectory()
    assert truth.velocity_m_s is not None and truth.gyro_bias_rad_s is not None and truth.accel_bias_m_s2 is not None
    wrong = replace(
        truth,
        velocity_m_s=truth.velocity_m_s + [0.3, 0.4, 0.0],
        gyro_bias_rad_s=truth.gyro_bias_rad_s + [0.0, 0.0, 1e-3],
        accel_bias_m_s2=truth.accel_bias_m_s2 + [0.1, 0.0, 0.0],
    )
    scores = score(truth, Alignment(rotation_z(2.0), np.array([1.0, 2.0, 3.0])).apply(wrong))
    assert scores.velocity_m_s is not None and scores.velocity_m_s.rmse == pytest.approx(0.5)
    assert scores.gyro_bias_rad_s is not None and scores.gyro_bias_rad_s.mean == pytest.approx(1e-3)
    assert scores.accel_bias_m_s2 is not None and scores.accel_bias_m_s2.max == pytest.approx(0.1)
    poses_only = Trajectory(truth.t_ns, truth.p_world_imu, truth.quat_wxyz)
    for pair in ((truth, poses_only), (poses_only, truth)):
        without = score(*pair)
        assert (without.velocity_m_s, without.gyro_bias_rad_s, without.accel_bias_m_s2) == (None, None, None)


def test_velocities_and_biases_are_interpolated() -> None:
    truth = smooth_trajectory()
    midpoints_ns = truth.t_ns[:-1] + 25_000_000
    found, _ = interpolate(truth, midpoints_ns)
    for name in ("p_world_imu", "velocity_m_s", "gyro_bias_rad_s", "accel_bias_m_s2"):
        values = getattr(truth, name)
        np.testing.assert_allclose(getattr(found, name), 0.5 * (values[:-1] + values[1:]), atol=1e-12)


def test_long_gaps_are_reported_and_not_interpolated() -> None:
    truth, estimate = smooth_trajectory(), smooth_trajectory()
    sparse = truth[np.r_[0:100, 200:400]]
    associated, _ = associate(sparse, estimate)
    assert len(associated) == 300
    scores = score(sparse, estimate)
    assert scores.longest_gap_s == pytest.approx(5.05)
    assert (scores.n_poses, scores.n_estimated) == (300, 400)
    frames = truth.t_ns
    assert score(truth, estimate[30:], frames).initialization_s == pytest.approx(1.5)


def test_each_pose_of_a_sparse_truth_has_one_partner() -> None:
    truth, estimate = smooth_trajectory()[::4], smooth_trajectory()
    associations: tuple[Association, ...] = ("nearest", "evo")
    for association in associations:
        associated, estimated = associate(truth, estimate, association)
        assert len(associated) == len(estimated) == 100
        np.testing.assert_array_equal(associated.p_world_imu, estimated.p_world_imu)


@settings(max_examples=30, deadline=None)
@given(seeds, st.floats(0.0, 0.02))
def test_nearest_rotations_agree_with_the_svd(seed: int, size: float) -> None:
    rng = np.random.default_rng(seed)
    R = exp_so3(rng.normal(size=(5, 3))) + size * rng.uniform(-1, 1, (5, 3, 3))
    U, _, Vt = np.linalg.svd(R)
    np.testing.assert_allclose(nearest_rotations(R), U @ Vt, atol=1e-12)


def test_rpe_of_arrays_by_frames_time_and_matrices() -> None:
    truth = smooth_trajectory()
    estimate = replace(truth, p_world_imu=1.02 * truth.p_world_imu)
    poses = truth.p_world_imu, truth.quat_wxyz, estimate.p_world_imu, estimate.quat_wxyz
    frames = rpe(*poses, 10, "frames")
    assert len(frames.errors_m) == frames.translation_m.n == 390 and frames.rotation_deg.max < 1e-6
    by_time = rpe(*poses, 0.5, "s", t_ns=truth.t_ns)
    np.testing.assert_allclose(by_time.errors_m, frames.errors_m)
    np.testing.assert_array_equal(by_time.second - by_time.first, 10)
    matrices = rpe(truth.p_world_imu, truth.rotations, estimate.p_world_imu, estimate.rotations, 10, "frames")
    np.testing.assert_allclose(matrices.errors_m, frames.errors_m, atol=1e-12)
    np.testing.assert_allclose(matrices.errors_rad, frames.errors_rad, atol=1e-7)
    units: tuple[Unit, ...] = ("m", "deg")
    selections: tuple[Selection, ...] = ("all", "consecutive")
    for unit in units:
        for selection in selections:
            assert rpe(*poses, 5, unit, selection=selection, source="estimate").translation_m.n > 3
    with pytest.raises(EvaluationError, match="without time stamps"):
        rpe(*poses, 1, "s")


def test_availability_and_cost_of_a_run(flight: "SyntheticFlight") -> None:
    estimates = list(flight.run.estimates)
    for i in (40, 41, 80):
        estimates[i] = replace(estimates[i], health=Health.LOST)
    costs_ms = np.arange(1.0, len(estimates) + 1.0)
    found = score_run(EstimatorRun(tuple(estimates), costs_ms, 2.0 * costs_ms))
    n = len(estimates)
    assert (found.frames, found.poses, found.lost_frames, found.resets) == (n, n - 13, 3, 2)
    assert found.initialization_s == pytest.approx(0.5)
    counted = (n - 1) - 60  # frames later than 3 s after the first, of which one is lost
    assert found.coverage_percent == pytest.approx(100 * (counted - 1) / counted)
    assert found.cpu_ms is not None and found.latency_ms is not None
    assert found.cpu_ms.mean == pytest.approx(costs_ms.mean()) and found.latency_ms.max == 2.0 * n
    assert found.cpu_ms.median <= found.cpu_ms.p95 <= found.cpu_ms.p99 <= found.cpu_ms.max
    assert found.real_time_factor == pytest.approx(0.05 * (n - 1) / (1e-3 * costs_ms.sum()))
    assert found.real_time_factor is not None
    assert found.real_time_factor_wall == pytest.approx(0.5 * found.real_time_factor)


def test_scores_of_a_run_without_poses(flight: "SyntheticFlight") -> None:
    estimates = tuple(replace(e, health=Health.INITIALIZING, state=None) for e in flight.run.estimates)
    found = score_run(EstimatorRun(estimates, 0.0 * flight.run.cpu_ms, 0.0 * flight.run.cpu_ms))
    assert (found.poses, found.lost_frames, found.resets, found.initialization_s) == (0, 0, 0, None)
    assert found.coverage_percent == 0.0 and found.real_time_factor is None
    empty = score_run(EstimatorRun((), np.zeros(0), np.zeros(0)))
    assert empty.frames == 0 and empty.cpu_ms is None and empty.coverage_percent is None


def test_the_public_names_exist_and_are_imported_lazily() -> None:
    for name in dronevio.eval.__all__:
        assert callable(getattr(dronevio.eval, name))
    with pytest.raises(AttributeError, match="no attribute 'ape'"):
        _ = dronevio.eval.ape
    code = (
        "import sys, dronevio.eval; before = 'numpy' in sys.modules; from dronevio.eval import ate, rpe, align, nees;"
        "print(before, *sorted({name.split('.')[0] for name in sys.modules}))"
    )
    before, *loaded = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    ).stdout.split()
    assert before == "False" and "numpy" in loaded
    assert not {"scipy", "cv2", "mujoco", "gtsam", "rerun", "matplotlib", "gymnasium", "tyro", "rich"} & set(loaded)


def test_bounds_of_the_nees_import_only_scipy_special() -> None:
    def parts_of_scipy(statements: str) -> list[str]:
        code = (
            f"import sys; from dronevio.eval import nees_bounds; before = 'scipy' in sys.modules; {statements};"
            "print(before, *sorted(name for name in sys.modules if name.startswith('scipy.')))"
        )
        run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
        before, *loaded = run.stdout.split()
        assert before == "False"
        return loaded

    loaded = parts_of_scipy("nees_bounds(3)")
    assert "scipy.special" in loaded and "scipy.stats" not in loaded
    assert loaded == parts_of_scipy("import scipy.special")  # from SciPy 1.18 on, it imports scipy.linalg itself
