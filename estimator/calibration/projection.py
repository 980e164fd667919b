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
from dronevio.estimator.intrinsics import lens_jacobian, lens_xy
from dronevio.models.arrays import Array, Integers, Mask
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
    is_fisheye: Mask
    """(C,) Whether the lens of a camera is a fisheye."""
    corrections: Corrections
    """Corrections of the calibration."""


@dataclass(frozen=True, eq=False)
class Projection:
    """Residuals of N observations and the Jacobians of their projections.

    Components come first, so that the innermost loops of numpy go over the observations.
    """

    residual: Array
    """(2, N) Observed minus projected coordinates, in which a focal length is a scale; see `lens_xy`."""
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
    return state.corrections.intrinsics(state.is_fisheye).corrected_xy(observations.xy, observations.camera)


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
    xy, is_fisheye = p_cam[:2] * inverse_depth, state.is_fisheye[camera]
    focal, radial = 1.0 + c.focal[camera, 0], c.radial[camera, 0]
    lens = lens_xy(xy.T, is_fisheye).T
    r2 = lens[0] * lens[0] + lens[1] * lens[1]
    distorted = (1.0 + radial * r2) * lens
    residual = lens_xy(observations.xy, is_fisheye).T - focal * distorted - c.principal[camera].T

    # By the lens coordinates, and by the landmark in each frame
    J_lens = (2.0 * focal * radial * lens)[:, None] * lens
    J_lens[[0, 1], [0, 1]] += focal * (1.0 + radial * r2)
    J_xy = np.einsum("ijn,njk->ikn", J_lens, lens_jacobian(xy.T, is_fisheye)) * inverse_depth
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
    J_camera[:, 0:3], J_camera[:, 3:6], J_camera[:, 6] = _row_cross(J_cam, p_cam), -J_imu, distorted
    J_camera[0, 7] = J_camera[1, 8] = 1.0
    J_camera[:, 9] = focal * r2 * lens
    for index in range(len(state.Ts_imu_cam)):
        first = COMMON_PARAMETERS + PARAMETERS_PER_CAMERA * index
        J_corrections[:, first : first + PARAMETERS_PER_CAMERA] = J_camera * (camera == index)
    return Projection(residual, J_pose, J_point, J_corrections)


def _each(values: Array, index: Integers) -> Array:
    """Return the values (M, ...) of indices (N,), components first: (..., N)."""
    return np.ascontiguousarray(np.moveaxis(values, 0, -1)).take(index, axis=-1)


def _row_cross(rows: Array, p: Array) -> Array:
    """Return the cross products (R, 3, N) of rows (R, 3, N) with vectors (3, N)."""
    product = np.empty(rows.shape)
    for axis, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
        product[:, axis] = rows[:, i] * p[j] - rows[:, j] * p[i]
    return product
