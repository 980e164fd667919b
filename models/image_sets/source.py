"""Where the images of a result come from, as a JSON file, so that a later step finds and reads them again.

The file holds the arguments of `open_images`: ``path`` and ``masks``, absolute, and ``every``, ``cameras`` and
``frames``; ``null`` where an argument was not given.
"""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from dronevio.models.errors import InputError
from dronevio.models.image_sets.image_set import ImageSet
from dronevio.models.image_sets.open import open_images
from dronevio.models.recordings.files import read_text, write_text

_EXPECTED = "a description of images as `dronevio sfm` writes it"


@dataclass(frozen=True)
class ImageSource:
    """Arguments with which images were opened."""

    path: Path
    """Folder of images, video or recording."""
    masks: Path | None = None
    """Folder of masks or one mask for all images, None if there are none."""
    every: int | None = None
    """Distance between the frames of a video, None for all."""
    cameras: tuple[int, ...] | None = None
    """Indices of the cameras of a recording, None for the first."""
    frames: int | None = None
    """Number of frames of a recording, None for all."""

    def open(self) -> ImageSet:
        """Return the images.

        Raises:
            InputError: They are no longer there, or damaged.
        """
        return open_images(self.path, masks=self.masks, every=self.every, cameras=self.cameras, frames=self.frames)


def write_image_source(path: Path, source: ImageSource) -> None:
    """Write a description of images, with absolute paths.

    Raises:
        InputError: The file cannot be written.
    """
    values = asdict(source)
    for name in ("path", "masks"):
        if values[name] is not None:
            values[name] = str(values[name].resolve())
    write_text(path, json.dumps(values, indent=2, ensure_ascii=False) + "\n")


def read_image_source(path: Path) -> ImageSource:
    """Read a description of images.

    Raises:
        InputError: The file is missing or damaged.
    """
    text = read_text(path, _EXPECTED)
    try:
        return _parsed(json.loads(text))
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(path, f"other contents ({error!r})", _EXPECTED) from None


def _parsed(values: dict[str, Any]) -> ImageSource:
    """Return the source that a JSON document describes; ValueError, KeyError or TypeError if it is another one."""
    masks, every, cameras, frames = (values[name] for name in ("masks", "every", "cameras", "frames"))
    return ImageSource(
        Path(values["path"]),
        None if masks is None else Path(masks),
        None if every is None else int(every),
        None if cameras is None else tuple(int(camera) for camera in cameras),
        None if frames is None else int(frames),
    )
