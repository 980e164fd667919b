"""Frames of videos, which are decoded on request.

The time stamps of all frames are read first, without decoding. A frame is then decoded from the position in the video
or from the last keyframe before it, whichever is nearer, so that reading in order decodes each frame once. The result
does not depend on the order of the requests.
"""

import threading
from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Image
from dronevio.models.errors import InputError
from dronevio.models.recordings.files import check_regular_file
from dronevio.models.recordings.image_header import MAX_FRAME_PIXELS

if TYPE_CHECKING:
    from av.video.frame import VideoFrame

Indices = npt.NDArray[np.int64]

_EXPECTED = "a video that can be decoded"
_STAMPED = "a video with a time stamp of each frame, such as an MP4 or Matroska file"
_CACHED_FRAMES = 4  # for several threads, which request frames almost in order


@dataclass(frozen=True, eq=False)
class VideoIndex:
    """Size and time stamps of the N frames of a video, in the order of time."""

    width: int
    """Number of columns [px]."""
    height: int
    """Number of rows [px]."""
    pts: Indices
    """(N,) Presentation time stamp of each frame, strictly increasing, in units of the time base."""
    keyframe_pts: Indices
    """(M,) Presentation time stamps of the keyframes, strictly increasing."""
    time_base: Fraction
    """Unit of the time stamps [s]."""


def read_video_index(path: Path) -> VideoIndex:
    """Return the size and the time stamps of the frames of the first video stream of a file.

    Raises:
        InputError: The file is missing, not a video, or has no time stamps.
    """
    import av

    check_regular_file(path, _EXPECTED)
    pts: list[int] = []
    keyframes: list[int] = []
    try:
        with av.open(str(path)) as container:
            if not container.streams.video:
                raise InputError(path, "no video stream", _EXPECTED)
            stream = container.streams.video[0]
            if container.format.name == "avi" and stream.codec_context.has_b_frames:
                raise InputError(path, "an AVI file with B-frames, whose times it does not store", _STAMPED)
            width, height, time_base = stream.width, stream.height, stream.time_base
            if width * height > MAX_FRAME_PIXELS:
                raise InputError(path, f"frames of {width} × {height} px", f"at most {MAX_FRAME_PIXELS // 10**6} Mpx")
            for packet in container.demux(stream):
                if packet.size == 0 or packet.is_discard:
                    continue
                if packet.pts is None:
                    raise InputError(path, "a frame without time stamp", _STAMPED)
                pts.append(packet.pts)
                if packet.is_keyframe:
                    keyframes.append(packet.pts)
    except (av.FFmpegError, OSError) as error:
        raise InputError(path, f"cannot be read ({error.strerror})", _EXPECTED) from None
    if not pts or time_base is None:
        raise InputError(path, "no frames", _EXPECTED)
    return VideoIndex(width, height, np.unique(pts), np.unique(keyframes), time_base)


class VideoFrames:
    """Frames of a video; the object is called with the index of a frame. Several threads may call it."""

    def __init__(self, path: Path, index: VideoIndex, pts: Indices, is_grey: bool = False) -> None:
        """Take the frames to read.

        Args:
            path: The video.
            index: Its size and time stamps.
            pts: (I,) Presentation time stamps of the frames to read, increasing.
            is_grey: Whether images are grey, also those in colour.
        """
        self._path, self._index, self._pts, self._is_grey = path, index, pts, is_grey
        self._lock = threading.Lock()
        self._decoded: OrderedDict[int, Image] = OrderedDict()
        self._following: Iterator[VideoFrame] = iter(())
        self._position: int | None = None

    def __call__(self, index: int) -> Image:
        """Return the frame with a given index: grey (H, W), or red, green and blue (H, W, 3).

        Raises:
            InputError: The video cannot be decoded, or the frame has another size than the first.
        """
        import av

        index = range(len(self._pts))[index]
        with self._lock:
            if index not in self._decoded:
                try:
                    self._decode(index)
                except (av.FFmpegError, OSError) as error:
                    self._position = None
                    raise InputError(self._path, f"cannot be decoded ({error.strerror})", _EXPECTED) from None
            return self._decoded[index].copy()

    def _decode(self, index: int) -> None:
        """Decode the video up to the frame with a given index and keep its image, or raise InputError."""
        pts = int(self._pts[index])
        before = self._index.keyframe_pts[self._index.keyframe_pts <= pts]
        keyframe = int(before[-1]) if len(before) else None
        position = self._position
        if position is None or position >= pts or (keyframe is not None and keyframe > position):
            self._following = _frames(self._path, keyframe)
        if self._advance(index):
            return
        self._following = _frames(self._path, None)  # some files have no exact index of their keyframes
        if not self._advance(index):
            time_s = float(pts * self._index.time_base)
            raise InputError(self._path, f"no frame at {time_s:.6f} s, where there is a packet", _EXPECTED)

    def _advance(self, index: int) -> bool:
        """Decode frames until the one with a given index, and keep the images of the last ones; return whether it
        was found.
        """
        for frame in self._following:
            self._position = frame.pts
            if frame.pts is None or frame.pts > self._pts[index]:
                break
            number = int(np.searchsorted(self._pts, frame.pts))
            if frame.pts == self._pts[number] and number > index - _CACHED_FRAMES:
                self._decoded[number] = self._image(frame)
                self._decoded.move_to_end(number)
                while len(self._decoded) > _CACHED_FRAMES:
                    self._decoded.popitem(last=False)
            if number == index and frame.pts == self._pts[number]:
                return True
        self._position = None
        return False

    def _image(self, frame: "VideoFrame") -> Image:
        """Return the pixels of a decoded frame, or raise InputError."""
        if frame.is_corrupt:
            raise InputError(self._path, f"a damaged frame at {frame.time:.6f} s", _EXPECTED)
        if (frame.width, frame.height) != (self._index.width, self._index.height):
            raise InputError(
                self._path,
                f"a frame of {frame.width} × {frame.height} px",
                f"{self._index.width} × {self._index.height} px as in the first frame",
            )
        is_grey = self._is_grey or frame.format.name.startswith("gray")
        return np.asarray(frame.to_ndarray(format="gray" if is_grey else "rgb24"), dtype=np.uint8)


def _frames(path: Path, keyframe_pts: int | None) -> "Iterator[VideoFrame]":
    """Yield the frames of a video from a keyframe on, from the beginning if it is None."""
    import av

    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        stream.codec_context.options = {"max_pixels": str(MAX_FRAME_PIXELS)}  # frames may become larger than the first
        if keyframe_pts is not None:
            container.seek(keyframe_pts, stream=stream)
        yield from container.decode(stream)
