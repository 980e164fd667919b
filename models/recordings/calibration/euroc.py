"""Calibration files of an EuRoC folder: cameras, IMU and body.

As in the data set, the files have no first line ``%YAML:1.0``, which PyYAML refuses; files with it are read as well.
Lenses that the data set does not have are described as in Kalibr's files (`camera_fields`).

Fields of a `Rig` that the format does not include are written under additional keys, which other readers ignore:
``T_vehicle_imu`` (pose of the IMU in the vehicle frame) and ``time_offset_s`` (t_imu − t_cam) in ``body.yaml``,
``readout_s`` in the ``sensor.yaml`` of a camera with a rolling shutter, ``time_offset_s`` in that of a camera that is
exposed at another time than the first, and the keys of
`dronevio.models.recordings.calibration.imu_fields` in that of the IMU, with ``sampling`` if its samples are increments.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import cast

import numpy as np

from dronevio.models.errors import InputError
from dronevio.models.imu import UNKNOWN_IMU, ImuModel, Sampling
from dronevio.models.recordings.calibration.camera_fields import camera_model_yaml, read_camera_model
from dronevio.models.recordings.calibration.imu_fields import imu_fields_yaml, read_imu_fields
from dronevio.models.recordings.calibration.yaml_document import YamlDocument, read_yaml
from dronevio.models.recordings.calibration.yaml_text import pose_yaml, yaml_text
from dronevio.models.recordings.files import as_input_error
from dronevio.models.rig import Rig, RigCamera

_COEFFICIENTS = "distortion_coefficients"


def read_euroc_rig(mav0: Path, cameras: Sequence[int] = (0,)) -> Rig:
    """Read the calibration of the IMU, if there is one, and of cameras of the folder ``mav0``, by their indices.

    Raises:
        InputError: A file or field is missing or invalid, or a camera model is not supported.
    """
    body = read_yaml(mav0 / "body.yaml") if (mav0 / "body.yaml").exists() else YamlDocument(mav0, {}, {})
    with as_input_error(mav0):
        rig = Rig(
            cameras=tuple(_read_camera(read_yaml(mav0 / f"cam{i}" / "sensor.yaml")) for i in cameras),
            imu=_read_imu(read_yaml(mav0 / "imu0" / "sensor.yaml")) if (mav0 / "imu0").exists() else UNKNOWN_IMU,
            T_vehicle_imu=body.pose("T_vehicle_imu") if "T_vehicle_imu.data" in body else np.eye(4),
            time_offset_s=body.number("time_offset_s") if "time_offset_s" in body else 0.0,
        )
    return rig.with_cameras(range(len(cameras)))


def read_euroc_sampling(mav0: Path) -> Sampling:
    """Return the sampling of the IMU of the folder ``mav0``, ``point`` where none is stated.

    Raises:
        InputError: The file is missing or invalid.
    """
    if not (mav0 / "imu0").exists():
        return "point"
    yaml = read_yaml(mav0 / "imu0" / "sensor.yaml")
    if "sampling" not in yaml:
        return "point"
    if yaml.values["sampling"] not in ("point", "increment"):
        raise yaml.error("sampling", "point or increment")
    return cast(Sampling, yaml.values["sampling"])


def calibration_files(rig: Rig, sampling: Sampling = "point") -> dict[str, str]:
    """Return the texts of the calibration files of a rig by their paths below ``mav0``."""
    texts = {f"cam{i}/sensor.yaml": _camera_yaml(camera) for i, camera in enumerate(rig.cameras)}
    texts["imu0/sensor.yaml"] = _imu_yaml(rig.imu)
    if sampling == "increment":
        texts["imu0/sensor.yaml"] += "sampling: increment # means over the interval before the time stamp\n"
    texts["state_groundtruth_estimate0/sensor.yaml"] = (
        f"sensor_type: visual-inertial\ncomment: true motion of the body\n{pose_yaml('T_BS', np.eye(4))}"
    )
    texts["body.yaml"] = (
        "comment: the body frame is that of the IMU\n"
        "# pose of the IMU in the vehicle: x forward, y left, z up, at the centre of mass\n"
        f"{pose_yaml('T_vehicle_imu', rig.T_vehicle_imu)}"
        f"# t_imu = t_cam + offset\ntime_offset_s: {yaml_text(float(rig.time_offset_s))}\n"
    )
    return texts


def _read_camera(yaml: YamlDocument) -> RigCamera:
    """Return the camera of a ``sensor.yaml``, or raise InputError."""
    model = read_camera_model(yaml, _COEFFICIENTS)
    readout_s = yaml.number("readout_s") if "readout_s" in yaml else 0.0
    offset_s = yaml.number("time_offset_s") if "time_offset_s" in yaml else 0.0
    with as_input_error(yaml.path):
        return RigCamera(model, yaml.pose("T_BS"), yaml.positive("rate_hz"), readout_s, offset_s)


def _read_imu(yaml: YamlDocument) -> ImuModel:
    """Return the IMU of a ``sensor.yaml``, or raise InputError."""
    if "T_BS.data" in yaml and not np.array_equal(yaml.pose("T_BS"), np.eye(4)):
        raise yaml.error("T_BS.data", "the identity, because the body frame is that of the IMU")
    return read_imu_fields(yaml, "comment", "rate_hz")


def _camera_yaml(camera: RigCamera) -> str:
    """Return the ``sensor.yaml`` of a camera."""
    more = ""
    if camera.readout_s:
        more += f"readout_s: {yaml_text(float(camera.readout_s))} # first to last row\n"
    if camera.time_offset_s:
        more += f"time_offset_s: {yaml_text(float(camera.time_offset_s))} # of the exposure, beside that in body.yaml\n"
    return (
        "sensor_type: camera\ncomment: pixel centres are whole numbers\n\n"
        f"# pose of the camera (x right, y down, z forward) in the body frame\n{pose_yaml('T_BS', camera.T_imu_cam)}\n"
        f"rate_hz: {yaml_text(float(camera.rate_hz))}\n"
        f"{camera_model_yaml(camera.model, _COEFFICIENTS, 'radial-tangential')}{more}"
    )


def _imu_yaml(imu: ImuModel) -> str:
    """Return the ``sensor.yaml`` of an IMU."""
    fields = imu_fields_yaml(imu, "comment", "rate_hz")
    return f"sensor_type: imu\n{pose_yaml('T_BS', np.eye(4))}\n{fields}"


def count_cameras(mav0: Path) -> int:
    """Return the number of camera folders ``cam0``, ``cam1`` and so on, without a gap.

    Raises:
        InputError: There is no ``cam0``.
    """
    count = 0
    while (mav0 / f"cam{count}").is_dir():
        count += 1
    if count == 0:
        raise InputError(mav0, "no folder cam0", "an EuRoC recording with cam0 and imu0")
    return count
