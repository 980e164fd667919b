"""Scores of trajectories: coverage, scale, noise, uncertainty, refused input, and cost."""

import json
import subprocess
import sys
import time
from dataclasses import asdict, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dronevio.eval.metrics import (
    Alignment,
    AlignmentMode,
    PairRule,
    ScoreOptions,
    coverage_percent,
    scale_error_percent,
    score,
    score_trajectory,
)
from dronevio.models.errors import ConfigError, EvaluationError
from dronevio.models.rotation import exp_so3, quat_wxyz_from_matrix, rotation_z
from dronevio.models.state import Trajectory

START_NS = 1403715273262142976
LEAST_SQUARES: tuple[AlignmentMode, ...] = ("yaw", "se3", "sim3")


def truth_at_200_hz(duration_s: float = 20.0) -> Trajectory:
    """Return a smooth path with EuRoC-like time stamps."""
    t_ns = START_NS + 5_000_000 * np.arange(round(duration_s * 200) + 1)
    t = (t_ns - START_NS) * 1e-9
    p = np.stack([3 * np.sin(0.7 * t), 2 * np.sin(1.1 * t), 1 + 0.5 * np.sin(0.5 * t)], axis=1)
    phi = np.stack([0.3 * np.sin(t), 0.2 * np.cos(1.3 * t), 0.5 * t], axis=1)
    return Trajectory(t_ns, p, quat_wxyz_from_matrix(exp_so3(phi)))


def noisy(trajectory: Trajectory, sigma_m: float, seed: int = 0) -> Trajectory:
    """Return a trajectory with white noise on its positions."""
    noise = np.random.default_rng(seed).normal(0.0, sigma_m, trajectory.p_world_imu.shape)
    return replace(trajectory, p_world_imu=trajectory.p_world_imu + noise)


@settings(max_examples=10, deadline=None)
@given(st.floats(-3, 3), st.tuples(*[st.floats(-9, 9)] * 3), st.sampled_from(LEAST_SQUARES))
def test_an_exact_estimate_in_another_world_frame_has_no_error(
    yaw: float, t: tuple[float, float, float], mode: AlignmentMode
) -> None:
    truth = truth_at_200_hz()
    estimate = Alignment(rotation_z(yaw), np.array(t)).apply(truth[::10])
    scores = score(truth, estimate, truth.t_ns[::10], ScoreOptions(mode))
    assert scores.ate_m.max < 1e-8 and scores.ate_deg.max < 1e-6
    assert scores.rpe_m is not None and scores.rpe_m.max < 1e-8
    assert scores.rpe_deg is not None and scores.rpe_deg.max < 1e-6
    assert scores.scale_error_percent == pytest.approx(0.0, abs=1e-7)
    assert scores.coverage_percent == 100.0
    assert (scores.n_poses, scores.n_estimated, scores.rpe_pairs) == (401, 401, 381)
    assert (scores.first_pose_s, scores.last_pose_s) == (0.0, 20.0)
    assert scores.path_m == pytest.approx(truth.length_m, rel=1e-3)
    assert scores.nees_position is None


def test_errors_of_white_noise_have_its_standard_deviation() -> None:
    truth = truth_at_200_hz()
    scores = score(truth, noisy(truth, 0.1))
    assert scores.ate_m.rmse == pytest.approx(0.1 * np.sqrt(3), rel=0.03)
    assert scores.rpe_m is not None
    assert scores.rpe_m.rmse == pytest.approx(0.1 * np.sqrt(6), rel=0.03)  # a pair has the noise of two poses


@settings(max_examples=20, deadline=None)
@given(st.floats(0.5, 2.0))
def test_the_scale_error_is_the_excess_in_percent(scale: float) -> None:
    truth = truth_at_200_hz()[::10]
    scaled = replace(truth, p_world_imu=scale * truth.p_world_imu)
    found = scale_error_percent(truth.p_world_imu, scaled.p_world_imu)
    assert found == pytest.approx(100 * (scale - 1), abs=1e-9)
    assert score(truth, scaled).scale_error_percent == pytest.approx(found)
    similar = score(truth, scaled, options=ScoreOptions("sim3"))  # removes the scale from the errors, and reports it
    assert similar.scale_error_percent == pytest.approx(found)
    assert similar.ate_m.max < 1e-9


def test_the_scale_error_of_a_straight_path_is_unknown() -> None:
    line = np.outer(np.linspace(0, 1, 20), [1.0, 2.0, 3.0])
    assert scale_error_percent(line, line) is None


def test_coverage_counts_frames_later_than_three_seconds() -> None:
    frames = 50_000_000 * np.arange(200)  # 10 s; the 139 frames 61 … 199 count
    assert coverage_percent(frames, frames) == 100.0
    assert coverage_percent(frames, frames[61:]) == 100.0
    assert coverage_percent(frames, frames[62:]) == pytest.approx(100 * 138 / 139)
    assert coverage_percent(frames, frames[:130]) == pytest.approx(100 * 69 / 139)
    assert coverage_percent(frames, frames + 500_000) == 100.0  # such as stamps rounded to the millisecond
    assert coverage_percent(frames, frames + 2_000_000) == 0.0
    assert coverage_percent(frames, np.repeat(frames[100:101], 1)) == pytest.approx(100 / 139)
    assert coverage_percent(frames, frames[:0]) == 0.0
    assert coverage_percent(frames[:61], frames) is None
    assert coverage_percent(frames[:0], frames) is None


