"""AV1 videos of grey images: quality, size, keyframes and latency of the encoder."""

import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest

from dronevio.eval.rerun.video import Av1Encoder, VideoSample, VideoSettings
from dronevio.models.arrays import Image

if TYPE_CHECKING:
    from tests.eval.conftest import DecodeAv1

RATE_HZ = 20.0


def moving_images(count: int = 45, width: int = 376, height: int = 240) -> Iterator[Image]:
    """Yield windows that move over a texture, with noise that differs from image to image."""
    texture = cv2.resize(np.random.default_rng(0).integers(0, 256, (60, 90), dtype=np.uint8), (900, 600))
    for i in range(count):
        window = texture[2 * i : 2 * i + height, 5 * i : 5 * i + width]
        noise = np.random.default_rng(i).normal(0.0, 2.0, window.shape)
        yield np.clip(window + noise, 0, 255).astype(np.uint8)


def encode(
    images: Iterable[Image], rate_hz: float = RATE_HZ, settings: VideoSettings | None = None
) -> list[VideoSample]:
    """Return the samples of a video."""
    encoder = Av1Encoder(rate_hz, settings or VideoSettings())
    samples = [sample for image in images for sample in encoder.encode(image)]
    return [*samples, *encoder.finish()]


def psnr_db(a: Image, b: Image) -> float:
    """Return the peak signal-to-noise ratio of two images [dB]."""
    return float(10.0 * np.log10(255.0**2 / np.mean((a.astype(float) - b.astype(float)) ** 2)))


@pytest.fixture(scope="module")
def images() -> list[Image]:
    """Return 45 images at 20 Hz, more than one keyframe interval."""
    return list(moving_images())


@pytest.fixture(scope="module")
def samples(images: list[Image]) -> list[VideoSample]:
    """Return the encoded images."""
    return encode(images)


def test_every_image_is_decoded_in_order(
    images: list[Image], samples: list[VideoSample], decode_av1: "DecodeAv1"
) -> None:
    decoded = decode_av1(sample.data for sample in samples)
    assert len(samples) == len(decoded) == len(images)
    assert min(psnr_db(a, b) for a, b in zip(decoded, images, strict=True)) > 33.0
    # A decoded image is closer to its own original than to the next image.
    assert all(psnr_db(decoded[i], images[i]) > psnr_db(decoded[i], images[i + 1]) for i in range(len(images) - 1))


def test_decoding_can_start_at_each_keyframe(
    images: list[Image], samples: list[VideoSample], decode_av1: "DecodeAv1"
) -> None:
    keyframes = [i for i, sample in enumerate(samples) if sample.is_keyframe]
    assert keyframes == [0, 40]
    for first in keyframes:
        decoded = decode_av1(sample.data for sample in samples[first : first + 3])
        assert len(decoded) == 3
        assert psnr_db(decoded[0], images[first]) > 33.0
        assert samples[first].data[0] >> 3 & 0xF in (
            1,
            2,
        )  # type of the first OBU: sequence header, or temporal delimiter


def test_samples_take_less_than_a_tenth_of_the_images(images: list[Image], samples: list[VideoSample]) -> None:
    assert sum(len(sample.data) for sample in samples) < 0.1 * sum(image.nbytes for image in images)


def test_a_larger_rate_factor_gives_smaller_samples(images: list[Image]) -> None:
    coarse = sum(len(sample.data) for sample in encode(images, settings=VideoSettings(crf=50)))
    fine = sum(len(sample.data) for sample in encode(images, settings=VideoSettings(crf=25)))
    assert coarse < 0.5 * fine


def test_same_images_give_the_same_bytes(images: list[Image], samples: list[VideoSample]) -> None:
    assert [sample.data for sample in encode(images)] == [sample.data for sample in samples]


def test_no_images_give_no_samples() -> None:
    assert encode([]) == []


def test_the_frame_rate_need_not_be_an_integer() -> None:
    assert len(encode(moving_images(5), 29.97)) == 5


def test_the_encoder_prints_nothing(capfd: pytest.CaptureFixture[str]) -> None:
    encode(moving_images(3))
    out, err = capfd.readouterr()
    assert out == err == ""


def test_the_full_range_of_grey_values_is_kept(decode_av1: "DecodeAv1") -> None:
    image = np.zeros((240, 376), np.uint8)
    image[:, 188:] = 255
    [decoded] = decode_av1(sample.data for sample in encode([image]))
    assert decoded[:, :180].max() <= 1
    assert decoded[:, 196:].min() >= 254


def test_images_of_odd_size_are_padded_to_even_size(decode_av1: "DecodeAv1") -> None:
    images = [image[:239, :375] for image in moving_images(3)]
    decoded = decode_av1(sample.data for sample in encode(images))
    assert [frame.shape for frame in decoded] == [(240, 376)] * 3
    assert psnr_db(decoded[2][:239, :375], images[2]) > 33.0


def test_each_sample_is_returned_without_delay(images: list[Image]) -> None:
    encoder = Av1Encoder(RATE_HZ, VideoSettings())
    assert [len(encoder.encode(image)) for image in images] == [1] * len(images)
    assert encoder.finish() == []


@pytest.mark.skipif(not hasattr(os, "sched_getscheduler"), reason="the system has no scheduling policies")
def test_the_encoder_keeps_the_priority_of_threads(images: list[Image]) -> None:
    """SVT-AV1 gives all its threads and the caller real-time priority if it runs as root."""
    encoder = Av1Encoder(RATE_HZ, VideoSettings())
    encoder.encode(images[0])
    policies = {os.sched_getscheduler(int(thread.name)) for thread in Path("/proc/self/task").iterdir()}
    encoder.finish()
    assert policies == {os.SCHED_OTHER}
