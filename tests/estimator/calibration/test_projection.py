"""Projection with a calibration among the unknowns: residuals, and Jacobians against numerical derivatives."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from dronevio.estimator.backend.triangulation import triangulate
from dronevio.estimator.calibration.corrections import (
    COMMON_PARAMETERS,
    PARAMETERS_PER_CAMERA,
    Corrections,
    seen_errors,
)
from dronevio.estimator.calibration.projection import (
    CalibrationObservations,
    CalibrationState,
    camera_poses,
    corrected_xy,
    project,
)
from dronevio.models.arrays import Array
from dronevio.models.rig_presets import rig_named
from dronevio.models.rotation import exp_so3, pose_matrix

K, L, CAMERAS = 3, 5, 2
MODELS = rig_named("euroc").cameras[0].model, rig_named("fisheye").cameras[0].model
H = 1e-6
"""Step of central differences."""


@dataclass(frozen=True, eq=False)
class Problem:
    """Two cameras on a moving rig that observe all landmarks exactly, with some corrections of the calibration."""

    state: CalibrationState
    observations: CalibrationObservations
    points: Array
    corrections: Array

    def residual(self, **changed: Any) -> Array:
        """Return the residuals with some variables of the state, the points or the corrections replaced."""
        points = changed.pop("points", self.points)
        corrections = Corrections.from_vector(changed.pop("corrections", self.corrections))
        return project(replace(self.state, corrections=corrections, **changed), self.observations, points).residual


@pytest.fixture
def problem() -> Problem:
    rng = np.random.default_rng(0)
    corrections = rng.normal(size=COMMON_PARAMETERS + PARAMETERS_PER_CAMERA * CAMERAS) * 0.01
    state = CalibrationState(
        R_world_imu=exp_so3(0.1 * rng.normal(size=(K, 3))),
        p_world_imu=0.3 * rng.normal(size=(K, 3)),
        v_world_imu=rng.normal(size=(K, 3)),
        rates_rad_s=rng.normal(size=(K, 3)),
        time_offsets_s=np.array([0.0, 0.002, 0.005]),
        Ts_imu_cam=pose_matrix(exp_so3(0.1 * rng.normal(size=(CAMERAS, 3))), 0.1 * rng.normal(size=(CAMERAS, 3))),
        models=MODELS,
        corrections=Corrections.from_vector(corrections),
    )
    points = np.column_stack([rng.uniform(-1.0, 1.0, (L, 2)), rng.uniform(4.0, 8.0, L)])
    landmark, keyframe, camera = (x.ravel() for x in np.meshgrid(range(L), range(K), range(CAMERAS), indexing="ij"))
    observations = CalibrationObservations(keyframe, camera, landmark, np.zeros((len(landmark), 2)))
    image = -project(state, observations, points).residual.T  # the observed coordinates are on the axis, 0 in the image
    xy = np.where(camera[:, None] == 0, *(model.undistort(image) for model in MODELS))
    exact = replace(observations, xy=xy)
    return Problem(state, exact, points, corrections)


def test_camera_poses_and_intrinsics_agree_with_the_projection(problem: Problem) -> None:
    """Exact observations are triangulated to the landmarks that were projected."""
    R, p = camera_poses(problem.state, problem.observations)
    found = triangulate(problem.observations.starts, R, p, corrected_xy(problem.state, problem.observations))
    np.testing.assert_allclose(found.points, problem.points, atol=1e-3)
    assert found.rms.max() < 1e-6


def test_jacobian_by_poses(problem: Problem) -> None:
    J = project(problem.state, problem.observations, problem.points).J_pose
    for i, step in enumerate(H * np.eye(6)):
        ahead, behind = (
            problem.residual(
                R_world_imu=problem.state.R_world_imu @ exp_so3(sign * step[:3]),
                p_world_imu=problem.state.p_world_imu + sign * step[3:],
            )
            for sign in (1.0, -1.0)
        )
        np.testing.assert_allclose(J[:, i], (behind - ahead) / (2.0 * H), atol=1e-7)


def test_jacobian_by_landmarks(problem: Problem) -> None:
    J = project(problem.state, problem.observations, problem.points).J_point
    for i, step in enumerate(H * np.eye(3)):
        ahead, behind = (problem.residual(points=problem.points + sign * step) for sign in (1.0, -1.0))
        np.testing.assert_allclose(J[:, i], (behind - ahead) / (2.0 * H), atol=1e-7)


def without_rotations(corrections: Array) -> Array:
    """Return a vector of corrections without rotations, at which corrections by addition and on the right agree."""
    cameras = corrections[COMMON_PARAMETERS:].reshape(CAMERAS, PARAMETERS_PER_CAMERA).copy()
    cameras[:, :3] = 0.0
    return np.concatenate([corrections[:COMMON_PARAMETERS], cameras.ravel()])


def test_jacobian_by_extrinsics_and_intrinsics(problem: Problem) -> None:
    corrections = without_rotations(problem.corrections)
    state = replace(problem.state, corrections=Corrections.from_vector(corrections))
    J = project(state, problem.observations, problem.points).J_corrections
    for i in range(1, len(corrections)):
        step = H * np.eye(len(corrections))[i]
        ahead, behind = (problem.residual(corrections=corrections + sign * step) for sign in (1.0, -1.0))
        np.testing.assert_allclose(J[:, i], (behind - ahead) / (2.0 * H), atol=1e-7)


def test_a_principal_point_is_seen_as_a_rotation(problem: Problem) -> None:
    """Both together change no image near the axis, and neither do they change the view."""
    size, one = COMMON_PARAMETERS + PARAMETERS_PER_CAMERA, np.zeros(len(problem.observations.xy), np.int64)
    observations = replace(problem.observations, camera=one)
    Ts, models = problem.state.Ts_imu_cam[:1], MODELS[:1]
    state = replace(problem.state, time_offsets_s=np.zeros(K), Ts_imu_cam=Ts, models=models)
    on_axis = np.array([[0.0, 0.0, 5.0]]) @ (state.R_world_imu[0] @ state.Ts_imu_cam[0, :3, :3]).T
    points = np.tile(state.p_world_imu[0] + on_axis + state.Ts_imu_cam[0, :3, 3], (L, 1))
    x = np.zeros(size)
    x[COMMON_PARAMETERS : COMMON_PARAMETERS + 2] = 1e-4, -2e-4
    x[COMMON_PARAMETERS + 7 : COMMON_PARAMETERS + 9] = -2e-4, -1e-4
    np.testing.assert_allclose(seen_errors(size) @ x, np.zeros(6), atol=1e-12)
    first = observations.keyframe == 0
    images = [
        project(replace(state, corrections=Corrections.from_vector(vector)), observations, points).residual[:, first]
        for vector in (np.zeros(size), x, np.abs(x))
    ]
    assert np.abs(images[1] - images[0]).max() < 1e-5 < 1e-4 < np.abs(images[2] - images[0]).max()


@pytest.mark.parametrize(("delay_s", "tolerance"), [(0.0, 1e-6), (0.01, 0.05)])
def test_jacobian_by_the_time_offset(problem: Problem, delay_s: float, tolerance: float) -> None:
    """Exact where the observations contain the correction, and of first order in the rotation within a delay."""
    time_offsets_s = np.full(K, problem.corrections[0] - delay_s)
    state = replace(problem.state, time_offsets_s=time_offsets_s)
    J = project(state, problem.observations, problem.points).J_corrections[:, 0]
    step = H * np.eye(len(problem.corrections))[0]
    ahead, behind = (
        problem.residual(time_offsets_s=time_offsets_s, corrections=problem.corrections + sign * step)
        for sign in (1.0, -1.0)
    )
    np.testing.assert_allclose(J, (behind - ahead) / (2.0 * H), atol=tolerance * np.abs(J).max())


def test_observations_of_some_landmarks_are_renumbered(problem: Problem) -> None:
    kept = np.array([True, False, True, False, True])
    found = problem.observations.of_landmarks(kept)
    rows = np.isin(problem.observations.landmark, [0, 2, 4])
    np.testing.assert_array_equal(found.landmark, np.repeat([0, 1, 2], K * CAMERAS))
    np.testing.assert_array_equal(found.xy, problem.observations.xy[rows])
    np.testing.assert_array_equal(found.starts, np.arange(3) * K * CAMERAS)