def test_frames_after_a_loss_are_not_covered() -> None:
    truth = truth_at_200_hz()
    frames = truth.t_ns[::10]
    scores = score(truth, truth[::10][:100], frames)
    assert scores.ate_m.max < 1e-9
    assert scores.coverage_percent == pytest.approx(100 * 39 / 340)


def test_scored_trajectories_hold_the_errors_over_time() -> None:
    truth = truth_at_200_hz()
    estimate = noisy(truth[::10], 0.05)
    scored = score_trajectory(truth, estimate)
    np.testing.assert_array_equal(scored.truth.t_ns, scored.estimate.t_ns)
    distance = np.linalg.norm(scored.truth.p_world_imu - scored.estimate.p_world_imu, axis=1)
    np.testing.assert_allclose(scored.translation_error_m, distance, rtol=1e-12)
    assert scored.scores.ate_m.rmse == pytest.approx(np.sqrt(np.mean(distance**2)), rel=1e-12)
    assert scored.rpe_t_ns.shape == scored.rpe_m.shape == scored.rpe_rad.shape == (scored.scores.rpe_pairs,)
    np.testing.assert_allclose(
        scored.alignment.positions(estimate.p_world_imu), scored.estimate.p_world_imu, atol=1e-12
    )
    assert scored.scores == score(truth, estimate)


def test_covariances_are_scored() -> None:
    truth = truth_at_200_hz()[::10]
    estimate = noisy(truth, 0.05)
    estimate = replace(estimate, covariance=np.tile(0.05**2 * np.eye(15), (len(truth), 1, 1)))
    estimate.p_world_imu[0] = truth.p_world_imu[0]
    scored = score_trajectory(truth, estimate)
    assert scored.consistency is not None
    assert scored.scores.nees_position == pytest.approx(3.0, abs=0.7)
    assert scored.scores.nees_orientation == pytest.approx(0.0, abs=1e-9)
    assert scored.scores.position_beyond_3_sigma_percent == pytest.approx(0.27, abs=0.5)
    others: tuple[AlignmentMode, ...] = ("none", "se3", "sim3")
    for mode in others:  # the NEES is that of the estimate anchored at the first pose
        scores = score(truth, estimate, options=ScoreOptions(mode))
        assert scores.nees_position == scored.scores.nees_position


def test_association_with_the_nearest_pose() -> None:
    truth = truth_at_200_hz()
    estimate = replace(truth[::10], t_ns=truth.t_ns[::10] + 2_000_000)
    by_nearest = score(truth, estimate, options=ScoreOptions(association="nearest"))
    assert by_nearest.ate_m.max < 1e-9 and by_nearest.n_poses == 401
    assert score(truth, estimate).ate_m.max > 1e-3
    with pytest.raises(EvaluationError):
        score(truth, estimate, options=ScoreOptions(association="nearest", max_gap_s=0.001))


def test_scores_can_be_written_as_json() -> None:
    truth = truth_at_200_hz(0.5)
    document = json.loads(json.dumps(asdict(score(truth, noisy(truth, 0.1))), allow_nan=False))
    assert document["rpe_m"] is None and document["ate_m"]["rmse"] > 0.0


def test_invalid_trajectories_and_options_are_refused() -> None:
    truth = truth_at_200_hz(2.0)
    later = replace(truth, t_ns=truth.t_ns + 10**10)
    for estimate in (later, truth[:2], truth[:0]):
        with pytest.raises(EvaluationError, match="in common"):
            score(truth, estimate)
    with pytest.raises(EvaluationError, match="not finite"):
        score(truth, replace(truth, p_world_imu=truth.p_world_imu * np.nan))
    with pytest.raises(ConfigError, match="association"):
        score(truth, truth, options=ScoreOptions(association="greedy"))  # type: ignore[arg-type]
    for delta_s in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(ConfigError, match="above zero"):
            score(truth, truth, options=ScoreOptions(rpe=PairRule(delta_s)))


def test_a_hundred_thousand_poses_are_scored_fast() -> None:
    """Within four times the processor time of as many singular value decompositions (3, 3)."""
    truth = truth_at_200_hz(500.0)
    estimate = replace(noisy(truth, 0.1), t_ns=truth.t_ns + 1_000_000)[:-1]
    matrices = np.random.default_rng(0).normal(size=(100_000, 3, 3))
    of_scores_s, of_matrices_s = [], []
    for _ in range(3):
        start_s = time.process_time()
        assert score(truth, estimate, truth.t_ns).n_poses == 100_000
        middle_s = time.process_time()
        np.linalg.svd(matrices)
        of_scores_s.append(middle_s - start_s)
        of_matrices_s.append(time.process_time() - middle_s)
    assert min(of_scores_s) < 4.0 * min(of_matrices_s)  # measured: 1.7


def test_the_metrics_import_only_numpy() -> None:
    code = "import sys, dronevio.eval.metrics; print(*sorted({name.split('.')[0] for name in sys.modules}))"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert "numpy" in loaded
    assert not {"scipy", "cv2", "mujoco", "gtsam", "rerun", "matplotlib", "gymnasium", "tyro", "rich"} & set(loaded)
