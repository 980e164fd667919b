"""Calibration of Basalt, in JSON: that of the TUM-VI data set and of Basalt's own examples.

``T_imu_cam`` is the pose of a camera in the IMU frame, and t_imu = t_cam + ``cam_time_offset_ns``. The standard
deviations of the IMU are densities in continuous time. Not applied are the vignette, and ``calib_accel_bias`` and
``calib_gyro_bias``, whose constant part the odometry estimates. Format: V. Usenko et al., "Visual-inertial mapping with
non-linear factor recovery", RA-L 2020, and the files ``data/*_calib.json`` of its sources.
"""

import json
from collections.abc import Mapping

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError
from dronevio.models.imu import ImuModel
from dronevio.models.lenses.lens import LENSES, LensName
from dronevio.models.recordings.calibration.calibration import Calibration
from dronevio.models.recordings.calibration.yaml_document import YamlDocument
from dronevio.models.recordings.files import as_input_error
from dronevio.models.rig import Rig, RigCamera
from dronevio.models.rotation import matrix_from_quat_wxyz, pose_matrix, quat_wxyz_from_matrix

_ROOT = "value0"  # the name that Basalt's serialization gives to the document
_LENSES: Mapping[str, LensName] = {
    "pinhole": "radtan",
    "pinhole-radtan8": "radtan",
    "kb4": "equidistant",
    "ds": "ds",
    "eucm": "eucm",
    "ucm": "eucm",
    "fov": "fov",
}
_UNIT_TOLERANCE = 1e-3


def is_basalt(file: YamlDocument) -> bool:
    """Return whether a parsed file is a calibration of Basalt."""
    return f"{_ROOT}.T_imu_cam" in file.lines or f"{_ROOT}.intrinsics" in file.lines


def basalt_calibration(file: YamlDocument, rate_hz: float = 20.0) -> Calibration:
    """Return the calibration of a parsed file.

    Args:
        file: The file.
        rate_hz: Frame rate of the cameras, which the format does not specify [Hz].

    Raises:
        InputError: A field is missing or invalid, or a camera model is not supported.
    """
    sizes = file.values.get(f"{_ROOT}.resolution")
    number = 0
    cameras: list[RigCamera] = []
    while f"{_ROOT}.intrinsics.{number}.camera_type" in file.lines:
        if not isinstance(sizes, tuple) or number >= len(sizes):
            raise file.error(f"{_ROOT}.resolution", "width and height of each camera")
        model = _read_camera(file, f"{_ROOT}.intrinsics.{number}.", sizes[number])
        with as_input_error(file.path):
            cameras.append(RigCamera(model, _read_pose(file, f"{_ROOT}.T_imu_cam.{number}."), rate_hz))
        number += 1
    if not cameras:
        raise file.error(f"{_ROOT}.intrinsics", "a list of cameras with camera_type and intrinsics")
    offset = f"{_ROOT}.cam_time_offset_ns"
    return Calibration(
        paths=(file.path,),
        cameras=tuple(cameras),
        topics=("",) * len(cameras),
        time_offset_s=file.number(offset) / 1e9 if offset in file else 0.0,
        imu=_read_imu(file),
        T_vehicle_imu=np.eye(4),
        sampling="point",
    )


def basalt_json(rig: Rig) -> str:
    """Return the text of the calibration of a rig.

    Raises:
        ConfigError: Basalt has no such lens.
    """
    identity = _pose(np.eye(4))
    calibration = {
        "T_imu_cam": [_pose(camera.T_imu_cam) for camera in rig.cameras],
        "intrinsics": [_camera(camera.model) for camera in rig.cameras],
        "resolution": [[camera.model.width, camera.model.height] for camera in rig.cameras],
        "vignette": [],
        "calib_accel_bias": [0.0] * 9,
        "calib_gyro_bias": [0.0] * 12,
        "imu_update_rate": float(rig.imu.rate_hz),
        "accel_noise_std": [float(rig.imu.accel_noise_density)] * 3,
        "gyro_noise_std": [float(rig.imu.gyro_noise_density)] * 3,
        "accel_bias_std": [float(rig.imu.accel_random_walk)] * 3,
        "gyro_bias_std": [float(rig.imu.gyro_random_walk)] * 3,
        "T_mocap_world": identity,
        "T_imu_marker": identity,
        "mocap_time_offset_ns": 0,
        "mocap_to_imu_offset_ns": 0,
        "cam_time_offset_ns": round(rig.time_offset_s * 1e9),
    }
    return json.dumps({_ROOT: calibration}, indent=4) + "\n"


