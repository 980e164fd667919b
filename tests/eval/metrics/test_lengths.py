"""Errors by length of sub-trajectories, drift, and KITTI's scores: analytic cases and invariances."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dronevio.eval.metrics import Alignment, errors_by_length, relative_errors, score
from dronevio.eval.metrics.errors import distance_errors_percent
from dronevio.eval.metrics.kitti import kitti_scores
from dronevio.eval.metrics.lengths import drifts_m
from dronevio.eval.metrics.pairs import (
    PairRule,
    consecutive_pairs,
    pairs_after_distance,
    pairs_after_rotation,
    path_lengths_m,
)
from dronevio.eval.metrics.trajectory_errors import default_lengths_m
from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError, EvaluationError
from dronevio.models.rotation import exp_so3, pose_matrix, quat_wxyz_from_matrix, rotation_z
from dronevio.models.state import Trajectory

seeds = st.integers(0, 2**32 - 1)


def smooth_path(seed: int, n: int = 400) -> Trajectory:
    """Return a smooth random path with steps of 1 m."""
    rng = np.random.default_rng(seed)
    phi = np.cumsum(0.03 * rng.normal(size=(n, 3)), axis=0)
    R = exp_so3(phi)
    p = np.cumsum(R[:, :, 0], axis=0)
    return Trajectory(100_000_000 * np.arange(n), p, quat_wxyz_from_matrix(R))


def disturbed(truth: Trajectory, seed: int) -> Trajectory:
    """Return a trajectory that drifts away from the truth."""
    rng, n = np.random.default_rng(seed), len(truth)
    R = truth.rotations @ exp_so3(np.cumsum(2e-3 * rng.normal(size=(n, 3)), axis=0))
    drift_m = np.cumsum(0.01 * rng.normal(size=(n, 3)), axis=0)
    return replace(truth, p_world_imu=truth.p_world_imu + drift_m, quat_wxyz=quat_wxyz_from_matrix(R))


def arrays(truth: Trajectory, estimate: Trajectory) -> tuple[Array, Array, Array, Array]:
    """Return true positions and orientations, and estimated ones."""
    return truth.p_world_imu, truth.quat_wxyz, estimate.p_world_imu, estimate.quat_wxyz


@settings(max_examples=20, deadline=None)
@given(seeds, st.floats(-3, 3), st.tuples(*[st.floats(-50, 50)] * 3))
def test_errors_by_length_do_not_depend_on_the_gauge(seed: int, yaw: float, t: tuple[float, ...]) -> None:
    truth = smooth_path(seed)
    estimate = disturbed(truth, seed + 1)
    transformed = Alignment(rotation_z(yaw), np.array(t)).apply(estimate)
    by_length, by_length_transformed = (
        errors_by_length(*arrays(truth, x), (20.0, 100.0)) for x in (estimate, transformed)
    )
    for plain, other in zip(by_length, by_length_transformed, strict=True):
        assert other.translation_m.rmse == pytest.approx(plain.translation_m.rmse, rel=1e-6)
        assert other.rotation_deg.max == pytest.approx(plain.rotation_deg.max, rel=1e-6)
        assert other.drift_percent.mean == pytest.approx(plain.drift_percent.mean, rel=1e-6)
        # Yaw and tilt are Euler angles, which depend on the yaw of the world at second order.
        angle = np.radians(plain.rotation_deg.max)
        assert abs(other.yaw_deg.mean - plain.yaw_deg.mean) <= plain.rotation_deg.max * angle
        assert abs(other.tilt_deg.mean - plain.tilt_deg.mean) <= plain.rotation_deg.max * angle


@settings(max_examples=10, deadline=None)
@given(st.floats(0.5, 2.0))
def test_the_drift_of_a_straight_path_equals_its_scale_error(scale: float) -> None:
    p = np.outer(np.arange(300.0), [0.6, 0.8, 0.0])
    q = np.tile([1.0, 0.0, 0.0, 0.0], (300, 1))
    [short, long] = errors_by_length(p, q, scale * p, q, (10.0, 50.0))
    for errors in (short, long):
        assert errors.drift_percent.median == pytest.approx(100 * abs(scale - 1), abs=1e-9)
        assert errors.translation_percent.max == pytest.approx(100 * abs(scale - 1), abs=1e-9)
        assert errors.rotation_deg.max < 1e-9
    assert (short.translation_m.n, long.translation_m.n) == (292, 260)  # the last sub-trajectories lack up to 20 %


def test_a_constant_tilt_is_drift_but_no_relative_error() -> None:
    """A tilt of 2° raises a metre forward by 3.5 cm; the relative error aligns the tilted first poses."""
    truth = smooth_path(0)
    level = replace(truth, p_world_imu=truth.p_world_imu * [1.0, 1.0, 0.0])
    tilted = Alignment(exp_so3(np.array([0.0, np.radians(2.0), 0.0])), np.zeros(3)).apply(level)
    pairs = pairs_after_distance(level.p_world_imu, 30.0)
    assert relative_errors(*arrays(level, tilted), pairs)[0].max() < 1e-9
    step = level.p_world_imu[pairs[1]] - level.p_world_imu[pairs[0]]
    x, z = (np.cos(np.radians(2.0)) - 1.0) * step[:, 0], np.sin(np.radians(2.0)) * step[:, 0]
    # The best yaw alignment of tilted orientations differs from zero at second order of the tilt.
    np.testing.assert_allclose(drifts_m(*arrays(level, tilted), pairs), np.hypot(x, z), atol=0.05, rtol=0.05)


@pytest.mark.parametrize("mounting_rad", [(0.0, 0.0, 0.0), (0.0, -np.pi / 2, 0.0)])  # the x axis of EuRoC's IMU is up
def test_yaw_and_tilt_by_hand(mounting_rad: tuple[float, ...]) -> None:
    """Estimates that yaw or roll by 0.1° per metre, for two mountings of the IMU."""
    p = np.outer(np.arange(200.0), [1.0, 0.0, 0.0])
    R = exp_so3(np.array(mounting_rad))
    q = np.tile(quat_wxyz_from_matrix(R), (200, 1))
    for axis, yaw, tilt in (([0.0, 0.0, 1.0], 1.0, 0.0), ([1.0, 0.0, 0.0], 0.0, 1.0)):
        rotated = quat_wxyz_from_matrix(exp_so3(np.outer(np.radians(0.1 * np.arange(200)), axis)) @ R)
        [errors] = errors_by_length(p, q, p, rotated, (10.0,))
        medians = [errors.yaw_deg.median, errors.tilt_deg.median, errors.rotation_deg.median]
        assert medians == pytest.approx([yaw, tilt, 1.0], abs=1e-9)


def test_distance_errors_omit_pairs_without_motion() -> None:
    p = np.array([[0.0, 0, 0], [0, 0, 0], [4, 3, 0]])
    pairs = np.array([0, 1]), np.array([1, 2])
    np.testing.assert_allclose(distance_errors_percent(p, 1.1 * p + 7.0, pairs), [10.0])
    np.testing.assert_allclose(distance_errors_percent(p, 0.0 * p, pairs), [100.0])


def test_lengths_that_do_not_occur_are_omitted() -> None:
    truth = smooth_path(1, 50)
    found = errors_by_length(*arrays(truth, truth), (10.0, 500.0))
    assert [errors.length_m for errors in found] == [10.0]
    with pytest.raises(ConfigError, match="above zero"):
        errors_by_length(*arrays(truth, truth), (0.0,))
    assert default_lengths_m(75.891) == (7.58, 15.17, 22.76, 30.35, 37.94)
    assert default_lengths_m(0.0) == ()


def test_the_scores_hold_errors_by_length_and_their_mean_drift() -> None:
    truth = smooth_path(2)
    scores = score(truth, disturbed(truth, 3))
    assert [errors.length_m for errors in scores.lengths] == list(default_lengths_m(scores.path_m))
    drifts = [errors.drift_percent for errors in scores.lengths]
    assert scores.drift_percent == pytest.approx(sum(x.mean * x.n for x in drifts) / sum(x.n for x in drifts))
    stationary = replace(truth, p_world_imu=0.0 * truth.p_world_imu)
    assert score(stationary, stationary).drift_percent is None


def test_a_very_long_path_is_sampled_evenly(monkeypatch: pytest.MonkeyPatch) -> None:
    truth = smooth_path(4, 1000)
    estimate = disturbed(truth, 5)
    [whole] = errors_by_length(*arrays(truth, estimate), (50.0,))
    monkeypatch.setattr("dronevio.eval.metrics.lengths._MAX_PAIRS", 200)
    [sampled] = errors_by_length(*arrays(truth, estimate), (50.0,))
    assert whole.translation_m.n > 900 and 150 < sampled.translation_m.n <= 200
    assert sampled.translation_m.rmse == pytest.approx(whole.translation_m.rmse, rel=0.1)


@settings(max_examples=30, deadline=None)
@given(seeds, st.floats(0.5, 30.0))
def test_each_consecutive_pair_begins_where_the_last_ends(seed: int, delta: float) -> None:
    length_m = path_lengths_m(smooth_path(seed, 120).p_world_imu * np.random.default_rng(seed).uniform(0.2, 3.0))
    first, second = consecutive_pairs(length_m, delta)
    np.testing.assert_array_equal(first[1:], second[:-1])
    assert np.all(length_m[second] - length_m[first] >= delta)
    assert np.all(length_m[second - 1] - length_m[first] < delta)  # the previous pose is too near
    assert len(consecutive_pairs(length_m[:0], delta)[0]) == 0


@pytest.mark.parametrize("block_size", [1, 300, 1 << 22])
def test_pairs_after_rotation_are_those_of_a_full_search(block_size: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dronevio.eval.metrics.pairs._BLOCK_SIZE", block_size)
    truth = smooth_path(6, 80)
    found = list(zip(*(rows.tolist() for rows in pairs_after_rotation(truth.quat_wxyz, 0.3, 0.05)), strict=True))
    R = truth.rotations
    angles = np.arccos(np.clip(0.5 * (np.einsum("iab,jab->ij", R, R) - 1.0), -1.0, 1.0))
    assert found == [(i, j) for i in range(80) for j in range(i + 1, 80) if abs(angles[i, j] - 0.3) <= 0.05]
    assert len(found) > 50


def test_pairs_after_a_second_of_a_slow_camera() -> None:
    """KITTI's stamps are 103.7 ms apart: no pose is within 3 % of a second, one is within half an interval."""
    for interval_ns in (103_700_000, 105_000_000):
        t_ns = interval_ns * np.arange(100)
        first, second = PairRule().select(t_ns, np.zeros((100, 3)), np.zeros((100, 4)))
        assert len(first) == 90 and set((second - first).tolist()) == {10}
    with_gap_ns = np.concatenate([t_ns[:40], t_ns[60:]])
    first, second = PairRule().select(with_gap_ns, np.zeros((80, 3)), np.zeros((80, 4)))
    assert np.all(np.abs(with_gap_ns[second] - with_gap_ns[first] - 10**9) <= 52_500_000)


