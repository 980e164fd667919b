"""Image sets from folders of photographs."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Literal, get_args

import numpy as np

from dronevio.models.arrays import Image
from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError, InputError
from dronevio.models.image_sets.control_points import find_control_points
from dronevio.models.image_sets.geotags import geotags_of
from dronevio.models.image_sets.image_set import FocalSource, ImageSet, Indices
from dronevio.models.image_sets.intrinsics import initial_camera
from dronevio.models.image_sets.masks import find_masks
from dronevio.models.image_sets.photos import (
    OTHER_SUFFIXES,
    PHOTO_SUFFIXES,
    PhotoHeader,
    read_photo,
    read_photo_header,
    significant_bits_of_photos,
)
from dronevio.models.lenses.lens import LensName

CameraSharing = Literal["shared", "per-image"]
"""Whether images of the same size with the same EXIF data of camera and lens share a camera, or each has its own."""

_EXPECTED = f"a folder of images ({', '.join(PHOTO_SUFFIXES)})"


@dataclass(frozen=True, eq=False)
class PhotoFiles:
    """Image files of I images; the object is called with the index of an image."""

    files: tuple[Path, ...]
    """(I,) Path of each image."""
    image_camera: Indices
    """(I,) Index of the camera of each image."""
    cameras: tuple[CameraModel, ...]
    """Camera models, which have the sizes of the images."""
    bits: tuple[int, ...]
    """(I,) Significant bits of each image, 8 to 16, of which the upper 8 are returned."""

    def __call__(self, index: int) -> Image:
        """Return the image with a given index: grey (H, W), or red, green and blue (H, W, 3).

        Raises:
            InputError: The file is missing, damaged, or has another size than its camera.
        """
        camera = self.cameras[self.image_camera[index]]
        return read_photo(self.files[index], camera.width, camera.height, self.bits[index])


def image_folder(
    path: Path | str,
    *,
    camera: CameraSharing = "shared",
    model: CameraModel | None = None,
    masks: Path | str | None = None,
    lens: LensName = "radtan",
) -> ImageSet:
    """Return the images in a folder and its subfolders, in natural order of their names.

    Hidden files and the folder of the masks are left out. Sizes and EXIF data are read at once, pixels on request.
    Files that look like images but cannot be read, or have another size than the calibration, are in
    `ImageSet.skipped`.

    Args:
        path: The folder.
        camera: ``shared`` for one camera for all images of the same size with the same EXIF data of camera and lens,
            ``per-image`` for a camera for each image.
        model: Calibration of the one camera of all images; None for initial values from EXIF data or an assumed field
            of view.
        masks: A folder of masks or one mask for all images; see `dronevio.models.image_sets.masks`.
        lens: Lens model without a calibration: ``radtan``, a pinhole, or ``equidistant``, a fisheye.

    Raises:
        InputError: The folder does not exist or has no image that can be used, or the masks are missing or in the same
            folder.
        ConfigError: A calibration is given for ``per-image`` cameras.
    """
    if camera not in get_args(CameraSharing):
        raise ConfigError(f"camera {camera!r}; expected one of {', '.join(get_args(CameraSharing))}")
    if model is not None and camera == "per-image":
        raise ConfigError("a calibration for per-image cameras; expected one shared camera")
    folder, mask_path = Path(path), Path(masks) if masks is not None else None
    usable, skipped = usable_photos(folder, mask_path, model)
    names, headers = tuple(usable), list(usable.values())
    files = tuple(folder / name for name in names)
    if model is None:
        image_camera, cameras, sources = _initial_cameras(headers, camera, lens)
    else:
        image_camera, cameras, sources = np.zeros(len(files), np.int64), (model,), ("calibration",)
    return ImageSet(
        names=names,
        image_camera=image_camera,
        cameras=cameras,
        is_calibrated=np.full(len(cameras), model is not None),
        is_ordered=False,
        t_ns=None,
        frame=None,
        Ts_imu_cam=None,
        read=PhotoFiles(files, image_camera, cameras, photo_bits(files, headers)),
        read_mask=find_masks(mask_path, names, image_camera, cameras),
        focal_source=sources,
        skipped=skipped,
        geotags=geotags_of([header.geotag for header in headers]),
        control_points=find_control_points(folder, names),
    )


def usable_photos(
    folder: Path, masks: Path | None, model: CameraModel | None
) -> tuple[dict[str, PhotoHeader], dict[str, InputError]]:
    """Return the headers of the images below a folder, and why other files that look like images are none.

    Args:
        folder: The folder.
        masks: A file or folder to leave out.
        model: Calibration of the camera, whose size the images have; None for any size.

    Returns:
        Both by their paths below the folder, the images in natural order.

    Raises:
        InputError: There is no image that can be used, or the folder is within that of the masks.
    """
    names, skipped = find_photos(folder, masks)
    headers: dict[str, PhotoHeader] = {}
    for name in names:
        try:
            headers[name] = _usable_header(folder / name, model)
        except InputError as error:
            skipped[name] = error
    if not headers:
        raise next(iter(skipped.values()))
    return headers, skipped


def find_photos(folder: Path, masks: Path | None = None) -> tuple[tuple[str, ...], dict[str, InputError]]:
    """Return the paths of the images below a folder, relative to it and in natural order.

    Args:
        folder: The folder.
        masks: A file or folder to leave out.

    Returns:
        The paths, and those of other files that look like images, each with the reason why it is none.

    Raises:
        InputError: The folder does not exist or has no files that look like images, or it is within the folder of the
            masks.
    """
    if not folder.exists():
        raise InputError(folder, "no such folder", _EXPECTED)
    if not folder.is_dir():
        raise InputError(folder, "a file", _EXPECTED)
    left_out = masks.resolve() if masks is not None else None
    if left_out is not None and folder.resolve().is_relative_to(left_out):
        raise InputError(left_out, "a folder that contains the images", "a separate folder of masks")
    names, others = [], dict[str, InputError]()
    for file in folder.rglob("*"):
        name, suffix = PurePosixPath(file.relative_to(folder).as_posix()), file.suffix.lower()
        if suffix not in (*PHOTO_SUFFIXES, *OTHER_SUFFIXES) or any(part.startswith(".") for part in name.parts):
            continue
        if file.is_dir() or (left_out is not None and file.resolve().is_relative_to(left_out)):
            continue
        if suffix in OTHER_SUFFIXES:
            others[str(name)] = InputError(file, "a format that is not read", f"one of {', '.join(PHOTO_SUFFIXES)}")
        elif file.is_symlink() and not file.exists():
            others[str(name)] = InputError(file, "a link to a file that does not exist", "an image")
        else:
            names.append(str(name))
    if not names and not others:
        raise InputError(folder, "a folder without images", _EXPECTED)
    return tuple(sorted(names, key=natural_key)), others


def _usable_header(file: Path, model: CameraModel | None) -> PhotoHeader:
    """Return the size and the EXIF data of an image.

    Raises:
        InputError: It is none, or has another size than the calibration.
    """
    header = read_photo_header(file)
    if model is not None and (header.width, header.height) != (model.width, model.height):
        raise InputError(
            file,
            f"an image of {header.width} × {header.height} px",
            f"{model.width} × {model.height} px as in the calibration",
        )
    return header


def natural_key(name: str) -> tuple[tuple[tuple[str | int, ...], ...], str]:
    """Return a sort key of paths by which numbers are in numeric order: ``a2`` before ``a10``."""
    parts = tuple(
        tuple(int(text) if i % 2 else text for i, text in enumerate(re.split("([0-9]+)", part)))
        for part in name.split("/")
    )
    return parts, name


def _initial_cameras(
    headers: list[PhotoHeader], sharing: CameraSharing, lens: LensName
) -> tuple[Indices, tuple[CameraModel, ...], tuple[FocalSource, ...]]:
    """Return the camera of each image, and the initial model and source of the focal length of each camera."""
    keys = list(enumerate(headers)) if sharing == "per-image" else [(0, header) for header in headers]
    unique = {key: number for number, key in enumerate(dict.fromkeys(keys))}
    initial = [initial_camera(header.width, header.height, header.exif, lens) for _, header in unique]
    image_camera = np.array([unique[key] for key in keys], dtype=np.int64)
    return image_camera, tuple(model for model, _ in initial), tuple(source for _, source in initial)


def photo_bits(files: Sequence[Path], headers: Sequence[PhotoHeader]) -> tuple[int, ...]:
    """Return the significant bits of each image, found once for all images of the same size and EXIF data."""
    groups: dict[PhotoHeader, list[Path]] = {}
    for file, header in zip(files, headers, strict=True):
        groups.setdefault(header, []).append(file)
    bits = {header: significant_bits_of_photos(group) if header.is_deep else 8 for header, group in groups.items()}
    return tuple(bits[header] for header in headers)
