"""The choice of the map frame after an optimization."""

import numpy as np
import pytest

from dronevio.estimator.slam.map.map_frame import frame_change, with_frame_offset
from dronevio.models.arrays import Array
from dronevio.models.rotation import exp_so3, inverse_pose, pose_matrix, rotation_z

POSES = {
    n: pose_matrix(exp_so3(np.sin([0.7 * n, 1.1 * n, 1.7 * n])), 4.0 * np.sin([0.3 * n, 0.2 * n, 0.9 * n]))
    for n in range(0, 40, 2)
}
"""Poses of keyframes, of which every other one was culled."""
MOVED = pose_matrix(rotation_z(np.array(0.3)), np.array([2.0, -1.0, 0.5]))


def moved(poses: dict[int, Array], T: Array) -> dict[int, Array]:
    """Return poses of which each is moved by the same transformation (4, 4)."""
    return {number: T @ pose for number, pose in poses.items()}


def test_a_map_that_is_moved_as_a_whole_is_moved_back() -> None:
    np.testing.assert_allclose(frame_change(moved(POSES, MOVED), POSES), inverse_pose(MOVED), atol=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_no_other_frame_is_nearer(seed: int) -> None:
    rng = np.random.default_rng(seed)
    changed = {n: T @ pose_matrix(exp_so3(0.1 * rng.normal(size=3)), rng.normal(size=3)) for n, T in POSES.items()}
    aligned = moved(changed, frame_change(changed, POSES))
    points = np.vstack([np.column_stack([np.zeros(3), np.eye(3)]), np.ones(4)])

    def squares(T: Array) -> float:
        return float(sum(np.sum(((T @ aligned[number] - POSES[number]) @ points) ** 2) for number in POSES))

    small = 1e-3
    others = [pose_matrix(rotation_z(np.array(angle)), np.zeros(3)) for angle in (small, -small)]
    others += [pose_matrix(np.eye(3), sign * small * axis) for sign in (1.0, -1.0) for axis in np.eye(3)]
    assert all(squares(T) > squares(np.eye(4)) for T in others)


def test_inclinations_stay() -> None:
    tilt = pose_matrix(exp_so3(np.array([0.2, -0.1, 0.0])), np.zeros(3))
    T = frame_change(moved(POSES, tilt), POSES)
    np.testing.assert_allclose(T[2, :3], [0.0, 0.0, 1.0], atol=1e-12)


def test_yaw_is_that_of_the_axes_without_motion() -> None:
    still = {number: pose_matrix(T[:3, :3], np.zeros(3)) for number, T in POSES.items()}
    np.testing.assert_allclose(frame_change(moved(still, MOVED), still), inverse_pose(MOVED), atol=1e-12)


def test_only_common_keyframes_count() -> None:
    reference = {number: POSES[number] for number in (4, 10, 16)} | {99: np.eye(4)}
    np.testing.assert_allclose(frame_change(moved(POSES, MOVED), reference), inverse_pose(MOVED), atol=1e-12)
    np.testing.assert_array_equal(frame_change(POSES, {99: np.eye(4)}), np.eye(4))


def test_offset_of_the_map_is_part_of_the_covariance() -> None:
    """A map that was moved by 3 cm along x and turned by 0.01 rad, at a position 2 m along y from its origin."""
    T_map_imu = pose_matrix(rotation_z(np.array(np.pi / 2.0)), np.array([0.0, 2.0, 0.0]))
    T_map_first = pose_matrix(rotation_z(np.array(0.01)), np.array([0.03, 0.0, 0.0]))
    found = with_frame_offset(1e-6 * np.eye(6), T_map_imu, T_map_first)
    # In the frame of the first pose, it is 3 cm farther back along x of the map, and turned back about the origin
    # of the map, which moves it by 2 cm forward: 1 cm along y of the IMU, whose x axis is y of the map.
    offset = np.array([0.0, 0.0, -0.01, 0.0, 0.01, 0.0])
    np.testing.assert_allclose(found - 1e-6 * np.eye(6), np.outer(offset, offset), atol=5e-6)
    np.testing.assert_array_equal(with_frame_offset(np.eye(6), T_map_imu, np.eye(4)), np.eye(6))
