"""The mapper behind the odometry: in the same process, or in one of its own."""

from typing import TYPE_CHECKING

from dronevio._lazy import attach

if TYPE_CHECKING:
    from dronevio.estimator.slam.worker.map_builder import LocalMap, MapBuilder, MapCost, OdometryMap
    from dronevio.estimator.slam.worker.map_process import MapProcess

__all__ = [
    "LocalMap",
    "MapBuilder",
    "MapCost",
    "MapProcess",
    "OdometryMap",
]

__getattr__, __dir__ = attach(
    __name__,
    {
        "dronevio.estimator.slam.worker.map_builder": (
            "LocalMap",
            "MapBuilder",
            "MapCost",
            "OdometryMap",
        ),
        "dronevio.estimator.slam.worker.map_process": ("MapProcess",),
    },
)
