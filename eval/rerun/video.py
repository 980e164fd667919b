"""Grey images as an AV1 video, at about a twentieth of their uncompressed size.

The rerun viewer decodes AV1 itself, natively and in a browser, while other codecs need ffmpeg. The encoder is SVT-AV1,
which is part of PyAV's wheel.
"""

import os
from collections.abc import Iterable
from dataclasses import dataclass
from fractions import Fraction
from typing import Annotated

import av
import numpy as np
from av.video.reformatter import ColorRange

from dronevio.eval.rerun.encoder_threads import open_encoder, wait_until_idle
from dronevio.models.arrays import Image
from dronevio.models.ranges import Range, Settings

_NEUTRAL_CHROMA = 128  # of both colour differences


@dataclass(frozen=True)
class VideoSettings(Settings):
    """Settings that trade size for quality and speed."""

    crf: Annotated[int, Range(0, 63)] = 42
    """Constant rate factor, from 0 for the best quality to 63 for the smallest size."""
    preset: Annotated[int, Range(0, 13)] = 13
    """Speed preset of SVT-AV1, from 0 for the slowest to 13 for the fastest."""
    keyframe_interval: Annotated[int, Range(1, 1000)] = 40
    """Number of frames between keyframes, which a viewer decodes when the time cursor jumps."""


@dataclass(frozen=True)
class VideoSample:
    """One encoded frame."""

    data: bytes
    """AV1 temporal unit in the low-overhead bitstream format."""
    is_keyframe: bool
    """Whether decoding can begin with this frame."""


class Av1Encoder:
    """Encodes grey images of one size into one sample per frame, in order.

    No frame refers to a later one (``pred-struct=1``), so that each sample is one frame and is returned at once. The
    encoder's threads are idle before the sample is returned, so that no work continues in the background while the
    estimator is timed, and for the reason in `dronevio.eval.rerun.encoder_threads`. ``rtc=1`` improves the motion
    search of the fast presets. The lowest level of parallelism (``lp=1``) uses the least processor time. The
    restoration filter has no visible effect here and is disabled.
    """

    def __init__(self, rate_hz: float, settings: VideoSettings) -> None:
        """Take the frame rate [Hz], which influences the bit rate, and the settings."""
        self._rate_hz = rate_hz
        self._settings = settings
        self._encoder: av.VideoCodecContext | None = None  # made for the size of the first image
        self._threads: frozenset[int] = frozenset()  # those of the encoder
        self._count = 0

    def encode(self, image: Image) -> list[VideoSample]:
        """Encode the next image (H, W) and return the finished samples."""
        if self._encoder is None:
            height, width = (n + n % 2 for n in image.shape)
            self._encoder = _make_encoder(width, height, self._rate_hz, self._settings)
            self._threads = open_encoder(self._encoder)
        frame = av.VideoFrame.from_ndarray(_as_yuv420(image), format="yuv420p")
        frame.color_range = ColorRange.JPEG
        frame.pts = self._count
        self._count += 1
        samples = _samples(self._encoder.encode(frame))
        wait_until_idle(self._threads)
        return samples

    def finish(self) -> list[VideoSample]:
        """Return the remaining samples after the last image."""
        return [] if self._encoder is None else _samples(self._encoder.encode(None))


def _as_yuv420(image: Image) -> Image:
    """Return a grey image (H, W) as planar YUV (3 H / 2, W); odd sizes repeat the last row or column."""
    image = np.pad(image, [(0, n % 2) for n in image.shape], mode="edge")
    height, width = image.shape
    return np.concatenate([image, np.full((height // 2, width), _NEUTRAL_CHROMA, np.uint8)])


def _make_encoder(width: int, height: int, rate_hz: float, settings: VideoSettings) -> av.VideoCodecContext:
    os.environ.setdefault("SVT_LOG", "1")  # only errors; the default writes thirty lines to standard error
    encoder = av.CodecContext.create("libsvtav1", "w")
    encoder.width, encoder.height = width, height
    encoder.pix_fmt = "yuv420p"
    encoder.color_range = ColorRange.JPEG  # 0 is black and 255 is white, as in the images
    encoder.framerate = Fraction(rate_hz).limit_denominator(1000)
    encoder.time_base = 1 / encoder.framerate
    encoder.gop_size = settings.keyframe_interval
    parameters = "pred-struct=1:rtc=1:lp=1:enable-restoration=0"
    encoder.options = {"preset": str(settings.preset), "crf": str(settings.crf), "svtav1-params": parameters}
    return encoder


def _samples(packets: "Iterable[av.Packet[av.VideoStream]]") -> list[VideoSample]:
    return [VideoSample(bytes(packet), packet.is_keyframe) for packet in packets]
