"""Simultaneous localization and mapping around the odometry: places recognized again, loops closed."""

from typing import TYPE_CHECKING

from dronevio._lazy import attach

if TYPE_CHECKING:
    from dronevio.estimator.slam.config import SlamConfig
    from dronevio.estimator.slam.features import PlaceFeatureConfig, PlaceFeatureExtractor
    from dronevio.estimator.slam.keyframe import KeyframeFeatures, MapKeyframe
    from dronevio.estimator.slam.recognizer import PlaceConfig, PlaceRecognizer
    from dronevio.estimator.slam.verification import PlaceMatch, VerificationConfig
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
        "dronevio.estimator.slam.features": ("PlaceFeatureConfig", "PlaceFeatureExtractor"),
        "dronevio.estimator.slam.keyframe": ("KeyframeFeatures", "MapKeyframe"),
        "dronevio.estimator.slam.recognizer": ("PlaceConfig", "PlaceRecognizer"),
        "dronevio.estimator.slam.verification": ("PlaceMatch", "VerificationConfig"),
        "dronevio.estimator.slam.visual_slam": ("VisualSlam",),
    },
)
