"""Resection: the pose of a new keyframe from the landmarks that it observes.

The window is linearized where the images put its newest keyframe, not where the IMU predicts it. One Gauss-Newton step
of the whole window is then enough in most cases. The landmarks are taken as exact and the prediction is the prior, as
in the motion-only bundle adjustment of Mur-Artal and Tardós ("ORB-SLAM2", T-RO 2017).
"""

import gtsam
import numpy as np

from dronevio.estimator.backend.innovation import PredictionUncertainty, innovation
from dronevio.estimator.backend.landmarks import LandmarkDatabase
from dronevio.estimator.types import Calibration, Observations
from dronevio.models.arrays import Array
from dronevio.models.state import NavState

MAX_SIGMAS = 6.0
"""Length of the step from the prediction to the images, in standard deviations of the prediction, beyond which they
contradict each other. The prediction remains then, so that the window shows the contradiction (`jolts`)."""
MIN_LANDMARKS = 8
"""Smallest number of landmarks that determine the pose; with fewer, the prediction remains."""


def resected_pose(
    predicted: gtsam.Pose3,
    last: NavState,
    preintegrated: gtsam.PreintegratedCombinedMeasurements,
    landmarks: LandmarkDatabase,
    observations: Observations,
    calibration: Calibration,
    image_sigma: float,
) -> gtsam.Pose3:
    """Return the pose of a keyframe that agrees best with its observations and with its prediction by the IMU.

    Args:
        predicted: The predicted pose, `T_world_imu`.
        last: The state of the keyframe before, from which it is predicted.
        preintegrated: The IMU between the two.
        landmarks: The landmarks of the window.
        observations: The features of the keyframe.
        calibration: The calibration in use.
        image_sigma: Standard deviation of an image observation whose patch is unchanged, in normalized coordinates.
    """
    # Uncertainty of the prediction: leading terms over some tenths of a second, as of the innovations
    t, noise, P = preintegrated.deltaTij(), preintegrated.preintMeasCov(), last.covariance
    P = np.zeros((15, 15)) if P is None else P
    R_world_last = last.T_world_imu[:3, :3]
    of_position = R_world_last @ noise[3:6, 3:6] @ R_world_last.T + t**2 * P[6:9, 6:9] + 0.25 * t**4 * P[12:, 12:]
    of_rotation = np.diag(noise)[:3] + t**2 * np.diag(P)[9:12]
    image_variance_px2 = float((image_sigma * calibration.focal_px[0]) ** 2)
    # Robust fit of rotation and displacement to the innovation
    found = innovation(
        landmarks.ids,
        landmarks.points,
        observations,
        predicted.matrix(),
        PredictionUncertainty(of_position, 0.0, image_variance_px2),
        calibration,
    )
    if len(found) < MIN_LANDMARKS:
        return predicted
    step: Array = found.fit(of_rotation).solution
    # Squared length of the step in standard deviations of the prediction
    moved_m = predicted.rotation().matrix() @ step[3:]
    squared = float((step[:3] ** 2 / (of_rotation + 1e-12)).sum())
    squared += float(moved_m @ np.linalg.solve(of_position + 1e-12 * np.eye(3), moved_m))
    return predicted.retract(step) if squared < MAX_SIGMAS**2 else predicted
