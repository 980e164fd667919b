"""Images of a camera in a recording: a video in a file, or JPEG images for a viewer during the flight."""

from typing import Protocol

import cv2
import numpy as np
import rerun as rr

from dronevio.eval.rerun.sink import Sink
from dronevio.eval.rerun.video import Av1Encoder, VideoSample, VideoSettings
from dronevio.models.arrays import Image

_JPEG_QUALITY = 75


class ImageLog(Protocol):
    """Logs the images of one camera."""

    def add(self, t_ns: int, image: Image) -> None:
        """Add the next image (H, W) with its time stamp [ns]."""

    def close(self) -> None:
        """Log the images that have not been logged yet."""


class VideoLog:
    """Encodes images as AV1 and logs one keyframe interval at a time, which can be decoded by itself."""

    def __init__(self, sink: Sink, entity: str, rate_hz: float, settings: VideoSettings) -> None:
        """Start the video.

        Args:
            sink: Output of the rows.
            entity: Path of the images.
            rate_hz: Frame rate of the camera [Hz].
            settings: Size and quality of the video.
        """
        self._sink, self._entity = sink, entity
        self._encoder = Av1Encoder(rate_hz, settings)
        self._t_ns: list[int] = []
        self._samples: list[VideoSample] = []
        sink.static(entity, rr.VideoStream(codec=rr.VideoCodec.AV1))

    def add(self, t_ns: int, image: Image) -> None:
        """Add the next image (H, W); a keyframe logs the interval before it."""
        self._t_ns.append(t_ns)
        for sample in self._encoder.encode(image):
            self._add_sample(sample)

    def close(self) -> None:
        """Log the last interval."""
        for sample in self._encoder.finish():
            self._add_sample(sample)
        self._flush()

    def _add_sample(self, sample: VideoSample) -> None:
        if sample.is_keyframe:
            self._flush()
        self._samples.append(sample)

    def _flush(self) -> None:
        done = len(self._samples)
        if done == 0:
            return
        columns = rr.VideoStream.columns(
            sample=[sample.data for sample in self._samples],
            is_keyframe=[sample.is_keyframe for sample in self._samples],
        )
        self._sink.columns(self._entity, np.array(self._t_ns[:done], dtype=np.int64), columns)
        del self._samples[:], self._t_ns[:done]


class JpegLog:
    """Encodes images as JPEG and logs a batch at a time, without waiting for later frames and without threads."""

    def __init__(self, sink: Sink, entity: str, batch: int) -> None:
        """Take the output, the path of the images, and the number of images of a batch."""
        self._sink, self._entity, self._batch = sink, entity, batch
        self._t_ns: list[int] = []
        self._blobs: list[bytes] = []

    def add(self, t_ns: int, image: Image) -> None:
        """Add the next image (H, W); a full batch is logged."""
        _, blob = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
        self._t_ns.append(t_ns)
        self._blobs.append(blob.tobytes())
        if len(self._blobs) >= self._batch:
            self.close()

    def close(self) -> None:
        """Log the images that have not been logged yet."""
        if not self._blobs:
            return
        columns = rr.EncodedImage.columns(blob=self._blobs, media_type=["image/jpeg"] * len(self._blobs))
        self._sink.columns(self._entity, np.array(self._t_ns, dtype=np.int64), columns)
        self._t_ns, self._blobs = [], []
