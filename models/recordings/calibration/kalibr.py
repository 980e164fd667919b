"""Calibration files of Kalibr: ``camchain.yaml`` for the cameras, ``imu.yaml`` for the IMU.

``T_cam_imu`` maps points of the IMU frame into the camera frame, ``T_cn_cnm1`` those of the previous camera frame, and
t_imu = t_cam + ``timeshift_cam_imu``. Format: Kalibr's wiki, "yaml formats" (Furgale, Rehder and Siegwart, IROS 2013).

Additional keys, which other readers ignore, preserve a rig without loss of precision: ``T_imu_cam`` (also used by
OpenVINS), ``rate_hz`` and ``readout_s`` of a camera, ``T_vehicle_imu``, ``sampling``, and the keys of
`dronevio.models.recordings.calibration.imu_fields`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import numpy as np
import numpy.typing as npt

from dronevio.models.camera import CameraModel
from dronevio.models.errors import InputError
from dronevio.models.imu import ImuModel, Sampling
from dronevio.models.recordings.calibration.euroc import LENS_NAMES
from dronevio.models.recordings.calibration.imu_fields import imu_fields_yaml, read_imu_fields
from dronevio.models.recordings.calibration.sensor_yaml import SensorYaml, yaml_text
from dronevio.models.recordings.calibration.yaml_document import read_yaml
from dronevio.models.recordings.files import as_input_error
from dronevio.models.rig import Rig, RigCamera
from dronevio.models.rotation import inverse_pose

Array = npt.NDArray[np.float64]

CAMCHAIN_FILE, IMU_FILE = "camchain.yaml", "imu.yaml"
"""File names in the documentation of Kalibr."""
CAMERA_TOPIC = "/cam{}/image_raw"
"""Topic of the images of a camera, as in EuRoC's bags."""
IMU_TOPIC = "/imu0"
"""Topic of the IMU samples, as in EuRoC's bags."""

_POSE_TOLERANCE = 1e-3  # largest difference of two specifications of the same pose [rad, m]
_TIME_OFFSET_TOLERANCE_S = 5e-4  # between synchronized cameras that were calibrated separately


@dataclass(frozen=True, eq=False)
class KalibrCalibration:
    """Content of Kalibr's files: cameras, an IMU or both."""

    paths: tuple[Path, ...]
    """Paths of the files."""
    cameras: tuple[RigCamera, ...]
    """Cameras of the files, possibly none."""
    topics: tuple[str, ...]
    """Image topic of each camera, empty if it is not specified."""
    time_offset_s: float
    """Time offset of the first camera: t_imu = t_cam + offset [s]; those of the others are relative to it."""
    imu: ImuModel | None
    """IMU of the files, None if there is none."""
    T_vehicle_imu: Array
    """(4, 4) Pose of the IMU in the vehicle frame, the identity if it is not specified."""
    sampling: Sampling
    """Sampling of the IMU."""

    def rig(self) -> Rig:
        """Return the rig of the cameras and the IMU.

        Raises:
            InputError: The files have no camera or no IMU.
        """
        if not self.cameras:
            raise InputError(self.paths[0], "no camera", "Kalibr's camchain.yaml: cam0 with intrinsics and T_cam_imu")
        if self.imu is None:
            raise InputError(
                self.paths[0],
                "no IMU",
                "Kalibr's imu.yaml as well, with the noise densities",
            )
        with as_input_error(self.paths[0]):
            return Rig(self.cameras, self.imu, self.T_vehicle_imu, self.time_offset_s)


def read_kalibr(path: Path, *more: Path) -> Rig:
    """Read a rig.

    Args:
        path: A file with cameras and IMU, a ``camchain.yaml`` with an ``imu.yaml`` in the same folder, or that folder.
        more: Further files, if cameras and IMU are in different folders.

    Raises:
        InputError: As `read_calibration`, or the cameras or the IMU are missing.
    """
    path = Path(path)
    chain = path / CAMCHAIN_FILE if path.is_dir() else path
    beside = chain.with_name(IMU_FILE)
    calibration = read_calibration([chain, *more])
    if calibration.imu is None and beside.exists():
        calibration = read_calibration([chain, *more, beside])
    return calibration.rig()


