"""Transfer of a window to another calibration: its observations, and the uncertainty of what it has marginalized.

Observations of earlier keyframes stay of use after a correction of the calibration. Those of a corrected time offset
are moved along the path of the landmark in the image, as `ExposureCompensation` moves those of new frames. The marginal
prior cannot be computed again. Its keyframes get the error that the previous calibration has left in them: a common
rotation, common errors of velocity and biases, and the motion during the change of the time offset. Otherwise their
positions relative to each other and to landmarks stay, and with them the scale of the window.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from dronevio.estimator.backend.landmarks import LandmarkDatabase
from dronevio.estimator.backend.marginal_prior import STATE_DIM, KeyframeState, MarginalPrior
from dronevio.estimator.backend.observations import ObservationTable
from dronevio.estimator.types import Calibration
from dronevio.models.arrays import Array
from dronevio.models.rotation import cross


def recalibrated_observations(
    landmarks: LandmarkDatabase,
    states: Mapping[int, KeyframeState],
    rates_rad_s: Mapping[int, Array],
    before: Calibration,
    after: Calibration,
) -> ObservationTable:
    """Return the observations of a window by another calibration.

    Args:
        landmarks: Observations and landmarks by the previous calibration.
        states: States of the keyframes by their numbers.
        rates_rad_s: (3,) Angular velocities of keyframes in the IMU frame, bias removed [rad/s]. If the time offset
            changes, observations of other keyframes are left out.
        before: The previous calibration.
        after: The other one. Its lenses are those of the previous one.
    """
    table = landmarks.all_observations
    xy = after.corrected_xy(before.given_xy(table.xy, table.camera), table.camera)
    delay_s = after.time_offset_correction_s - before.time_offset_correction_s
    if delay_s:
        is_known = np.isin(table.keyframe, list(rates_rad_s))
        table, xy = table[is_known], xy[is_known]
        for k in np.unique(table.keyframe).tolist():
            of_k = table.keyframe == k
            flow = image_velocity(table[of_k], landmarks, states[k], rates_rad_s[k], before.Ts_imu_cam)
            xy[of_k] -= delay_s * flow
    return replace(table, xy=xy)


def image_velocity(
    observations: ObservationTable,
    landmarks: LandmarkDatabase,
    state: KeyframeState,
    rate_rad_s: Array,
    Ts_imu_cam: Array,
) -> Array:
    """Return the velocities (N, 2) of observed landmarks in normalized coordinates [1/s].

    Landmarks that are not triangulated have the median inverse depth of the others.

    Args:
        observations: N observations of one keyframe.
        landmarks: The triangulated landmarks.
        state: State of the keyframe.
        rate_rad_s: (3,) Its angular velocity in the IMU frame, bias removed [rad/s].
        Ts_imu_cam: (C, 4, 4) Poses of the cameras.
    """
    R_world_imu, T = state.pose.rotation().matrix(), Ts_imu_cam[observations.camera]
    R_imu_cam, p_imu_cam = T[:, :3, :3], T[:, :3, 3]
    velocity = np.einsum("nji,nj->ni", R_imu_cam, R_world_imu.T @ state.velocity + cross(rate_rad_s, p_imu_cam))
    rate = np.einsum("nji,j->ni", R_imu_cam, rate_rad_s)
    inverse_depth = np.full(len(observations), np.nan)
    known = np.isin(observations.landmark, landmarks.ids)
    points = landmarks.points[landmarks.rows(observations.landmark[known])]
    from_cam = (points - state.pose.translation()) @ R_world_imu - p_imu_cam[known]
    depth_m = np.einsum("ni,ni->n", R_imu_cam[known, :, 2], from_cam)
    inverse_depth[known] = np.where(depth_m > 0.0, 1.0 / np.where(depth_m > 0.0, depth_m, 1.0), np.nan)
    is_finite = np.isfinite(inverse_depth)
    inverse_depth[~is_finite] = np.median(inverse_depth[is_finite]) if is_finite.any() else 0.0
    rays = np.column_stack([observations.xy, np.ones(len(observations))])
    of_rays = -cross(rate, rays) - velocity * inverse_depth[:, None]
    return np.asarray(of_rays[:, :2] - rays[:, :2] * of_rays[:, 2:])


def with_calibration_error(
    prior: MarginalPrior, covariance: Array, rates_rad_s: Mapping[int, Array], delay_s: float
) -> MarginalPrior:
    """Return a prior with the error that a wrong calibration has left in it.

    Args:
        prior: The prior.
        covariance: (15, 15) Diagonal covariance of the error of a state, in the order of `NavState`. The part of the
            position is not used.
        rates_rad_s: (3,) Angular velocities of keyframes in the IMU frame, bias removed [rad/s].
        delay_s: Change of the time offset [s].
    """
    orientation, _, velocity, gyro_bias, accel_bias = np.sqrt(np.diag(covariance)).reshape(5, 3)
    J = np.zeros((len(prior.b), 13))
    for row, (k, state) in zip(range(0, len(prior.b), STATE_DIM), prior.states.items(), strict=False):
        R_imu_world = state.pose.rotation().matrix().T
        J[row : row + 3, 0:3] = R_imu_world * orientation
        J[row + 6 : row + 9, 3:6] = np.diag(velocity)
        J[row + 9 : row + 12, 6:9] = np.diag(accel_bias)
        J[row + 12 : row + 15, 9:12] = np.diag(gyro_bias)
        J[row : row + 3, 12] = delay_s * rates_rad_s.get(k, np.zeros(3))
        J[row + 3 : row + 6, 12] = delay_s * R_imu_world @ state.velocity
    return prior.with_common_error(J)
