"""Image files of frames."""

from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from dronevio.models.state import CameraFrame

PARTIAL_SUFFIX = ".partial"
"""Suffix of the file of an image that is being written."""


def frame_file(mav0: Path, folder: str, t_ns: int) -> Path:
    """Return the file of an image with a time stamp [ns] in one of the folders of ``mav0``."""
    return mav0 / folder / "data" / f"{t_ns}.png"


def write_frame(mav0: Path, frame: CameraFrame) -> None:
    """Write the images of a frame as recordings have them: ``cam{i}/data/<stamp>.png`` for each camera.

    Args:
        mav0: The folder; missing folders are created.
        frame: The frame.
    """
    for number, image in enumerate(frame.images):
        path = frame_file(mav0, f"cam{number}", frame.t_ns)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_png(path, image)


def write_png(path: Path, image: npt.NDArray[np.uint8] | npt.NDArray[np.uint16]) -> None:
    """Write an image to a temporary name and rename it, so that no partial image is visible."""
    partial = path.with_suffix(PARTIAL_SUFFIX)
    partial.write_bytes(cv2.imencode(".png", image)[1].tobytes())
    partial.replace(path)
