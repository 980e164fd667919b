"""Inputs that would block, never end, or fill the memory are refused before they are read."""

import io
import os
import resource
import socket
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image as PillowImage

from dronevio.models.errors import InputError
from dronevio.models.image_sets import open_images
from dronevio.models.image_sets.photos import read_photo, read_photo_header
from dronevio.models.reconstructions import read_reconstruction
from dronevio.models.recordings.calibration.reading import read_calibration
from dronevio.models.recordings.files import read_bytes, read_text
from dronevio.models.recordings.image_header import MAX_DECODED_BYTES, ImageHeader, check_decoded_size, header_of
from dronevio.models.recordings.images import decode_grey, read_grey
from dronevio.models.recordings.open import open_recording, read_trajectory
from dronevio.models.recordings.video_frames import read_video_index

READERS: dict[str, Callable[[Path], Any]] = {
    "bytes": lambda path: read_bytes(path, "data"),
    "text": lambda path: read_text(path, "text"),
    "trajectory": read_trajectory,
    "calibration": lambda path: read_calibration([path]),
    "grey image": lambda path: read_grey(path, 32, 24),
    "photograph": read_photo,
    "header of a photograph": read_photo_header,
    "video": read_video_index,
    "reconstruction": read_reconstruction,
}


@pytest.mark.timeout(30)
@pytest.mark.parametrize("name", READERS)
def test_pipes_sockets_and_devices_are_refused(tmp_path: Path, name: str) -> None:
    """A pipe without a writer would block, and /dev/zero never ends."""
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InputError, match="a pipe; expected"):
        READERS[name](tmp_path / "pipe")
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(tmp_path / "s"))
        with pytest.raises(InputError, match="a socket; expected"):
            READERS[name](tmp_path / "s")
    with pytest.raises(InputError, match="/dev/zero: a device; expected"):
        READERS[name](Path("/dev/zero"))


@pytest.mark.timeout(30)
@pytest.mark.parametrize("name", ["a.bag", "a.mcap", "a.db3", "a.mp4", "folder.mcap", "metadata.yaml"])
def test_recordings_that_are_pipes_are_refused(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    if name in ("folder.mcap", "metadata.yaml"):
        path = tmp_path / "bag"
        path.mkdir()
        os.mkfifo(path / name)
    else:
        os.mkfifo(path)
    with pytest.raises(InputError, match="a pipe; expected"):
        open_images(path) if name == "a.mp4" else open_recording(path)


@pytest.mark.timeout(30)
def test_images_in_a_folder_that_are_pipes_are_left_out(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "a.png")
    PillowImage.fromarray(np.zeros((24, 32), np.uint8)).save(tmp_path / "b.png")
    assert open_images(tmp_path).names == ("b.png",)


# --- decoded size


def chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def png(width: int, height: int) -> bytes:
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"\0" * 99)) + chunk(b"IEND", b"")
    )


def jpeg(width: int, height: int) -> bytes:
    content = cv2.imencode(".jpg", np.zeros((24, 32, 3), np.uint8))[1].tobytes()
    at = content.index(b"\xff\xc0") + 5
    return content[:at] + struct.pack(">HH", height, width) + content[at + 4 :]


def tiff(width: int, height: int, order: str = "<", big: bool = False) -> bytes:
    """Return the header of a TIFF with 16 bits in three channels, whose depths are outside its directory."""
    form, offset = (f"{order}HHQQ", 16) if big else (f"{order}HHII", 8)

    def inline(value: int) -> int:  # values of 16 bits fill the field from the left
        return value if order == "<" else value << (48 if big else 16)

    depths_at = offset + (8 if big else 2) + 4 * struct.calcsize(form) + (8 if big else 4)
    many = (8 if big else 4) >= 3 * 2
    depth = inline(16) if many and order == "<" else depths_at
    rows = [(256, 4, 1, width), (257, 4, 1, height), (258, 3, 3, depth), (277, 3, 1, inline(3))]
    if order == ">" and big:
        rows = [(t, k, n, v << 32 if k == 4 else v) for t, k, n, v in rows]
        rows[2] = (258, 3, 3, 16 << 48)
    start = struct.pack(f"{order}2sHHHQ", b"II" if order == "<" else b"MM", 43, 8, 0, 16)
    if not big:
        start = struct.pack(f"{order}2sHI", b"II" if order == "<" else b"MM", 42, 8)
    count = struct.pack(f"{order}{'Q' if big else 'H'}", len(rows))
    body = b"".join(struct.pack(form, *row) for row in rows)
    return start + count + body + b"\0" * (8 if big else 4) + struct.pack(f"{order}HHH", 16, 16, 16)


def bmp(width: int, height: int) -> bytes:
    return b"BM" + struct.pack("<IHHIIiiHH", 54, 0, 0, 54, 40, width, -height, 1, 24) + b"\0" * 24


def webp_lossy(width: int, height: int) -> bytes:
    return b"RIFF\x1e\0\0\0WEBPVP8 \x12\0\0\0\0\0\0\x9d\x01\x2a" + struct.pack("<HH", width, height) + b"\0" * 8


def webp_lossless(width: int, height: int) -> bytes:
    packed = struct.pack("<I", (width - 1) | (height - 1) << 14)
    return b"RIFF\x1e\0\0\0WEBPVP8L\x12\0\0\0\x2f" + packed + b"\0" * 16


def webp_extended(width: int, height: int) -> bytes:
    size = (width - 1).to_bytes(3, "little") + (height - 1).to_bytes(3, "little")
    return b"RIFF\x1e\0\0\0WEBPVP8X\x0a\0\0\0\0\0\0\0" + size + b"\0" * 8


