"""Sensor rigs by name.

The rigs of EuRoC have the calibration of the data set. The others are mounted on a level IMU (x forward, y left, z up)
and face exactly forward, so that they differ in their lenses only.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from dronevio.models.camera import CameraModel
from dronevio.models.errors import unknown_name
from dronevio.models.imu import EUROC_IMU, ImuModel
from dronevio.models.imu_presets import BMI088
from dronevio.models.python_names import PREFIX, PythonName
from dronevio.models.rig import EUROC_CAM1, EUROC_T_IMU_CAM1, Rig, RigCamera, euroc_rig
from dronevio.models.rotation import pose_matrix

PINHOLE = CameraModel(width=752, height=480, fx=458.0, fy=458.0, cx=375.5, cy=239.5)
"""Pinhole camera with EuRoC's image size and rounded focal length, and the principal point at the image centre."""

UZH_FPV_CAMERA = CameraModel(
    width=640,
    height=480,
    fx=275.46015578667294,
    fy=274.9948095922592,
    cx=315.958384100568,
    cy=242.7123497822731,
    distortion=(-6.545154718304953e-06, -0.010379525898159981, 0.014935312423953146, -0.005639061406567785),
    lens="equidistant",
)
"""Fisheye camera with a field of view of 133° horizontally and 170° diagonally: the left Snapdragon camera of the
sequences ``indoor_45`` (Delmerico et al., "Are we ready for autonomous drone racing? The UZH-FPV drone racing dataset",
ICRA 2019; Kalibr calibration of the data set)."""

TUM_VI_CAMERA = CameraModel(
    width=512,
    height=512,
    fx=190.97847715128717,
    fy=190.9733070521226,
    cx=254.93170605935475,
    cy=256.8974428996504,
    distortion=(0.0034823894022493434, 0.0007150348452162257, -0.0020532361418706202, 0.00020293673591811182),
    lens="equidistant",
)
"""Fisheye camera with a field of view of 154° horizontally and 230° diagonally: the left camera of TUM-VI (Schubert et
al., "The TUM VI benchmark for evaluating visual-inertial odometry", IROS 2018; the calibration at 512 × 512)."""

NANO_CAMERA = CameraModel(
    width=324, height=244, fx=235.0, fy=235.0, cx=161.5, cy=121.5, distortion=(-0.1, 0.0, 0.0, 0.0)
)
"""Camera for a drone of 30 g, with the image size of the Himax HM01B0 on Bitcraze's AI-deck. The diagonal field of view
of 87° and the barrel distortion of 9 % at the corners are typical of such a module, not measured on one."""

_R_FORWARD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # camera facing along x, upright
_MOUNT_M = (0.07, 0.02)  # position in front of and above the centre of mass, as on EuRoC's drone
_WIDE_BASELINE_M = 0.11  # as on EuRoC's drone
_NARROW_BASELINE_M = 0.08  # about that of the Snapdragon Flight board of UZH-FPV
_ROLLING_READOUT_S = (
    0.030  # 1024 rows of 29.5 µs: Schubert et al., "Rolling-shutter modelling for direct VIO", IROS 2019
)
_NANO_READOUT_S = 0.0156  # HM01B0: 60 frames per second of 260 rows, 244 of them visible
_NANO_MOUNT_M = (0.02, 0.005)  # front edge of a board of 30 mm on top of the drone


def _forward(model: CameraModel, left_m: float = 0.0, rate_hz: float = 20.0, readout_s: float = 0.0) -> RigCamera:
    """Return a camera that faces along the x axis of a level IMU, ``left_m`` to the left of it [m]."""
    return RigCamera(model, pose_matrix(_R_FORWARD, np.array([0.0, left_m, 0.0])), rate_hz, readout_s)


def _level(*cameras: RigCamera, imu: ImuModel = EUROC_IMU, mount_m: tuple[float, float] = _MOUNT_M) -> Rig:
    """Return a rig with a level IMU, ``mount_m`` in front of and above the centre of mass [m]."""
    forward_m, up_m = mount_m
    return Rig(cameras, imu, T_vehicle_imu=pose_matrix(np.eye(3), np.array([forward_m, 0.0, up_m])))


def _pair(model: CameraModel, baseline_m: float, rate_hz: float = 20.0) -> Rig:
    """Return a rectified stereo rig, the left camera first."""
    return _level(_forward(model, 0.5 * baseline_m, rate_hz), _forward(model, -0.5 * baseline_m, rate_hz))


def _euroc_stereo() -> Rig:
    mono = euroc_rig()
    return replace(mono, cameras=(*mono.cameras, RigCamera(EUROC_CAM1, EUROC_T_IMU_CAM1)))


def _rolling() -> Rig:
    mono = euroc_rig()
    return replace(mono, cameras=(replace(mono.cameras[0], readout_s=_ROLLING_READOUT_S),))


@dataclass(frozen=True)
class PythonRig(PythonName):
    """Name of a rig in a module."""

    what: ClassVar[str] = "rig"


RIGS: dict[str, Callable[[], Rig]] = {
    "euroc": euroc_rig,
    "euroc-stereo": _euroc_stereo,
    "rolling": _rolling,
    "pinhole": lambda: _level(_forward(PINHOLE)),
    "pinhole-stereo": lambda: _pair(PINHOLE, _WIDE_BASELINE_M),
    "fisheye": lambda: _level(_forward(TUM_VI_CAMERA)),
    "fisheye-stereo": lambda: _pair(UZH_FPV_CAMERA, _NARROW_BASELINE_M, rate_hz=25.0),
    "nano": lambda: _level(_forward(NANO_CAMERA, readout_s=_NANO_READOUT_S), imu=BMI088, mount_m=_NANO_MOUNT_M),
}
"""Constructors of the rigs by name."""


def rig_named(name: str) -> Rig:
    """Return the rig with a given name.

    Args:
        name: One of `RIGS`: ``euroc`` (radtan, monocular, the default), ``euroc-stereo``, ``rolling`` (EuRoC's camera
            with a rolling shutter of 30 ms), ``pinhole``, ``pinhole-stereo`` (rectified, 11 cm baseline), ``fisheye``
            (154° horizontally, 230° diagonally), ``fisheye-stereo`` (133° and 170°, 8 cm baseline), ``nano``
            (324 × 244, rolling shutter, with the BMI088 of Bitcraze's Crazyflie); or ``python:package.module:NAME``,
            a `Rig` of your own.

    Raises:
        ConfigError: There is no rig with this name.
    """
    if name.startswith(PREFIX):
        return PythonRig.parse(name).instance_of(Rig)
    if name not in RIGS:
        raise unknown_name("rig", name, (*RIGS, f"{PREFIX}package.module:NAME"))
    return RIGS[name]()
