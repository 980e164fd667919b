"""Images of a scene with their cameras, the input of structure from motion: folders, videos and recordings."""

from typing import TYPE_CHECKING

from dronevio._lazy import attach

if TYPE_CHECKING:
    from dronevio.models.image_sets.combined import joined, subset, with_earlier
    from dronevio.models.image_sets.folder import CameraSharing, image_folder
    from dronevio.models.image_sets.geotags import GeoTags
    from dronevio.models.image_sets.image_set import FocalSource, ImageSet, InertialData
    from dronevio.models.image_sets.open import open_images
    from dronevio.models.image_sets.recording import image_recording
    from dronevio.models.image_sets.video import image_video

__all__ = [
    "CameraSharing",
    "FocalSource",
    "GeoTags",
    "ImageSet",
    "InertialData",
    "image_folder",
    "image_recording",
    "image_video",
    "joined",
    "open_images",
    "subset",
    "with_earlier",
]

__getattr__, __dir__ = attach(
    __name__,
    {
        "dronevio.models.image_sets.combined": ("joined", "subset", "with_earlier"),
        "dronevio.models.image_sets.folder": ("CameraSharing", "image_folder"),
        "dronevio.models.image_sets.geotags": ("GeoTags",),
        "dronevio.models.image_sets.image_set": ("FocalSource", "ImageSet", "InertialData"),
        "dronevio.models.image_sets.open": ("open_images",),
        "dronevio.models.image_sets.recording": ("image_recording",),
        "dronevio.models.image_sets.video": ("image_video",),
    },
)
