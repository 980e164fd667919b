"""Initial camera models of images that are not calibrated, from EXIF data or an assumed field of view.

A focal length in EXIF data is in millimetres. It is converted to pixels with the 35 mm equivalent focal length, which
compares the diagonals of the image and of 35 mm film (CIPA DCG-001), or with the resolution of the focal plane. The
latter describes the photograph as it was taken: for a photograph that was resized, it is scaled by the ratio of the
present size to the original size, the tags ``PixelXDimension`` and ``PixelYDimension``. Some programs replace these by
the new size but keep the resolution; the size of the sensor that follows is then too small, and is refused below
`SMALLEST_SENSOR_MM`.

Tags: CIPA DC-008, "Exchangeable image file format for digital still cameras: Exif".
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from dronevio.models.camera import CameraModel
from dronevio.models.image_sets.image_set import FocalSource
from dronevio.models.lenses.lens import LensName

ASSUMED_FOCAL_RATIO = 1.2
"""Focal length without any information, relative to the longer side of the image: a field of view of 45°, as in
COLMAP."""
ASSUMED_FISHEYE_FOCAL_RATIO = 0.4
"""Focal length of a fisheye relative to the longer side of the image: a field of view of 143° along it. Those of TUM-VI
and UZH-FPV have 0.37 and 0.43."""
FILM_DIAGONAL_MM = math.hypot(36.0, 24.0)
"""Diagonal of an image on 35 mm film [mm]."""
SMALLEST_SENSOR_MM = 4.0
"""Smallest plausible length of the longer side of a sensor [mm]; that of compact cameras, of 1/3.2 inch, is 4.5 mm."""
LARGEST_SENSOR_MM = 70.0
"""Largest plausible length of the longer side of a sensor [mm]; that of medium format has 54 mm."""
FOCAL_RATIOS = (0.1, 10.0)
"""Range of plausible focal lengths relative to the longer side of the image, as in COLMAP."""

_UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 1e-3}  # 4 and 5 are not in the standard, but in use
_INCH = 2
_MAKE, _MODEL, _LENS_MODEL = 0x010F, 0x0110, 0xA434
_FOCAL_LENGTH, _FOCAL_LENGTH_35MM = 0x920A, 0xA405
_PIXEL_X_DIMENSION, _PIXEL_Y_DIMENSION = 0xA002, 0xA003
_FOCAL_PLANE_X_RESOLUTION, _FOCAL_PLANE_RESOLUTION_UNIT = 0xA20E, 0xA210


@dataclass(frozen=True)
class ExifCamera:
    """Properties of camera and lens in the EXIF data of a photograph; None where a tag is absent or invalid."""

    make: str = ""
    """Manufacturer of the camera."""
    model: str = ""
    """Name of the camera."""
    lens: str = ""
    """Name of the lens."""
    focal_mm: float | None = None
    """Focal length of the lens [mm]."""
    focal_35mm_mm: float | None = None
    """Focal length with the same diagonal field of view on 35 mm film [mm]."""
    px_per_mm: float | None = None
    """Horizontal resolution of the focal plane of the photograph as it was taken [px/mm]."""
    original_width: int | None = None
    """Number of columns of the photograph as it was taken [px]."""
    original_height: int | None = None
    """Number of rows of the photograph as it was taken [px]."""


def exif_camera(tags: Mapping[int, object]) -> ExifCamera:
    """Return the properties of camera and lens, given the values of EXIF tags by number."""
    resolution = _positive(tags.get(_FOCAL_PLANE_X_RESOLUTION))
    unit_mm = _UNIT_MM.get(int(_positive(tags.get(_FOCAL_PLANE_RESOLUTION_UNIT)) or _INCH))
    width, height = _positive(tags.get(_PIXEL_X_DIMENSION)), _positive(tags.get(_PIXEL_Y_DIMENSION))
    return ExifCamera(
        make=_text(tags.get(_MAKE)),
        model=_text(tags.get(_MODEL)),
        lens=_text(tags.get(_LENS_MODEL)),
        focal_mm=_positive(tags.get(_FOCAL_LENGTH)),
        focal_35mm_mm=_positive(tags.get(_FOCAL_LENGTH_35MM)),
        px_per_mm=resolution / unit_mm if resolution is not None and unit_mm is not None else None,
        original_width=int(width) if width is not None else None,
        original_height=int(height) if height is not None else None,
    )


def exif_focal_px(exif: ExifCamera, width: int, height: int) -> tuple[float, FocalSource] | None:
    """Return the focal length [px] that follows from EXIF data, and its source.

    Args:
        exif: The EXIF data.
        width: Number of columns of the present image [px].
        height: Number of rows of the present image [px].

    Returns:
        The focal length and its source, None if the data do not determine a plausible one.
    """
    longer = max(width, height)
    if exif.focal_35mm_mm is not None:
        focal_px = exif.focal_35mm_mm / FILM_DIAGONAL_MM * math.hypot(width, height)
        if _is_plausible(focal_px / longer, FOCAL_RATIOS):
            return focal_px, "exif-35mm"
    if exif.focal_mm is not None and exif.px_per_mm is not None:
        # Software that rotates the pixels may or may not exchange the two dimensions, therefore the longer sides.
        original = max(exif.original_width or 0, exif.original_height or 0) or longer
        sensor_mm = original / exif.px_per_mm
        focal_px = exif.focal_mm / sensor_mm * longer
        if _is_plausible(sensor_mm, (SMALLEST_SENSOR_MM, LARGEST_SENSOR_MM)) and _is_plausible(
            focal_px / longer, FOCAL_RATIOS
        ):
            return focal_px, "exif-focal-plane"
    return None


def initial_camera(
    width: int, height: int, exif: ExifCamera | None = None, lens: LensName = "radtan"
) -> tuple[CameraModel, FocalSource]:
    """Return the initial model of a camera that is not calibrated, and the source of its focal length.

    The model has no distortion, and the principal point is at the centre of the image. The focal length of a fisheye is
    assumed, because EXIF data state that of a pinhole.

    Args:
        width: Number of columns [px].
        height: Number of rows [px].
        exif: EXIF data, None without any.
        lens: ``radtan``, a pinhole, or ``equidistant``, a fisheye.
    """
    if lens == "equidistant":
        focal_px = ASSUMED_FISHEYE_FOCAL_RATIO * max(width, height)
        centre = (width - 1) / 2, (height - 1) / 2
        return CameraModel(width, height, focal_px, focal_px, *centre, lens="equidistant"), "assumed"
    from_exif = exif_focal_px(exif, width, height) if exif is not None else None
    focal_px, source = from_exif or (ASSUMED_FOCAL_RATIO * max(width, height), "assumed")
    camera = CameraModel(width, height, focal_px, focal_px, (width - 1) / 2, (height - 1) / 2)
    return camera, source


def _is_plausible(value: float, limits: tuple[float, float]) -> bool:
    """Return whether a value is within limits."""
    return limits[0] <= value <= limits[1]


def _positive(value: object) -> float | None:
    """Return a number above zero, None for anything else; a tag with the value 0 is unknown."""
    try:
        number = float(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return number if 0.0 < number < math.inf else None


def _text(value: object) -> str:
    """Return a text without padding, empty for anything else."""
    return value.strip(" \0") if isinstance(value, str) else ""
