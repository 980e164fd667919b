"""Sensor rig: cameras and IMU of a drone with their calibration."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, TypeAlias

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError
from dronevio.models.imu import EUROC_IMU, ImuModel
from dronevio.models.ranges import Range, Settings, require

Cameras: TypeAlias = Sequence[int | str] | str | int | None
"""Cameras to use: indices or names ``cam0``, ``cam1``, ...; a largest number, from the first on; or None for all."""

MAX_CAMERAS = 16
"""Largest number of cameras of a rig in files."""

_ORTHONORMAL = 1e-4  # published extrinsics have as few as 5 digits


@dataclass(frozen=True, eq=False)
class RigCamera(Settings):
    """A camera of a rig."""

    model: CameraModel
    """Intrinsics of the camera."""
    T_imu_cam: Array
    """(4, 4) Pose of the camera in the IMU frame; x right, y down, z forward."""
    rate_hz: Annotated[float, Range(above=0.0, high=1e4)] = 20.0
    """Frame rate [Hz]."""
    readout_s: Annotated[float, Range(0.0, 1.0)] = 0.0
    """Time from the middle of the exposure of the first row to that of the last row, 0 for a global shutter [s]. The
    time stamp of a frame is the middle of the exposure of its middle row."""
    time_offset_s: Annotated[float, Range(-1.0, 1.0)] = 0.0
    """How much later this camera is exposed than the time stamp of its image and `Rig.time_offset_s` state [s]; for
    cameras whose time offsets differ."""

    def __post_init__(self) -> None:
        """Check pose, rate and readout time.

        Raises:
            ConfigError: A field has an invalid value; the message names both.
        """
        super().__post_init__()
        _require_rigid("T_imu_cam", self.T_imu_cam)
        frame_s = 1.0 / self.rate_hz
        require(self, self.readout_s <= frame_s, "readout_s", f"0 to {frame_s:g} s, the time between frames")


@dataclass(frozen=True, eq=False)
class Rig(Settings):
    """The sensors of a drone with their calibration."""

    cameras: tuple[RigCamera, ...]
    """Cameras of the rig, of which the first is the main camera."""
    imu: ImuModel = EUROC_IMU
    """Rate and error model of the IMU."""
    T_vehicle_imu: Array = field(default_factory=lambda: np.eye(4))
    """(4, 4) Pose of the IMU in the vehicle frame; x forward, y left, z up, origin at the centre of mass."""
    time_offset_s: Annotated[float, Range(-1e6, 1e6)] = 0.0
    """Time offset of the cameras' clock: t_imu = t_cam + offset [s], to which that of each camera is added."""

    def __post_init__(self) -> None:
        """Check pose, time offset and frame rates.

        Raises:
            ConfigError: A field has an invalid value; the message names both.
        """
        super().__post_init__()
        _require_rigid("T_vehicle_imu", self.T_vehicle_imu)
        rates = [camera.rate_hz for camera in self.cameras]
        if len(set(rates)) > 1:
            raise ConfigError(
                f"cameras with rate_hz = {', '.join(map(str, rates))}; expected one rate for all images of a frame"
            )

    def with_cameras(self, indices: Sequence[int]) -> "Rig":
        """Return the rig with some of its cameras, of which the first is the main camera: time offsets refer to it."""
        chosen = [self.cameras[index] for index in indices]
        first_s = chosen[0].time_offset_s
        cameras = tuple(replace(camera, time_offset_s=camera.time_offset_s - first_s) for camera in chosen)
        return replace(self, cameras=cameras, time_offset_s=self.time_offset_s + first_s)


def camera_indices(cameras: Cameras, count: int) -> tuple[int, ...]:
    """Return the indices of the cameras to use.

    Args:
        cameras: Indices or names of cameras, the number of cameras to use at most, from the first on, or None for all.
        count: Number of cameras that there are.

    Raises:
        ConfigError: A camera does not exist or is chosen twice, or none is chosen.
    """
    if cameras is None or isinstance(cameras, int):
        if cameras is not None and cameras < 1:
            raise ConfigError(f"{cameras} cameras; expected 1 or more, or None for all")
        return tuple(range(count if cameras is None else min(cameras, count)))
    chosen = (cameras,) if isinstance(cameras, str) else cameras
    names = {name: index for index in range(count) for name in (str(index), f"cam{index}")}
    indices = tuple(names.get(str(camera), -1) for camera in chosen)
    if not indices or min(indices) < 0 or len(set(indices)) < len(indices):
        there = "cam0" if count == 1 else f"different ones of cam0 to cam{count - 1}, by index or name"
        raise ConfigError(f"cameras {', '.join(map(str, chosen)) or 'none'}; expected {there}")
    return indices


