"""Grey frames as an AV1 video: a twentieth of their raw size, and still good enough to look for a corner in.

Rerun's viewer decodes AV1 by itself, native and web, where other codecs need ffmpeg. The encoder is SVT-AV1,
which comes with PyAV's wheel.
"""

import os
from collections.abc import Iterable
from dataclasses import dataclass
from fractions import Fraction

import av
import numpy as np
import numpy.typing as npt
from av.video.reformatter import ColorRange

_NO_COLOUR = 128  # both colour differences, as they are stored
Image = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class VideoSettings:
    """How to trade size for quality and speed."""

    crf: int = 42
    """Constant rate factor, 0 (best) to 63: at 42 a 752×480 frame of a flight indoors takes 8 kB, at 38 10 kB."""
    preset: int = 13
    """SVT-AV1's speed, 0 (slowest) to 13: there such a frame takes 3 ms of processor time, at 10 twice that."""
    keyframe_interval: int = 40
    """Frames from one keyframe to the next: how far a viewer must decode when the time cursor jumps."""


@dataclass(frozen=True)
class VideoSample:
    """One encoded frame."""

    data: bytes
    """An AV1 temporal unit, in the low-overhead bitstream format."""
    is_keyframe: bool
    """Whether decoding can start here."""


class Av1Encoder:
    """Encodes grey images of one size; gives one sample a frame, in order.

    The stream has no frames that refer to later ones (``pred-struct=1``), so that each sample is one frame, known by
    its place, and comes at once: nothing runs on in the background, into the times that others are measuring.
    ``rtc=1`` makes the fast presets search motion better: they are made for video calls. One thread does the work
    (``lp=1``): more of them take half as much processor time again. The restoration filter, which mends nothing
    that one would see here, is left out.
    """

    def __init__(self, rate_hz: float, settings: VideoSettings) -> None:
        """Take the frame rate [Hz], which the choice of bits depends on, and the settings."""
        self._rate_hz = rate_hz
        self._settings = settings
        self._encoder: av.VideoCodecContext | None = None  # its size is that of the first image
        self._count = 0

    def encode(self, image: Image) -> list[VideoSample]:
        """Take the next image (H, W) and return the samples that are done."""
        if self._encoder is None:
            height, width = (n + n % 2 for n in image.shape)
            self._encoder = _encoder(width, height, self._rate_hz, self._settings)
        frame = av.VideoFrame.from_ndarray(_without_colour(image), format="yuv420p")
        frame.color_range = ColorRange.JPEG
        frame.pts = self._count
        self._count += 1
        return _samples(self._encoder.encode(frame))

    def finish(self) -> list[VideoSample]:
        """Return the samples that are still missing, when all images have been taken."""
        return [] if self._encoder is None else _samples(self._encoder.encode(None))


def _without_colour(image: Image) -> Image:
    """Return a grey image (H, W) as planar YUV (3 H / 2, W); an odd size is made even by its last row or column."""
    image = np.pad(image, [(0, n % 2) for n in image.shape], mode="edge")
    height, width = image.shape
    return np.concatenate([image, np.full((height // 2, width), _NO_COLOUR, np.uint8)])


def _encoder(width: int, height: int, rate_hz: float, settings: VideoSettings) -> av.VideoCodecContext:
    os.environ.setdefault("SVT_LOG", "1")  # errors only: else it writes thirty lines on standard error
    encoder = av.CodecContext.create("libsvtav1", "w")
    encoder.width, encoder.height = width, height
    encoder.pix_fmt = "yuv420p"
    encoder.color_range = ColorRange.JPEG  # 0 is black and 255 white, as in the images
    encoder.framerate = Fraction(rate_hz).limit_denominator(1000)
    encoder.time_base = 1 / encoder.framerate
    encoder.gop_size = settings.keyframe_interval
    parameters = "pred-struct=1:rtc=1:lp=1:enable-restoration=0"
    encoder.options = {"preset": str(settings.preset), "crf": str(settings.crf), "svtav1-params": parameters}
    return encoder


def _samples(packets: "Iterable[av.Packet[av.VideoStream]]") -> list[VideoSample]:
    return [VideoSample(bytes(packet), packet.is_keyframe) for packet in packets]
