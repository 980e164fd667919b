"""Calibration files of Kalibr: ``camchain.yaml`` for the cameras, ``imu.yaml`` for the IMU.

``T_cam_imu`` maps points of the IMU frame into the camera frame, ``T_cn_cnm1`` those of the previous camera frame, and
t_imu = t_cam + ``timeshift_cam_imu``. Format: Kalibr's wiki, "yaml formats" (Furgale, Rehder and Siegwart, IROS 2013).

Additional keys, which other readers ignore, preserve a rig without loss of precision: ``T_imu_cam`` (also used by
OpenVINS), ``rate_hz`` and ``readout_s`` of a camera, ``T_vehicle_imu``, ``sampling``, and the keys of
`dronevio.models.recordings.calibration.imu_fields`.
"""

from dataclasses import replace
from typing import cast

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.errors import InputError
from dronevio.models.imu import Sampling
from dronevio.models.recordings.calibration.calibration import Calibration
from dronevio.models.recordings.calibration.camera_fields import camera_model_yaml, read_camera_model
from dronevio.models.recordings.calibration.imu_fields import imu_fields_yaml, read_imu_fields
from dronevio.models.recordings.calibration.yaml_document import YamlDocument
from dronevio.models.recordings.calibration.yaml_text import indented, rows_yaml, yaml_text
from dronevio.models.recordings.files import as_input_error
from dronevio.models.rig import Rig, RigCamera
from dronevio.models.rotation import inverse_pose

CAMCHAIN_FILE, IMU_FILE = "camchain.yaml", "imu.yaml"
"""File names in the documentation of Kalibr."""
CAMERA_TOPIC = "/cam{}/image_raw"
"""Topic of the images of a camera, as in EuRoC's bags."""
IMU_TOPIC = "/imu0"
"""Topic of the IMU samples, as in EuRoC's bags."""

_COEFFICIENTS = "distortion_coeffs"
_POSE_TOLERANCE = 1e-3  # largest difference of two specifications of the same pose [rad, m]
_TIME_OFFSET_TOLERANCE_S = 5e-4  # between synchronized cameras that were calibrated separately


def kalibr_calibration(file: YamlDocument, rate_hz: float = 20.0) -> Calibration:
    """Return the calibration of a parsed file, which has cameras, an IMU or both.

    Args:
        file: The file.
        rate_hz: Frame rate of cameras without ``rate_hz`` [Hz], which Kalibr does not specify.

    Raises:
        InputError: A field is missing or invalid, or a camera model is not supported.
    """
    prefix = _imu_prefix(file)
    if "cam0" not in file.lines and prefix is None:
        raise InputError(
            file.path,
            "neither cam0 nor IMU noise densities",
            "Kalibr's camchain.yaml or imu.yaml, both in one, or Basalt's calibration.json",
        )
    cameras, topics, offsets = _read_chain(file, rate_hz) if "cam0" in file.lines else ((), (), (0.0,))
    pose = f"{prefix}T_vehicle_imu"
    return Calibration(
        paths=(file.path,),
        cameras=cameras,
        topics=topics,
        time_offset_s=offsets[0],
        imu=None if prefix is None else read_imu_fields(file, "name", "update_rate", prefix),
        T_vehicle_imu=file.pose_of_rows(pose) if pose in file else np.eye(4),
        sampling="point" if prefix is None else _sampling(file, prefix),
        is_mounted="cam0.T_imu_cam" in file or "cam0.T_cam_imu" in file,
    )


def camchain_yaml(rig: Rig) -> str:
    """Return the text of a ``camchain.yaml`` for a rig, without loss of precision."""
    return "".join(_camera_yaml(rig, number) for number in range(len(rig.cameras)))


def imu_yaml(rig: Rig, sampling: Sampling = "point") -> str:
    """Return the text of an ``imu.yaml`` for a rig, without loss of precision."""
    fields = imu_fields_yaml(rig.imu, "name", "update_rate")
    kind = "" if sampling == "point" else f"sampling: {sampling}\n"
    return f"{fields}rostopic: {IMU_TOPIC}\n{kind}{rows_yaml('T_vehicle_imu', rig.T_vehicle_imu)}"


