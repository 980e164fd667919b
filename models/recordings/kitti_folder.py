"""Recordings of KITTI: drives of the raw data, and sequences of the odometry benchmark.

A drive has images in ``image_00`` to ``image_03``, which are triggered together, and samples of an inertial navigation
system in ``oxts``; the calibration is in the folder of its date. Drives ``_sync`` are rectified and have one sample per
frame, at 10 Hz, which is too slow for odometry; ``_extract`` has 100 Hz and the images as they were taken. A sequence
has rectified images alone, without an IMU: its rig is in the frame of the first camera. Format: the development kits
of Geiger, Lenz, Stiller and Urtasun, "Vision meets robotics: the KITTI dataset", IJRR 2013.
"""

import calendar
import math
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.camera import CameraModel
from dronevio.models.errors import InputError
from dronevio.models.imu import UNKNOWN_IMU, ImuModel, Times
from dronevio.models.recordings.calibration.reading import read_calibration
from dronevio.models.recordings.files import as_input_error, read_bytes, read_text
from dronevio.models.recordings.folder_contents import FolderContents, rate_hz
from dronevio.models.recordings.image_header import header_of
from dronevio.models.recordings.image_list import ImageList
from dronevio.models.recordings.kitti import R_UP_KITTI, read_kitti, read_times_ns
from dronevio.models.recordings.timed_table import NUMBER, TableFormat, TimedTable, numbered_rows, parse_decimal_seconds
from dronevio.models.rig import Cameras, Rig, RigCamera, camera_indices
from dronevio.models.rotation import inverse_pose, matrix_from_quat_wxyz, pose_matrix, quat_wxyz_from_matrix
from dronevio.models.state import Trajectory

OXTS_TABLE = TableFormat("samples of KITTI's oxts", (7,), None, parse_decimal_seconds, "seconds")
"""Angular velocity and specific force of the samples, as a table."""

_PAIRS = ((0, 1), (2, 3))  # the grey cameras, which have the better images, and the colour cameras
_STAMP = re.compile(r"(\d{4})-(\d\d)-(\d\d) (\d\d):(\d\d):(\d\d)\.(\d{1,9})", re.ASCII)
_STAMPS = "KITTI time stamps: one per line, such as 2011-09-26 13:02:25.964389445"
_SAMPLE = "a sample of KITTI's oxts: 30 numbers between spaces"
_FIELDS = 30
_LAT, _LON, _ALT, _ROLL, _PITCH, _YAW = range(6)
_V_NORTH, _V_EAST, _V_UP = 6, 7, 10
_ACCEL, _GYRO = slice(11, 14), slice(17, 20)
_EARTH_M = 6378137.0  # as in the development kit
_MAX_LATITUDE = 89.0


def is_kitti_folder(path: Path) -> bool:
    """Return whether a path is a drive or a sequence of KITTI."""
    return any((path / f"image_{number:02d}" / "timestamps.txt").is_file() for number in range(4)) or (
        (path / "times.txt").is_file() and (path / "calib.txt").is_file()
    )


