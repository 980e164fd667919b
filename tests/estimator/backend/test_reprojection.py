"""Linearized reprojection errors against finite differences, and against the system before elimination."""

import numpy as np
import numpy.typing as npt
import pytest

from dronevio.estimator.backend.observations import ObservationTable
from dronevio.estimator.backend.reprojection import ObservationIndices, VisualState, residuals, visual_system
from dronevio.models.arrays import Array
from dronevio.models.rotation import exp_so3, pose_matrix

K, L, CAMERAS = 4, 9, 2


class Passage:
    """A rig of two cameras that passes some landmarks; each camera observes most of them, without noise."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.Ts_imu_cam = pose_matrix(exp_so3(0.2 * rng.normal(size=(CAMERAS, 3))), 0.1 * rng.normal(size=(CAMERAS, 3)))
        points = np.column_stack([rng.uniform(-2.0, 2.0, (L, 2)), rng.uniform(4.0, 8.0, L)])
        self.state = VisualState(exp_so3(0.1 * rng.normal(size=(K, 3))), 0.3 * rng.normal(size=(K, 3)), points)
        k, landmark, camera = (x.ravel() for x in np.meshgrid(range(K), range(L), range(CAMERAS), indexing="ij"))
        rows = rng.permutation(len(k))[: int(0.8 * len(k))]
        self.indices = ObservationIndices(k[rows], landmark[rows])
        self.weight = rng.uniform(0.5, 2.0, len(rows))

        def observed(xy: Array) -> ObservationTable:
            return ObservationTable(100 + landmark[rows], 7 + k[rows], camera[rows], xy, np.ones(len(rows)), 0 * rows)

        self.observations = observed(np.zeros((len(rows), 2)))
        self.observations = observed(-self.residual(self.state))

    def residual(self, state: VisualState) -> Array:
        """Return the residuals (N, 2) of the observations at some state."""
        return residuals(self.observations, self.indices, self.Ts_imu_cam, state)[0]


def retracted(state: VisualState, delta_poses: Array, delta_points: Array) -> VisualState:
    """Return the state at a tangent vector of poses (K, 6) in the IMU frame and of landmarks (L, 3)."""
    R = state.R_world_imu
    shift = np.einsum("kij,kj->ki", R, delta_poses[:, 3:])
    return VisualState(R @ exp_so3(delta_poses[:, :3]), state.p_world_imu + shift, state.points + delta_points)


def dense_system(passage: Passage, residual: Array) -> tuple[Array, Array]:
    """Return information matrix and right-hand side of all variables, with Jacobians by central differences."""
    n, h = 6 * K + 3 * L, 1e-6
    J = np.zeros((len(residual) * 2, n))
    for i, step in enumerate(h * np.eye(n)):
        poses, points = step[: 6 * K].reshape(K, 6), step[6 * K :].reshape(L, 3)
        ahead = passage.residual(retracted(passage.state, poses, points))
        behind = passage.residual(retracted(passage.state, -poses, -points))
        J[:, i] = ((ahead - behind) / (2.0 * h)).ravel()
    W = np.repeat(passage.weight, 2)
    return J.T @ (W[:, None] * J), -J.T @ (W * residual.ravel())


def test_residuals_of_exact_observations_are_zero() -> None:
    passage = Passage(4)
    residual, depth_m = residuals(passage.observations, passage.indices, passage.Ts_imu_cam, passage.state)
    np.testing.assert_allclose(residual, 0.0, atol=1e-15)
    assert depth_m.min() > 2.0


@pytest.mark.parametrize("seed", range(3))
def test_elimination_and_back_substitution(seed: int) -> None:
    """The reduced system of the poses, and the landmarks' step, are those of the dense system."""
    passage = Passage(seed)
    residual = 0.01 * np.random.default_rng(seed).normal(size=(len(passage.weight), 2))
    H, b = dense_system(passage, residual)
    system = visual_system(
        passage.observations, passage.indices, passage.Ts_imu_cam, passage.state, residual, passage.weight
    )
    poses, points = slice(0, 6 * K), slice(6 * K, None)
    inverse = np.linalg.inv(H[points, points])
    expected_H = H[poses, poses] - H[poses, points] @ inverse @ H[points, poses]
    expected_b = b[poses] - H[poses, points] @ inverse @ b[points]
    found_H, found_b = system.reduced_system(np.ones(L, dtype=np.bool_))
    scale = np.abs(np.diag(H)[: 6 * K]).max()
    np.testing.assert_allclose(found_H, expected_H, atol=1e-5 * scale)
    np.testing.assert_allclose(found_b, expected_b, atol=1e-5 * np.abs(b).max())

    delta_poses = 0.01 * np.random.default_rng(seed + 9).normal(size=(K, 6))
    expected_points = inverse @ (b[points] - H[points, poses] @ delta_poses.ravel())
    np.testing.assert_allclose(system.back_substitute(delta_poses).ravel(), expected_points, rtol=1e-3, atol=1e-4)


def test_landmarks_that_stay_are_not_eliminated() -> None:
    """A landmark that stays adds its observations to the diagonal blocks of the poses, and nothing is subtracted."""
    passage = Passage(5)
    residual = 0.01 * np.random.default_rng(5).normal(size=(len(passage.weight), 2))

    def of_rows(rows: npt.NDArray[np.bool_]) -> tuple[Array, Array]:
        """Return the reduced system without landmark 3, and the diagonal blocks, of some of the observations."""
        indices = ObservationIndices(passage.indices.keyframe[rows], passage.indices.landmark[rows])
        system = visual_system(
            passage.observations[rows],
            indices,
            passage.Ts_imu_cam,
            passage.state,
            residual[rows],
            passage.weight[rows],
        )
        return system.reduced_system(np.arange(L) != 3)[0], system.H_pose

    is_kept = passage.observations.landmark == 103
    difference = of_rows(np.ones(len(is_kept), dtype=np.bool_))[0] - of_rows(~is_kept)[0]
    expected = np.zeros((6 * K, 6 * K))
    for k, block in enumerate(of_rows(is_kept)[1]):
        expected[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] = block
    np.testing.assert_allclose(difference, expected, atol=1e-9 * np.abs(expected).max())


def test_no_observations_give_no_information() -> None:
    passage = Passage(0)
    none = np.zeros(0, dtype=np.int64)
    system = visual_system(
        passage.observations[:0],
        ObservationIndices(none, none),
        passage.Ts_imu_cam,
        passage.state,
        np.zeros((0, 2)),
        np.zeros(0),
    )
    H, b = system.reduced_system(np.ones(L, dtype=np.bool_))
    assert not H.any() and not b.any()
