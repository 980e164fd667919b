"""Folders of photographs: pixels, order, cameras, masks, and the refusal of damaged files."""

import os
import struct
import sys
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image as PillowImage

from dronevio.models import CameraModel, ConfigError, InputError, image_folder, open_images
from dronevio.models.arrays import Image
from dronevio.models.image_sets import joined, photos
from dronevio.models.image_sets.folder import natural_key
from dronevio.models.image_sets.photos import read_photo, read_photo_header

ORIENTATION = 0x0112
MODEL = CameraModel(width=32, height=24, fx=30.0, fy=31.0, cx=15.0, cy=12.0)


def noise(seed: int, *shape: int) -> Image:
    return np.random.default_rng(seed).integers(0, 256, shape or (24, 32, 3), dtype=np.uint8)


def save(path: Path, pixels: Image, orientation: int | None = None) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    exif = PillowImage.Exif()
    if orientation is not None:
        exif[ORIENTATION] = orientation
    PillowImage.fromarray(pixels).save(path, exif=exif, lossless=True)  # an option of WebP, ignored by the others
    return path


# --- pixels


@pytest.mark.parametrize("suffix", [".png", ".tif", ".bmp", ".webp", ".TIFF"])
@pytest.mark.parametrize("shape", [(24, 32, 3), (24, 32)])
def test_lossless_formats_are_read_exactly(tmp_path: Path, suffix: str, shape: tuple[int, ...]) -> None:
    pixels = noise(1, *shape)
    image = read_photo(save(tmp_path / f"a{suffix}", pixels))
    if suffix == ".webp" and len(shape) == 2:  # WebP has no grey images
        image = image[..., 0]
    assert image.dtype == np.uint8
    np.testing.assert_array_equal(image, pixels)


def test_jpeg_is_read_as_by_opencv(tmp_path: Path) -> None:
    smooth = np.asarray(cv2.GaussianBlur(noise(2, 48, 64, 3), (0, 0), 3.0), np.uint8)
    path = save(tmp_path / "a.jpg", smooth)
    theirs = cv2.imread(str(path), cv2.IMREAD_COLOR_RGB)
    assert np.abs(read_photo(path).astype(int) - np.asarray(theirs).astype(int)).max() <= 2


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif", ".webp"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_orientation_does_not_move_pixels(tmp_path: Path, suffix: str, orientation: int) -> None:
    pixels = noise(3)
    upright = read_photo(save(tmp_path / f"a{suffix}", pixels))
    turned = save(tmp_path / f"b{suffix}", pixels, orientation)
    np.testing.assert_array_equal(read_photo(turned, 32, 24), upright)
    header = read_photo_header(turned)
    assert (header.width, header.height) == (32, 24)


@pytest.mark.parametrize("suffix", [".png", ".tif"])
@pytest.mark.parametrize("shape", [(24, 32), (24, 32, 3)])
def test_16_bits_are_reduced_to_the_upper_8(tmp_path: Path, suffix: str, shape: tuple[int, ...]) -> None:
    pixels = np.random.default_rng(4).integers(0, 2**16, shape, dtype=np.uint16)
    path = tmp_path / f"a{suffix}"
    assert cv2.imwrite(str(path), pixels[..., ::-1] if len(shape) == 3 else pixels)
    np.testing.assert_array_equal(read_photo(path), pixels >> 8)


def test_palettes_and_bits_are_expanded(tmp_path: Path) -> None:
    palette = PillowImage.fromarray(noise(5)).quantize(16)
    palette.save(tmp_path / "palette.png", transparency=3)
    np.testing.assert_array_equal(read_photo(tmp_path / "palette.png"), np.asarray(palette.convert("RGB")))
    bits = noise(6, 24, 32) > 127
    PillowImage.fromarray(bits).save(tmp_path / "bits.png")
    np.testing.assert_array_equal(read_photo(tmp_path / "bits.png"), np.where(bits, 255, 0))


@pytest.mark.parametrize(("channels", "shape"), [(4, (24, 32, 3)), (2, (24, 32))])
def test_alpha_is_dropped(tmp_path: Path, channels: int, shape: tuple[int, ...]) -> None:
    pixels = noise(7, 24, 32, channels)
    image = read_photo(save(tmp_path / "a.png", pixels))
    np.testing.assert_array_equal(image, pixels[..., :-1].reshape(shape))


