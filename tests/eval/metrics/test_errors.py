"""Absolute and relative errors, pairs of poses, and interpolation, compared with their definitions and with SciPy."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from dronevio.eval.metrics import (
    Statistics,
    interpolate,
    nearest,
    pairs_after_distance,
    pairs_after_time,
    relative_errors,
    rotation_errors_rad,
)
from dronevio.models.errors import EvaluationError
from dronevio.models.rotation import exp_so3, quat_wxyz_from_matrix, quat_wxyz_from_xyzw, quat_xyzw_from_wxyz
from dronevio.models.state import Trajectory

seeds = st.integers(0, 2**32 - 1)
START_NS = 1403715273262142976


def trajectory(seed: int, n: int = 60, step_ns: int = 50_000_000) -> Trajectory:
    """Return a random walk in position and orientation with irregular time stamps."""
    rng = np.random.default_rng(seed)
    rotations = Rotation.from_rotvec(np.cumsum(0.1 * rng.normal(size=(n, 3)), axis=0))
    t_ns = START_NS + step_ns * np.arange(n) + rng.integers(0, step_ns // 2, n)
    return Trajectory(t_ns, np.cumsum(rng.normal(size=(n, 3)), axis=0), quat_wxyz_from_xyzw(rotations.as_quat()))


def test_statistics_by_hand() -> None:
    assert Statistics.of(np.array([3.0, 0.0, 0.0, 5.0])) == Statistics(
        rmse=np.sqrt(8.5), mean=2.0, median=1.5, max=5.0, min=0.0, std=np.sqrt(4.5), n=4
    )
    for invalid in ([], [np.nan], [1.0, np.inf]):
        with pytest.raises(EvaluationError):
            Statistics.of(np.array(invalid))


@given(st.floats(0, np.pi), st.tuples(*[st.floats(-1, 1)] * 3), st.floats(0.5, 2))
def test_rotation_errors_are_exact_also_for_small_angles(angle: float, axis: tuple[float, ...], length: float) -> None:
    direction = np.array(axis) if np.linalg.norm(axis) > 1e-3 else np.array([0.0, 0.0, 1.0])
    half, direction = 0.5 * angle, direction / np.linalg.norm(direction)
    base = np.array([0.1, 0.7, -0.3, 0.5])
    rotated = Rotation.from_quat(quat_xyzw_from_wxyz(base)) * Rotation.from_quat(
        [*(np.sin(half) * direction), np.cos(half)]
    )
    error = rotation_errors_rad(base[None], -length * quat_wxyz_from_xyzw(rotated.as_quat())[None])
    assert error[0] == pytest.approx(angle, rel=1e-9, abs=1e-15)


@settings(max_examples=50, deadline=None)
@given(seeds)
def test_relative_errors_agree_with_their_definition(seed: int) -> None:
    truth, estimate = trajectory(seed), trajectory(seed + 1)
    pairs = pairs_after_time(truth.t_ns, 1.0)
    metres, radians = relative_errors(
        truth.p_world_imu, truth.quat_wxyz, estimate.p_world_imu, estimate.quat_wxyz, pairs
    )
    Q, P = truth.Ts_world_imu, estimate.Ts_world_imu
    for k, (i, j) in enumerate(zip(*pairs, strict=True)):
        E = np.linalg.inv(np.linalg.inv(Q[i]) @ Q[j]) @ np.linalg.inv(P[i]) @ P[j]
        assert metres[k] == pytest.approx(np.linalg.norm(E[:3, 3]), rel=1e-9)
        assert radians[k] == pytest.approx(Rotation.from_matrix(E[:3, :3]).magnitude(), rel=1e-6)


@settings(max_examples=30, deadline=None)
@given(seeds, st.tuples(*[st.floats(-3, 3)] * 3), st.tuples(*[st.floats(-9, 9)] * 3))
def test_relative_errors_do_not_depend_on_the_gauge(
    seed: int, phi: tuple[float, float, float], t: tuple[float, float, float]
) -> None:
    truth, estimate = trajectory(seed), trajectory(seed + 1)
    pairs = pairs_after_time(truth.t_ns, 1.0)
    R = exp_so3(np.array(phi))
    transformed = (estimate.p_world_imu @ R.T + t, quat_wxyz_from_matrix(R @ estimate.rotations))
    before = relative_errors(truth.p_world_imu, truth.quat_wxyz, estimate.p_world_imu, estimate.quat_wxyz, pairs)
    np.testing.assert_allclose(
        relative_errors(truth.p_world_imu, truth.quat_wxyz, *transformed, pairs), before, rtol=1e-6, atol=1e-9
    )
    assert np.max(relative_errors(estimate.p_world_imu, estimate.quat_wxyz, *transformed, pairs)) < 1e-9


def test_a_scale_error_is_in_proportion_to_the_distance() -> None:
    """A speed of 2 m/s that is estimated 1 % too large gives an error of 2 cm over a second."""
    t_ns = 50_000_000 * np.arange(100)
    p = np.outer(t_ns * 1e-9, [2.0, 0.0, 0.0])
    q = np.tile([1.0, 0.0, 0.0, 0.0], (100, 1))
    metres, radians = relative_errors(p, q, 1.01 * p, q, pairs_after_time(t_ns, 1.0))
    np.testing.assert_allclose(metres, 0.02)
    np.testing.assert_array_equal(radians, 0.0)
    assert len(metres) == 80


@settings(max_examples=100, deadline=None)
@given(seeds, st.floats(0.2, 2.0), st.floats(0.01, 3.0))
def test_pairs_after_time_are_those_of_a_full_search(seed: int, delta_s: float, tolerance_s: float) -> None:
    t_ns = trajectory(seed, 40).t_ns
    kept = np.random.default_rng(seed).random(40) < 0.8  # gaps
    t_ns = t_ns[kept]
    found = list(zip(*(rows.tolist() for rows in pairs_after_time(t_ns, delta_s, tolerance_s)), strict=True))
    delta_ns = round(delta_s * 1e9)
    expected = []
    for i, t in enumerate(t_ns.tolist()):
        gap, j = min((abs(other - t - delta_ns), j) for j, other in enumerate(t_ns.tolist()))
        if j > i and gap <= tolerance_s * 1e9:
            expected.append((i, j))
    assert found == expected


def test_pairs_across_a_gap_are_omitted() -> None:
    t_ns = 50_000_000 * np.array([0, 1, 2, 3, 4, 9, 10, 11, 20, 21, 22, 23, 24, 25])
    i, j = pairs_after_time(t_ns, 0.1)
    assert np.all(t_ns[j] - t_ns[i] == 100_000_000)
    assert i.tolist() == [0, 1, 2, 5, 8, 9, 10, 11]
    assert len(pairs_after_time(t_ns[:0], 0.1)[0]) == 0


def test_pairs_after_distance_by_hand() -> None:
    p = np.zeros((11, 3))
    p[:, 0] = [0, 1, 2, 3, 4, 5, 4, 3, 2, 1, 0]  # the distance is that along the path
    i, j = pairs_after_distance(p, 3.0)
    assert i.tolist() == [0, 1, 2, 3, 4, 5, 6, 7] and (j - i).tolist() == [3] * 8
    assert len(pairs_after_distance(p, 30.0)[0]) == 0
    assert len(pairs_after_distance(np.zeros((5, 3)), 1.0)[0]) == 0


@settings(max_examples=50, deadline=None)
@given(seeds)
def test_interpolation_agrees_with_scipy(seed: int) -> None:
    truth, rng = trajectory(seed), np.random.default_rng(seed)
    t_ns = np.sort(rng.choice(np.arange(truth.t_ns[0], truth.t_ns[-1], 1000), 40, replace=False))
    found, rows = interpolate(truth, t_ns)
    np.testing.assert_array_equal(rows, np.arange(40))
    t, at = (truth.t_ns - START_NS) * 1e-9, (t_ns - START_NS) * 1e-9
    for k in range(3):
        np.testing.assert_allclose(found.p_world_imu[:, k], np.interp(at, t, truth.p_world_imu[:, k]), atol=1e-9)
    slerp = Slerp(t, Rotation.from_quat(quat_xyzw_from_wxyz(truth.quat_wxyz)))(at)
    angles = (slerp.inv() * Rotation.from_quat(quat_xyzw_from_wxyz(found.quat_wxyz))).magnitude()
    assert angles.max() < 1e-7


@settings(max_examples=50, deadline=None)
@given(seeds)
def test_interpolation_at_the_true_stamps_changes_nothing(seed: int) -> None:
    truth = trajectory(seed, step_ns=2_000_000_000)  # further apart than the gaps that are interpolated
    found, rows = interpolate(truth, truth.t_ns)
    np.testing.assert_array_equal(rows, np.arange(len(truth)))
    np.testing.assert_array_equal(found.p_world_imu, truth.p_world_imu)
    assert rotation_errors_rad(found.quat_wxyz, truth.quat_wxyz).max() < 1e-12


def test_poses_in_long_gaps_and_outside_are_omitted() -> None:
    truth = trajectory(0)
    truth = Trajectory(START_NS + 100_000_000 * np.arange(60), truth.p_world_imu, truth.quat_wxyz)
    truth = truth[np.r_[0:20, 30:60]]  # a gap of 1.1 s
    first, last = int(truth.t_ns[0]), int(truth.t_ns[-1])
    after_first = np.array([-(10**9), -1001, -1000, 0, 1_950_000_000, 3_000_000_000])
    wanted = np.concatenate([first + after_first, last + np.array([0, 1000, 1001])])
    found, rows = interpolate(truth, wanted)
    assert rows.tolist() == [2, 3, 5, 6, 7]
    np.testing.assert_array_equal(found.t_ns, wanted[rows])
    assert interpolate(truth, wanted, max_gap_s=2.0)[1].tolist() == [2, 3, 4, 5, 6, 7]
    assert len(interpolate(truth[:0], wanted)[1]) == 0 and len(interpolate(truth, wanted[:0])[1]) == 0


@settings(max_examples=100, deadline=None)
@given(seeds, st.floats(0.0, 0.1))
def test_nearest_poses_are_those_of_a_full_search(seed: int, max_gap_s: float) -> None:
    rng = np.random.default_rng(seed)
    truth, estimate = (np.sort(rng.choice(10**9, n, replace=False)) for n in (rng.integers(1, 30), rng.integers(1, 30)))
    rows_truth, rows_estimate = nearest(truth, estimate, max_gap_s)
    assert len(set(rows_truth.tolist())) == len(rows_truth)
    assert np.all(np.diff(rows_truth) > 0) and np.all(np.diff(rows_estimate) > 0)
    gaps = np.abs(truth[:, None] - estimate)
    for i, j in zip(rows_truth, rows_estimate, strict=True):
        assert gaps[i, j] == gaps[:, j].min() <= max_gap_s * 1e9
    for j in set(range(len(estimate))) - set(
        rows_estimate.tolist()
    ):  # without a partner: too far, or another is nearer
        i = int(np.argmin(gaps[:, j]))
        assert gaps[i, j] > max_gap_s * 1e9 or any(
            gaps[i, k] <= gaps[i, j] for t, k in zip(rows_truth, rows_estimate, strict=True) if t == i
        )
