"""The map: keyframes, the odometry's factors between them, pose graphs, and the covariance of their poses."""

from typing import TYPE_CHECKING

from dronevio._lazy import attach

if TYPE_CHECKING:
    from dronevio.estimator.slam.map.keyframe import KeyframeFeatures, MapKeyframe
    from dronevio.estimator.slam.map.odometry_factors import AbsolutePosition, GravityDirection, RelativePose
    from dronevio.estimator.slam.map.pose_graph import OptimizedGraph, PoseGraph
    from dronevio.estimator.slam.map.submap import Submap

__all__ = [
    "AbsolutePosition",
    "GravityDirection",
    "KeyframeFeatures",
    "MapKeyframe",
    "OptimizedGraph",
    "PoseGraph",
    "RelativePose",
    "Submap",
]

__getattr__, __dir__ = attach(
    __name__,
    {
        "dronevio.estimator.slam.map.keyframe": (
            "KeyframeFeatures",
            "MapKeyframe",
        ),
        "dronevio.estimator.slam.map.odometry_factors": (
            "AbsolutePosition",
            "GravityDirection",
            "RelativePose",
        ),
        "dronevio.estimator.slam.map.pose_graph": (
            "OptimizedGraph",
            "PoseGraph",
        ),
        "dronevio.estimator.slam.map.submap": ("Submap",),
    },
)