def _camera_yaml(rig: Rig, number: int) -> str:
    """Return the part of a ``camchain.yaml`` for one camera."""
    camera = rig.cameras[number]
    T_cam_imu = inverse_pose(camera.T_imu_cam)
    others = ", ".join(str(other) for other in range(len(rig.cameras)) if other != number)
    text = f"{camera_model_yaml(camera.model, _COEFFICIENTS)}{rows_yaml('T_cam_imu', T_cam_imu)}"
    if number:
        text += rows_yaml("T_cn_cnm1", T_cam_imu @ rig.cameras[number - 1].T_imu_cam)
    text += (
        f"timeshift_cam_imu: {yaml_text(float(rig.time_offset_s + camera.time_offset_s))}\n"
        f"rostopic: {CAMERA_TOPIC.format(number)}\n"
        f"cam_overlaps: [{others}]\n"
        f"{rows_yaml('T_imu_cam', camera.T_imu_cam)}"
        f"rate_hz: {yaml_text(float(camera.rate_hz))}\n"
    )
    text += f"readout_s: {yaml_text(float(camera.readout_s))}\n" if camera.readout_s else ""
    return f"cam{number}:\n{indented(text)}"


def _imu_prefix(file: YamlDocument) -> str | None:
    """Return the prefix of the IMU keys of a file, None if it has no IMU."""
    if "imu0" in file.lines:
        return "imu0."
    return "" if any(key.startswith(("gyroscope_", "accelerometer_")) for key in file.lines) else None


def _sampling(yaml: YamlDocument, prefix: str) -> Sampling:
    """Return the sampling of the IMU, or raise InputError."""
    key = f"{prefix}sampling"
    if key not in yaml:
        return "point"
    if yaml.values[key] not in ("point", "increment"):
        raise yaml.error(key, "point or increment")
    return cast(Sampling, yaml.values[key])


def _read_chain(yaml: YamlDocument, rate_hz: float) -> tuple[tuple[RigCamera, ...], tuple[str, ...], tuple[float, ...]]:
    """Return the cameras of a ``camchain.yaml``, their topics and time offsets [s], or raise InputError."""
    cameras: list[RigCamera] = []
    while f"cam{len(cameras)}" in yaml.lines:
        cameras.append(_read_camera(yaml, f"cam{len(cameras)}.", cameras, rate_hz))
    names = [f"cam{number}." for number in range(len(cameras))]
    topics = tuple(yaml.word(f"{cam}rostopic") if f"{cam}rostopic" in yaml else "" for cam in names)
    shifts = [f"{cam}timeshift_cam_imu" for cam in names]
    offsets = tuple(yaml.number(key) if key in yaml else 0.0 for key in shifts)
    own = [round(offset_s - offsets[0], 12) for offset_s in offsets]
    with as_input_error(yaml.path):
        timed = tuple(
            replace(camera, time_offset_s=own_s) if abs(own_s) > _TIME_OFFSET_TOLERANCE_S else camera
            for camera, own_s in zip(cameras, own, strict=True)
        )
    return timed, topics, offsets


def _read_camera(yaml: YamlDocument, cam: str, previous: list[RigCamera], rate_hz: float) -> RigCamera:
    """Return a camera of a ``camchain.yaml``, given the previous ones, or raise InputError."""
    model = read_camera_model(yaml, _COEFFICIENTS, cam)
    rate_hz = yaml.positive(f"{cam}rate_hz") if f"{cam}rate_hz" in yaml else rate_hz
    readout_s = yaml.number(f"{cam}readout_s") if f"{cam}readout_s" in yaml else 0.0
    with as_input_error(yaml.path):
        return RigCamera(model, _T_imu_cam(yaml, cam, previous), rate_hz, readout_s)


def _T_imu_cam(yaml: YamlDocument, cam: str, previous: list[RigCamera]) -> Array:
    """Return the pose (4, 4) of a camera in the IMU frame, or raise InputError."""
    poses: dict[str, Array] = {}
    if f"{cam}T_imu_cam" in yaml:
        poses[f"{cam}T_imu_cam"] = yaml.pose_of_rows(f"{cam}T_imu_cam")
    if f"{cam}T_cam_imu" in yaml:
        poses[f"{cam}T_cam_imu"] = inverse_pose(yaml.pose_of_rows(f"{cam}T_cam_imu"))
    if f"{cam}T_cn_cnm1" in yaml and previous:
        poses[f"{cam}T_cn_cnm1"] = previous[-1].T_imu_cam @ inverse_pose(yaml.pose_of_rows(f"{cam}T_cn_cnm1"))
    if not poses and not previous:
        return np.eye(4)  # in the frame of the first camera, after kalibr_calibrate_cameras
    if not poses:
        raise yaml.error(f"{cam}T_cn_cnm1", "the pose of the previous camera, a result of kalibr_calibrate_cameras")
    first = next(iter(poses))
    for key, T in poses.items():
        if np.abs(T - poses[first]).max() > _POSE_TOLERANCE:
            raise yaml.error(key, f"a pose that agrees with {first}")
    return poses[first]
