"""The back end: a fixed-lag smoother over keyframes and landmarks with a marginal prior."""

from typing import TYPE_CHECKING

from dronevio._lazy import attach

if TYPE_CHECKING:
    from dronevio.estimator.backend.config import SmootherConfig
    from dronevio.estimator.backend.keyframes import KeyframeConfig, KeyframePolicy
    from dronevio.estimator.backend.landmarks import LandmarkConfig
    from dronevio.estimator.backend.smoother import Keyframe, KeyframeSmoother
    from dronevio.estimator.backend.triangulation import Triangulation, triangulate

__all__ = [
    "Keyframe",
    "KeyframeConfig",
    "KeyframePolicy",
    "KeyframeSmoother",
    "LandmarkConfig",
    "SmootherConfig",
    "Triangulation",
    "triangulate",
]

__getattr__, __dir__ = attach(
    __name__,
    {
        "dronevio.estimator.backend.config": ("SmootherConfig",),
        "dronevio.estimator.backend.keyframes": ("KeyframeConfig", "KeyframePolicy"),
        "dronevio.estimator.backend.landmarks": ("LandmarkConfig",),
        "dronevio.estimator.backend.smoother": ("Keyframe", "KeyframeSmoother"),
        "dronevio.estimator.backend.triangulation": ("Triangulation", "triangulate"),
    },
)
