"""Metrics of one run in the scripts, over the whole flight and over a time window."""

import json
import math
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dronevio.eval.run import EstimatorRun
from dronevio.models.rotation import exp_so3, quat_wxyz_from_matrix
from dronevio.models.state import Estimate, Health, NavState, Trajectory


@pytest.fixture(scope="module")
def run_metrics(script: Callable[[str], Any]) -> Any:
    return script("run_metrics")


def flight(seed: int = 0, n: int = 200) -> tuple[Trajectory, Trajectory]:
    """Return a smooth motion at 20 Hz, and the same in another world frame, rotated about the vertical and shifted."""
    rng = np.random.default_rng(seed)
    t_s = np.arange(n) * 0.05
    a, f, phase = rng.uniform(0.5, 1.5, (3, 3))
    p = a * np.sin(f * t_s[:, None] + phase)
    v = a * f * np.cos(f * t_s[:, None] + phase)
    R = exp_so3(0.3 * p)
    Q = exp_so3(np.array([0.0, 0.0, rng.uniform(-3.0, 3.0)]))
    t_ns = 10**18 + np.arange(n, dtype=np.int64) * 50_000_000
    truth = Trajectory(t_ns, p, quat_wxyz_from_matrix(R), v)
    moved = Trajectory(t_ns, p @ Q.T + rng.normal(size=3), quat_wxyz_from_matrix(Q @ R), v @ Q.T)
    return truth, moved


@given(st.integers(0, 50), st.integers(1, 199), st.floats(0.05, 2.0))
@settings(deadline=None, max_examples=30)
def test_jumps_have_the_size_and_time_of_a_discontinuity(run_metrics: Any, seed: int, at: int, size_m: float) -> None:
    truth, estimate = flight(seed)
    step_m, jump_m, _ = run_metrics.steps(truth, estimate, int(truth.t_ns[0]))
    assert step_m < 1e-9 and jump_m < 1e-3  # a straight step along a curved path
    p = estimate.p_world_imu + size_m * (np.arange(200) >= at)[:, None] * [0.6, 0.0, 0.8]
    step_m, jump_m, when_s = run_metrics.steps(truth, replace(estimate, p_world_imu=p), int(truth.t_ns[0]))
    assert step_m == pytest.approx(size_m)
    assert jump_m == pytest.approx(size_m, abs=1e-3)
    assert when_s == pytest.approx(at * 0.05)


def run_of(estimate: Trajectory, healths: list[Health] | None = None) -> EstimatorRun:
    assert estimate.velocity_m_s is not None
    states = [
        NavState(t, T, v, np.zeros(3), np.zeros(3), np.diag([1e-4] * 15))
        for t, T, v in zip(estimate.t_ns.tolist(), estimate.Ts_world_imu, estimate.velocity_m_s, strict=True)
    ]
    healths = healths or [Health.TRACKING] * len(states)
    estimates = tuple(Estimate(s.t_ns, h, s) for s, h in zip(states, healths, strict=True))
    return EstimatorRun(estimates, np.arange(1.0, len(states) + 1), np.zeros(len(states)))


def test_perfect_run_has_no_errors(run_metrics: Any) -> None:
    truth, estimate = flight()
    metrics = run_metrics.metrics_of("x", "mono", run_of(estimate), truth, truth.t_ns)
    assert metrics.ate_m < 1e-9 and metrics.end_m < 1e-9 and metrics.nees_position < 1e-9 and not metrics.failed
    assert metrics.path_m == pytest.approx(truth.length_m)
    assert metrics.cpu_ms_mean == pytest.approx(100.5) and metrics.cpu_ms_max == 200.0
    assert metrics.health == {"initializing": 0.0, "tracking": 100.0, "inertial-only": 0.0, "lost": 0.0}
    assert len(metrics.nees_position_over_time) == 9  # 9.95 s from the first pose, which fixes the gauge


def test_errors_beyond_covariance_count_while_tracking(run_metrics: Any) -> None:
    truth, estimate = flight()
    p = estimate.p_world_imu + 0.03 * (np.arange(200) >= 150)[:, None] * [0.0, 0.6, 0.8]  # σ is 0.01 m on each axis
    wrong = replace(estimate, p_world_imu=p)
    assert run_metrics.tracking_sigmas(run_of(wrong), truth) == pytest.approx(3.0)
    healths = [Health.TRACKING] * 150 + [Health.INERTIAL_ONLY] * 50
    assert run_metrics.tracking_sigmas(run_of(wrong, healths), truth) < 1e-6
    assert run_metrics.tracking_sigmas(run_of(wrong, [Health.INERTIAL_ONLY] * 200), truth) is None
    metrics = run_metrics.metrics_of("x", "mono", run_of(wrong), truth, truth.t_ns)
    assert metrics.tracking_sigmas == pytest.approx(3.0)