def _read_camera(file: YamlDocument, prefix: str, size: object) -> CameraModel:
    """Return a camera, or raise InputError."""
    name = file.word(f"{prefix}camera_type")
    if name not in _LENSES:
        raise file.error(f"{prefix}camera_type", f"one of {', '.join(_LENSES)}")
    lens = _LENSES[name]
    if not isinstance(size, tuple) or len(size) != 2 or not all(isinstance(n, float) and n == int(n) for n in size):
        raise file.error(f"{_ROOT}.resolution", "width and height in whole pixels")
    fx, fy, cx, cy = (file.number(f"{prefix}intrinsics.{key}") for key in ("fx", "fy", "cx", "cy"))
    if name == "pinhole":
        distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)
    elif name == "ucm":  # the unified model has no β
        distortion = file.number(f"{prefix}intrinsics.alpha"), 1.0
    else:
        distortion = tuple(file.number(f"{prefix}intrinsics.{key}") for key in LENSES[lens].COEFFICIENTS)
    with as_input_error(file.path):
        return CameraModel(int(size[0]), int(size[1]), fx, fy, cx, cy, distortion, lens)


def _read_pose(file: YamlDocument, prefix: str) -> Array:
    """Return a pose (4, 4), or raise InputError."""
    p = np.array([file.number(f"{prefix}{key}") for key in ("px", "py", "pz")])
    q = np.array([file.number(f"{prefix}{key}") for key in ("qw", "qx", "qy", "qz")])
    if not abs(np.linalg.norm(q) - 1.0) < _UNIT_TOLERANCE:
        raise file.error(f"{prefix}qw", "with qx, qy and qz a unit quaternion")
    return pose_matrix(matrix_from_quat_wxyz(q / np.linalg.norm(q)), p)


def _read_imu(file: YamlDocument) -> ImuModel:
    """Return the IMU, whose densities are the largest of the three axes, or raise InputError."""
    densities = {}
    for theirs, ours in (
        ("gyro_noise_std", "gyro_noise_density"),
        ("gyro_bias_std", "gyro_random_walk"),
        ("accel_noise_std", "accel_noise_density"),
        ("accel_bias_std", "accel_random_walk"),
    ):
        key = f"{_ROOT}.{theirs}"
        # Older files have one number for the three axes.
        value = file.number(key) if isinstance(file.values.get(key), float) else max(file.numbers(key, 3))
        if value <= 0.0:
            raise file.error(key, "positive numbers")
        densities[ours] = value
    with as_input_error(file.path):
        return ImuModel("imu0", file.positive(f"{_ROOT}.imu_update_rate"), **densities)


def _pose(T: Array) -> dict[str, float]:
    """Return a pose (4, 4) in the format of Basalt."""
    w, x, y, z = quat_wxyz_from_matrix(T[:3, :3]).tolist()
    px, py, pz = T[:3, 3].tolist()
    return {"px": px, "py": py, "pz": pz, "qx": x, "qy": y, "qz": z, "qw": w}


def _camera(m: CameraModel) -> dict[str, object]:
    """Return a camera in the format of Basalt, or raise ConfigError."""
    names = {"equidistant": "kb4", "radtan": "pinhole-radtan8", "ds": "ds", "eucm": "eucm"}
    if m.lens not in names:
        raise ConfigError(f"camera lens {m.lens}; expected one of {', '.join(names)} for Basalt")
    numbers = {"fx": float(m.fx), "fy": float(m.fy), "cx": float(m.cx), "cy": float(m.cy)}
    if m.lens == "radtan" and not any(m.distortion):
        return {"camera_type": "pinhole", "intrinsics": numbers}
    names_of = tuple(LENSES[m.lens].COEFFICIENTS)
    coefficients = (*map(float, m.distortion), *(len(names_of) - len(m.distortion)) * (0.0,))
    numbers |= dict(zip(names_of, coefficients, strict=True))
    if m.lens == "radtan":
        numbers["rpmax"] = 0.0  # no limit of the undistortion
    return {"camera_type": names[m.lens], "intrinsics": numbers}
