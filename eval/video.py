"""Grey frames as an AV1 video: a twentieth of their raw size, and still good enough to look for a corner in.

Rerun's viewer decodes AV1 by itself, native and web, where other codecs need ffmpeg. The encoder is SVT-AV1,
which comes with PyAV's wheel.
"""

import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from fractions import Fraction

import av
import numpy as np
import numpy.typing as npt

Image = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class VideoSettings:
    """How to trade size for quality and speed."""

    crf: int = 36
    """Constant rate factor, 0 (best) to 63: at 36 a sharply textured, noisy 752×480 frame in motion takes 22 kB."""
    preset: int = 12
    """SVT-AV1's speed, 0 (slowest) to 13: at 12 such a frame takes 7 ms of processor time, at 8 three times that."""
    keyframe_interval: int = 20
    """Frames from one keyframe to the next: how far a viewer must decode when the time cursor jumps."""


@dataclass(frozen=True)
class VideoSample:
    """One encoded frame."""

    data: bytes
    """An AV1 temporal unit, in the low-overhead bitstream format."""
    is_keyframe: bool
    """Whether decoding can start here."""


def encode_av1(images: Iterable[Image], rate_hz: float, settings: VideoSettings | None = None) -> Iterator[VideoSample]:
    """Encode grey (H, W) images of one size; yields one sample a frame, in order, some frames behind the input.

    The stream has no frames that refer to later ones (``pred-struct=1``), so that each sample is one frame, known by
    its place. ``rtc=1`` makes the fast presets search motion better: they are made for video calls. The encoder runs
    in threads of its own, beside whoever decodes the images.
    """
    settings = settings or VideoSettings()
    encoder: av.VideoCodecContext | None = None
    for index, image in enumerate(images):
        if encoder is None:
            encoder = _encoder(image.shape[1], image.shape[0], rate_hz, settings)
        frame = av.VideoFrame.from_ndarray(image, format="gray").reformat(format="yuv420p")
        frame.pts = index
        yield from _samples(encoder.encode(frame))
    if encoder is not None:
        yield from _samples(encoder.encode(None))


def _encoder(width: int, height: int, rate_hz: float, settings: VideoSettings) -> av.VideoCodecContext:
    os.environ.setdefault("SVT_LOG", "1")  # errors only: else it writes thirty lines on standard error
    encoder = av.CodecContext.create("libsvtav1", "w")
    encoder.width, encoder.height = width, height
    encoder.pix_fmt = "yuv420p"
    encoder.framerate = Fraction(rate_hz).limit_denominator(1000)
    encoder.time_base = 1 / encoder.framerate
    encoder.gop_size = settings.keyframe_interval
    encoder.options = {"preset": str(settings.preset), "crf": str(settings.crf), "svtav1-params": "pred-struct=1:rtc=1"}
    return encoder


def _samples(packets: "Iterable[av.Packet[av.VideoStream]]") -> Iterator[VideoSample]:
    for packet in packets:
        yield VideoSample(bytes(packet), packet.is_keyframe)
