"""Checks of measurements that are pushed into an estimator."""

import numpy as np

from dronevio.models.errors import ConfigError
from dronevio.models.imu import ImuSamples
from dronevio.models.rig import Rig
from dronevio.models.state import CameraFrame


def check_imu(samples: ImuSamples) -> None:
    """Check IMU samples.

    Raises:
        ConfigError: They are no `ImuSamples`, or a value is not finite.
    """
    if not isinstance(samples, ImuSamples):
        raise ConfigError(f"IMU samples of type {type(samples).__name__}; expected ImuSamples")
    for name, values in (("gyro_rad_s", samples.gyro_rad_s), ("accel_m_s2", samples.accel_m_s2)):
        if not np.isfinite(values).all():
            row = int(np.flatnonzero(~np.isfinite(values).all(axis=1))[0])
            raise ConfigError(
                f"IMU sample at {samples.t_ns[row]} ns with {name} = {values[row].tolist()}; expected finite numbers"
            )


def check_rig(rig: Rig) -> None:
    """Check a rig for an estimator that uses cameras.

    Raises:
        ConfigError: It is no `Rig`, or has no camera.
    """
    if not isinstance(rig, Rig):
        raise ConfigError(f"a rig of type {type(rig).__name__}; expected Rig")
    if not rig.cameras:
        raise ConfigError("a rig without cameras; expected at least one camera")


def check_image_count(frame: CameraFrame, rig: Rig) -> None:
    """Check the number of images of a frame.

    Raises:
        ConfigError: It is no `CameraFrame`, or has fewer or more images than the rig has cameras.
    """
    if not isinstance(frame, CameraFrame):
        raise ConfigError(f"a frame of type {type(frame).__name__}; expected CameraFrame")
    if len(frame.images) != len(rig.cameras):
        raise ConfigError(
            f"frame at {frame.t_ns} ns with {len(frame.images)} images; expected {len(rig.cameras)}, one for each"
            " camera of the rig, and NO_IMAGE for a camera without an image"
        )
