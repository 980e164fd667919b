"""Navigation states, estimates and trajectories."""

import numpy as np
import pytest

from dronevio.models.errors import ConfigError
from dronevio.models.rotation import exp_so3, pose_matrix
from dronevio.models.state import Estimate, Health, NavState, Trajectory


def states(n: int, covariances: int | None = None) -> list[NavState]:
    """Return n states, of which the first ``covariances`` have a covariance; all by default."""
    known = n if covariances is None else covariances
    rng = np.random.default_rng(n)
    T = pose_matrix(exp_so3(rng.normal(size=(n, 3))), rng.normal(size=(n, 3)))
    v, b_gyro, b_accel = rng.normal(size=(3, n, 3))
    P = [np.eye(15) * (k + 1.0) if k < known else None for k in range(n)]
    return [NavState(10**18 + 7 * k, T[k], v[k], b_gyro[k], b_accel[k], P[k]) for k in range(n)]


def test_trajectories_keep_all_fields_of_states() -> None:
    kept = states(6)
    trajectory = Trajectory.from_states(iter(kept))
    assert len(trajectory) == 6
    np.testing.assert_allclose(trajectory.Ts_world_imu, [s.T_world_imu for s in kept], atol=1e-14)
    for name in ("t_ns", "velocity_m_s", "gyro_bias_rad_s", "accel_bias_m_s2", "covariance"):
        np.testing.assert_array_equal(getattr(trajectory, name), [getattr(s, name) for s in kept])
    assert trajectory.t_ns.dtype == np.int64


def test_covariances_need_all_states() -> None:
    assert Trajectory.from_states(states(4, covariances=3)).covariance is None


def test_without_states_the_trajectory_is_empty() -> None:
    empty = Trajectory.from_states([])
    assert len(empty) == 0 and empty.length_m == 0.0 and empty.rotations.shape == (0, 3, 3)


def test_selection_applies_to_all_fields() -> None:
    trajectory = Trajectory.from_states(states(6))
    for rows in (slice(1, 5, 2), np.array([True, False, True, False, False, True]), np.array([0, 3])):
        picked = trajectory[rows]
        for name, values in vars(trajectory).items():
            np.testing.assert_array_equal(getattr(picked, name), values[rows])
    bare = Trajectory(trajectory.t_ns, trajectory.p_world_imu, trajectory.quat_wxyz)[2:]
    assert len(bare) == 4 and bare.velocity_m_s is None and bare.covariance is None


def test_shapes_and_time_are_checked() -> None:
    t_ns, p, q = np.arange(3), np.zeros((3, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (3, 1))
    with pytest.raises(ConfigError, match="shapes"):
        Trajectory(t_ns, p[:2], q)
    with pytest.raises(ConfigError, match="shapes"):
        Trajectory(t_ns, p, q[:, :3])
    with pytest.raises(ConfigError, match="do not increase"):
        Trajectory(np.array([0, 1, 1]), p, q)


def test_path_length_and_relative_times() -> None:
    corners = np.array([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0], [3.0, 4.0, 0.0], [3.0, 4.0, -2.0]])
    t_ns = 10**18 + 500_000_000 * np.arange(4)
    path = Trajectory(t_ns, corners, np.tile([1.0, 0.0, 0.0, 0.0], (4, 1)))
    assert path.length_m == pytest.approx(9.0)
    np.testing.assert_allclose(path.t_s, [0.0, 0.5, 1.0, 1.5])


def test_map_pose_needs_a_state_and_a_map_frame() -> None:
    state = states(1)[0]
    rng = np.random.default_rng(3)
    T_map_odom = pose_matrix(exp_so3(rng.normal(size=3)), rng.normal(size=3))
    odometry = Estimate(state.t_ns, Health.TRACKING, state)
    assert odometry.T_map_imu is None and odometry.health_report is None
    assert Estimate(state.t_ns, Health.LOST, None, T_map_odom=T_map_odom).T_map_imu is None
    corrected = Estimate(state.t_ns, Health.TRACKING, state, T_map_odom=T_map_odom).T_map_imu
    assert corrected is not None
    point_imu = np.array([0.3, -0.2, 0.9, 1.0])
    np.testing.assert_allclose(corrected @ point_imu, T_map_odom @ (state.T_world_imu @ point_imu), atol=1e-14)