def read_kitti_contents(
    folder: Path,
    cameras: Cameras = None,
    calibration: Sequence[Path] = (),
    imu: ImuModel | None = None,
    for_odometry: bool = False,
) -> FolderContents:
    """Return the contents of a drive or a sequence: of the grey cameras, or the colour cameras without these.

    Args:
        folder: The folder.
        cameras: Cameras to use, of which ``cam0`` is the left one.
        calibration: Files of Kalibr with the noise of the IMU, which KITTI does not specify.
        imu: Model of the IMU. Without any, the noise of the rig is that of EuRoC's IMU.
        for_odometry: Whether an IMU and its noise are required.

    Raises:
        InputError: A file is missing or damaged; or, for odometry, there is no IMU or its noise is unknown.
        ConfigError: A camera does not exist.
    """
    is_drive = not (folder / "times.txt").is_file()
    name = "image_{:02d}" if is_drive else "image_{}"
    pair = next((pair for pair in _PAIRS if (folder / name.format(pair[0])).is_dir()), None)
    if pair is None:
        raise InputError(folder, f"no folder {name.format(0)} or {name.format(2)}", "images of KITTI")
    present = [number for number in pair if (folder / name.format(number)).is_dir()]
    numbers = [present[index] for index in camera_indices(cameras, len(present))]
    times_file = folder / name.format(numbers[0]) / "timestamps.txt" if is_drive else folder / "times.txt"
    t_ns = _read_stamps(times_file) if is_drive else read_times_ns(times_file)
    lists = tuple(_images(folder / name.format(number), times_file, t_ns, is_drive) for number in numbers)
    table, truth = _read_oxts(folder / "oxts") if is_drive else (TimedTable.empty(folder), _sequence_truth(folder))
    if for_odometry and not len(table.t_ns):
        raise InputError(
            folder, "a sequence of KITTI, which has no IMU", "a drive of the raw data; dronevio sfm needs none"
        )
    if for_odometry and imu is None and not calibration:
        raise InputError(
            folder, "no noise densities of the IMU", "--calibration imu.yaml, or an IMU such as --imu BMI088"
        )
    noise = imu or (read_calibration(calibration).imu if calibration else None) or UNKNOWN_IMU
    noise = replace(noise, rate_hz=rate_hz(table.t_ns, 100.0))
    models = _drive_cameras(folder, numbers, lists[0]) if is_drive else _sequence_cameras(folder, numbers, lists[0])
    with as_input_error(folder):
        rig = Rig(tuple(RigCamera(model, T, rate_hz(t_ns, 10.0)) for model, T in models), noise)
    return FolderContents(folder.resolve().name, folder, lists, table, OXTS_TABLE, rig, ground_truth=truth)


def read_kitti_frame_times(folder: Path) -> Times:
    """Return the time stamps (M,) [ns] of the frames.

    Raises:
        InputError: The list is missing or damaged.
    """
    if (folder / "times.txt").is_file():
        return read_times_ns(folder / "times.txt")
    camera = next(n for n in range(4) if (folder / f"image_{n:02d}" / "timestamps.txt").is_file())
    return _read_stamps(folder / f"image_{camera:02d}" / "timestamps.txt")


def read_kitti_truth(folder: Path) -> Trajectory:
    """Return the ground truth of a drive, the pose of its IMU, or of a sequence, that of its left camera.

    Raises:
        InputError: There is none, or it is damaged.
    """
    is_drive = not (folder / "times.txt").is_file()
    truth = _read_oxts(folder / "oxts")[1] if is_drive else _sequence_truth(folder)
    if truth is None:
        raise InputError(folder, "no ground truth", "the folder poses beside the folder sequences, or oxts")
    return truth


def _images(camera: Path, times_file: Path, t_ns: Times, is_drive: bool) -> ImageList:
    """Return the images of a camera, whose names are their numbers, with the time stamps of the frames (M,) [ns]."""
    folder = camera / "data" if is_drive else camera
    digits = 10 if is_drive else 6
    if not folder.is_dir():
        raise InputError(folder, "no such folder", "images of KITTI")
    numbered = {int(file.stem): file for file in folder.iterdir() if re.fullmatch(r"\d{1,10}", file.stem, re.ASCII)}
    files = tuple(numbered.get(number, folder / f"{number:0{digits}d}.png") for number in range(len(t_ns)))
    rows = np.flatnonzero([file.is_file() for file in files])
    if not len(rows):
        raise InputError(folder, "no images", f"images such as {0:0{digits}d}.png")
    return ImageList(camera / times_file.name, t_ns, files, np.arange(1, len(t_ns) + 1)).selected(rows)