def test_missing_and_not_finite_estimates_are_failures(run_metrics: Any) -> None:
    truth, estimate = flight()
    healths = [Health.TRACKING] * 100 + [Health.LOST] * 100
    metrics = run_metrics.metrics_of("x", "mono", run_of(estimate, healths), truth, truth.t_ns)
    assert metrics.status == "ok" and metrics.failed and metrics.coverage_percent < 30.0
    assert metrics.health["lost"] == 50.0
    v = estimate.velocity_m_s
    assert v is not None
    v[17, 1] = np.nan
    metrics = run_metrics.metrics_of("x", "mono", run_of(estimate), truth, truth.t_ns)
    assert (metrics.status, metrics.not_finite, metrics.ate_m) == ("failed", 1, math.inf)


def test_singular_covariances_make_the_nees_infinite(run_metrics: Any) -> None:
    truth, estimate = flight()
    run = run_of(estimate)
    state = run.estimates[5].state
    assert state is not None
    flat = replace(run.estimates[5], state=replace(state, covariance=np.zeros((15, 15))))
    run = replace(run, estimates=(*run.estimates[:5], flat, *run.estimates[6:]))
    metrics = run_metrics.metrics_of("x", "mono", run, truth, truth.t_ns)
    assert metrics.status == "ok" and metrics.ate_m < 1e-9
    assert metrics.nees_position == math.inf and "positive definite" in metrics.reason


def test_rows_are_read_as_they_were_written(run_metrics: Any, script: Callable[[str], Any], tmp_path: Path) -> None:
    truth, estimate = flight()
    metrics = run_metrics.metrics_of("x", "mono", run_of(estimate), truth, truth.t_ns)
    for row in (metrics, run_metrics.RunMetrics("y", "stereo", "crashed", "SIGSEGV")):
        (tmp_path / "row.json").write_text(json.dumps(asdict(row)))
        read = run_metrics.RunMetrics(**script("estimation_tasks").read_row(tmp_path / "row.json"))
        assert repr(read) == repr(row)  # NaN differs from itself


def test_window_drift_is_the_change_of_the_error(run_metrics: Any) -> None:
    truth, estimate = flight()
    drift = np.clip(truth.t_s - 4.0, 0.0, 2.0)[:, None] * [0.03, -0.04, 0.0]  # 5 cm/s from 4 s to 6 s
    run = run_of(replace(estimate, p_world_imu=estimate.p_world_imu + drift))
    assert run_metrics.window_drift_m(run, truth, (4.0, 6.0)) == pytest.approx(0.1)
    assert run_metrics.window_drift_m(run, truth, (4.0, 5.0)) == pytest.approx(0.05)
    assert run_metrics.window_drift_m(run, truth, (7.0, 9.0)) < 1e-9
    never_tracking = run_of(estimate, [Health.INITIALIZING] * 200)
    assert run_metrics.window_drift_m(never_tracking, truth, (4.0, 6.0)) == math.inf


@pytest.mark.parametrize(
    ("interruptions", "end_s", "expected"),
    [
        ([], 4.0, 0.0),
        ([(4.0, 5.0)], 4.0, 1.0),
        ([(4.0, 5.0), (5.2, 6.0)], 4.0, 2.0),  # tracking for 0.2 s is too short
        ([(2.0, 10.0)], 4.0, math.inf),
        ([(4.0, 9.7)], 4.0, 5.7),  # tracking until the end
    ],
)
def test_recovery_needs_uninterrupted_tracking(
    run_metrics: Any, interruptions: list[tuple[float, float]], end_s: float, expected: float
) -> None:
    _, estimate = flight()
    t_s = estimate.t_s
    interrupted = [any(a - 1e-6 <= t < b - 1e-6 for a, b in interruptions) for t in t_s]
    run = run_of(estimate, [Health.INERTIAL_ONLY if each else Health.TRACKING for each in interrupted])
    assert run_metrics.recovery_s(run, end_s) == pytest.approx(expected, abs=1e-6)