@pytest.mark.parametrize(
    "options",
    [
        {"delta": 0.0},
        {"delta": -1.0},
        {"delta": 1.5, "unit": "frames"},
        {"delta": 200.0, "unit": "deg"},
        {"unit": "furlongs"},
        {"selection": "some"},
        {"source": "both"},
        {"tolerance": 1.0},
        {"tolerance": float("nan")},
    ],
)
def test_invalid_options_of_pairs_are_refused(options: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match="expected"):
        PairRule(**options)


def matrices(trajectory: Trajectory) -> Array:
    """Return the poses of a trajectory as matrices (N, 3, 4)."""
    return pose_matrix(trajectory.rotations, trajectory.p_world_imu)[:, :3]


@settings(max_examples=10, deadline=None)
@given(st.floats(0.7, 1.4))
def test_kitti_errors_of_a_scale_by_hand(scale: float) -> None:
    """A straight road of 901 frames, 1 m apart: a scale error in per cent is the translation error in per cent."""
    p = np.outer(np.arange(901.0), [0.0, 0.0, 1.0])
    truth = pose_matrix(np.tile(np.eye(3), (901, 1, 1)), p)[:, :3]
    estimate = pose_matrix(np.tile(np.eye(3), (901, 1, 1)), scale * p)[:, :3]
    found = kitti_scores(truth, estimate)
    # A segment of 100 m ends at the first frame beyond, after 101 m, so that its error is larger by 1 %.
    expected = {length: 100 * abs(scale - 1) * (length + 1) / length for length in range(100, 900, 100)}
    for length, percent, deg in found.by_length:
        assert percent == pytest.approx(expected[round(length)], abs=1e-9) and deg == pytest.approx(0.0, abs=1e-5)
    assert found.segments == sum(1 + (899 - length) // 10 for length in range(100, 900, 100))
    assert found.rpe_m == pytest.approx(abs(scale - 1), abs=1e-12)
    assert kitti_scores(truth, estimate, alignment="scale").ate_m == pytest.approx(0.0, abs=1e-9)
    short = kitti_scores(truth[:50], estimate[:50])
    assert short.translation_percent is None and short.segments == 0


@settings(max_examples=10, deadline=None)
@given(seeds)
def test_kitti_agrees_with_relative_errors(seed: int) -> None:
    """Both compare the same pairs of frames; the matrices are orthonormal and the angles not small."""
    truth = smooth_path(seed, 300)
    estimate = disturbed(truth, seed + 1)
    found = kitti_scores(matrices(truth), matrices(estimate), lengths_m=(100.0,))
    length_m = path_lengths_m(truth.p_world_imu)
    pairs = [(i, int(np.searchsorted(length_m, length_m[i] + 100.0, side="right"))) for i in range(0, 300, 10)]
    i, j = np.array([pair for pair in pairs if pair[1] < 300]).T
    metres, radians = relative_errors(*arrays(truth, estimate), (i, j))
    assert found.segments == len(i)
    assert found.translation_percent == pytest.approx(metres.mean(), rel=1e-9)
    assert found.rotation_deg_per_100_m == pytest.approx(np.degrees(radians).mean(), rel=1e-6)
    transformed = Alignment(exp_so3(np.array([0.1, -0.4, 2.0])), np.array([5.0, 6.0, 7.0])).apply(estimate)
    other = kitti_scores(matrices(truth), matrices(transformed), lengths_m=(100.0,))
    assert other.ate_m == pytest.approx(found.ate_m, rel=1e-6)
    assert other.translation_percent == pytest.approx(found.translation_percent, rel=1e-9)


def test_kitti_omits_pairs_across_missing_frames() -> None:
    truth = smooth_path(7, 300)
    estimate = disturbed(truth, 8)
    frames = np.concatenate([np.arange(0, 50), np.arange(60, 300)])
    found = kitti_scores(matrices(truth), matrices(estimate)[frames], frames, lengths_m=(100.0,))
    whole = kitti_scores(matrices(truth), matrices(estimate), lengths_m=(100.0,))
    assert 0 < found.segments < whole.segments
    i = np.flatnonzero(np.diff(frames) == 1)
    step_m, _ = relative_errors(*arrays(truth, estimate), (frames[i], frames[i] + 1))
    assert found.rpe_m == pytest.approx(step_m.mean(), rel=1e-9)
    with pytest.raises(EvaluationError, match="expected two or more"):
        kitti_scores(matrices(truth)[:100], matrices(estimate)[frames], frames)
    with pytest.raises(ConfigError, match="expected one of first"):
        kitti_scores(matrices(truth), matrices(estimate), alignment="yaw")  # type: ignore[arg-type]