def read_calibration(paths: Sequence[Path], rate_hz: float = 20.0) -> KalibrCalibration:
    """Read the calibration of one or more files.

    Args:
        paths: The files in any order: cameras, IMU, or both in one file.
        rate_hz: Frame rate of cameras without ``rate_hz`` [Hz]; the files of Kalibr do not specify it.

    Raises:
        InputError: A file is missing or damaged, a field is missing, invalid or specified twice, or a camera model is
            not supported.
    """
    return calibration_of([read_yaml(Path(path)) for path in paths], rate_hz)


def calibration_of(files: Sequence[SensorYaml], rate_hz: float = 20.0) -> KalibrCalibration:
    """Return the calibration of parsed files; see `read_calibration`.

    Raises:
        InputError: As `read_calibration`.
    """
    paths = tuple(file.path for file in files)
    chain = _only([file for file in files if "cam0" in file.lines], "cameras")
    imu = _only([file for file in files if _imu_prefix(file) is not None], "an IMU")
    if chain is None and imu is None:
        raise InputError(
            paths[0], "neither cam0 nor IMU noise densities", "Kalibr's camchain.yaml or imu.yaml, or both in one"
        )
    cameras, topics, offsets = _read_chain(chain, rate_hz) if chain else ((), (), (0.0,))
    prefix = (imu and _imu_prefix(imu)) or ""
    pose = f"{prefix}T_vehicle_imu"
    return KalibrCalibration(
        paths=paths,
        cameras=cameras,
        topics=topics,
        time_offset_s=offsets[0],
        imu=read_imu_fields(imu, "name", "update_rate", prefix) if imu else None,
        T_vehicle_imu=imu.pose_of_rows(pose) if imu and pose in imu else np.eye(4),
        sampling=_sampling(imu, prefix) if imu else "point",
    )


def camchain_yaml(rig: Rig) -> str:
    """Return the text of a ``camchain.yaml`` for a rig, without loss of precision."""
    return "".join(_camera_yaml(rig, number) for number in range(len(rig.cameras)))


def imu_yaml(rig: Rig, sampling: Sampling = "point") -> str:
    """Return the text of an ``imu.yaml`` for a rig, without loss of precision."""
    fields = imu_fields_yaml(rig.imu, "name", "update_rate")
    kind = "" if sampling == "point" else f"sampling: {sampling}\n"
    return f"{fields}rostopic: {IMU_TOPIC}\n{kind}{rows_yaml('T_vehicle_imu', rig.T_vehicle_imu)}"


def rows_yaml(key: str, T: Array) -> str:
    """Return the lines of a matrix as a list of rows, without loss of precision."""
    return f"{key}:\n" + "".join(f"  - {yaml_text(tuple(row))}\n" for row in T.tolist())


def indented(text: str) -> str:
    """Return lines with the indentation of a nested map."""
    return "".join(f"  {line}\n" for line in text.splitlines())


def _camera_yaml(rig: Rig, number: int) -> str:
    """Return the part of a ``camchain.yaml`` for one camera."""
    camera = rig.cameras[number]
    m, T_cam_imu = camera.model, inverse_pose(camera.T_imu_cam)
    others = ", ".join(str(other) for other in range(len(rig.cameras)) if other != number)
    text = (
        "camera_model: pinhole\n"
        f"intrinsics: {yaml_text(tuple(map(float, (m.fx, m.fy, m.cx, m.cy))))}\n"
        f"distortion_model: {m.lens}\n"
        f"distortion_coeffs: {yaml_text(tuple(map(float, m.distortion)))}\n"
        f"resolution: [{m.width}, {m.height}]\n"
        f"{rows_yaml('T_cam_imu', T_cam_imu)}"
    )
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


def _only(files: list[SensorYaml], what: str) -> SensorYaml | None:
    """Return the only one of some files, None if there is none, or raise InputError if there are several."""
    if len(files) > 1:
        raise InputError(files[1].path, f"{what}, which {files[0].path} has as well", f"one file with {what}")
    return files[0] if files else None


