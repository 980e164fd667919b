"""Files of maps: our own, which can be continued, and pose graphs in the g2o format."""

from typing import TYPE_CHECKING

from dronevio._lazy import attach

if TYPE_CHECKING:
    from dronevio.estimator.slam.files.g2o import write_g2o
    from dronevio.estimator.slam.files.map_file import read_map, write_map
    from dronevio.estimator.slam.files.saved_map import KnownMap, SavedMap

__all__ = [
    "KnownMap",
    "SavedMap",
    "read_map",
    "write_g2o",
    "write_map",
]

__getattr__, __dir__ = attach(
    __name__,
    {
        "dronevio.estimator.slam.files.g2o": ("write_g2o",),
        "dronevio.estimator.slam.files.map_file": (
            "read_map",
            "write_map",
        ),
        "dronevio.estimator.slam.files.saved_map": (
            "KnownMap",
            "SavedMap",
        ),
    },
)
