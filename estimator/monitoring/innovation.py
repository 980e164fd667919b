"""Innovation: the differences between the image observations of a frame and their prediction, with its uncertainty.

The prediction propagates the newest keyframe's state by the IMU and projects the landmarks of the window, whose
positions are taken as exact.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from dronevio.estimator.backend.observations import track_sigma_scale
from dronevio.estimator.backend.reprojection import MEDIAN_CHI2_2DOF
from dronevio.estimator.backend.triangulation import MIN_DEPTH_M
from dronevio.estimator.optimization.linear_fit import LinearFit, median, robust_linear_fit
from dronevio.estimator.types import Calibration, Observations, common_rows
from dronevio.models.arrays import Array, Integers
from dronevio.models.state import NavState

UNKNOWN_INFORMATION = 1e-6
"""Information on an unknown of which nothing is known, in its unit: enough for a solution."""


@dataclass(frozen=True, eq=False)
class PredictionUncertainty:
    """Uncertainty of a predicted state and of image observations."""

    position_covariance: Array
    """(3, 3) Covariance of the position in the world frame since the newest keyframe [m²]."""
    rotation_variance: float
    """Variance of the orientation about each axis since the newest keyframe [rad²]."""
    image_variance_px2: float
    """Variance of the coordinates of an image observation whose patch is unchanged [px²]."""


@dataclass(frozen=True, eq=False)
class Innovation:
    """The innovation of the N landmarks that a frame observes."""

    rows: Integers
    """(N,) Rows of the landmarks among all that constrain the window."""
    residual_px: Array
    """(N, 2) Observed minus predicted image coordinates [px]."""
    in_imu: Array
    """(N, 3) Predicted positions of the landmarks in the IMU frame [m]."""
    J_imu: Array
    """(N, 2, 3) Derivatives of the image coordinates by these positions [px/m]."""
    R_world_imu: Array
    """(3, 3) Predicted orientation of the IMU."""
    focal_px: Array
    """(N,) Focal length of the observing camera [px]."""
    sigma_scale: Array
    """(N,) Standard deviation of the image noise of each observation relative to that of an unchanged patch."""
    uncertainty: PredictionUncertainty
    """Uncertainty of the prediction."""

    def __len__(self) -> int:
        """Return the number of landmarks."""
        return len(self.rows)

    @cached_property
    def noise_px2(self) -> Array:
        """(N,) Variance due to image noise and orientation, in each coordinate [px²]."""
        of_image = self.uncertainty.image_variance_px2 * self.sigma_scale**2
        return of_image + self.uncertainty.rotation_variance * self.focal_px**2

    @property
    def median_px(self) -> float:
        """Median length [px]; 0 without landmarks."""
        return median(np.hypot(*self.residual_px.T)) if len(self) else 0.0

    @property
    def nis(self) -> float:
        """Median of the normalized squares relative to its expectation (NIS); 0 without landmarks."""
        if not len(self):
            return 0.0
        J_u, J_v = self.J_imu[:, 0] @ self.R_world_imu.T, self.J_imu[:, 1] @ self.R_world_imu.T
        P = self.uncertainty.position_covariance
        a, b, d = ((J @ P * K).sum(axis=1) for J, K in ((J_u, J_u), (J_u, J_v), (J_v, J_v)))
        a, d = a + self.noise_px2, d + self.noise_px2  # S = (a b; b d), the innovation's covariance
        u, v = self.residual_px.T
        squares = (d * u * u - 2.0 * b * u * v + a * v * v) / (a * d - b * b)
        return median(squares) / MEDIAN_CHI2_2DOF

    def fit(self, rotation_variance: Array | float, derivatives: Array | None = None) -> LinearFit:
        """Return the errors of the predicted pose that explain the innovation, and further unknowns.

        Args:
            rotation_variance: (3,) or number, variance of the predicted rotation about the axes of the IMU [rad²].
            derivatives: (N, 2, m) Derivatives of the innovation by m unknowns of which nothing is known before [px].

        Returns:
            The rotation (3,) [rad] and the position (3,) in the IMU frame [m], then the further unknowns (m,).
        """
        J, (x, y, z), R = self.J_imu, self.in_imu.T, self.R_world_imu
        further = np.empty((len(self), 2, 0)) if derivatives is None else derivatives
        A = np.empty((len(self), 2, 6 + further.shape[2]))
        A[..., 0] = J[..., 1] * z[:, None] - J[..., 2] * y[:, None]
        A[..., 1] = J[..., 2] * x[:, None] - J[..., 0] * z[:, None]
        A[..., 2] = J[..., 0] * y[:, None] - J[..., 1] * x[:, None]
        A[..., 3:6], A[..., 6:] = -J, further
        prior = np.diag(np.full(A.shape[2], UNKNOWN_INFORMATION))
        prior[range(3), range(3)] = 1.0 / (rotation_variance + 1e-10)
        prior[3:6, 3:6] = np.linalg.inv(R.T @ self.uncertainty.position_covariance @ R + 1e-10 * np.eye(3))
        return robust_linear_fit(A, self.residual_px, self.uncertainty.image_variance_px2, prior)


def innovation(
    ids: Integers,
    points: Array,
    observations: Observations,
    predicted: NavState,
    uncertainty: PredictionUncertainty,
    calibration: Calibration,
) -> Innovation:
    """Return the innovation of a frame.

    Args:
        ids: (L,) Identities of the landmarks, in increasing order.
        points: (L, 3) Their positions in the world frame [m].
        observations: The features tracked into the frame.
        predicted: The state that the IMU predicts for the frame.
        uncertainty: Uncertainty of the prediction.
        calibration: The calibration in use.
    """
    rows, columns = common_rows(ids, observations.ids)
    camera, R, p = observations.camera[columns], predicted.T_world_imu[:3, :3], predicted.T_world_imu[:3, 3]
    Ts_imu_cam, focal_px = calibration.Ts_imu_cam[camera], calibration.focal_px[camera]
    in_imu = (points[rows] - p) @ R
    axes = np.swapaxes(Ts_imu_cam[:, :3, :3], 1, 2)  # rows: the camera axes in the IMU frame
    in_cam = (axes @ (in_imu - Ts_imu_cam[:, :3, 3])[:, :, None])[:, :, 0]
    z = np.maximum(in_cam[:, 2:], MIN_DEPTH_M)
    xy = in_cam[:, :2] / z
    residual_px = focal_px[:, None] * (observations.xy[columns] - xy)
    J_imu = (focal_px[:, None] / z)[:, :, None] * (axes[:, :2] - xy[:, :, None] * axes[:, 2:])
    sigma_scale = track_sigma_scale(observations)[columns]
    return Innovation(rows, residual_px, in_imu, J_imu, R, focal_px, sigma_scale, uncertainty)
