"""Image sets from videos, whose frames are decoded on request."""

from pathlib import Path

import numpy as np

from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError, InputError
from dronevio.models.image_sets.image_set import FocalSource, ImageSet
from dronevio.models.image_sets.intrinsics import initial_camera
from dronevio.models.image_sets.masks import find_masks
from dronevio.models.lenses.lens import LensName
from dronevio.models.recordings.video_frames import VideoFrames, read_video_index

VIDEO_SUFFIXES = (".mp4", ".avi", ".mov", ".mkv", ".webm")
"""Suffixes of video files, in lower case."""


def image_video(
    path: Path | str,
    every: int = 1,
    model: CameraModel | None = None,
    masks: Path | str | None = None,
    lens: LensName = "radtan",
) -> ImageSet:
    """Return frames of a video.

    Args:
        path: The video.
        every: Distance between the frames to return: 1 for all, 10 for each tenth.
        model: Calibration of the camera, None for an assumed field of view.
        masks: A folder of masks or one mask for all images; see `dronevio.models.image_sets.masks`.
        lens: Lens model without a calibration: ``radtan``, a pinhole, or ``equidistant``, a fisheye.

    Raises:
        InputError: The video is missing, damaged, or has another size than the calibration.
        ConfigError: ``every`` is below 1.
    """
    path = Path(path)
    if every < 1:
        raise ConfigError(f"every {every} frames of a video; expected 1 or more")
    index = read_video_index(path)
    if model is not None and (index.width, index.height) != (model.width, model.height):
        raise InputError(
            path,
            f"a video of {index.width} × {index.height} px",
            f"{model.width} × {model.height} px as in the calibration",
        )
    source: FocalSource
    camera, source = initial_camera(index.width, index.height, lens=lens)
    if model is not None:
        camera, source = model, "calibration"
    chosen = np.arange(0, len(index.pts), every, dtype=np.int64)
    names = tuple(f"frame-{i:06d}" for i in chosen.tolist())
    image_camera = np.zeros(len(chosen), np.int64)
    return ImageSet(
        names=names,
        image_camera=image_camera,
        cameras=(camera,),
        is_calibrated=np.array([model is not None]),
        is_ordered=True,
        t_ns=np.array([round(pts * index.time_base * 10**9) for pts in index.pts[chosen].tolist()], dtype=np.int64),
        frame=None,
        Ts_imu_cam=None,
        read=VideoFrames(path, index, index.pts[chosen]),
        read_mask=find_masks(Path(masks) if masks is not None else None, names, image_camera, (camera,)),
        focal_source=(source,),
    )
