"""Grey images from files, and the refusal of damaged ones."""

import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dronevio.models.arrays import Image
from dronevio.models.errors import InputError
from dronevio.models.recordings.image_header import encoded_size
from dronevio.models.recordings.images import read_grey


def noise_image() -> Image:
    return np.random.default_rng(0).integers(0, 256, (24, 32), dtype=np.uint8)


IMAGE = noise_image()
PNG = cv2.imencode(".png", IMAGE)[1].tobytes()
JPEG = cv2.imencode(".jpg", IMAGE)[1].tobytes()


@pytest.fixture(scope="module")
def scratch(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("images") / "image.png"


def test_pixels_are_read_exactly(scratch: Path) -> None:
    scratch.write_bytes(PNG)
    image = read_grey(scratch, 32, 24)
    assert image.dtype == np.uint8
    np.testing.assert_array_equal(image, IMAGE)
    scratch.write_bytes(JPEG)
    assert read_grey(scratch, 32, 24).shape == (24, 32)


def test_images_of_enormous_size_are_refused(scratch: Path) -> None:
    """The header states 60000 × 60000 px, also where the calibration does."""
    size = (60_000).to_bytes(4, "big") * 2
    header = b"IHDR" + size + PNG[24:29]
    scratch.write_bytes(PNG[:12] + header + zlib.crc32(header).to_bytes(4, "big") + PNG[33:])
    with pytest.raises(InputError, match="an image of 60000 × 60000 px; expected an image of 32 × 24 px"):
        read_grey(scratch, 32, 24)
    with pytest.raises(InputError, match="an image of 60000 × 60000 px, which needs 3433 MiB; expected an image that"):
        read_grey(scratch, 60_000, 60_000)


@pytest.mark.parametrize("segments", [b"", b"\xff\xe0\x00\x04ab", b"\xff\xff\xff\xe1\x00\x06abcd"])
def test_jpegs_of_enormous_size_are_refused_by_their_header(
    scratch: Path, segments: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    at = JPEG.index(b"\xff\xc0") + 5  # height and width in the frame header
    content = JPEG[:2] + segments + JPEG[2:at] + (60_000).to_bytes(2, "big") * 2 + JPEG[at + 4 :]
    scratch.write_bytes(content)
    assert encoded_size(content) == (60_000, 60_000)
    assert encoded_size(JPEG[:2] + segments + JPEG[2:]) == encoded_size(PNG) == (32, 24)
    monkeypatch.setattr(cv2, "imdecode", None)  # nothing is decoded
    with pytest.raises(InputError, match="an image of 60000 × 60000 px; expected an image of 32 × 24 px"):
        read_grey(scratch, 32, 24)


@given(st.binary(max_size=40))
def test_damaged_headers_have_no_size_or_some_size(content: bytes) -> None:
    for data in (content, b"\xff\xd8" + content, b"\xff\xd8\xff" + content):
        size = encoded_size(data)
        assert size is None or min(size) >= 0


def test_colour_is_converted_to_grey(scratch: Path) -> None:
    scratch.write_bytes(cv2.imencode(".png", cv2.cvtColor(IMAGE, cv2.COLOR_GRAY2BGR))[1].tobytes())
    np.testing.assert_array_equal(read_grey(scratch, 32, 24), IMAGE)


@pytest.mark.parametrize("content", [PNG, JPEG], ids=["png", "jpeg"])
def test_truncated_files_are_refused(scratch: Path, content: bytes, capfd: pytest.CaptureFixture[str]) -> None:
    for end in [*range(0, len(content), 7), len(content) - 1]:
        scratch.write_bytes(content[:end])
        with pytest.raises(InputError, match="expected an image of 32 × 24 px"):
            read_grey(scratch, 32, 24)
    assert capfd.readouterr() == ("", "")  # no decoder wrote to the terminal


@settings(max_examples=300, deadline=None)
@given(st.integers(0, len(PNG) - 1), st.integers(1, 255))
def test_a_png_with_a_wrong_byte_is_refused(scratch: Path, where: int, change: int) -> None:
    content = bytearray(PNG)
    content[where] ^= change
    scratch.write_bytes(content)
    with pytest.raises(InputError):
        read_grey(scratch, 32, 24)


def test_other_files_and_sizes_are_refused(scratch: Path, tmp_path: Path) -> None:
    scratch.write_bytes(PNG)
    with pytest.raises(InputError, match="an image of 32 × 24 px; expected an image of 24 × 32 px"):
        read_grey(scratch, 24, 32)
    scratch.write_text("no image")
    with pytest.raises(InputError, match="data that cannot be decoded"):
        read_grey(scratch, 32, 24)
    for path in (tmp_path, tmp_path / "missing.png"):
        with pytest.raises(InputError):
            read_grey(path, 32, 24)