def _imu_prefix(file: SensorYaml) -> str | None:
    """Return the prefix of the IMU keys of a file, None if it has no IMU."""
    if "imu0" in file.lines:
        return "imu0."
    return "" if any(key.startswith(("gyroscope_", "accelerometer_")) for key in file.lines) else None


def _sampling(yaml: SensorYaml, prefix: str) -> Sampling:
    """Return the sampling of the IMU, or raise InputError."""
    key = f"{prefix}sampling"
    if key not in yaml:
        return "point"
    if yaml.values[key] not in ("point", "increment"):
        raise yaml.error(key, "point or increment")
    return cast(Sampling, yaml.values[key])


def _read_chain(yaml: SensorYaml, rate_hz: float) -> tuple[tuple[RigCamera, ...], tuple[str, ...], tuple[float, ...]]:
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


def _read_camera(yaml: SensorYaml, cam: str, previous: list[RigCamera], rate_hz: float) -> RigCamera:
    """Return a camera of a ``camchain.yaml``, given the previous ones, or raise InputError."""
    if yaml.word(f"{cam}camera_model") != "pinhole":
        raise yaml.error(f"{cam}camera_model", "pinhole, the only supported model")
    lens = yaml.word(f"{cam}distortion_model")
    k: Sequence[float] = (0.0, 0.0, 0.0, 0.0)
    if lens != "none":
        if lens not in LENS_NAMES:
            raise yaml.error(f"{cam}distortion_model", f"one of none, {', '.join(LENS_NAMES)}")
        k = yaml.numbers(f"{cam}distortion_coeffs", 4)
    size = yaml.numbers(f"{cam}resolution", 2)
    if any(side < 1 or side != int(side) for side in size):
        raise yaml.error(f"{cam}resolution", "width and height in whole pixels")
    fx, fy, cx, cy = yaml.numbers(f"{cam}intrinsics", 4)
    if min(fx, fy) <= 0.0:
        raise yaml.error(f"{cam}intrinsics", "fu, fv, pu, pv with positive focal lengths")
    distortion = (k[0], k[1], k[2], k[3])
    with as_input_error(yaml.path):
        model = CameraModel(int(size[0]), int(size[1]), fx, fy, cx, cy, distortion, LENS_NAMES.get(lens, "radtan"))
    rate_hz = yaml.positive(f"{cam}rate_hz") if f"{cam}rate_hz" in yaml else rate_hz
    readout_s = yaml.number(f"{cam}readout_s") if f"{cam}readout_s" in yaml else 0.0
    with as_input_error(yaml.path):
        return RigCamera(model, _T_imu_cam(yaml, cam, previous), rate_hz, readout_s)


def _T_imu_cam(yaml: SensorYaml, cam: str, previous: list[RigCamera]) -> Array:
    """Return the pose (4, 4) of a camera in the IMU frame, or raise InputError."""
    poses: dict[str, Array] = {}
    if f"{cam}T_imu_cam" in yaml:
        poses[f"{cam}T_imu_cam"] = yaml.pose_of_rows(f"{cam}T_imu_cam")
    if f"{cam}T_cam_imu" in yaml:
        poses[f"{cam}T_cam_imu"] = inverse_pose(yaml.pose_of_rows(f"{cam}T_cam_imu"))
    if f"{cam}T_cn_cnm1" in yaml and previous:
        poses[f"{cam}T_cn_cnm1"] = previous[-1].T_imu_cam @ inverse_pose(yaml.pose_of_rows(f"{cam}T_cn_cnm1"))
    if not poses:
        raise yaml.error(
            f"{cam}T_cam_imu", "the pose of the IMU in the camera frame, a result of kalibr_calibrate_imu_camera"
        )
    first = next(iter(poses))
    for key, T in poses.items():
        if np.abs(T - poses[first]).max() > _POSE_TOLERANCE:
            raise yaml.error(key, f"a pose that agrees with {first}")
    return poses[first]
