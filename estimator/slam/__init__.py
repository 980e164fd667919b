"""Simultaneous localization and mapping around the odometry: places recognized again, loops closed."""

from typing import TYPE_CHECKING

from dronevio._lazy import attach

if TYPE_CHECKING:
    from dronevio.estimator.slam.config import SlamConfig
    from dronevio.estimator.slam.map.keyframe import KeyframeFeatures, MapKeyframe
    from dronevio.estimator.slam.places.features import PlaceFeatureConfig, PlaceFeatureExtractor
    from dronevio.estimator.slam.places.recognizer import PlaceConfig, PlaceRecognizer
    from dronevio.estimator.slam.places.verification import PlaceMatch, VerificationConfig
    from dronevio.estimator.slam.visual_slam import VisualSlam

__all__ = [
    "KeyframeFeatures",
    "MapKeyframe",
    "PlaceConfig",
    "PlaceFeatureConfig",
    "PlaceFeatureExtractor",
    "PlaceMatch",
    "PlaceRecognizer",
    "SlamConfig",
    "VerificationConfig",
    "VisualSlam",
]

__getattr__, __dir__ = attach(
    __name__,
    {
        "dronevio.estimator.slam.config": ("SlamConfig",),
        "dronevio.estimator.slam.places.features": ("PlaceFeatureConfig", "PlaceFeatureExtractor"),
        "dronevio.estimator.slam.map.keyframe": ("KeyframeFeatures", "MapKeyframe"),
        "dronevio.estimator.slam.places.recognizer": ("PlaceConfig", "PlaceRecognizer"),
        "dronevio.estimator.slam.places.verification": ("PlaceMatch", "VerificationConfig"),
        "dronevio.estimator.slam.visual_slam": ("VisualSlam",),
    },
)
