"""Recordings as videos of a GoPro camera, whose file has the samples of the camera's IMU in a track of its own.

A payload of the track (`gpmf`) has the samples of about a second. Their times are those of the payloads in the
container, as those of the images are, without the jitter with which payloads are cut: the samples are regular over
`SMOOTHED_PAYLOADS`. Newer cameras state the time of the first sample of each payload, which is taken instead. The
clocks may nevertheless differ by some hundredths of a second, which an estimator has to find.

The axes of the samples are up, left and back, seen from the camera, in the order of the file or after the rotation that
it states.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Self

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.defects import Defect, DefectKind
from dronevio.models.errors import ConfigError, InputError
from dronevio.models.imu import ImuModel, ImuSamples, Times
from dronevio.models.recordings.calibration.reading import calibration_of
from dronevio.models.recordings.calibration.yaml_document import YamlDocument, read_yaml
from dronevio.models.recordings.files import check_regular_file
from dronevio.models.recordings.folder_contents import rate_hz
from dronevio.models.recordings.frame_truth import FrameTruth
from dronevio.models.recordings.gpmf import SENSORS, SensorPayload, axes_matrix, read_payload
from dronevio.models.recordings.repair import imu_defects
from dronevio.models.recordings.split_imu import interpolated_accel
from dronevio.models.recordings.video_frames import VideoFrames, read_video_index
from dronevio.models.rig import Cameras, Rig, camera_indices
from dronevio.models.state import NO_IMAGE, CameraFrame, Trajectory

IMU_AXES = "yxz"
"""Axes of the IMU of a GoPro camera along the axes of the camera; see `imu_rotation_named`."""
SMOOTHED_PAYLOADS = 61
"""Number of payloads over which the rate of a sensor is constant, about a minute."""

_EXPECTED = "a video of a GoPro camera, with a track of telemetry (GPMF)"


@dataclass(frozen=True, eq=False)
class VideoRecording:
    """A recording in a video with telemetry; satisfies the `Recording` protocol."""

    name: str
    """Name of the file."""
    rig: Rig
    """Calibration of the camera and the IMU."""
    imu: ImuSamples
    """IMU samples of the whole recording."""
    frame_times_ns: Times
    """(M,) Time stamps of the frames [ns]."""
    frames: VideoFrames = field(repr=False)
    """Images of the video, by their index."""
    ground_truth: Trajectory | None = None
    """None: a video has no ground truth."""
    frame_truth: FrameTruth | None = None
    """None: a video has none of the frames either."""
    complete: bool = True
    """Whether the recording is complete."""
    repair: bool = False
    """Whether frames go without images that are damaged; otherwise these raise an error."""
    defects: tuple[Defect, ...] = field(default=(), repr=False)
    """Defects that were found when the video was opened with `repair`."""
    later: tuple["VideoRecording", ...] = field(default=(), repr=False)
    """No further segments: the clock of a video does not step."""

    @classmethod
    def open(
        cls,
        path: Path,
        cameras: Cameras = None,
        calibration: Sequence[Path] = (),
        imu: ImuModel | None = None,
        imu_rotation: str | None = None,
        repair: bool = False,
    ) -> Self:
        """Read everything except the images.

        Args:
            path: The video.
            cameras: Cameras to use: the only one.
            calibration: Calibration files of the camera and possibly the IMU; the pose of the camera may be missing.
            imu: Model of the IMU in place of that of the calibration. Its rate is replaced by that of the samples.
            imu_rotation: Axes of the IMU (`imu_rotation_named`) that replace the pose of the calibration; None for that
                of the calibration, or `IMU_AXES` without one.
            repair: Whether to go on with damaged images and to list the defects.

        Raises:
            InputError: The video is damaged or has no telemetry, or the calibration is incomplete.
            ConfigError: A camera does not exist, or the name of the rotation is not one.
        """
        camera_indices(cameras, 1)
        if not calibration:
            raise InputError(path, "no calibration of the camera", "one of Kalibr or Basalt (--calibration cam.yaml)")
        index = read_video_index(path)
        t_ns = np.array([round(pts * index.time_base * 10**9) for pts in index.pts.tolist()], dtype=np.int64)
        samples = read_telemetry(path)
        documents = [_with_pose(read_yaml(Path(file)), imu_rotation) for file in calibration]
        calibration_set = calibration_of(documents, rate_hz(t_ns, 30.0))
        model = imu or calibration_set.imu
        if model is None:
            expected = "Kalibr's imu.yaml as well, or the name of an IMU (--imu MPU-6050)"
            raise InputError(calibration[0], "no noise densities of the IMU", expected)
        rig = replace(calibration_set, imu=replace(model, rate_hz=rate_hz(samples.t_ns, model.rate_hz))).rig()
        size = rig.cameras[0].model.width, rig.cameras[0].model.height
        if (index.width, index.height) != size:
            raise InputError(
                path, f"frames of {index.width} × {index.height} px", f"{size[0]} × {size[1]} px as calibrated"
            )
        rig = replace(rig, cameras=rig.cameras[:1])
        defects = imu_defects(samples, t_ns, rig.time_offset_s, path) if repair else ()
        frames = VideoFrames(path, index, index.pts, is_grey=True)
        return cls(path.stem, rig, samples, t_ns, frames, repair=repair, defects=defects)

    def frame(self, index: int) -> CameraFrame:
        """Return the frame with a given index, 0 ≤ index < M.

        Raises:
            InputError: The image is damaged, unless `repair` is set.
        """
        t_ns = int(self.frame_times_ns[index])
        try:
            return CameraFrame(t_ns, (self.frames(index),))
        except InputError as error:
            if not self.repair:
                raise
            return CameraFrame(t_ns, (NO_IMAGE,), defects=(Defect(DefectKind.DAMAGED_IMAGE, t_ns, error.found),))


def imu_rotation_named(name: str) -> Array:
    """Return the rotation (3, 3) from the camera frame into the IMU frame.

    Args:
        name: Axes of the IMU along x (right), y (down) and z (forward) of the camera, where a small letter is the
            opposite direction: with ``yxz``, x of the camera is −y of the IMU.

    Raises:
        ConfigError: The name is not that of three axes, or of a reflection.
    """
    try:
        matrix = axes_matrix("XYZ", name)
    except ValueError:
        matrix = np.zeros((3, 3))
    if not np.linalg.det(matrix) > 0.0:
        raise ConfigError(f"rotation of the IMU {name!r}; expected axes of the IMU along those of the camera, as yxz")
    return matrix.T


def read_telemetry(path: Path) -> ImuSamples:
    """Return the IMU samples of a video, at the times of the gyroscope.

    Raises:
        InputError: The file is missing, damaged or has no telemetry.
    """
    import av

    check_regular_file(path, _EXPECTED)
    payloads: dict[str, list[tuple[float, SensorPayload]]] = {key: [] for key in SENSORS}
    try:
        with av.open(str(path)) as container:
            streams = [stream for stream in container.streams if stream.type == "data"]
            for packet in container.demux(streams) if streams else ():
                data = bytes(packet) if packet.size else b""
                if packet.pts is None or not data.startswith(b"DEVC"):
                    continue
                for key, payload in read_payload(data).items():
                    payloads[key].append((float(packet.pts * packet.time_base), payload))
    except (av.FFmpegError, OSError) as error:
        raise InputError(path, f"cannot be read ({error.strerror})", _EXPECTED) from None
    except ValueError as error:
        raise InputError(path, f"damaged telemetry ({error})", _EXPECTED) from None
    if min(map(len, payloads.values())) < 2:
        raise InputError(path, "no track with gyroscope and accelerometer", _EXPECTED)
    (gyro_t_ns, gyro), (accel_t_ns, accel) = (_timed(payloads[key]) for key in SENSORS)
    rows, accel = interpolated_accel(gyro_t_ns, accel_t_ns, accel)
    increasing = np.concatenate([[True], np.diff(gyro_t_ns[rows]) > 0])[: len(rows)]
    if not np.isfinite(accel).all() or not np.isfinite(gyro).all() or not increasing.all() or not len(rows):
        raise InputError(path, "telemetry whose times do not increase, or with infinite numbers", _EXPECTED)
    return ImuSamples(gyro_t_ns[rows], np.ascontiguousarray(gyro[rows]), np.ascontiguousarray(accel))


def _timed(payloads: Sequence[tuple[float, SensorPayload]]) -> tuple[Times, Array]:
    """Return time stamps (N,) [ns] and samples (N, 3) of a sensor.

    Args:
        payloads: Time of each payload in the container [s], and its samples.
    """
    filled = [(start_s, payload) for start_s, payload in payloads if len(payload.values)]
    counts = np.cumsum([0, *(len(payload.values) for _, payload in filled)])
    starts_s = np.array([start_s for start_s, _ in filled])
    stamps = [payload.stamp_us for _, payload in filled]
    known = [stamp for stamp in stamps if stamp is not None]
    if len(known) == len(stamps):
        starts_s = starts_s[0] + (np.array(known, dtype=np.int64) - known[0]) * 1e-6
    else:
        starts_s = _smoothed(counts[:-1].astype(np.float64), starts_s)
    rate = (starts_s[-1] - starts_s[0]) / (counts[-2] - counts[0])
    starts_s = np.append(starts_s, starts_s[-1] + rate * (counts[-1] - counts[-2]))
    times_s = np.interp(np.arange(counts[-1]), counts, starts_s)
    return np.rint(times_s * 1e9).astype(np.int64), np.vstack([payload.values for _, payload in filled])


def _smoothed(counts: Array, starts_s: Array) -> Array:
    """Return the times (P,) of payloads by the line through those around each; the counts are of samples before it."""
    half, result = SMOOTHED_PAYLOADS // 2, np.empty_like(starts_s)
    for row in range(len(starts_s)):
        near = slice(max(row - half, 0), row + half + 1)
        result[row] = np.polyfit(counts[near] - counts[row], starts_s[near], 1)[1]
    return result


def _with_pose(document: YamlDocument, imu_rotation: str | None) -> YamlDocument:
    """Return a calibration in which the first camera has the pose that the axes of the IMU give, if it is needed."""
    poses = ("cam0.T_imu_cam", "cam0.T_cam_imu")
    if "cam0" not in document.lines or (imu_rotation is None and any(key in document for key in poses)):
        return document
    T = np.eye(4)
    T[:3, :3] = imu_rotation_named(imu_rotation or IMU_AXES)
    kept = {key: value for key, value in document.values.items() if key not in poses}
    rows = tuple(tuple(row) for row in T.tolist())
    return replace(
        document, values={**kept, poses[0]: rows}, lines={**document.lines, poses[0]: document.lines["cam0"]}
    )
