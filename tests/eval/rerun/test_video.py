import av
import cv2
import numpy as np
import pytest

from dronevio.eval.rerun.video import Av1Encoder, VideoSettings

RATE_HZ = 20.0


def moving_images(count=45, width=376, height=240):
    texture = cv2.resize(np.random.default_rng(0).integers(0, 256, (60, 90), dtype=np.uint8), (900, 600))
    for i in range(count):
        window = texture[2 * i : 2 * i + height, 5 * i : 5 * i + width]
        noise = np.random.default_rng(i).normal(0.0, 2.0, window.shape)
        yield np.clip(window + noise, 0, 255).astype(np.uint8)


def encode(images, rate_hz=RATE_HZ, settings=None):
    encoder = Av1Encoder(rate_hz, settings or VideoSettings())
    samples = [sample for image in images for sample in encoder.encode(image)]
    return [*samples, *encoder.finish()]


def decode(samples):
    decoder = av.CodecContext.create("libdav1d", "r")
    packets = [av.Packet(sample.data) for sample in samples]
    frames = [frame for packet in [*packets, None] for frame in decoder.decode(packet)]
    return [frame.to_ndarray(format="gray") for frame in frames]


def psnr_db(a, b):
    return 10.0 * np.log10(255.0**2 / np.mean((a.astype(float) - b.astype(float)) ** 2))


@pytest.fixture(scope="module")
def images():
    return list(moving_images())


@pytest.fixture(scope="module")
def samples(images):
    return encode(images)


def test_every_image_comes_back_in_its_place(images, samples):
    decoded = decode(samples)
    assert len(samples) == len(decoded) == len(images)
    assert min(psnr_db(a, b) for a, b in zip(decoded, images, strict=True)) > 33.0
    # a frame is more like its own original than like its neighbour's
    assert all(psnr_db(decoded[i], images[i]) > psnr_db(decoded[i], images[i + 1]) for i in range(len(images) - 1))


def test_decoding_can_start_at_each_keyframe(images, samples):
    keyframes = [i for i, sample in enumerate(samples) if sample.is_keyframe]
    assert keyframes == [0, 40]
    for first in keyframes:
        decoded = decode(samples[first : first + 3])
        assert len(decoded) == 3
        assert psnr_db(decoded[0], images[first]) > 33.0
        assert samples[first].data[0] >> 3 & 0xF in (1, 2)  # a sequence header, after a temporal delimiter at most


def test_samples_are_small(images, samples):
    assert sum(len(sample.data) for sample in samples) < 0.1 * sum(image.nbytes for image in images)


def test_lower_quality_is_smaller(images):
    coarse = sum(len(sample.data) for sample in encode(images, settings=VideoSettings(crf=50)))
    fine = sum(len(sample.data) for sample in encode(images, settings=VideoSettings(crf=25)))
    assert coarse < 0.5 * fine


def test_same_images_give_the_same_bytes(images, samples):
    assert [sample.data for sample in encode(images)] == [sample.data for sample in samples]


def test_no_images_give_no_samples():
    assert encode([]) == []


def test_a_rate_that_is_no_integer():
    assert len(encode(moving_images(5), 29.97)) == 5


def test_the_encoder_is_silent(capfd):
    encode(moving_images(3))
    out, err = capfd.readouterr()
    assert out == err == ""


def test_black_is_black_and_white_is_white():
    image = np.zeros((240, 376), np.uint8)
    image[:, 188:] = 255
    [decoded] = decode(encode([image]))
    assert decoded[:, :180].max() <= 1
    assert decoded[:, 196:].min() >= 254


def test_an_odd_size_is_made_even():
    images = [image[:239, :375] for image in moving_images(3)]
    decoded = decode(encode(images))
    assert [frame.shape for frame in decoded] == [(240, 376)] * 3
    assert psnr_db(decoded[2][:239, :375], images[2]) > 33.0


def test_each_sample_comes_at_once(images):
    encoder = Av1Encoder(RATE_HZ, VideoSettings())
    assert [len(encoder.encode(image)) for image in images] == [1] * len(images)
    assert encoder.finish() == []
