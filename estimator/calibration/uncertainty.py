"""The uncertainty of a state due to that of the calibration.

The smoother takes the calibration as known. An error of the time offset moves each pose along the motion, and an error
of the camera's rotation turns the displacement since the initialization. Both are added to the covariance of a
published state: by the prior before the first window of the online calibration, and then by what the windows leave
uncertain, and what they have found and is too small to be applied. If a window begins at rest, its parts count.
"""

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.rotation import skew
from dronevio.models.state import NavState


def calibration_covariance(
    state: NavState, displacement_m: Array, rate_rad_s: Array, time_offset_sigma_s: float, rotation_sigma_rad: float
) -> Array:
    """Return the covariance (15, 15) that errors of the calibration add to a state, in the order of `NavState`.

    Args:
        state: The state.
        displacement_m: (3,) Displacement in the world frame since the initialization [m].
        rate_rad_s: (3,) Angular velocity in the IMU frame [rad/s].
        time_offset_sigma_s: Standard deviation of the time offset [s].
        rotation_sigma_rad: Standard deviation of the rotation of the camera about each axis [rad].
    """
    J = np.zeros((15, 4))
    J[0:3, 0] = time_offset_sigma_s * rate_rad_s
    J[3:6, 0] = time_offset_sigma_s * state.velocity_m_s
    J[3:6, 1:] = rotation_sigma_rad * skew(displacement_m)
    J[6:9, 1:] = rotation_sigma_rad * skew(state.velocity_m_s)
    return np.asarray(J @ J.T)
