"""Masks of images: files whose pixels are 0 where no features may be detected, as in COLMAP.

A single file is the mask of all images. In a folder, the mask of the image ``a/b.jpg`` is the first that exists of
``a/b.jpg.png`` (COLMAP), ``a/b.jpg``, ``a/b.png`` and ``a.png``; the last one is for all images in the folder ``a``,
such as those of one camera of a recording.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from dronevio.models.arrays import Mask
from dronevio.models.camera import CameraModel
from dronevio.models.errors import InputError
from dronevio.models.image_sets.image_set import Indices
from dronevio.models.image_sets.photos import read_photo


@dataclass(frozen=True, eq=False)
class MaskFiles:
    """Mask files of I images; the object is called with the index of an image."""

    files: tuple[Path | None, ...]
    """(I,) Mask file of each image, None for an image without one."""
    image_camera: Indices
    """(I,) Index of the camera of each image."""
    cameras: tuple[CameraModel, ...]
    """Camera models, which have the sizes of the images."""

    def __call__(self, index: int) -> Mask | None:
        """Return the mask (H, W) of the image with a given index, None if it has none.

        Raises:
            InputError: The file is damaged, or has another size than the image.
        """
        file = self.files[index]
        if file is None:
            return None
        camera = self.cameras[self.image_camera[index]]
        values = read_photo(file, camera.width, camera.height)
        return np.asarray(values != 0 if values.ndim == 2 else (values != 0).any(axis=2))


def find_masks(
    path: Path | None, names: Sequence[str], image_camera: Indices, cameras: tuple[CameraModel, ...]
) -> MaskFiles:
    """Return the masks of images.

    Args:
        path: A folder of masks, or one mask for all images; None for no masks.
        names: (I,) Names of the images.
        image_camera: (I,) Index of the camera of each image.
        cameras: Camera models.

    Raises:
        InputError: The path does not exist, or the folder has no mask of any of the images.
    """
    if path is None:
        return MaskFiles((None,) * len(names), image_camera, cameras)
    if not path.exists():
        raise InputError(path, "no such file or folder", "a mask or a folder of masks")
    if not path.is_dir():
        return MaskFiles((path,) * len(names), image_camera, cameras)
    files = tuple(_mask_file(path, PurePosixPath(name)) for name in names)
    if not any(files):
        raise InputError(path, "a folder without a mask of any image", f"files such as {names[0]}.png")
    return MaskFiles(files, image_camera, cameras)


def _mask_file(folder: Path, name: PurePosixPath) -> Path | None:
    """Return the mask file of an image, None if there is none."""
    candidates = [f"{name}.png", str(name), str(name.with_suffix(".png"))]
    if name.parent != PurePosixPath("."):
        candidates.append(f"{name.parent}.png")
    return next((folder / candidate for candidate in candidates if (folder / candidate).is_file()), None)
