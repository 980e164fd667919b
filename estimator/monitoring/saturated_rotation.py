"""Rotation that a saturated gyroscope does not measure, from the innovation of the images.

A gyroscope whose range is exceeded shows a rate that is too small, by an amount that no model of its noise describes.
The innovation of a frame shows what is missing: the landmarks of the window are elsewhere in the image than the
prediction puts them. The missing rotation about the saturated axes is fitted to the innovation by weighted least
squares, with the position and the rotation about the other axes as further unknowns and their covariance as prior. It
is then added to the saturated readings, so that the prediction, and the preintegrated motion between keyframes, are
those of a gyroscope of sufficient range.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from dronevio.estimator.imu.buffer import Increments
from dronevio.estimator.monitoring.innovation import Innovation
from dronevio.models.arrays import Array

MIN_LANDMARKS = 8
"""Smallest number of landmarks from which the rotation is estimated."""
ITERATIONS = 3
"""Number of Gauss-Newton steps; the first leaves errors of the second order in the missing rotation."""
SIGMA_INFLATION = 5.0
"""Factor on the standard deviation of the estimated rotation. The same images constrain the window, which therefore
must not take the rotation for an independent measurement."""


def with_rotation_by_image(measured: Increments, innovation_of: Callable[[Increments], Innovation]) -> Increments:
    """Return increments with the rotation that a saturated gyroscope has not measured, if the image shows it.

    Args:
        measured: The increments since the frame before, as measured.
        innovation_of: Returns the innovation of the frame, if its state is predicted by some increments.
    """
    sigma_rad, increments = saturated_sigma_rad(measured), measured
    if not sigma_rad.any():
        return measured
    for _ in range(ITERATIONS):
        rotation = missing_rotation(innovation_of(increments), sigma_rad)
        if rotation is None:
            break
        increments = with_rotation(increments, measured, *rotation)
    return increments


def missing_rotation(innovation: Innovation, saturated_sigma_rad: Array) -> tuple[Array, Array] | None:
    """Return the rotation that is missing in a prediction, from its innovation.

    Args:
        innovation: The innovation of the frame.
        saturated_sigma_rad: (3,) Standard deviation of the predicted rotation about each axis of the IMU, due to
            saturation [rad]; zero about axes that were not saturated.

    Returns:
        The rotation vector (3,) in the IMU frame and its standard deviations (3,) [rad]; None with too few landmarks.
    """
    if len(innovation) < MIN_LANDMARKS:
        return None
    found = innovation.fit(innovation.uncertainty.rotation_variance + saturated_sigma_rad**2)
    return found.solution[:3], np.sqrt(np.diag(found.covariance)[:3])


def saturated_sigma_rad(increments: Increments) -> Array:
    """Return the standard deviation (3,) of the rotation over increments about each axis, due to saturation [rad]."""
    return np.asarray(increments.dt_s @ _gyro_excess(increments))


def with_rotation(increments: Increments, saturated: Increments, rotation_rad: Array, sigma_rad: Array) -> Increments:
    """Return increments with a rotation added to the readings of saturated axes.

    Args:
        increments: The increments.
        saturated: The same increments as measured; they tell which readings are saturated.
        rotation_rad: (3,) Rotation about the axes of the IMU [rad]; about axes without saturation it is not used.
        sigma_rad: (3,) Its standard deviation [rad].
    """
    excess = np.broadcast_to(saturated.excess_sigma, (len(saturated.dt_s), 6))
    is_saturated = _gyro_excess(saturated) > 0.0
    duration_s = increments.dt_s @ is_saturated
    per_s = np.where(duration_s > 0.0, 1.0 / np.maximum(duration_s, 1e-9), 0.0)
    gyro_sigma = np.where(is_saturated, np.minimum(excess[:, :3], SIGMA_INFLATION * sigma_rad * per_s), excess[:, :3])
    return replace(
        increments,
        gyro_rad_s=increments.gyro_rad_s + is_saturated * (rotation_rad * per_s),
        excess_sigma=np.hstack([gyro_sigma, excess[:, 3:]]),
    )


def _gyro_excess(increments: Increments) -> Array:
    """Return the standard deviations (N, 3) due to saturation of the gyroscope alone, and zero elsewhere [rad/s].

    Where the accelerometer errs as well, as in a gap, the position is not known well enough to tell the rotation.
    """
    excess = np.broadcast_to(increments.excess_sigma, (len(increments.dt_s), 6))
    return np.where(excess[:, 3:].any(axis=1, keepdims=True), 0.0, excess[:, :3])
