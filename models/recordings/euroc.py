"""Recordings as EuRoC folders (ASL format): images, IMU samples, calibration and ground truth.

The body frame is that of the IMU, IMU samples are values at their time stamps, cameras are pinholes with
radial-tangential distortion or equidistant fisheyes. Format: Burri et al., "The EuRoC micro aerial vehicle datasets",
IJRR 2016.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import reduce
from pathlib import Path
from typing import Self

import numpy as np
import numpy.typing as npt

from dronevio.models.errors import ConfigError, InputError
from dronevio.models.imu import ImuSamples, Times
from dronevio.models.progress import Progress, silent
from dronevio.models.protocols import Recording
from dronevio.models.recordings.calibration.euroc import calibration_files, count_cameras, read_euroc_rig
from dronevio.models.recordings.files import read_text, write_text
from dronevio.models.recordings.frame_truth import FRAME_TRUTH_FILE, FrameTruth, frame_truth_text, read_frame_truth
from dronevio.models.recordings.images import encode_png, read_grey
from dronevio.models.recordings.timed_table import (
    TIME_LIMIT_NS,
    TableFormat,
    check_increasing,
    check_unit_quaternions,
    parse_integer_ns,
    read_timed_table,
)
from dronevio.models.rig import Rig, check_camera_count
from dronevio.models.state import CameraFrame, Trajectory

Array = npt.NDArray[np.float64]

IMU_TABLE = TableFormat("an EuRoC IMU table", (7,), ",", parse_integer_ns, "whole nanoseconds")
"""Columns: time, angular velocity x y z [rad/s], specific force x y z [m/s²]."""
GROUND_TRUTH_FILE = Path("state_groundtruth_estimate0") / "data.csv"
"""Path of the ground truth below ``mav0``."""
INCOMPLETE = "INCOMPLETE"
"""Name of a file in ``mav0`` that exists while frames are missing."""
GROUND_TRUTH_TABLE = TableFormat("an EuRoC ground truth", (17, 8), ",", parse_integer_ns, "whole nanoseconds")
"""Columns: time, position, quaternion wxyz, and optionally velocity and the biases of gyroscope and accelerometer."""

_IMU_HEADER = (
    "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]\n"
)
_POSE_HEADER = "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z []"
_MOTION_HEADER = (
    ", v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1],"
    " b_w_RS_S_x [rad s^-1], b_w_RS_S_y [rad s^-1], b_w_RS_S_z [rad s^-1],"
    " b_a_RS_S_x [m s^-2], b_a_RS_S_y [m s^-2], b_a_RS_S_z [m s^-2]"
)


@dataclass(frozen=True, eq=False)
class EurocRecording:
    """A recording in an EuRoC folder; satisfies the `Recording` protocol."""

    name: str
    """Name of the parent folder of ``mav0``."""
    mav0: Path
    """Path of the folder ``mav0``."""
    rig: Rig
    """Calibration of cameras and IMU."""
    imu: ImuSamples
    """IMU samples of the whole recording, point samples."""
    frame_times_ns: Times
    """(M,) Time stamps at which every camera has an image, strictly increasing [ns]."""
    image_files: tuple[tuple[Path, ...], ...]
    """M image files of each camera."""
    ground_truth: Trajectory | None
    """Ground truth of the IMU, None if the folder has none."""
    frame_truth: FrameTruth | None = None
    """Ground truth of the frames, None if the folder has none; it may include frames that the recording lost."""
    complete: bool = True
    """Whether the recording was written completely; if not, it has the frames for which every camera has an image."""

    @classmethod
    def open(cls, folder: Path | str, cameras: int | None = None) -> Self:
        """Read everything except the images, which `frame` reads on request.

        Args:
            folder: The folder ``mav0`` or its parent.
            cameras: Number of cameras to use; None for all.

        Raises:
            InputError: A file is missing, damaged or not supported.
            ConfigError: The number of cameras is less than 1.
        """
        check_camera_count(cameras)
        mav0 = find_mav0(folder)
        used = count_cameras(mav0) if cameras is None else min(cameras, count_cameras(mav0))
        lists = [_read_image_list(mav0 / f"cam{i}") for i in range(used)]
        complete = not (mav0 / INCOMPLETE).exists()
        if not complete:
            lists = [_existing(t_ns, files) for t_ns, files in lists]
        times = reduce(np.intersect1d, [t_ns for t_ns, _ in lists])
        if not len(times) and not complete:
            raise InputError(mav0, "an incomplete recording without frames", "at least one frame")
        if not len(times):
            raise InputError(mav0, f"{used} cameras without a time stamp in common", "synchronized cameras")
        truth, frame_truth = mav0 / GROUND_TRUTH_FILE, mav0 / FRAME_TRUTH_FILE
        return cls(
            name=mav0.resolve().parent.name,
            mav0=mav0,
            rig=read_euroc_rig(mav0, used),
            imu=read_imu(mav0 / "imu0" / "data.csv"),
            frame_times_ns=times,
            image_files=tuple(
                tuple(files[row] for row in np.searchsorted(t_ns, times).tolist()) for t_ns, files in lists
            ),
            ground_truth=read_groundtruth(truth) if truth.exists() else None,
            frame_truth=read_frame_truth(frame_truth) if frame_truth.exists() else None,
            complete=complete,
        )

    def frame(self, index: int) -> CameraFrame:
        """Return the frame with a given index, 0 ≤ index < M.

        Raises:
            InputError: An image is missing, damaged, or has another size than in the calibration.
        """
        models = [camera.model for camera in self.rig.cameras]
        images = tuple(
            read_grey(files[index], model.width, model.height)
            for files, model in zip(self.image_files, models, strict=True)
        )
        return CameraFrame(int(self.frame_times_ns[index]), images)


def find_mav0(folder: Path | str) -> Path:
    """Return the folder ``mav0`` of a recording, given ``mav0`` or its parent.

    Raises:
        InputError: The folder is not an EuRoC recording.
    """
    folder = Path(folder)
    expected = "an EuRoC recording: the folder mav0 or its parent"
    if not folder.exists():
        raise InputError(folder, "no such folder", expected)
    if not folder.is_dir():
        raise InputError(folder, "a file", expected)
    if (folder / "mav0").is_dir():
        return folder / "mav0"
    if (folder / "cam0").is_dir() or (folder / "imu0").is_dir():
        return folder
    raise InputError(folder, "a folder without mav0, cam0 or imu0", expected)


def ground_truth_file(folder: Path | str) -> Path:
    """Return the path of the ground-truth table of a recording, given ``mav0`` or its parent.

    Raises:
        InputError: The recording has none.
    """
    path = find_mav0(folder) / GROUND_TRUTH_FILE
    if not path.exists():
        raise InputError(path, "no such file", GROUND_TRUTH_TABLE.name)
    return path


def read_imu(path: Path | str) -> ImuSamples:
    """Read an IMU table as point samples.

    Raises:
        InputError: The file is missing, empty, truncated or in another format, or its time stamps do not increase.
    """
    table = read_timed_table(Path(path), IMU_TABLE)
    return ImuSamples(table.t_ns, _columns(table.values, 0, 3), _columns(table.values, 3, 6), "point")


def read_groundtruth(path: Path | str) -> Trajectory:
    """Read a ground-truth table: poses, with velocities and biases if it has all 17 columns.

    Raises:
        InputError: The file is missing, empty, truncated or in another format, or its time stamps do not increase.
    """
    table = read_timed_table(Path(path), GROUND_TRUTH_TABLE)
    p, quat_wxyz = _columns(table.values, 0, 3), _columns(table.values, 3, 7)
    check_unit_quaternions(table, quat_wxyz)
    if table.values.shape[1] == 7:
        return Trajectory(table.t_ns, p, quat_wxyz)
    return Trajectory(
        table.t_ns,
        p,
        quat_wxyz,
        _columns(table.values, 7, 10),
        _columns(table.values, 10, 13),
        _columns(table.values, 13, 16),
    )


def read_euroc_frame_times(folder: Path | str) -> Times:
    """Return the time stamps (M,) [ns] of the frames of the main camera in an EuRoC folder.

    Raises:
        InputError: The file ``cam0/data.csv`` is missing or damaged.
    """
    return _read_image_list(find_mav0(folder) / "cam0")[0]


def write_euroc(
    folder: Path,
    rig: Rig,
    imu: ImuSamples,
    truth: Trajectory | None,
    frame_times_ns: Times,
    frame_truth: FrameTruth | None = None,
) -> None:
    """Write an EuRoC folder except for its images, without loss of precision.

    The images have to be written to ``mav0/cam*/data/<t_ns>.png``. The ground truth is written with 17 columns if it
    has velocity and both biases, otherwise with 8.

    Args:
        folder: Parent folder of ``mav0``.
        rig: Calibration of cameras and IMU.
        imu: IMU samples, point samples.
        truth: Ground truth of the IMU, None if it is unknown.
        frame_times_ns: (M,) Time stamps of the frames [ns].
        frame_truth: Ground truth of the frames, None if it is unknown.

    Raises:
        ConfigError: The IMU samples are increments.
        InputError: A file cannot be written.
    """
    if imu.sampling != "point":
        raise ConfigError(f"IMU samples with sampling {imu.sampling!r}; expected 'point' for an EuRoC folder")
    mav0 = Path(folder) / "mav0"
    for name, text in calibration_files(rig).items():
        write_text(mav0 / name, text)
    images = "#timestamp [ns],filename\n" + "".join(f"{t},{t}.png\n" for t in frame_times_ns.tolist())
    for i in range(len(rig.cameras)):
        (mav0 / f"cam{i}" / "data").mkdir(parents=True, exist_ok=True)
        write_text(mav0 / f"cam{i}" / "data.csv", images)
    write_text(mav0 / "imu0" / "data.csv", _IMU_HEADER + _rows(imu.t_ns, [imu.gyro_rad_s, imu.accel_m_s2]))
    if truth is not None:
        write_text(mav0 / GROUND_TRUTH_FILE, _truth_text(truth))
    if frame_truth is not None:
        write_text(mav0 / FRAME_TRUTH_FILE, frame_truth_text(frame_truth))


def write_euroc_recording(
    folder: Path, recording: Recording, progress: Progress = silent, frame_truth: FrameTruth | None = None
) -> None:
    """Write a recording as an EuRoC folder with its images, without loss of precision.

    Args:
        folder: Parent folder of ``mav0``, which contains a file ``INCOMPLETE`` while frames are missing.
        recording: Recording to write.
        progress: Callback that receives the number of written frames.
        frame_truth: Ground truth of the frames, None if it is unknown.

    Raises:
        ConfigError: The IMU samples are increments.
        InputError: A frame cannot be read, or a file cannot be written.
    """
    times, mav0 = recording.frame_times_ns, Path(folder) / "mav0"
    write_euroc(folder, recording.rig, recording.imu, recording.ground_truth, times, frame_truth)
    write_text(mav0 / INCOMPLETE, "Frames are missing: the recording is being written, or writing was interrupted.\n")
    progress(0, len(times))
    for index, t_ns in enumerate(times.tolist()):
        for number, image in enumerate(recording.frame(index).images):
            (mav0 / f"cam{number}" / "data" / f"{t_ns}.png").write_bytes(encode_png(image))
        progress(index + 1, len(times))
    (mav0 / INCOMPLETE).unlink()


def _truth_text(truth: Trajectory) -> str:
    """Return the text of a ground-truth table."""
    motion = [a for a in (truth.velocity_m_s, truth.gyro_bias_rad_s, truth.accel_bias_m_s2) if a is not None]
    has_motion = len(motion) == 3
    header = f"{_POSE_HEADER}{_MOTION_HEADER if has_motion else ''}\n"
    return header + _rows(truth.t_ns, [truth.p_world_imu, truth.quat_wxyz, *(motion if has_motion else [])])


def _existing(t_ns: Times, files: tuple[Path, ...]) -> tuple[Times, tuple[Path, ...]]:
    """Return the time stamps and files of those images of a list that exist."""
    exists = np.array([file.exists() for file in files])
    return t_ns[exists], tuple(file for file, kept in zip(files, exists.tolist(), strict=True) if kept)


def _columns(values: Array, start: int, end: int) -> Array:
    """Return the columns from ``start`` to ``end``, exclusive, as a contiguous array."""
    return np.ascontiguousarray(values[:, start:end])


def _rows(t_ns: Times, columns: Sequence[Array]) -> str:
    """Return the rows of a table, each number with as many digits as it needs."""
    rows = zip(t_ns.tolist(), np.hstack(columns).tolist(), strict=True)
    return "".join(f"{t},{','.join(map(repr, row))}\n" for t, row in rows)


def _read_image_list(camera: Path) -> tuple[Times, tuple[Path, ...]]:
    """Return time stamps (M,) [ns] and image files of the ``data.csv`` of a camera, or raise InputError."""
    path = camera / "data.csv"
    text = read_text(path, "a list of images: rows of time stamp [ns], file name")
    rows = list(_image_rows(path, text))
    if not rows:
        raise InputError(path, "no rows", "rows of time stamp [ns], file name")
    if not text.endswith("\n"):
        raise InputError(path, "a last row without a line end", "a complete file, not a truncated one", rows[-1][0])
    t_ns = np.array([t for _, t, _ in rows], dtype=np.int64)
    check_increasing(path, t_ns, np.array([line for line, _, _ in rows]))
    return t_ns, tuple(camera / "data" / name for _, _, name in rows)


def _image_rows(path: Path, text: str) -> Iterator[tuple[int, int, str]]:
    """Yield line, time stamp [ns] and file name of each image, or raise InputError."""
    for line, raw in enumerate(text.split("\n"), 1):
        row = raw.strip()
        if not row or row[0] == "#":
            continue
        stamp, comma, name = (part.strip() for part in row.partition(","))
        try:
            t_ns = parse_integer_ns(stamp)
        except ValueError:
            raise InputError(path, f"time stamp {stamp[:40]!r}", "whole nanoseconds", line) from None
        if not comma or not name or "," in name:
            raise InputError(path, repr(row[:60]), "two columns: time stamp [ns], file name", line)
        # A list must not refer to files outside its folder.
        if name in (".", "..") or any(character in name for character in "/\\\0"):
            raise InputError(path, f"file name {name[:60]!r}", "the name of a file in the folder data", line)
        if abs(t_ns) >= TIME_LIMIT_NS:
            raise InputError(path, f"time stamp {stamp[:40]}", "whole nanoseconds, below 2⁶² ns", line)
        yield line, t_ns, name
