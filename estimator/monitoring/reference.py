"""The newest keyframe, which the frames after it are compared with, and the uncertainty of the prediction from it."""

import math
from dataclasses import dataclass

import numpy as np

from dronevio.estimator.backend.landmarks import TriangulatedLandmarks
from dronevio.estimator.monitoring.innovation import Innovation, PredictionUncertainty, innovation
from dronevio.estimator.types import Calibration, CalibrationSigmas, Observations
from dronevio.models.arrays import Array
from dronevio.models.state import NavState


@dataclass(frozen=True, eq=False)
class Reference:
    """The newest keyframe and its landmarks."""

    keyframe: NavState
    """State of the keyframe."""
    landmarks: TriangulatedLandmarks
    """The landmarks that constrain the window."""
    image_variance_px2: float
    """Variance of the coordinates of an image observation whose patch is unchanged [px²]."""
    gyro_noise_density: float
    """Noise density of the gyroscope [rad/s/√Hz]."""
    accel_noise_density: float
    """Noise density of the accelerometer [m/s²/√Hz]."""
    calibration: CalibrationSigmas
    """Standard deviations of the calibration in use."""

    def innovation(self, observations: Observations, predicted: NavState, calibration: Calibration) -> Innovation:
        """Return the innovation of a frame.

        Args:
            observations: The features tracked into the frame.
            predicted: The state that the IMU predicts for the frame from the keyframe.
            calibration: The calibration in use.
        """
        uncertainty = PredictionUncertainty(*self._prediction_covariance(predicted), self.image_variance_px2)
        ids, points = self.landmarks.ids, self.landmarks.points
        return innovation(ids, points, observations, predicted, uncertainty, calibration)

    def rotation_uncertainty_px(self, predicted: NavState, calibration: Calibration) -> float:
        """Return the effect of the rotation's uncertainty since the keyframe on the image [px]."""
        before, now = self.keyframe.covariance, predicted.covariance
        if before is None or now is None:
            return 0.0
        variance_before, variance = np.linalg.eigvalsh(np.stack([before[:3, :3], now[:3, :3]]))[:, -1].tolist()
        return float(calibration.focal_px[0]) * math.sqrt(max(variance - variance_before, 0.0))

    def _prediction_covariance(self, predicted: NavState) -> tuple[Array, float]:
        """Return the uncertainty of the prediction since the keyframe.

        These are the leading terms of `propagate_covariance` over some tenths of a second, and what the calibration
        adds: landmarks are where the camera has seen them, so that its errors turn and scale the motion since.

        Returns:
            The covariance (3, 3) of the position [m²] and the variance of the orientation about any axis [rad²].
        """
        t, P = (predicted.t_ns - self.keyframe.t_ns) * 1e-9, self.keyframe.covariance
        if P is None:
            return np.zeros((3, 3)), 0.0
        gyro_bias, accel_bias = float(np.trace(P[9:12, 9:12])) / 3.0, float(np.trace(P[12:, 12:])) / 3.0
        accel_variance = 0.25 * t**4 * accel_bias + self.accel_noise_density**2 * t**3 / 3.0
        before, now, sigmas = self.keyframe.T_world_imu, predicted.T_world_imu, self.calibration
        turned_rad2 = 3.0 - float((before[:3, :3] * now[:3, :3]).sum())  # 2 (1 - cos) of the angle
        return (
            t * t * P[6:9, 6:9] + accel_variance * np.eye(3) + sigmas.of_displacement(now[:3, 3] - before[:3, 3]),
            t * t * gyro_bias
            + t * self.gyro_noise_density**2
            + (sigmas.rotation_rad**2 + sigmas.focal**2) * turned_rad2,
        )