def test_pictures_with_several_images_give_the_first(tmp_path: Path) -> None:
    """Cameras of phones and drones write previews after the photograph."""
    preview = PillowImage.fromarray(noise(1, 12, 16, 3))
    photo = PillowImage.fromarray(noise(2))
    photo.save(tmp_path / "a.jpg")
    photo.save(tmp_path / "b.jpg", format="MPO", save_all=True, append_images=[preview])
    images = image_folder(tmp_path)
    np.testing.assert_array_equal(images.read(1), images.read(0))


def test_cmyk_becomes_rgb(tmp_path: Path) -> None:
    PillowImage.fromarray(noise(8)).convert("CMYK").save(tmp_path / "a.jpg")
    assert read_photo(tmp_path / "a.jpg").shape == (24, 32, 3)


# --- damaged files


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif", ".bmp", ".webp"])
def test_truncated_files_are_refused(tmp_path: Path, suffix: str) -> None:
    path = save(tmp_path / f"a{suffix}", noise(9))
    path.write_bytes(path.read_bytes()[:-300])
    with pytest.raises(InputError, match=r"a\.\w+: "):
        read_photo(path)


def test_changed_bytes_of_a_png_are_refused(tmp_path: Path) -> None:
    path = save(tmp_path / "a.png", noise(10))
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(data)
    with pytest.raises(InputError, match="cannot be decoded"):
        read_photo(path)


@pytest.mark.parametrize("content", [b"", b"a text", b"\x89PNG\r\n\x1a\n"])
def test_files_that_are_no_images_are_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.png").write_bytes(content)
    with pytest.raises(InputError, match=r"a\.png: .*expected an image"):
        image_folder(tmp_path)


def test_a_result_is_no_folder_of_images(tmp_path: Path) -> None:
    """The pictures of its report are not the photographs."""
    save(tmp_path / "a.png", noise(3, 24, 32))
    assert len(open_images(tmp_path)) == 1
    for name in ("report.json", "report.html"):
        (tmp_path / name).touch()
    with pytest.raises(InputError, match="a result, whose pictures"):
        open_images(tmp_path)


def test_other_formats_are_refused(tmp_path: Path) -> None:
    PillowImage.fromarray(noise(11)).save(tmp_path / "a.png", format="GIF")
    with pytest.raises(InputError, match="not a supported image"):
        image_folder(tmp_path)


def test_32_bit_images_are_refused(tmp_path: Path) -> None:
    PillowImage.fromarray(np.zeros((24, 32), np.float32)).save(tmp_path / "a.tif")
    images = image_folder(tmp_path)
    with pytest.raises(InputError, match="32 bits per channel; expected 8 or 16"):
        images.read(0)


