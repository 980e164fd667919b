"""Recordings as EuRoC folders (ASL format): images, IMU samples, calibration and ground truth.

The body frame is that of the IMU, IMU samples are values at their time stamps unless stated otherwise, and cameras
have any lens of this package. Format: Burri et al., "The EuRoC micro aerial vehicle datasets", IJRR 2016. Folders of
TUM-VI have the same tables without ``sensor.yaml``, and their ground truth in ``mocap0`` (Schubert et al., "The TUM VI
benchmark for evaluating visual-inertial odometry", IROS 2018).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Self

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array
from dronevio.models.defects import Defect
from dronevio.models.errors import InputError
from dronevio.models.imu import UNKNOWN_IMU, ImuModel, ImuSamples, Times
from dronevio.models.progress import Progress, silent
from dronevio.models.protocols import Recording
from dronevio.models.recordings.calibration.euroc import (
    calibration_files,
    count_cameras,
    read_euroc_rig,
    read_euroc_sampling,
)
from dronevio.models.recordings.exported import interval_means
from dronevio.models.recordings.files import write_text
from dronevio.models.recordings.folder_contents import FolderContents, calibrated_rig
from dronevio.models.recordings.folder_segments import point_samples, repaired_segments, strict_segments
from dronevio.models.recordings.frame_truth import FRAME_TRUTH_FILE, FrameTruth, frame_truth_text, read_frame_truth
from dronevio.models.recordings.image_list import ImageList
from dronevio.models.recordings.images import assembled_frame, encode_png, read_grey, significant_bits_of_files
from dronevio.models.recordings.segments import segment_name, split_at_steps
from dronevio.models.recordings.timed_table import (
    TableFormat,
    TimedTable,
    check_unit_quaternions,
    parse_integer_ns,
    read_timed_table,
)
from dronevio.models.recordings.tum import read_tum
from dronevio.models.rig import Cameras, Rig, camera_indices
from dronevio.models.state import CameraFrame, Trajectory

IMU_TABLE = TableFormat("an EuRoC IMU table", (7,), ",", parse_integer_ns, "whole nanoseconds")
"""Columns: time, angular velocity x y z [rad/s], specific force x y z [m/s²]."""
GROUND_TRUTH_FILE = Path("state_groundtruth_estimate0") / "data.csv"
"""Path of the ground truth below ``mav0``."""
TUM_VI_TRUTH_FILE = Path("mocap0") / "data.csv"
"""Path of the ground truth of TUM-VI below ``mav0``, which that of EuRoC precedes."""
TUM_VI_CALIBRATION = (Path("dso") / "camchain.yaml", Path("dso") / "imu_config.yaml")
"""Calibration files of Kalibr beside ``mav0`` in exports of TUM-VI, for a folder without ``sensor.yaml``."""
TUM_GROUND_TRUTH_FILE = "groundtruth.tum"
"""Name of a TUM file beside ``mav0`` with the ground truth of the IMU, for a recording without `GROUND_TRUTH_FILE`."""
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
    """A recording in an EuRoC folder, or one of another layout; satisfies the `Recording` protocol."""

    name: str
    """Name of the parent folder of ``mav0``."""
    mav0: Path
    """Path of the folder ``mav0``, or of a folder of another layout."""
    rig: Rig
    """Calibration of cameras and IMU."""
    imu: ImuSamples
    """IMU samples of the whole recording; point samples unless ``sensor.yaml`` has ``sampling: increment``."""
    frame_times_ns: Times
    """(M,) Time stamps at which every camera has an image, or any camera with `repair`; strictly increasing [ns]."""
    image_files: tuple[tuple[Path | None, ...], ...]
    """M image files of each camera, None where it has none."""
    image_delays_ns: Times = field(repr=False)
    """(M, C) How much later than its frame each image is stamped [ns]."""
    ground_truth: Trajectory | None
    """Ground truth of the IMU, None if the folder has none."""
    frame_truth: FrameTruth | None = None
    """Ground truth of the frames, None if the folder has none; it may include frames that the recording lost."""
    complete: bool = True
    """Whether the recording was written completely; if not, it has the frames for which every camera has an image."""
    repair: bool = False
    """Whether frames go without images that are missing or damaged; otherwise these raise an error."""
    defects: tuple[Defect, ...] = field(default=(), repr=False)
    """Defects that were found when the recording was opened with `repair`."""
    later: tuple["EurocRecording", ...] = field(default=(), repr=False)
    """Segments after steps of the clock, each a recording of its own, if it was opened with `repair`; see
    `dronevio.models.recordings.segments`."""

    @classmethod
    def open(
        cls,
        folder: Path | str,
        cameras: Cameras = None,
        repair: bool = False,
        calibration: Sequence[Path] = (),
        imu: ImuModel | None = None,
    ) -> Self:
        """Read everything except the images, which `frame` reads on request.

        Args:
            folder: The folder ``mav0`` or its parent.
            cameras: Cameras to use.
            repair: Whether to go on with images that are missing or damaged, time stamps that do not increase and IMU
                samples that are not finite, and to list them in `defects`. Otherwise, they raise an error, and frames
                that not every camera has are left out.
            calibration: Calibration files of Kalibr or Basalt that replace the ``sensor.yaml`` files.
            imu: Model of the IMU in place of that of the calibration. The rate is that of the samples, or of
                ``sensor.yaml``.

        Raises:
            InputError: A file is missing, damaged or not supported; or, with `repair`, IMU and cameras do not overlap
                in time.
            ConfigError: A camera does not exist.
        """
        return cls.of(read_euroc_contents(find_mav0(folder), cameras, calibration, imu), repair)

    @classmethod
    def of(cls, contents: FolderContents, repair: bool = False) -> Self:
        """Return the recording of the contents of a folder; see `open`.

        Raises:
            InputError: The contents have defects; or, with `repair`, there is no IMU, or IMU and cameras do not overlap
                in time.
        """
        segments = (repaired_segments if repair else strict_segments)(contents)
        first, *later = (
            cls(
                name=segment_name(contents.name, number, len(segments)),
                mav0=contents.folder,
                rig=contents.rig,
                imu=segment.imu,
                frame_times_ns=segment.frames.t_ns,
                image_files=segment.frames.files,
                image_delays_ns=segment.frames.delays_ns,
                ground_truth=contents.ground_truth,
                frame_truth=contents.frame_truth,
                complete=contents.complete,
                repair=repair,
                defects=segment.defects,
            )
            for number, segment in enumerate(segments, 1)
        )
        return replace(first, later=tuple(later))

    @cached_property
    def image_bits(self) -> tuple[int, ...]:
        """Significant bits of the images of each camera, 8 to 16, of which a frame has the upper 8."""
        return tuple(
            significant_bits_of_files([file for file in files if file], camera.model.width, camera.model.height)
            for files, camera in zip(self.image_files, self.rig.cameras, strict=True)
        )

    def frame(self, index: int) -> CameraFrame:
        """Return the frame with a given index, 0 ≤ index < M.

        Raises:
            InputError: An image has another size than in the calibration; or it is missing or damaged, unless `repair`
                is set.
        """
        files, models = (each[index] for each in self.image_files), (camera.model for camera in self.rig.cameras)
        reads = [
            None if file is None else partial(read_grey, file, model.width, model.height, bits)
            for file, model, bits in zip(files, models, self.image_bits, strict=True)
        ]
        return assembled_frame(int(self.frame_times_ns[index]), reads, self.repair, self.image_delays_ns[index])


def read_euroc_contents(
    mav0: Path, cameras: Cameras = None, calibration: Sequence[Path] = (), imu: ImuModel | None = None
) -> FolderContents:
    """Return the contents of a folder ``mav0``; see `EurocRecording.open`.

    Raises:
        InputError: A file is missing, damaged or not supported.
        ConfigError: A camera does not exist.
    """
    used = camera_indices(cameras, count_cameras(mav0))
    lists = tuple(ImageList.read(mav0 / f"cam{i}") for i in used)
    has_imu = (mav0 / "imu0").exists()
    table = _imu_table(mav0)
    files, frame_truth = tuple(calibration) or _tum_vi_calibration(mav0), mav0 / FRAME_TRUTH_FILE
    if files:
        imu = imu or (None if has_imu else UNKNOWN_IMU)
        rig, sampling = calibrated_rig(mav0, files, used, lists[0].t_ns, table.t_ns, imu)
    else:
        rig, sampling = read_euroc_rig(mav0, used), read_euroc_sampling(mav0)
        rig = rig if imu is None else replace(rig, imu=replace(imu, rate_hz=rig.imu.rate_hz))
    return FolderContents(
        name=mav0.resolve().parent.name,
        folder=mav0,
        lists=lists,
        imu=table,
        imu_form=IMU_TABLE,
        rig=rig,
        sampling=sampling,
        ground_truth=_ground_truth_of(mav0),
        frame_truth=read_frame_truth(frame_truth) if frame_truth.exists() else None,
        complete=not (mav0 / INCOMPLETE).exists(),
    )


def _imu_table(mav0: Path) -> TimedTable:
    """Return the IMU samples of a folder ``mav0``, none without the folder ``imu0``."""
    folder = mav0 / "imu0"
    return (
        read_timed_table(folder / "data.csv", IMU_TABLE, checked=False) if folder.exists() else TimedTable.empty(mav0)
    )


def _tum_vi_calibration(mav0: Path) -> tuple[Path, ...]:
    """Return the calibration files of an export of TUM-VI for a folder without ``sensor.yaml``; none if it has some."""
    beside = tuple(mav0.resolve().parent / file for file in TUM_VI_CALIBRATION)
    if (mav0 / "cam0" / "sensor.yaml").exists():
        return ()
    if not all(file.is_file() for file in beside):
        expected = "that file, or a calibration of Kalibr or Basalt (--calibration camchain.yaml imu.yaml)"
        raise InputError(mav0 / "cam0" / "sensor.yaml", "no such file", expected)
    return beside


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


def read_recording_truth(folder: Path | str) -> Trajectory:
    """Read the ground truth of a recording, given ``mav0`` or its parent.

    Raises:
        InputError: The recording has none, or it is damaged.
    """
    mav0 = find_mav0(folder)
    truth = _ground_truth_of(mav0)
    if truth is None:
        raise InputError(
            mav0 / GROUND_TRUTH_FILE,
            "no such file",
            f"{GROUND_TRUTH_TABLE.name}, or {TUM_GROUND_TRUTH_FILE} beside mav0",
        )
    return truth


def _ground_truth_of(mav0: Path) -> Trajectory | None:
    """Return the ground truth of a recording, None if it has none."""
    for file in (mav0 / GROUND_TRUTH_FILE, mav0 / TUM_VI_TRUTH_FILE):
        if file.exists():
            return read_groundtruth(file)
    tum = mav0.resolve().parent / TUM_GROUND_TRUTH_FILE
    return read_tum(tum) if tum.exists() else None


def read_imu(path: Path | str) -> ImuSamples:
    """Read an IMU table as point samples.

    Raises:
        InputError: The file is missing, empty, truncated or in another format, or its time stamps do not increase.
    """
    table = read_timed_table(Path(path), IMU_TABLE)
    return point_samples(table.t_ns, table.values)


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


def read_euroc_segment_times(folder: Path | str) -> tuple[Times, ...]:
    """Return the time stamps (M,) [ns] of the frames of the main camera in each segment of an EuRoC folder.

    Raises:
        InputError: The file ``cam0/data.csv`` is missing or damaged.
    """
    mav0 = find_mav0(folder)
    listed = ImageList.read(mav0 / "cam0")
    split = split_at_steps([listed.t_ns])
    if len(split.steps):  # what the camera has in common with the IMU
        table = _imu_table(mav0)
        offset_ns = round(read_euroc_rig(mav0).time_offset_s * 1e9)
        split = split_at_steps([listed.t_ns, table.t_ns], [offset_ns, 0])
    listed = replace(listed, t_ns=split.stamps[0])
    segments = [listed.selected(np.arange(len(listed.t_ns))[rows]).ordered()[0] for rows in split.rows(0)]
    # A folder may be kept without its images.
    existing = [(each.t_ns, exists) for each in segments for exists in [each.existing()]]
    return tuple(t_ns[exists] if exists.any() else t_ns for t_ns, exists in existing)


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
        imu: IMU samples. Increments are written as `interval_means`, with the key ``sampling`` in ``sensor.yaml``.
        truth: Ground truth of the IMU, None if it is unknown.
        frame_times_ns: (M,) Time stamps of the frames [ns].
        frame_truth: Ground truth of the frames, None if it is unknown.

    Raises:
        InputError: A file cannot be written.
    """
    mav0 = Path(folder) / "mav0"
    for name, text in calibration_files(rig, imu.sampling).items():
        write_text(mav0 / name, text)
    images = "#timestamp [ns],filename\n" + "".join(f"{t},{t}.png\n" for t in frame_times_ns.tolist())
    for i in range(len(rig.cameras)):
        (mav0 / f"cam{i}" / "data").mkdir(parents=True, exist_ok=True)
        write_text(mav0 / f"cam{i}" / "data.csv", images)
    if imu.sampling == "increment":
        imu = interval_means(imu)
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
        InputError: A frame cannot be read, or a file cannot be written.
    """
    times, mav0 = recording.frame_times_ns, Path(folder) / "mav0"
    write_euroc(folder, recording.rig, recording.imu, recording.ground_truth, times[:0], frame_truth)
    write_text(mav0 / INCOMPLETE, "Frames are missing: the recording is being written, or writing was interrupted.\n")
    progress(0, len(times))
    for index in range(len(times)):
        frame = recording.frame(index)
        delays_ns = frame.image_delays_ns or (0,) * len(frame.images)
        for number, (image, delay_ns) in enumerate(zip(frame.images, delays_ns, strict=True)):
            _write_image(mav0 / f"cam{number}", frame.t_ns + delay_ns, image)
        progress(index + 1, len(times))
    (mav0 / INCOMPLETE).unlink()


def _write_image(camera: Path, t_ns: int, image: npt.NDArray[np.uint8]) -> None:
    """Write an image with its time stamp, and add it to the list of its camera, unless it is `NO_IMAGE`."""
    if not image.size:
        return
    (camera / "data" / f"{t_ns}.png").write_bytes(encode_png(image))
    with (camera / "data.csv").open("a", encoding="utf-8") as listed:
        listed.write(f"{t_ns},{t_ns}.png\n")


def _truth_text(truth: Trajectory) -> str:
    """Return the text of a ground-truth table."""
    motion = [a for a in (truth.velocity_m_s, truth.gyro_bias_rad_s, truth.accel_bias_m_s2) if a is not None]
    has_motion = len(motion) == 3
    header = f"{_POSE_HEADER}{_MOTION_HEADER if has_motion else ''}\n"
    return header + _rows(truth.t_ns, [truth.p_world_imu, truth.quat_wxyz, *(motion if has_motion else [])])


def _columns(values: Array, start: int, end: int) -> Array:
    """Return the columns from ``start`` to ``end``, exclusive, as a contiguous array."""
    return np.ascontiguousarray(values[:, start:end])


def _rows(t_ns: Times, columns: Sequence[Array]) -> str:
    """Return the rows of a table, each number with as many digits as it needs."""
    rows = zip(t_ns.tolist(), np.hstack(columns).tolist(), strict=True)
    return "".join(f"{t},{','.join(map(repr, row))}\n" for t, row in rows)