def _require_rigid(name: str, T: Array) -> None:
    """Raise ConfigError unless T is a rigid transform (4, 4)."""
    if np.shape(T) != (4, 4):
        raise ConfigError(f"rig {name} with shape {np.shape(T)}; expected (4, 4)")
    if not np.all(np.isfinite(T)):
        raise ConfigError(f"rig {name} = {_rows(T)}; expected finite numbers")
    R = T[:3, :3]
    determinant = float(np.linalg.det(R))
    if determinant <= 0.0 or not np.allclose(R @ R.T, np.eye(3), atol=_ORTHONORMAL):
        raise ConfigError(
            f"rig {name} = {_rows(T)}, whose rotation has the determinant {determinant:.4g}"
            f" and R Rᵀ off the identity by {np.abs(R @ R.T - np.eye(3)).max():.2g}; expected a rotation"
        )
    if not np.array_equal(T[3], [0.0, 0.0, 0.0, 1.0]):
        raise ConfigError(f"rig {name} with last row {T[3].tolist()}; expected [0, 0, 0, 1]")


def _rows(T: Array) -> str:
    """Return a matrix as text on one line."""
    return str([[float(f"{v:.4g}") for v in row] for row in np.asarray(T, dtype=np.float64).tolist()])


EUROC_CAM0 = CameraModel(
    width=752,
    height=480,
    fx=458.654,
    fy=457.296,
    cx=367.215,
    cy=248.375,
    distortion=(-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05),
)
"""Left camera of EuRoC (``cam0/sensor.yaml`` of the data set)."""

EUROC_T_IMU_CAM0 = np.array(
    [
        [0.0148655429818, -0.999880929698, 0.00414029679422, -0.0216401454975],
        [0.999557249008, 0.0149672133247, 0.025715529948, -0.064676986768],
        [-0.0257744366974, 0.00375618835797, 0.999660727178, 0.00981073058949],
        [0.0, 0.0, 0.0, 1.0],
    ]
)
"""(4, 4) Pose of EuRoC's left camera in the IMU frame, which has x up and z forward."""

EUROC_CAM1 = CameraModel(
    width=752,
    height=480,
    fx=457.587,
    fy=456.134,
    cx=379.999,
    cy=255.238,
    distortion=(-0.28368365, 0.07451284, -0.00010473, -3.55590700e-05),
)
"""Right camera of EuRoC (``cam1/sensor.yaml`` of the data set)."""

EUROC_T_IMU_CAM1 = np.array(
    [
        [0.0125552670891, -0.999755099723, 0.0182237714554, -0.0198435579556],
        [0.999598781151, 0.0130119051815, 0.0251588363115, 0.0453689425024],
        [-0.0253898008918, 0.0179005838253, 0.999517347078, 0.00786212447038],
        [0.0, 0.0, 0.0, 1.0],
    ]
)
"""(4, 4) Pose of EuRoC's right camera in the IMU frame, 11 cm from the left one."""


def euroc_rig() -> Rig:
    """Return EuRoC's monocular rig, mounted 7 cm in front of the centre of mass of the vehicle and facing forward.

    The IMU's x axis points up, y to the right and z forward, as on the drone of the data set. An estimator must not
    assume that the z axis of the IMU is vertical.
    """
    T_vehicle_imu = np.eye(4)
    T_vehicle_imu[:3, :3] = np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])
    T_vehicle_imu[:3, 3] = [0.07, 0.0, 0.02]
    return Rig(cameras=(RigCamera(EUROC_CAM0, EUROC_T_IMU_CAM0),), T_vehicle_imu=T_vehicle_imu)