def _read_stamps(path: Path) -> Times:
    """Return the time stamps (M,) [ns] of a file, in UTC as far as the file tells, or raise InputError."""
    times = []
    for line, row in numbered_rows(read_text(path, _STAMPS)):
        match = _STAMP.fullmatch(row)
        if match is None:
            raise InputError(path, repr(row[:40]), _STAMPS, line)
        *whole, fraction = match.groups()
        seconds = calendar.timegm((*map(int, whole), 0, 0, 0))
        times.append(seconds * 10**9 + int(fraction.ljust(9, "0")))
    if not times:
        raise InputError(path, "no rows", _STAMPS)
    return np.array(times, dtype=np.int64)


def _read_oxts(folder: Path) -> tuple[TimedTable, Trajectory]:
    """Return the IMU samples and the poses of the navigation system, or raise InputError."""
    t_ns = _read_stamps(folder / "timestamps.txt")
    files = [folder / "data" / f"{number:010d}.txt" for number in range(len(t_ns))]
    rows = np.flatnonzero([file.is_file() for file in files])
    if not len(rows):
        raise InputError(folder / "data", "no samples", "files such as 0000000000.txt")
    values = np.array([_read_sample(files[row]) for row in rows.tolist()])
    inertial = np.hstack([values[:, _GYRO], values[:, _ACCEL]])
    table = TimedTable(folder / "timestamps.txt", t_ns[rows], inertial, rows + 1)
    return table, _trajectory(t_ns[rows], values)


def _read_sample(path: Path) -> list[float]:
    """Return the numbers of a sample, or raise InputError."""
    fields = read_text(path, _SAMPLE).split()
    if len(fields) != _FIELDS or not all(NUMBER.fullmatch(field) for field in fields):
        raise InputError(path, f"{len(fields)} fields", _SAMPLE, 1)
    numbers = [float(field) for field in fields]
    if not abs(numbers[_LAT]) < _MAX_LATITUDE:
        raise InputError(path, f"a latitude of {numbers[_LAT]:g}°", f"one below {_MAX_LATITUDE:g}°", 1)
    return numbers


def _trajectory(t_ns: Times, values: Array) -> Trajectory:
    """Return the poses of the IMU in a frame of east, north and up from the first one, as the development kit does.

    The positions are those of a Mercator projection, whose scale is that of the first latitude.
    """
    order = np.unique(t_ns, return_index=True)[1]
    values = values[order]
    scale = math.cos(math.radians(values[0, _LAT]))
    east = scale * _EARTH_M * np.radians(values[:, _LON])
    north = scale * _EARTH_M * np.log(np.tan(np.radians(90.0 + values[:, _LAT]) / 2.0))
    p = np.stack([east, north, values[:, _ALT]], axis=1)
    half = 0.5 * values[:, [_ROLL, _PITCH, _YAW]]
    quats = np.zeros((3, len(values), 4))
    for axis in range(3):
        quats[axis, :, 0], quats[axis, :, 1 + axis] = np.cos(half[:, axis]), np.sin(half[:, axis])
    R_x, R_y, R_z = (matrix_from_quat_wxyz(quat) for quat in quats)
    velocity = np.ascontiguousarray(values[:, [_V_EAST, _V_NORTH, _V_UP]])
    return Trajectory(t_ns[order], p - p[0], quat_wxyz_from_matrix(R_z @ R_y @ R_x), velocity)


