"""The rig: which cameras and IMU the drone carries, and where."""

from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from dronevio.models.camera import CameraModel
from dronevio.models.imu import EUROC_IMU, ImuModel

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class RigCamera:
    """One camera on the rig."""

    model: CameraModel
    """Projection and image size."""
    T_imu_cam: Array
    """(4, 4) Pose of the camera (x right, y down, z forward) in the IMU frame."""
    rate_hz: float = 20.0
    """Frame rate [Hz]."""
    readout_s: float = 0.0
    """Time from the first row's middle of exposure to the last row's [s]: 0 for a global shutter. A frame is stamped at
    the middle of the exposure of its middle row."""


@dataclass(frozen=True, eq=False)
class Rig:
    """The calibration of a drone's sensors."""

    cameras: tuple[RigCamera, ...]
    """The cameras, the first of them the main one."""
    imu: ImuModel = EUROC_IMU
    """The IMU's rate and noise."""
    T_vehicle_imu: Array = field(default_factory=lambda: np.eye(4))
    """(4, 4) Pose of the IMU in the vehicle frame (x forward, y left, z up, at the centre of mass)."""
    time_offset_s: float = 0.0
    """t_imu = t_cam + offset [s]."""


EUROC_CAM0 = CameraModel(
    width=752,
    height=480,
    fx=458.654,
    fy=457.296,
    cx=367.215,
    cy=248.375,
    distortion=(-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05),
)
"""EuRoC's left camera (``cam0/sensor.yaml`` of the data set)."""

EUROC_T_IMU_CAM0 = np.array(
    [
        [0.0148655429818, -0.999880929698, 0.00414029679422, -0.0216401454975],
        [0.999557249008, 0.0149672133247, 0.025715529948, -0.064676986768],
        [-0.0257744366974, 0.00375618835797, 0.999660727178, 0.00981073058949],
        [0.0, 0.0, 0.0, 1.0],
    ]
)
"""Pose of EuRoC's left camera in its IMU frame, which has x up and z forward."""


def euroc_rig() -> Rig:
    """Return EuRoC's monocular rig, mounted 7 cm ahead of the vehicle's centre of mass and looking forward.

    The IMU's x axis points up, y to the right, z forward, as on the data set's drone: an estimator must not assume
    that its IMU's z axis is the vehicle's.
    """
    T_vehicle_imu = np.eye(4)
    T_vehicle_imu[:3, :3] = np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])
    T_vehicle_imu[:3, 3] = [0.07, 0.0, 0.02]
    return Rig(cameras=(RigCamera(EUROC_CAM0, EUROC_T_IMU_CAM0),), T_vehicle_imu=T_vehicle_imu)
