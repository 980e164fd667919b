"""Interpolated poses are exact for constant velocities and accurate for the motion of a drone."""

import numpy as np

from dronevio.models.rig import EUROC_CAM0, EUROC_T_IMU_CAM0, RigCamera
from dronevio.models.rotation import exp_so3, log_so3, quat_wxyz_from_matrix
from dronevio.models.state import Trajectory
from dronevio.sim.cameras.interpolation import camera_poses, interpolated_poses
from dronevio.sim.cameras.shutter import half_span_ns

START_NS = 1_403_715_273_262_142_976
T_NS = START_NS + np.arange(0, 1_000_000_000, 5_000_000, dtype=np.int64)
W = np.array([1.0, -2.0, 0.5])


def seconds(t_ns: np.ndarray) -> np.ndarray:
    return ((t_ns - START_NS) * 1e-9)[:, None]


def test_constant_velocities_are_interpolated_exactly() -> None:
    velocity = np.array([3.0, -1.0, 0.2])
    path = Trajectory(T_NS, seconds(T_NS) * velocity, quat_wxyz_from_matrix(exp_so3(seconds(T_NS) * W)))
    t_ns = START_NS + np.array([-7_000_000, 0, 1, 123_456_789, 995_000_000, 999_999_999, 1_004_000_000])
    T = interpolated_poses(path, t_ns)
    np.testing.assert_allclose(T[:, :3, 3], seconds(t_ns) * velocity, atol=1e-12)
    np.testing.assert_allclose(T[:, :3, :3], exp_so3(seconds(t_ns) * W), atol=1e-9)


def test_drone_motion_has_the_documented_accuracy() -> None:
    def p(t_ns: np.ndarray) -> np.ndarray:  # 10 m/s² at 1.6 Hz
        s = seconds(t_ns)
        return 0.1 * np.concatenate([np.sin(10.0 * s), np.cos(10.0 * s), 0.0 * s], axis=1)

    def R(t_ns: np.ndarray) -> np.ndarray:  # 400 °/s², and turning about a changing axis
        s = seconds(t_ns)
        return exp_so3(0.07 * np.sin(10.0 * s) * W) @ exp_so3(s * W[::-1])

    path = Trajectory(T_NS, p(T_NS), quat_wxyz_from_matrix(R(T_NS)))
    t_ns = START_NS + np.random.default_rng(0).integers(0, 995_000_000, 500)
    T = interpolated_poses(path, t_ns)
    error_m = np.linalg.norm(T[:, :3, 3] - p(t_ns), axis=1)
    error_rad = np.linalg.norm(log_so3(np.swapaxes(T[:, :3, :3], 1, 2) @ R(t_ns)), axis=1)
    assert 1e-5 < error_m.max() < 3.2e-5
    assert error_rad.max() < 1e-4  # a twentieth of a pixel


def test_a_camera_with_a_time_offset_is_later_in_the_motion() -> None:
    path = Trajectory(T_NS, seconds(T_NS) * W, quat_wxyz_from_matrix(exp_so3(seconds(T_NS) * W)))
    camera = RigCamera(EUROC_CAM0, EUROC_T_IMU_CAM0, time_offset_s=0.00216)
    t_ns = START_NS + np.array([0, 500_000_000])
    expected = interpolated_poses(path, t_ns + 2_160_000) @ EUROC_T_IMU_CAM0
    np.testing.assert_array_equal(camera_poses(path, camera)(t_ns), expected)
    assert half_span_ns(camera, 0.001) == 2_660_001
