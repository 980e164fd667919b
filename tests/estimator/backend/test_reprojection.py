"""The linearized reprojection residuals, against finite differences and against the system without elimination."""

import numpy as np
import pytest

from dronevio.estimator.backend.observations import ObservationTable
from dronevio.estimator.backend.reprojection import Rows, Scene, residuals, visual_system
from dronevio.models.rotation import exp_so3, pose_matrix

K, L, CAMERAS = 4, 9, 2


class Seen:
    """Two cameras on a rig that passes some landmarks; not every camera sees each."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.Ts_imu_cam = pose_matrix(exp_so3(0.2 * rng.normal(size=(CAMERAS, 3))), 0.1 * rng.normal(size=(CAMERAS, 3)))
        points = np.column_stack([rng.uniform(-2.0, 2.0, (L, 2)), rng.uniform(4.0, 8.0, L)])
        self.scene = Scene(exp_so3(0.1 * rng.normal(size=(K, 3))), 0.3 * rng.normal(size=(K, 3)), points)
        k, landmark, camera = (x.ravel() for x in np.meshgrid(range(K), range(L), range(CAMERAS), indexing="ij"))
        seen = rng.permutation(len(k))[: int(0.8 * len(k))]
        self.rows = Rows(k[seen], landmark[seen])
        xy = np.zeros((len(seen), 2))
        self.observations = ObservationTable(100 + landmark[seen], 7 + k[seen], camera[seen], xy, np.ones(len(seen)))
        self.weight = rng.uniform(0.5, 2.0, len(seen))
        self.observations = ObservationTable(
            100 + landmark[seen], 7 + k[seen], camera[seen], -self.error(self.scene), np.ones(len(seen))
        )

    def error(self, scene: Scene) -> np.ndarray:
        return residuals(self.observations, self.rows, self.Ts_imu_cam, scene)[0]


def moved(scene: Scene, poses: np.ndarray, points: np.ndarray) -> Scene:
    """Return the scene after changes of poses (K, 6), in the IMU's axes, and of points (L, 3)."""
    R = scene.R_world_imu
    shift = np.einsum("kij,kj->ki", R, poses[:, 3:])
    return Scene(R @ exp_so3(poses[:, :3]), scene.p_world_imu + shift, scene.points + points)


def dense(seen: Seen, error: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return information and right side over all variables, from Jacobians by central differences."""
    n, step = 6 * K + 3 * L, 1e-6
    J = np.zeros((len(error) * 2, n))
    for i in range(n):
        change = np.zeros(n)
        change[i] = step
        ahead, behind = (
            seen.error(moved(seen.scene, s * change[: 6 * K].reshape(K, 6), s * change[6 * K :].reshape(L, 3)))
            for s in (1.0, -1.0)
        )
        J[:, i] = ((ahead - behind) / (2.0 * step)).ravel()
    W = np.repeat(seen.weight, 2)
    return J.T @ (W[:, None] * J), -J.T @ (W * error.ravel())


@pytest.mark.parametrize("seed", range(3))
def test_eliminated_landmarks_leave_the_poses_what_they_said(seed: int) -> None:
    seen = Seen(seed)
    error = 0.01 * np.random.default_rng(seed).normal(size=(len(seen.weight), 2))
    H, b = dense(seen, error)
    system = visual_system(seen.observations, seen.rows, seen.Ts_imu_cam, seen.scene, error, seen.weight)
    poses, points = slice(0, 6 * K), slice(6 * K, None)
    inverse = np.linalg.inv(H[points, points])
    expected_H = H[poses, poses] - H[poses, points] @ inverse @ H[points, poses]
    expected_b = b[poses] - H[poses, points] @ inverse @ b[points]
    found_H, found_b = system.without_points(np.ones(L, dtype=np.bool_))
    scale = np.abs(np.diag(H)[:24]).max()
    np.testing.assert_allclose(found_H, expected_H, atol=1e-5 * scale)
    np.testing.assert_allclose(found_b, expected_b, atol=1e-5 * np.abs(b).max())

    change = 0.01 * np.random.default_rng(seed + 9).normal(size=(K, 6))
    expected_points = inverse @ (b[points] - H[points, poses] @ change.ravel())
    np.testing.assert_allclose(system.points_given(change).ravel(), expected_points, rtol=1e-3, atol=1e-4)


def test_landmarks_that_are_not_eliminated_are_left_out() -> None:
    seen = Seen(5)
    error = 0.01 * np.random.default_rng(5).normal(size=(len(seen.weight), 2))
    kept = seen.observations.landmark == 103
    eliminated = np.arange(L) != 3
    system = visual_system(seen.observations, seen.rows, seen.Ts_imu_cam, seen.scene, error, seen.weight)
    without = visual_system(
        seen.observations[~kept],
        Rows(seen.rows.keyframe[~kept], seen.rows.landmark[~kept]),
        seen.Ts_imu_cam,
        seen.scene,
        error[~kept],
        seen.weight[~kept],
    )
    own = sum(
        visual_system(
            seen.observations[kept],
            Rows(seen.rows.keyframe[kept], seen.rows.landmark[kept]),
            seen.Ts_imu_cam,
            seen.scene,
            error[kept],
            seen.weight[kept],
        ).pose
    )
    H = system.without_points(eliminated)[0]
    H_without = without.without_points(eliminated)[0]
    blocks = [(H - H_without)[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] for k in range(K)]
    np.testing.assert_allclose(sum(blocks), own, rtol=1e-9)


def test_no_sightings_say_nothing() -> None:
    seen = Seen(0)
    nothing = np.zeros(0, dtype=np.int64)
    system = visual_system(
        seen.observations[:0], Rows(nothing, nothing), seen.Ts_imu_cam, seen.scene, np.zeros((0, 2)), np.zeros(0)
    )
    H, b = system.without_points(np.ones(L, dtype=np.bool_))
    assert not H.any() and not b.any()
