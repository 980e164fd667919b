"""Projection of landmarks in the adjustment of a calibration, with its Jacobians.

A camera exposes at a time that differs from the time of its keyframe by an error of the time offset. Within this delay,
the IMU moves with constant velocity and angular velocity. The projection depends on the pose and velocity of the
keyframe, on the landmark and on the calibration.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dronevio.estimator.backend.triangulation import MIN_DEPTH_M
from dronevio.estimator.calibration.corrections import COMMON_PARAMETERS, PARAMETERS_PER_CAMERA, Corrections
from dronevio.estimator.intrinsics import image_coordinates, image_jacobians
from dronevio.models.arrays import Array, Integers
from dronevio.models.camera import CameraModel
from dronevio.models.rotation import exp_so3


@dataclass(frozen=True, eq=False)
class CalibrationObservations:
    """N observations of L landmarks in K keyframes, sorted by landmark."""

    keyframe: Integers
    """(N,) Indices of the keyframes."""
    camera: Integers
    """(N,) Indices of the cameras in the rig."""
    landmark: Integers
    """(N,) Indices of the landmarks, which are consecutive from 0 on."""
    xy: Array
    """(N, 2) Image coordinates, normalized by the calibration without corrections."""

    @property
    def starts(self) -> Integers:
        """(L,) Index of the first observation of each landmark."""
        return np.flatnonzero(np.diff(self.landmark, prepend=-1))

    def of_landmarks(self, kept: npt.NDArray[np.bool_]) -> "CalibrationObservations":
        """Return the observations of some landmarks (L,), with new indices of these."""
        rows, index = kept[self.landmark], np.cumsum(kept) - 1
        return CalibrationObservations(
            self.keyframe[rows], self.camera[rows], index[self.landmark[rows]], self.xy[rows]
        )


@dataclass(frozen=True, eq=False)
class CalibrationState:
    """The variables on which projections depend, beside the landmarks."""

    R_world_imu: Array
    """(K, 3, 3) Orientations of the keyframes."""
    p_world_imu: Array
    """(K, 3) Positions of the keyframes [m]."""
    v_world_imu: Array
    """(K, 3) Velocities of the keyframes in the world frame [m/s]."""
    rates_rad_s: Array
    """(K, 3) Angular velocities of the keyframes in the IMU frame, without bias; they are not estimated [rad/s]."""
    time_offsets_s: Array
    """(K,) Corrections of the time offset that the observations of each keyframe already contain [s]."""
    Ts_imu_cam: Array
    """(C, 4, 4) Poses of the cameras without corrections."""
    models: tuple[CameraModel, ...]
    """The C cameras without corrections."""
    corrections: Corrections
    """Corrections of the calibration."""


@dataclass(frozen=True, eq=False)
class Projection:
    """Residuals of N observations and the Jacobians of their projections.

    Components come first, so that the innermost loops of numpy go over the observations.
    """

    residual: Array
    """(2, N) Observed minus projected image coordinates, in focal lengths; see `image_coordinates`."""
    J_pose: Array
    """(2, 6, N) Jacobian by (δθ, δp) of the keyframe, δθ in the IMU frame and δp in the world frame."""
    J_point: Array
    """(2, 3, N) Jacobian by the landmark in the world frame."""
    J_corrections: Array
    """(2, 3 + 10 C, N) Jacobian by the vector of corrections."""


def camera_poses(state: CalibrationState, observations: CalibrationObservations) -> tuple[Array, Array]:
    """Return the orientation (N, 3, 3) and position (N, 3) [m] of the camera of each observation."""
    k, camera, c = observations.keyframe, observations.camera, state.corrections
    delay_s = (c.time_offset_s - state.time_offsets_s)[:, None]
    R_imu = (state.R_world_imu @ exp_so3(state.rates_rad_s * delay_s))[:, None]
    p_imu = (state.p_world_imu + state.v_world_imu * delay_s)[:, None]
    R_imu_cam = state.Ts_imu_cam[:, :3, :3] @ exp_so3(c.rotation_rad)
    p_imu_cam = state.Ts_imu_cam[:, :3, 3] + c.translation_m
    R, p = R_imu @ R_imu_cam, p_imu + (R_imu @ p_imu_cam[..., None])[..., 0]  # (K, C, 3, 3) and (K, C, 3)
    return R[k, camera], p[k, camera]


def corrected_xy(state: CalibrationState, observations: CalibrationObservations) -> Array:
    """Return the normalized image coordinates (N, 2) by the corrected intrinsics."""
    return state.corrections.intrinsics(state.models).corrected_xy(observations.xy, observations.camera)


def project(state: CalibrationState, observations: CalibrationObservations, points: Array) -> Projection:
    """Return the residuals and Jacobians of observations of landmarks (L, 3) in the world frame [m]."""
    k, camera, c = observations.keyframe, observations.camera, state.corrections
    delay_s = (c.time_offset_s - state.time_offsets_s)[:, None]
    R_world_imu, R_exposure_key = _each(state.R_world_imu, k), _each(exp_so3(-state.rates_rad_s * delay_s), k)
    at_exposure_m = _each(state.p_world_imu + state.v_world_imu * delay_s, k)
    # The landmark in the frame of the keyframe, of the IMU at the time of exposure, and of the camera
    p_key = np.einsum("jin,jn->in", R_world_imu, _each(points, observations.landmark) - at_exposure_m)
    p_imu = np.einsum("ijn,jn->in", R_exposure_key, p_key)
    R_imu_cam = _each(state.Ts_imu_cam[:, :3, :3] @ exp_so3(c.rotation_rad), camera)
    from_camera = p_imu - _each(state.Ts_imu_cam[:, :3, 3] + c.translation_m, camera)
    p_cam = np.einsum("jin,jn->in", R_imu_cam, from_camera)
    inverse_depth = 1.0 / np.maximum(p_cam[2], MIN_DEPTH_M)
    xy, focal = p_cam[:2] * inverse_depth, 1.0 + c.focal[camera, 0]
    observed, image, J_image, J_radial = _in_images(state, observations, xy)
    residual = observed - focal * image - c.principal[camera].T

    # By the landmark in each frame
    J_xy = J_image * (focal * inverse_depth)
    J_cam = np.concatenate([J_xy, -np.einsum("ikn,kn->in", J_xy, xy)[:, None]], axis=1)
    J_imu = np.einsum("rjn,ijn->rin", J_cam, R_imu_cam)
    J_key = np.einsum("rin,ijn->rjn", J_imu, R_exposure_key)
    J_point = np.einsum("rjn,ijn->rin", J_key, R_world_imu)
    J_pose = np.concatenate([_row_cross(J_key, p_key), -J_point], axis=1)  # aᵀ [p]× = (a × p)ᵀ

    # By the corrections; the velocity is not rotated by R_exposure_key
    J_corrections = np.zeros((2, COMMON_PARAMETERS + PARAMETERS_PER_CAMERA * len(state.Ts_imu_cam), len(k)))
    v_key = np.einsum("kji,kj->ki", state.R_world_imu, state.v_world_imu)
    dp_imu_dt = _row_cross(p_imu[None], _each(state.rates_rad_s, k))[0] - _each(v_key, k)
    J_corrections[:, 0] = np.einsum("rin,in->rn", J_imu, dp_imu_dt)
    J_camera = np.zeros((2, PARAMETERS_PER_CAMERA, len(k)))
    J_camera[:, 0:3], J_camera[:, 3:6], J_camera[:, 6] = _row_cross(J_cam, p_cam), -J_imu, image
    J_camera[0, 7] = J_camera[1, 8] = 1.0
    J_camera[:, 9] = focal * J_radial
    for index in range(len(state.Ts_imu_cam)):
        first = COMMON_PARAMETERS + PARAMETERS_PER_CAMERA * index
        J_corrections[:, first : first + PARAMETERS_PER_CAMERA] = J_camera * (camera == index)
    return Projection(residual, J_pose, J_point, J_corrections)


def _in_images(
    state: CalibrationState, observations: CalibrationObservations, xy: Array
) -> tuple[Array, Array, Array, Array]:
    """Return observed and projected image coordinates (2, N), and derivatives (2, 2, N), (2, N) of the latter.

    Args:
        state: The cameras and their corrections.
        observations: The observations.
        xy: (2, N) Projected normalized coordinates, by which, and by the coefficient of the lens, are the derivatives.
    """
    n = len(observations.camera)
    observed, image, J_image, J_radial = np.zeros((2, n)), np.zeros((2, n)), np.zeros((2, 2, n)), np.zeros((2, n))
    for c, model in enumerate(state.models):
        rows = np.flatnonzero(observations.camera == c)
        radial = float(state.corrections.radial[c, 0])
        observed[:, rows] = image_coordinates(model, observations.xy[rows]).T
        found, by_xy, by_radial = image_jacobians(model, xy[:, rows].T, radial)
        image[:, rows], J_image[:, :, rows], J_radial[:, rows] = found.T, np.moveaxis(by_xy, 0, -1), by_radial.T
    return observed, image, J_image, J_radial


def _each(values: Array, index: Integers) -> Array:
    """Return the values (M, ...) of indices (N,), components first: (..., N)."""
    return np.ascontiguousarray(np.moveaxis(values, 0, -1)).take(index, axis=-1)


def _row_cross(rows: Array, p: Array) -> Array:
    """Return the cross products (R, 3, N) of rows (R, 3, N) with vectors (3, N)."""
    product = np.empty(rows.shape)
    for axis, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
        product[:, axis] = rows[:, i] * p[j] - rows[:, j] * p[i]
    return product
