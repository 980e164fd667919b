"""Source of the images of a result, as a JSON file by which a later step reads them again.

The file holds the fields of `ImageSource`; paths are absolute.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dronevio.models.errors import InputError
from dronevio.models.image_sets.combined import joined
from dronevio.models.image_sets.image_set import ImageSet
from dronevio.models.image_sets.open import open_images
from dronevio.models.recordings.files import read_text, write_text

_PATHS = ("path", "earlier_path", "masks")
_EXPECTED = "a description of images as `dronevio sfm` writes it"


@dataclass(frozen=True)
class ImageSource:
    """Source of images."""

    path: Path
    """Folder of images, video or recording."""
    earlier_path: Path | None = None
    """Further folder of images, video or recording, None if there is none."""
    masks: Path | None = None
    """Folder of masks or one mask for all images, None if there are none."""
    cameras: tuple[int | str, ...] | None = None
    """Cameras of a recording by index or name, None for the first."""

    def open(self) -> ImageSet:
        """Return all images at these places, of which a result may use some.

        Raises:
            InputError: They are no longer there, or damaged.
            ConfigError: Two of them have one name.
        """
        images = open_images(self.path, masks=self.masks, cameras=self.cameras)
        if self.earlier_path is None:
            return images
        return joined(open_images(self.earlier_path, masks=self.masks, cameras=self.cameras), images)


def write_image_source(path: Path, source: ImageSource) -> None:
    """Write the source of images.

    Raises:
        InputError: The file cannot be written.
    """
    values: dict[str, Any] = {"cameras": source.cameras}
    for name in _PATHS:
        value = getattr(source, name)
        values[name] = None if value is None else str(value.resolve())
    write_text(path, json.dumps(values, indent=2, ensure_ascii=False) + "\n")


def read_image_source(path: Path) -> ImageSource:
    """Read the source of images.

    Raises:
        InputError: The file is missing or damaged.
    """
    text = read_text(path, _EXPECTED)
    try:
        values = json.loads(text)
        cameras = values["cameras"]
        earlier, masks = (None if values[name] is None else Path(values[name]) for name in ("earlier_path", "masks"))
        chosen = None if cameras is None else tuple(each if isinstance(each, int) else str(each) for each in cameras)
        return ImageSource(Path(values["path"]), earlier, masks, chosen)
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(path, f"other contents ({error!r})", _EXPECTED) from None
