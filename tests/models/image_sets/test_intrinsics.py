"""Initial focal lengths: values worked by hand from EXIF data, and the refusal of implausible ones."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest
from PIL import Image as PillowImage
from PIL.TiffImagePlugin import IFDRational

from dronevio.models import image_folder, open_images
from dronevio.models.errors import ConfigError
from dronevio.models.image_sets.intrinsics import ExifCamera, exif_camera, exif_focal_px, initial_camera

MAKE, MODEL, EXIF_IFD = 0x010F, 0x0110, 0x8769
FOCAL_LENGTH, FOCAL_35MM = 0x920A, 0xA405
PIXEL_X, PIXEL_Y, RESOLUTION, UNIT = 0xA002, 0xA003, 0xA20E, 0xA210
CANON = {FOCAL_LENGTH: 18.0, RESOLUTION: 5315.436, UNIT: 2, PIXEL_X: 4752, PIXEL_Y: 3168}
"""Tags of a Canon EOS 500D, with a sensor of 22.3 mm; 5315 pixels per inch are 22.7 mm."""


def save(path: Path, tags: dict[int, object], size: tuple[int, int] = (64, 48)) -> None:
    exif = PillowImage.Exif()
    exif[MAKE], exif[MODEL] = "Maker", "Model"
    exif.get_ifd(EXIF_IFD).update(tags)
    exif[EXIF_IFD] = 0  # Pillow writes the tags of listed directories to TIFF files
    PillowImage.fromarray(np.zeros(size[::-1], np.uint8)).save(path, exif=exif)


def focal_px(tags: Mapping[int, object], width: int, height: int) -> float | None:
    found = exif_focal_px(exif_camera(tags), width, height)
    return None if found is None else found[0]


def test_35mm_equivalent_compares_diagonals() -> None:
    assert focal_px({FOCAL_35MM: 36}, 3600, 2400) == pytest.approx(3600)
    assert focal_px({FOCAL_35MM: 26}, 4000, 3000) == pytest.approx(26 / 43.26661531 * 5000)


def test_focal_plane_of_an_original() -> None:
    assert focal_px(CANON, 4752, 3168) == pytest.approx(18.0 * 5315.436 / 25.4)


@pytest.mark.parametrize(("unit", "resolution"), [(2, 5080.0), (3, 2000.0), (4, 200.0), (5, 0.2)])
def test_units_of_the_focal_plane(unit: int, resolution: float) -> None:
    tags = {FOCAL_LENGTH: 10.0, RESOLUTION: resolution, UNIT: unit, PIXEL_X: 4000, PIXEL_Y: 3000}
    assert focal_px(tags, 4000, 3000) == pytest.approx(2000.0)


def test_focal_plane_of_a_resized_photograph() -> None:
    """The resolution remains that of the original, so that the focal length in pixels scales with the size."""
    for width, height in ((1188, 792), (792, 1188)):
        assert focal_px(CANON, width, height) == pytest.approx(18.0 * 5315.436 / 25.4 / 4)


def test_size_of_the_file_replaces_a_missing_size() -> None:
    tags = {key: value for key, value in CANON.items() if key not in (PIXEL_X, PIXEL_Y)}
    assert focal_px(tags, 4752, 3168) == pytest.approx(18.0 * 5315.436 / 25.4)


def test_replaced_original_sizes_are_recognized() -> None:
    """640 pixels at 5315 pixels per inch would be a sensor of 3 mm."""
    assert focal_px(CANON | {PIXEL_X: 640, PIXEL_Y: 427}, 640, 427) is None


@pytest.mark.parametrize("unit", [0, 1, 7])
def test_unknown_units(unit: int) -> None:
    """A unit of 0 is no value, and without a value the unit is the inch."""
    assert (focal_px(CANON | {UNIT: unit}, 4752, 3168) is None) == (unit != 0)


@pytest.mark.parametrize("value", [0, -1.0, "text", b"bytes", None, (1, 2), IFDRational(1, 0), float("inf")])
def test_invalid_values_are_ignored(value: object) -> None:
    assert exif_camera({FOCAL_LENGTH: value, FOCAL_35MM: value, RESOLUTION: value, PIXEL_X: value}) == ExifCamera()
    assert focal_px(CANON | {FOCAL_35MM: value}, 4752, 3168) == pytest.approx(3766.8, abs=0.1)


@pytest.mark.parametrize("focal_mm", [1, 2000])
def test_implausible_equivalents_are_refused(focal_mm: float) -> None:
    assert focal_px({FOCAL_35MM: focal_mm}, 3600, 2400) is None


def test_assumed_field_of_view() -> None:
    camera, source = initial_camera(480, 640)
    assert (camera.fx, camera.fy, camera.cx, camera.cy, source) == (768.0, 768.0, 239.5, 319.5, "assumed")
    assert not any(camera.distortion)


# --- files


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif", ".webp"])
def test_tags_are_read_from_files(tmp_path: Path, suffix: str) -> None:
    save(tmp_path / f"a{suffix}", {FOCAL_LENGTH: IFDRational(9, 2), FOCAL_35MM: 30})
    images = image_folder(tmp_path)
    assert images.focal_source == ("exif-35mm",) and not images.is_calibrated.any()
    assert images.cameras[0].fx == images.cameras[0].fy == pytest.approx(30 / 43.26661531 * 80)


def test_focal_lengths_separate_cameras(tmp_path: Path) -> None:
    for name, focal_mm in {"a": 30, "b": 50, "c": 30}.items():
        save(tmp_path / f"{name}.jpg", {FOCAL_35MM: focal_mm})
    assert image_folder(tmp_path).image_camera.tolist() == [0, 1, 0]


def test_damaged_exif_data_are_ignored(tmp_path: Path) -> None:
    path = tmp_path / "a.jpg"
    save(path, {FOCAL_35MM: 30})
    data = path.read_bytes()
    start = data.index(b"Exif\0\0") + 6
    path.write_bytes(data[:start] + bytes(255 - b for b in data[start : start + 40]) + data[start + 40 :])
    images = image_folder(tmp_path)
    assert images.focal_source == ("assumed",) and images.read(0).shape == (48, 64)


def test_photographs_of_villa_balbianello() -> None:
    """They were resized from 4752 × 3168 to 640 × 427 px by a program that replaced the original size."""
    gtsam = pytest.importorskip("gtsam")
    images = image_folder(Path(gtsam.findExampleDataFile("Balbianello/BalbianelloMedium-1.jpg")).parent)
    assert images.names == tuple(f"BalbianelloMedium-{i}.jpg" for i in range(1, 6))
    assert images.image_camera.tolist() == [0] * 5 and images.focal_source == ("assumed",)
    assert images.cameras[0].fx == 768.0
    assert images.read(4).shape == (427, 640, 3)


def test_a_fisheye_folder(tmp_path: Path) -> None:
    PillowImage.new("L", (50, 20)).save(tmp_path / "0.png")
    [camera] = open_images(tmp_path, lens="equidistant").cameras
    assert (camera.lens, camera.fx, camera.cx, camera.cy) == ("equidistant", 20.0, 24.5, 9.5)
    with pytest.raises(ConfigError, match="a lens beside a calibration"):
        open_images(tmp_path, lens="equidistant", model=camera)