def _drive_cameras(folder: Path, numbers: Sequence[int], images: ImageList) -> list[tuple[CameraModel, Array]]:
    """Return the model of each camera of a drive and its pose in the IMU frame, or raise InputError."""
    place = folder if (folder / "calib_cam_to_cam.txt").is_file() else folder.resolve().parent
    cameras = _read_fields(place / "calib_cam_to_cam.txt")
    T_cam0_imu = _rigid(place / "calib_velo_to_cam.txt") @ _rigid(place / "calib_imu_to_velo.txt")
    header = header_of(read_bytes(images.files[0], "an image"))
    size = [] if header is None else [header.width, header.height]
    models = []
    for number in numbers:
        suffix = f"_{number:02d}"
        if size == _field(cameras, place, f"S_rect{suffix}", 2).tolist():
            model, T_cam_rect = _rectified(size, _field(cameras, place, f"P_rect{suffix}", 12))
            R_rect = pose_matrix(_field(cameras, place, "R_rect_00", 9).reshape(3, 3), np.zeros(3))
            models.append((model, inverse_pose(T_cam_rect @ R_rect @ T_cam0_imu)))
            continue
        if size != _field(cameras, place, f"S{suffix}", 2).tolist():
            expected = f"the size of rectified or original images in {place / 'calib_cam_to_cam.txt'}"
            raise InputError(images.files[0], f"an image of {' × '.join(map(str, size))} px", expected)
        K, k = _field(cameras, place, f"K{suffix}", 9), _field(cameras, place, f"D{suffix}", 5)
        with as_input_error(place / "calib_cam_to_cam.txt"):
            model = CameraModel(size[0], size[1], K[0], K[4], K[2], K[5], tuple(k.tolist()))
        R, t = _field(cameras, place, f"R{suffix}", 9).reshape(3, 3), _field(cameras, place, f"T{suffix}", 3)
        models.append((model, inverse_pose(pose_matrix(R, t) @ T_cam0_imu)))
    return models


def _sequence_cameras(folder: Path, numbers: Sequence[int], images: ImageList) -> list[tuple[CameraModel, Array]]:
    """Return the model of each camera of a sequence and its pose in the frame of the first camera."""
    fields = _read_fields(folder / "calib.txt")
    header = header_of(read_bytes(images.files[0], "an image"))
    if header is None:
        raise InputError(images.files[0], "a file that is not a supported image", "a PNG")
    size = [header.width, header.height]
    models = [_rectified(size, _field(fields, folder / "calib.txt", f"P{number}", 12)) for number in numbers]
    return [(model, inverse_pose(T)) for model, T in models]


def _rectified(size: Sequence[int], projection: Array) -> tuple[CameraModel, Array]:
    """Return the model of a rectified camera and the pose of the first rectified camera in its frame.

    Args:
        size: Width and height [px].
        projection: (12,) Matrix K (I | t), row by row.
    """
    P = projection.reshape(3, 4)
    model = CameraModel(int(size[0]), int(size[1]), P[0, 0], P[1, 1], P[0, 2], P[1, 2])
    return model, pose_matrix(np.eye(3), np.asarray(np.linalg.solve(P[:, :3], P[:, 3]), np.float64))


def _sequence_truth(folder: Path) -> Trajectory | None:
    """Return the poses of the left camera in a frame whose z axis points up; None if the sequence has none."""
    place = folder.resolve()
    files = [
        file for file in (place / "poses.txt", place.parent.parent / "poses" / f"{place.name}.txt") if file.is_file()
    ]
    if not files:
        return None
    poses = read_kitti(files[0], folder / "times.txt")
    rotations = R_UP_KITTI @ poses.rotations
    return Trajectory(poses.t_ns, poses.p_world_imu @ R_UP_KITTI.T, quat_wxyz_from_matrix(rotations))


def _rigid(path: Path) -> Array:
    """Return the transform (4, 4) of a file with the fields R and T, or raise InputError."""
    fields = _read_fields(path)
    return pose_matrix(_field(fields, path, "R", 9).reshape(3, 3), _field(fields, path, "T", 3))


def _read_fields(path: Path) -> dict[str, list[str]]:
    """Return the words of each field of a calibration file, or raise InputError."""
    rows = [row.partition(":") for _, row in numbered_rows(read_text(path, "a calibration of KITTI"))]
    return {key.strip(): text.split() for key, _, text in rows}


def _field(fields: dict[str, list[str]], path: Path, name: str, count: int) -> Array:
    """Return the numbers of a field, or raise InputError."""
    words = fields.get(name, [])
    if len(words) != count or not all(NUMBER.fullmatch(word) for word in words):
        raise InputError(path, f"{name} with {len(words)} numbers" if words else f"no {name}", f"{count} numbers")
    return np.array([float(word) for word in words])
