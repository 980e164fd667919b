"""Occupancy grids as files: all cells in an archive of numpy, and a layer of them as a map of ROS."""

from typing import TYPE_CHECKING

from dronevio._lazy import attach

if TYPE_CHECKING:
    from dronevio.models.occupancy_maps.archive import read_occupancy, write_occupancy
    from dronevio.models.occupancy_maps.ros_map import RosMap, layer_of, read_ros_map, write_ros_map

__all__ = ["RosMap", "layer_of", "read_occupancy", "read_ros_map", "write_occupancy", "write_ros_map"]

__getattr__, __dir__ = attach(
    __name__,
    {
        "dronevio.models.occupancy_maps.archive": ("read_occupancy", "write_occupancy"),
        "dronevio.models.occupancy_maps.ros_map": ("RosMap", "layer_of", "read_ros_map", "write_ros_map"),
    },
)
