"""Image sets from recordings, whose rig gives the calibration and the mounting of the cameras."""

import threading
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dronevio.models.arrays import Image
from dronevio.models.errors import ConfigError
from dronevio.models.image_sets.image_set import FocalSource, ImageSet, Indices, InertialData
from dronevio.models.image_sets.masks import find_masks
from dronevio.models.imu import Times
from dronevio.models.protocols import Recording
from dronevio.models.recordings.open import open_recording
from dronevio.models.rig import MAX_CAMERAS, Cameras, camera_indices
from dronevio.models.state import CameraFrame


class RecordedImages:
    """Images of a recording; the object is called with the index of an image. Several threads may call it."""

    def __init__(self, recording: Recording, frames: Indices, cameras: tuple[int, ...]) -> None:
        """Take the images to read, all cameras of the first frame first.

        Args:
            recording: The recording.
            frames: (F,) Index of each frame in the recording.
            cameras: Index of each camera in the recording.
        """
        self._recording, self._frames, self._cameras = recording, frames, cameras
        self._lock = threading.Lock()
        self._latest: tuple[int, CameraFrame] | None = None

    def __call__(self, index: int) -> Image:
        """Return the grey image (H, W) with a given index.

        Raises:
            InputError: The image is missing, damaged, or has another size than in the calibration.
        """
        images = len(self._frames) * len(self._cameras)
        row, camera = divmod(range(images)[index], len(self._cameras))
        number = int(self._frames[row])
        with self._lock:
            if self._latest is None or self._latest[0] != number:
                self._latest = number, self._recording.frame(number)
            return self._latest[1].images[self._cameras[camera]]


def image_recording(
    recording: Recording | Path | str,
    *,
    cameras: Cameras = (0,),
    frames: int | Sequence[int] | None = None,
    masks: Path | str | None = None,
) -> ImageSet:
    """Return images of a recording with its calibration, in the order of time.

    The images of a frame follow each other, in the order of ``cameras``. The time stamps are those of their clock.
    Images of cameras that are exposed at another time than the first of them are frames of their own.

    Args:
        recording: A recording, or the path of one that `open_recording` opens.
        cameras: Cameras to use.
        frames: Number of frames, spread evenly from the first to the last, or the indices of the frames; None for all.
        masks: A folder of masks or one mask for all images; see `dronevio.models.image_sets.masks`.

    Raises:
        InputError: The recording is damaged or not supported, or there are no masks.
        ConfigError: A camera or a frame does not exist, or is given twice.
    """
    if isinstance(recording, Path | str):
        recording = open_recording(recording, cameras)
        chosen_cameras = tuple(range(len(recording.rig.cameras)))
        is_count = cameras is None or isinstance(cameras, int)
        numbers = chosen_cameras if is_count else camera_indices(cameras, MAX_CAMERAS)
    else:
        numbers = chosen_cameras = camera_indices(cameras, len(recording.rig.cameras))
    chosen_frames = _frame_indices(frames, len(recording.frame_times_ns))
    rig_cameras = [recording.rig.cameras[i] for i in chosen_cameras]
    delays_ns = _delays_ns(recording, chosen_frames, chosen_cameras)
    frame = np.repeat(np.arange(len(chosen_frames), dtype=np.int64), len(chosen_cameras))
    own = delays_ns != delays_ns[:, :1]
    frame = np.where(own.ravel(), len(chosen_frames) + np.arange(len(frame)), frame)
    image_camera = np.tile(np.arange(len(chosen_cameras), dtype=np.int64), len(chosen_frames))
    stamps_ns = np.repeat(recording.frame_times_ns[chosen_frames], len(chosen_cameras))
    calibration: FocalSource = "calibration"
    models = tuple(camera.model for camera in rig_cameras)
    names = tuple(f"cam{numbers[k]}/{t}" for k, t in zip(image_camera.tolist(), stamps_ns.tolist(), strict=True))
    return ImageSet(
        names=names,
        image_camera=image_camera,
        cameras=models,
        is_calibrated=np.full(len(models), True),
        is_ordered=True,
        t_ns=stamps_ns + delays_ns.ravel(),
        frame=frame,
        Ts_imu_cam=np.stack([camera.T_imu_cam for camera in rig_cameras]),
        read=RecordedImages(recording, chosen_frames, chosen_cameras),
        read_mask=find_masks(Path(masks) if masks is not None else None, names, image_camera, models),
        focal_source=(calibration,) * len(models),
        inertial=InertialData(recording.imu, recording.rig.imu, recording.rig.time_offset_s)
        if len(recording.imu)
        else None,
    )


def _delays_ns(recording: Recording, frames: Indices, cameras: tuple[int, ...]) -> Times:
    """Return how much later than its frame (F,) the image of each camera (C,) is exposed, as (F, C) [ns]."""
    by_stamp = getattr(recording, "image_delays_ns", None)
    delays = np.zeros((len(frames), len(cameras)), np.int64) if by_stamp is None else by_stamp[frames][:, cameras]
    offsets = np.array([round(1e9 * recording.rig.cameras[k].time_offset_s) for k in cameras])
    return np.asarray(delays + offsets)


def _frame_indices(frames: int | Sequence[int] | None, count: int) -> Indices:
    """Return the indices of the frames to use of ``count`` frames, increasing, or raise ConfigError."""
    if frames is None:
        return np.arange(count, dtype=np.int64)
    if isinstance(frames, int):
        if not 1 <= frames <= count:
            raise ConfigError(f"{frames} frames of a recording with {count}; expected 1 to {count}")
        return np.round(np.linspace(0, count - 1, frames)).astype(np.int64)
    if not len(frames) or len(set(frames)) < len(frames) or min(frames) < 0 or max(frames) >= count:
        listed = ", ".join(map(str, frames)) or "none"
        raise ConfigError(f"frame indices {listed} of a recording; expected different ones from 0 to {count - 1}")
    return np.array(sorted(frames), dtype=np.int64)
