"""Errors of an initialization and discontinuities, on motions whose errors are known."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dronevio.eval.metrics.scores import score_trajectory
from dronevio.eval.metrics.start_errors import (
    largest_step_error_m,
    start_errors,
    start_scale,
    velocities_m_s,
)
from dronevio.models.rotation import exp_so3, quat_wxyz_from_matrix
from dronevio.models.state import Trajectory


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
def test_the_step_error_is_the_size_of_a_jump(seed: int, at: int, size_m: float) -> None:
    truth, estimate = flight(seed)
    assert largest_step_error_m(score_trajectory(truth, estimate)) < 1e-9
    p = estimate.p_world_imu + size_m * (np.arange(200) >= at)[:, None] * [0.6, 0.0, 0.8]
    jumped = score_trajectory(truth, replace(estimate, p_world_imu=p))
    assert largest_step_error_m(jumped) == pytest.approx(size_m)


@pytest.mark.parametrize("known", [True, False], ids=["velocities", "positions"])
def test_velocity_and_scale_two_seconds_after_the_start(known: bool) -> None:
    """The velocity of the estimate errs by 0.3 m/s from the 41st pose on, 2 s after the first, and its scale by 4 %."""
    truth, estimate = flight(3)
    assert truth.velocity_m_s is not None and estimate.velocity_m_s is not None
    given_truth = truth if known else replace(truth, velocity_m_s=None)
    wrong = estimate.velocity_m_s + (np.arange(200) >= 40)[:, None] * [0.0, 0.0, 0.3]
    scored = score_trajectory(given_truth, replace(estimate, velocity_m_s=wrong))
    found = start_errors(given_truth, scored, int(truth.t_ns[0]))
    tolerance = 1e-9 if known else 0.03  # lines through 11 points at 20 Hz smooth the motion
    assert found.velocity_m_s == pytest.approx(0.3, abs=tolerance)
    assert found.speed_m_s == pytest.approx(np.linalg.norm(truth.velocity_m_s[40]), abs=tolerance)
    assert found.scale_percent == pytest.approx(0.0, abs=1e-6)
    larger = start_scale(truth[:41], replace(estimate, p_world_imu=1.04 * estimate.p_world_imu)[:41])
    assert larger == pytest.approx(1.04)


def test_what_is_not_known_of_a_start_is_none() -> None:
    truth, estimate = flight()
    short = score_trajectory(truth, estimate[:9])
    found = start_errors(truth, short, int(truth.t_ns[0]))
    assert (found.velocity_m_s, found.speed_m_s, found.scale_percent) == (None, None, None)
    still = replace(truth, p_world_imu=np.zeros((200, 3)))
    assert start_scale(still, estimate) is None
    positions = replace(estimate, velocity_m_s=None)
    assert start_errors(truth, score_trajectory(truth, positions), int(truth.t_ns[0])).velocity_m_s is None


def test_the_acceleration_is_that_of_the_first_two_seconds() -> None:
    t_ns = np.arange(200, dtype=np.int64) * 50_000_000
    t_s = t_ns * 1e-9
    v = np.where(t_s < 2.5, 1.5 * t_s, 3.75)[:, None] * [1.0, 0.0, 0.0]  # 1.5 m/s² for 2.5 s, then none
    p = np.cumsum(v, axis=0) * 0.05
    truth = Trajectory(t_ns, p, np.tile([1.0, 0.0, 0.0, 0.0], (200, 1)), v)
    scored = score_trajectory(truth, truth)
    assert start_errors(truth, scored, 0).acceleration_m_s2 == pytest.approx(1.5)
    assert start_errors(truth, scored, int(3e9)).acceleration_m_s2 == pytest.approx(0.0, abs=1e-9)


def test_slopes_of_a_uniform_motion_are_its_velocity() -> None:
    t_ns = np.cumsum(np.random.default_rng(0).integers(10**7, 10**8, 40))  # intervals differ
    velocity = np.array([0.5, -2.0, 1.0])
    found = velocities_m_s(t_ns, (t_ns * 1e-9)[:, None] * velocity)
    np.testing.assert_allclose(found, np.tile(velocity, (40, 1)), atol=1e-9)
