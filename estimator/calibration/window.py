"""A window of keyframes for the adjustment of a calibration, and the selection of its landmarks."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import gtsam
import numpy as np

from dronevio.estimator.backend.triangulation import triangulate
from dronevio.estimator.calibration.corrections import Corrections
from dronevio.estimator.calibration.projection import (
    CalibrationObservations,
    CalibrationState,
    camera_poses,
    corrected_xy,
)
from dronevio.estimator.types import Calibration
from dronevio.models.arrays import Array, Integers
from dronevio.models.ranges import Range, Settings
from dronevio.models.state import NavState

MAX_LANDMARKS = 150
"""Largest number of landmarks of an adjustment. Those with the most observations are used."""


@dataclass(frozen=True, eq=False)
class WindowKeyframe:
    """A keyframe of the window."""

    state: NavState
    """State of the IMU by the smoother."""
    rate_rad_s: Array
    """(3,) Angular velocity in the IMU frame, without bias [rad/s]."""
    time_offset_s: float
    """Correction of the time offset that the observations already contain [s]."""
    gravity_m_s2: float
    """Magnitude of gravity of the preintegrated IMU [m/s²]."""
    preintegrated: gtsam.PreintegratedCombinedMeasurements | None
    """Preintegrated IMU since the keyframe before; not used of the first."""
    ids: Integers
    """(N,) Identities of the observed landmarks."""
    camera: Integers
    """(N,) Indices of the observing cameras in the rig."""
    xy: Array
    """(N, 2) Image coordinates, normalized by the calibration without corrections."""


@dataclass(frozen=True)
class AdjustmentConfig(Settings):
    """Settings of the bundle adjustment."""

    pixel_sigma: Annotated[float, Range(0.01, 100.0)] = 0.8
    """Standard deviation of an image observation [px]. It is large, because the errors of a track are correlated."""
    stationary_pixel_sigma: Annotated[float, Range(0.01, 100.0)] = 0.4
    """Standard deviation of an image observation in a window that begins at rest [px]. It is smaller, because the
    state at rest is better known and the tracks are shorter."""
    min_views: Annotated[int, Range(2, 100)] = 4
    """Smallest number of observations of a landmark."""
    min_parallax_deg: Annotated[float, Range(0.01, 90.0)] = 0.5
    """Smallest parallax of a landmark [°]."""
    max_reprojection_px: Annotated[float, Range(above=0.0)] = 15.0
    """Largest root mean square reprojection error of a landmark before the adjustment [px]."""
    iterations: Annotated[int, Range(1, 50)] = 12
    """Largest number of Gauss-Newton steps."""
    max_decrement: Annotated[float, Range(low=0.0)] = 0.2
    """Squared length of a step in standard deviations (Newton decrement), per unknown, below which it is the last one:
    the next step would be shorter than two standard deviations over all unknowns together."""
    orientation_sigma_rad: Annotated[float, Range(1e-5, 10.0)] = 0.1
    """Prior standard deviation of the first keyframe's orientation [rad]."""
    velocity_sigma_m_s: Annotated[float, Range(1e-5, 100.0)] = 0.5
    """Prior standard deviation of the first keyframe's velocity [m/s]."""
    gyro_bias_sigma_rad_s: Annotated[float, Range(1e-6, 10.0)] = 0.01
    """Prior standard deviation of the gyroscope bias [rad/s]. It is large, so that windows are nearly independent."""
    accel_bias_sigma_m_s2: Annotated[float, Range(1e-6, 100.0)] = 0.2
    """Prior standard deviation of the accelerometer bias [m/s²]. It is large, so that windows are nearly
    independent."""


def window_state(keyframes: Sequence[WindowKeyframe], given: Calibration, corrections: Corrections) -> CalibrationState:
    """Return the state of a window at the estimates of its keyframes.

    Args:
        keyframes: The keyframes in the order of time.
        given: The calibration without corrections.
        corrections: Corrections of the calibration.
    """
    return CalibrationState(
        np.stack([keyframe.state.T_world_imu[:3, :3] for keyframe in keyframes]),
        np.stack([keyframe.state.T_world_imu[:3, 3] for keyframe in keyframes]),
        np.stack([keyframe.state.velocity_m_s for keyframe in keyframes]),
        np.stack([keyframe.rate_rad_s for keyframe in keyframes]),
        np.array([keyframe.time_offset_s for keyframe in keyframes]),
        given.Ts_imu_cam,
        given.models,
        corrections,
    )


def window_observations(keyframes: Sequence[WindowKeyframe]) -> CalibrationObservations:
    """Return the observations of all keyframes, sorted by landmark."""
    ids = np.concatenate([keyframe.ids for keyframe in keyframes])
    camera = np.concatenate([keyframe.camera for keyframe in keyframes])
    xy = np.concatenate([keyframe.xy for keyframe in keyframes])
    index = np.repeat(np.arange(len(keyframes)), [len(keyframe.ids) for keyframe in keyframes])
    order = np.argsort(ids, kind="stable")
    landmark = np.unique(ids[order], return_inverse=True)[1]
    return CalibrationObservations(index[order], camera[order], landmark, xy[order])


def select_landmarks(
    state: CalibrationState, candidates: CalibrationObservations, focal_px: float, config: AdjustmentConfig
) -> tuple[CalibrationObservations, Array]:
    """Select the landmarks with enough observations, parallax and accuracy, and triangulate them.

    Args:
        state: State of the window.
        candidates: Observations of all landmarks.
        focal_px: Focal length [px].
        config: Settings.

    Returns:
        The observations of L landmarks, and their positions (L, 3) in the world frame [m].
    """
    counts = np.bincount(candidates.landmark)
    observations = candidates.of_landmarks(counts >= config.min_views)
    if not len(observations.landmark):
        return observations, np.zeros((0, 3))
    R, p = camera_poses(state, observations)
    landmarks = triangulate(observations.starts, R, p, corrected_xy(state, observations))
    is_accurate = landmarks.rms < config.max_reprojection_px / focal_px
    is_good = landmarks.in_front & (landmarks.parallax_rad > np.radians(config.min_parallax_deg)) & is_accurate
    counts = np.bincount(observations.landmark)
    descending = np.sort(counts[is_good])[::-1]
    if len(descending) > MAX_LANDMARKS:
        is_good &= counts >= descending[MAX_LANDMARKS - 1]
    return observations.of_landmarks(is_good), landmarks.points[is_good]
