"""The uncertainty of a state due to that of the calibration.

The smoother takes the calibration as known. An error of the time offset moves each pose along the motion, an error of
the camera's rotation turns the displacement since the initialization, and one of the focal length scales it. They are
added to the covariance of a published state: by the prior before the first window of the online calibration, and then
by what the windows leave uncertain, and what they have found and is too small to be applied. If a window begins at
rest, its parts count.

A correction does not revise the position, which stays as uncertain as the calibration before has made it.
"""

from dataclasses import dataclass, field

import numpy as np

from dronevio.estimator.types import CalibrationSigmas
from dronevio.models.arrays import Array
from dronevio.models.state import NavState


@dataclass(frozen=True, eq=False)
class Origin:
    """Where the displacement begins that errors of the calibration in use have turned and scaled."""

    position_m: Array
    """(3,) Position at the initialization, or at the last correction [m]."""
    covariance: Array = field(default_factory=lambda: np.zeros((3, 3)))
    """(3, 3) Covariance of this position by the errors of the calibrations before [m²]."""

    def corrected(self, state: NavState, before: CalibrationSigmas) -> "Origin":
        """Return the origin after a correction at a state, with the standard deviations before it."""
        p = state.T_world_imu[:3, 3]
        return Origin(p, self.covariance + before.of_displacement(p - self.position_m))


def calibration_covariance(state: NavState, origin: Origin, rate_rad_s: Array, sigmas: CalibrationSigmas) -> Array:
    """Return the covariance (15, 15) that errors of the calibration add to a state, in the order of `NavState`.

    Args:
        state: The state.
        origin: Where its displacement begins.
        rate_rad_s: (3,) Angular velocity in the IMU frame [rad/s].
        sigmas: Standard deviations of the calibration in use.
    """
    v, J = state.velocity_m_s, np.zeros(15)
    J[0:3], J[3:6] = sigmas.time_offset_s * rate_rad_s, sigmas.time_offset_s * v
    P = np.outer(J, J)
    P[3:6, 3:6] += origin.covariance
    # Displacement and velocity are turned and scaled by the same errors
    displacement_m = state.T_world_imu[:3, 3] - origin.position_m
    J_camera = np.vstack([sigmas.jacobian(displacement_m), sigmas.jacobian(v)])
    P[3:9, 3:9] += J_camera @ J_camera.T
    return P