def test_gigantic_images_are_refused(tmp_path: Path) -> None:
    chunks = (b"IHDR" + struct.pack(">IIBBBBB", 100_000, 100_000, 8, 2, 0, 0, 0), b"IDAT" + zlib.compress(b"0" * 100))
    data = b"".join(struct.pack(">I", len(c) - 4) + c + struct.pack(">I", zlib.crc32(c)) for c in chunks)
    (tmp_path / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n" + data)
    with pytest.raises(InputError, match="an image of 100000 × 100000 px, which needs 38147 MiB"):
        image_folder(tmp_path)


def test_a_file_that_changed_its_size_is_refused(tmp_path: Path) -> None:
    save(tmp_path / "a.png", noise(12))
    images = image_folder(tmp_path)
    save(tmp_path / "a.png", noise(12, 24, 30, 3))
    with pytest.raises(InputError, match="30 × 24 px; expected an image of 32 × 24 px"):
        images.read(0)


def test_a_file_that_disappeared_is_refused(tmp_path: Path) -> None:
    path = save(tmp_path / "a.png", noise(12))
    images = image_folder(tmp_path)
    path.unlink()
    with pytest.raises(InputError, match=r"a\.png: no such file"):
        images.read(0)


# --- folders


def test_names_are_in_natural_order(tmp_path: Path) -> None:
    names = ("2.png", "10.JPG", "b/2.png", "b/10.png", "b10/1.png")
    for name in reversed(names):
        save(tmp_path / name, noise(13))
    for name in (".hidden.png", ".folder/a.png", "._2.png"):
        save(tmp_path / name, noise(13))
    (tmp_path / "notes.txt").write_text("no image")
    images = image_folder(tmp_path)
    assert images.names == names and len(images) == 5
    assert not images.is_ordered and images.t_ns is None and images.frame is None and images.Ts_imu_cam is None


def test_natural_keys_are_total() -> None:
    names = ["a01", "a1", "a/1", "1a", "a", "", "a1b2", "a1b10", "a01/b"]
    ordered = sorted(names, key=natural_key)
    shuffled = names[::-1]
    assert ordered == sorted(shuffled, key=natural_key)
    assert ordered.index("a1b2") < ordered.index("a1b10")


def test_each_index_reads_its_file(tmp_path: Path) -> None:
    pixels = [noise(seed, *((24, 32) if seed % 2 else (24, 32, 3))) for seed in range(4)]
    for seed, image in enumerate(pixels):
        save(tmp_path / f"{seed}.png", image)
    images = image_folder(tmp_path)
    for index in (2, 0, 3, 1):
        np.testing.assert_array_equal(images.read(index), pixels[index])
        assert images.read_mask(index) is None


def test_files_that_only_look_like_images_are_skipped_and_named(tmp_path: Path) -> None:
    save(tmp_path / "ü a/image 1.png", noise(18))
    (tmp_path / "text.jpg").write_text("a text")
    (tmp_path / "empty.png").write_bytes(b"")
    (tmp_path / "raw.NEF").write_bytes(b"II*\0")
    (tmp_path / "link.jpg").symlink_to(tmp_path / "nowhere.jpg")
    os.mkfifo(tmp_path / "pipe.png")
    (tmp_path / "folder.jpg").mkdir()
    (tmp_path / ".hidden.jpg").write_text("a text")
    (tmp_path / "notes.txt").write_text("a text")
    images = image_folder(tmp_path)
    assert images.names == ("ü a/image 1.png",)
    reasons = {name: str(error) for name, error in images.skipped.items()}
    assert set(reasons) == {"text.jpg", "empty.png", "raw.NEF", "link.jpg", "pipe.png"}
    assert all(str(tmp_path / name) in reason and "expected" in reason for name, reason in reasons.items())
    assert "a format that is not read" in reasons["raw.NEF"] and "does not exist" in reasons["link.jpg"]


@pytest.mark.parametrize("suffix", [".heic", ".avif"])
def test_photographs_of_phones_are_read(tmp_path: Path, suffix: str) -> None:
    register = pytest.importorskip("pillow_heif").register_heif_opener
    register()
    pixels = np.full((48, 64, 3), [200, 100, 50], np.uint8)
    PillowImage.fromarray(pixels).save(tmp_path / f"a{suffix}", quality=95)
    image = image_folder(tmp_path).read(0)
    assert image.shape == pixels.shape and np.abs(image.astype(int) - pixels).max() < 12


def test_heic_without_its_package_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    photos._can_read_heif.cache_clear()
    save(tmp_path / "a.png", noise(19))
    (tmp_path / "b.heic").write_bytes(b"\0\0\0\x18ftypheic")
    skipped = image_folder(tmp_path).skipped
    photos._can_read_heif.cache_clear()
    assert "needs the package pillow-heif" in str(skipped["b.heic"])


@pytest.mark.parametrize("most", [255, 4095, 65535])
def test_pgm_is_read(tmp_path: Path, most: int) -> None:
    grey = np.random.default_rng(0).integers(0, most + 1, (24, 32)).astype(">u2" if most > 255 else np.uint8)
    (tmp_path / "a.pgm").write_bytes(f"P5 32 24 {most}\n".encode() + grey.tobytes())
    np.testing.assert_allclose(image_folder(tmp_path).read(0), grey * (255.99 / most), atol=1.0)


@pytest.mark.parametrize("found", ["missing", "file", "empty"])
def test_folders_without_images_are_refused(tmp_path: Path, found: str) -> None:
    path = tmp_path / "images"
    if found == "file":
        path.write_text("no folder")
    elif found == "empty":
        path.mkdir()
    with pytest.raises(InputError, match=r"images: .*; expected a folder of images \(.jpg"):
        image_folder(path)


# --- cameras


def test_images_of_one_size_share_a_camera(tmp_path: Path) -> None:
    for name, shape in {"a": (24, 32), "b": (32, 24), "c": (24, 32)}.items():
        save(tmp_path / f"{name}.png", noise(14, *shape))
    images = image_folder(tmp_path)
    assert images.image_camera.tolist() == [0, 1, 0]
    assert [(c.width, c.height) for c in images.cameras] == [(32, 24), (24, 32)]
    first = images.cameras[0]
    assert (first.fx, first.fy, first.cx, first.cy) == (1.2 * 32, 1.2 * 32, 15.5, 11.5)
    assert not images.is_calibrated.any() and images.focal_source == ("assumed", "assumed")


def test_each_image_can_have_its_camera(tmp_path: Path) -> None:
    for name in "abc":
        save(tmp_path / f"{name}.png", noise(14))
    images = image_folder(tmp_path, camera="per-image")
    assert images.image_camera.tolist() == [0, 1, 2] and len(images.cameras) == 3


def test_a_calibration_is_shared_by_all_images(tmp_path: Path) -> None:
    for name in "ab":
        save(tmp_path / f"{name}.png", noise(14))
    images = image_folder(tmp_path, model=MODEL)
    assert images.cameras == (MODEL,) and images.is_calibrated.tolist() == [True]
    assert images.image_camera.tolist() == [0, 0] and images.focal_source == ("calibration",)


def test_another_size_than_the_calibration_is_skipped(tmp_path: Path) -> None:
    save(tmp_path / "a.png", noise(14))
    save(tmp_path / "b.png", noise(14, 32, 24, 3))
    images = image_folder(tmp_path, model=MODEL)
    assert images.names == ("a.png",)
    assert "b.png: an image of 24 × 32 px; expected 32 × 24 px as in the calibration" in str(images.skipped["b.png"])
    (tmp_path / "a.png").unlink()
    with pytest.raises(InputError, match=r"b\.png: an image of 24 × 32 px"):
        image_folder(tmp_path, model=MODEL)


def test_a_calibration_per_image_is_refused(tmp_path: Path) -> None:
    save(tmp_path / "a.png", noise(14))
    with pytest.raises(ConfigError, match="expected one shared camera"):
        image_folder(tmp_path, camera="per-image", model=MODEL)


# --- masks


@pytest.mark.parametrize("name", ["a/b.jpg.png", "a/b.jpg", "a/b.png", "a.png"])
def test_masks_are_found_by_name(tmp_path: Path, name: str) -> None:
    save(tmp_path / "images/a/b.jpg", noise(15))
    save(tmp_path / "images/c.jpg", noise(15))
    values = np.where(np.arange(24)[:, None] < 10, 0, np.full((24, 32), 255)).astype(np.uint8)
    save(tmp_path / "images/masks" / name, values)
    images = image_folder(tmp_path / "images", masks=tmp_path / "images/masks")
    assert images.names == ("a/b.jpg", "c.jpg")
    mask = images.read_mask(0)
    assert mask is not None and mask.dtype == np.bool_ and mask.shape == (24, 32)
    assert mask[12:].all() and not mask[:8].any() and images.read_mask(1) is None


def test_one_mask_is_for_all_images(tmp_path: Path) -> None:
    for name in "ab":
        save(tmp_path / f"{name}.jpg", noise(15))
    values = np.zeros((24, 32, 3), np.uint8)
    values[3, 4, 1] = 1
    images = image_folder(tmp_path, masks=save(tmp_path / "mask.png", values))
    assert images.names == ("a.jpg", "b.jpg")
    for index in range(2):
        mask = images.read_mask(index)
        assert mask is not None and mask.sum() == 1 and mask[3, 4]


def test_a_mask_of_another_size_is_refused(tmp_path: Path) -> None:
    save(tmp_path / "images/a.png", noise(15))
    images = image_folder(tmp_path / "images", masks=save(tmp_path / "masks/a.png", noise(15, 12, 16)).parent)
    with pytest.raises(InputError, match="16 × 12 px; expected an image of 32 × 24 px"):
        images.read_mask(0)


def test_folders_without_any_mask_are_refused(tmp_path: Path) -> None:
    save(tmp_path / "images/a.jpg", noise(15))
    save(tmp_path / "masks/b.png", noise(15, 24, 32))
    with pytest.raises(InputError, match=r"masks: a folder without a mask of any image; .* a\.jpg\.png"):
        image_folder(tmp_path / "images", masks=tmp_path / "masks")
    with pytest.raises(InputError, match="none: no such file or folder"):
        image_folder(tmp_path / "images", masks=tmp_path / "none")
    with pytest.raises(InputError, match="expected a separate folder"):
        image_folder(tmp_path / "images", masks=tmp_path / "images")


def test_unions_name_what_both_sets_lack(tmp_path: Path) -> None:
    for name in ("a", "b"):
        save(tmp_path / name / f"{name}.png", noise(20))
        (tmp_path / name / f"{name}.jpg").write_text("a text")
    both = joined(image_folder(tmp_path / "a"), image_folder(tmp_path / "b"))
    assert both.names == ("a.png", "b.png") and set(both.skipped) == {"a.jpg", "b.jpg"}
