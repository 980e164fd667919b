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
from dronevio.models.rotation import cross, exp_so3


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
    """Residuals of N observations and the Jacobians of their projections."""

    residual: Array
    """(N, 2) Observed minus projected coordinates, in which a focal length is a scale; see `lens_xy`."""
    J_pose: Array
    """(N, 2, 6) Jacobian by (δθ, δp) of the keyframe, δθ in the IMU frame and δp in the world frame."""
    J_point: Array
    """(N, 2, 3) Jacobian by the landmark in the world frame."""
    J_corrections: Array
    """(N, 2, 3 + 10 C) Jacobian by the vector of corrections."""


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
    R_world_imu, R_exposure_key = state.R_world_imu[k], exp_so3(-state.rates_rad_s * delay_s)[k]
    at_exposure_m = (state.p_world_imu + state.v_world_imu * delay_s)[k]
    # The landmark in the frame of the keyframe, of the IMU at the time of exposure, and of the camera
    p_key = np.einsum("nji,nj->ni", R_world_imu, points[observations.landmark] - at_exposure_m)
    p_imu = np.einsum("nij,nj->ni", R_exposure_key, p_key)
    R_cam_imu = np.swapaxes(state.Ts_imu_cam[:, :3, :3] @ exp_so3(c.rotation_rad), 1, 2)[camera]
    p_cam = np.einsum("nij,nj->ni", R_cam_imu, p_imu - (state.Ts_imu_cam[:, :3, 3] + c.translation_m)[camera])
    depth = np.maximum(p_cam[:, 2], MIN_DEPTH_M)
    xy, focal, radial = p_cam[:, :2] / depth[:, None], 1.0 + c.focal[camera], c.radial[camera]
    is_fisheye = state.is_fisheye[camera]
    lens = lens_xy(xy, is_fisheye)
    r2 = (lens * lens).sum(axis=1, keepdims=True)
    distorted = (1.0 + radial * r2) * lens
    residual = lens_xy(observations.xy, is_fisheye) - focal * distorted - c.principal[camera]

    J_lens = focal[:, :, None] * (2.0 * radial * lens)[:, :, None] * lens[:, None]  # by the lens coordinates
    J_lens[:, [0, 1], [0, 1]] += focal * (1.0 + radial * r2)
    J_xy = J_lens @ lens_jacobian(xy, is_fisheye)
    J_cam = np.concatenate([J_xy, -(J_xy @ xy[..., None])], axis=2) / depth[:, None, None]  # by p_cam
    J_imu = J_cam @ R_cam_imu
    J_key = J_imu @ R_exposure_key
    J_point = J_key @ np.swapaxes(R_world_imu, 1, 2)
    J_pose = np.concatenate([cross(J_key, p_key[:, None]), -J_point], axis=2)  # aᵀ [p]× = (a × p)ᵀ

    J_corrections = np.zeros((len(k), 2, COMMON_PARAMETERS + PARAMETERS_PER_CAMERA * len(state.Ts_imu_cam)))
    v_key = np.einsum("nji,nj->ni", state.R_world_imu, state.v_world_imu)  # not rotated by R_exposure_key
    dp_imu_dt = cross(p_imu, state.rates_rad_s[k]) - v_key[k]
    J_corrections[:, :, 0] = np.einsum("nij,nj->ni", J_imu, dp_imu_dt)
    J_camera = np.zeros((len(k), 2, PARAMETERS_PER_CAMERA))
    J_camera[:, :, 0:3], J_camera[:, :, 3:6] = cross(J_cam, p_cam[:, None]), -J_imu
    J_camera[:, :, 6] = distorted
    J_camera[:, 0, 7] = J_camera[:, 1, 8] = 1.0
    J_camera[:, :, 9] = focal * r2 * lens
    for index in range(len(state.Ts_imu_cam)):
        rows, first = np.flatnonzero(camera == index), COMMON_PARAMETERS + PARAMETERS_PER_CAMERA * index
        J_corrections[rows, :, first : first + PARAMETERS_PER_CAMERA] = J_camera[rows]
    return Projection(residual, J_pose, J_point, J_corrections)
