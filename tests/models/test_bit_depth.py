"""Significant bits of images with 16 bits per channel, and their scale, which is one for all images of a camera."""

from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from dronevio.models.camera import CameraModel
from dronevio.models.image_sets import image_folder
from dronevio.models.imu import ImuSamples
from dronevio.models.recordings.bit_depth import significant_bits, spread, to_8bit
from dronevio.models.recordings.euroc import EurocRecording, write_euroc
from dronevio.models.rig import EUROC_T_IMU_CAM0, Rig, RigCamera

WIDTH, HEIGHT = 32, 24
Deep = npt.NDArray[np.uint16]

SHAPES = [(HEIGHT, WIDTH), (HEIGHT, WIDTH, 3)]


def scene(bits: int, seed: int = 0, brightness: float = 1.0, shape: tuple[int, ...] = (HEIGHT, WIDTH)) -> Deep:
    """Return an image whose values fill the range of a number of bits, times a brightness."""
    values = np.random.default_rng(seed).random(shape) * brightness * (2**bits - 1)
    values.flat[0] = brightness * (2**bits - 1)
    values.flat[1:60] = values.flat[0]
    return np.asarray(values, np.uint16)


def write_images(folder: Path, images: list[Deep], suffix: str = ".png") -> list[Path]:
    files = [folder / f"{k}{suffix}" for k in range(len(images))]
    folder.mkdir(parents=True, exist_ok=True)
    for file, image in zip(files, images, strict=True):
        assert cv2.imwrite(str(file), image[..., ::-1] if image.ndim == 3 else image)
    return files


@pytest.mark.parametrize("bits", range(8, 17))
def test_the_bits_that_occur_are_found_and_scaled_to_eight(bits: int) -> None:
    image = scene(bits)
    assert significant_bits([image]) == bits
    scaled = to_8bit(image, bits)
    assert scaled.dtype == np.uint8
    np.testing.assert_array_equal(scaled, image // 2 ** (bits - 8))
    assert scaled.max() == 255


def test_images_of_8_bits_stay_as_they_are() -> None:
    image = np.arange(256, dtype=np.uint8).reshape(16, 16)
    assert significant_bits([image, image]) == 8
    assert to_8bit(image, 12) is image


def test_the_brightest_image_decides() -> None:
    assert significant_bits([scene(12, brightness=0.1), scene(12), scene(12, brightness=0.2)]) == 12
    assert significant_bits([]) == 8


def test_a_few_hot_pixels_do_not_make_images_dark() -> None:
    image = scene(10, shape=(480, 752))
    image.flat[:: image.size // 30] = 65535
    assert significant_bits([image]) == 10
    assert to_8bit(image, 10).max() == 255


def test_images_are_spread_over_a_sequence() -> None:
    assert spread(range(100), 3) == [0, 50, 99]
    assert spread([4, 5], 9) == [4, 5]
    assert spread([]) == []


@pytest.mark.parametrize("bits", [10, 12, 14, 16])
@pytest.mark.parametrize("suffix", [".png", ".tiff"])
def test_all_frames_of_a_recording_have_one_scale(tmp_path: Path, bits: int, suffix: str) -> None:
    """The first frame is dark: it stays dark, and the others do not saturate."""
    camera = RigCamera(CameraModel(WIDTH, HEIGHT, 20.0, 20.0, 15.5, 11.5), EUROC_T_IMU_CAM0)
    t_ns = np.arange(1, 5) * 50_000_000
    imu = ImuSamples(t_ns, np.zeros((4, 3)), np.zeros((4, 3)))
    write_euroc(tmp_path, Rig((camera, camera)), imu, None, t_ns)
    dark, bright = scene(bits, 1, 0.05), scene(bits, 2)
    ordinary = np.full((HEIGHT, WIDTH), 31, np.uint8)
    for t in t_ns.tolist():  # the reader goes by content, not by name
        deep, files = dark if t == t_ns[0] else bright, [tmp_path / f"mav0/cam{i}/data/{t}.png" for i in range(2)]
        files[0].write_bytes(cv2.imencode(suffix, deep)[1].tobytes())
        files[1].write_bytes(cv2.imencode(suffix, ordinary)[1].tobytes())
    recording = EurocRecording.open(tmp_path)
    assert recording.image_bits == (bits, 8)
    np.testing.assert_array_equal(recording.frame(0).images[0], dark >> (bits - 8))
    np.testing.assert_array_equal(recording.frame(3).images[0], bright >> (bits - 8))
    np.testing.assert_array_equal(recording.frame(3).images[1], ordinary)


@pytest.mark.parametrize("bits", [10, 12, 14, 16])
@pytest.mark.parametrize("suffix", [".png", ".tiff"])
@pytest.mark.parametrize("shape", SHAPES, ids=["grey", "colour"])
def test_all_photographs_of_a_camera_have_one_scale(
    tmp_path: Path, bits: int, suffix: str, shape: tuple[int, ...]
) -> None:
    photos = [scene(bits, 1, 0.05, shape), scene(bits, 2, 1.0, shape)]
    write_images(tmp_path / "photos", photos, suffix)
    images = image_folder(tmp_path / "photos")
    for index, photo in enumerate(photos):
        np.testing.assert_array_equal(images.read(index), photo >> (bits - 8))


def test_a_damaged_photograph_does_not_prevent_the_opening(tmp_path: Path) -> None:
    files = write_images(tmp_path / "photos", [scene(12, 1), scene(12, 2)])
    files[0].write_bytes(files[0].read_bytes()[:-200])
    np.testing.assert_array_equal(image_folder(tmp_path / "photos").read(1), scene(12, 2) >> 4)