def ppm(width: int, height: int) -> bytes:
    return f"P6 # a comment\n{width} {height}\n255\n".encode()


BOMBS: dict[str, tuple[Callable[[int, int], bytes], int]] = {
    "png": (png, 4),
    "jpeg": (jpeg, 4),
    "tiff": (tiff, 8),
    "tiff, big end first": (lambda w, h: tiff(w, h, ">"), 8),
    "big tiff": (lambda w, h: tiff(w, h, "<", True), 8),
    "big tiff, big end first": (lambda w, h: tiff(w, h, ">", True), 8),
    "bmp": (bmp, 4),
    "lossy webp": (webp_lossy, 4),
    "lossless webp": (webp_lossless, 4),
    "extended webp": (webp_extended, 4),
    "ppm": (ppm, 4),
}


@pytest.mark.parametrize("name", BOMBS)
def test_bombs_of_each_format_are_refused_by_their_headers(tmp_path: Path, name: str) -> None:
    """12000 × 11000 px in some hundred bytes, below the limits of Pillow and OpenCV."""
    make, pixel_bytes = BOMBS[name]
    content = make(12_000, 11_000)
    header = header_of(content)
    assert header is not None and (header.width, header.height) == (12_000, 11_000)
    assert header.decoded_bytes == 12_000 * 11_000 * pixel_bytes
    path = tmp_path / "bomb.img"
    path.write_bytes(content)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(InputError, match="12000 × 11000 px; expected an image of 32 × 24 px"):
        read_grey(path, 32, 24)
    for read in (read_photo, read_photo_header, lambda p: decode_grey(p, content, 12_000, 11_000)):
        with pytest.raises(InputError, match="12000 × 11000 px, which needs"):
            read(path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000  # kB


def test_headers_agree_with_pillow_and_opencv() -> None:
    image = np.random.default_rng(0).integers(0, 256, (24, 37, 3), dtype=np.uint8)
    for suffix in (".png", ".jpg", ".tiff", ".bmp", ".webp", ".ppm"):
        header = header_of(cv2.imencode(suffix, image)[1].tobytes())
        assert header is not None and (header.width, header.height, header.depth_bytes) == (37, 24, 1), suffix
    deep = image[..., 0].astype(np.uint16)
    for suffix in (".png", ".tiff", ".pgm"):
        found = header_of(cv2.imencode(suffix, deep)[1].tobytes())
        assert found == ImageHeader(37, 24, 1, 2), suffix
    for kind, options in (("WEBP", {"lossless": True}), ("TIFF", {}), ("TIFF", {"compression": "tiff_lzw"})):
        stream = io.BytesIO()
        PillowImage.fromarray(image).save(stream, kind, **options)
        found = header_of(stream.getvalue())
        assert found is not None and (found.width, found.height, found.depth_bytes) == (37, 24, 1)
        np.testing.assert_allclose(
            decode_grey(Path("a"), stream.getvalue(), 37, 24), cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), atol=1
        )


def test_photographs_and_masks_of_any_reasonable_size_pass() -> None:
    path = Path("a.jpg")
    check_decoded_size(path, ImageHeader(14_204, 10_652, 3, 1), 40_000_000)  # 151 Mpx in 40 MB
    check_decoded_size(path, ImageHeader(14_204, 10_652, 1, 1), 150_000)  # its mask
    check_decoded_size(path, ImageHeader(8_000, 8_000, 3, 1), 1_000)  # a drawing
    with pytest.raises(InputError, match=r"which needs 577 MiB and is stored in 0\.9 MiB; expected a photograph"):
        check_decoded_size(path, ImageHeader(14_204, 10_652, 3, 1), 900_000)
    with pytest.raises(InputError, match=f"at most {MAX_DECODED_BYTES // 2**20} MiB"):
        check_decoded_size(path, ImageHeader(30_000, 30_000, 3, 1), 900_000_000)


def test_tiles_larger_than_the_image_are_refused(tmp_path: Path) -> None:
    """A decoder allocates a whole tile, whatever the size of the image."""
    rows = [(256, 4, 1, 32), (257, 4, 1, 24), (322, 4, 1, 16_384), (323, 4, 1, 16_384)]
    body = b"".join(struct.pack("<HHII", *row) for row in rows)
    content = struct.pack("<2sHIH", b"II", 42, 8, len(rows)) + body + b"\0\0\0\0"
    assert header_of(content) is None
    with pytest.raises(InputError, match="data that cannot be decoded"):
        decode_grey(tmp_path, content, 32, 24)


def test_damaged_headers_are_no_images() -> None:
    for make, _ in BOMBS.values():
        content = make(32, 24)
        assert header_of(content) is not None
        for end in range(len(content)):
            header_of(content[:end])
        assert header_of(content[:9]) is None
        zero = header_of(make(0, 0)) if make not in (webp_lossless, webp_extended) else None
        assert zero is None


def test_frames_of_videos_are_limited(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import av

    from dronevio.models.recordings import video_frames

    with av.open(str(tmp_path / "a.mp4"), "w") as container:
        stream = container.add_stream("mpeg4", rate=10)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for _ in range(3):
            frame = av.VideoFrame.from_ndarray(np.zeros((48, 64, 3), np.uint8), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    assert open_images(tmp_path / "a.mp4").read(0).shape == (48, 64, 3)
    images = open_images(tmp_path / "a.mp4")
    monkeypatch.setattr(video_frames, "MAX_FRAME_PIXELS", 1000)
    with pytest.raises(InputError, match="cannot be decoded"):  # as where a later frame is larger
        images.read(0)
    with pytest.raises(InputError, match="frames of 64 × 48 px; expected at most"):
        open_images(tmp_path / "a.mp4")
