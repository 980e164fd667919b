"""Simultaneous localization and mapping: places that are recognized again."""

from typing import TYPE_CHECKING

from dronevio._lazy import attach

if TYPE_CHECKING:
    from dronevio.estimator.slam.features import PlaceFeatureConfig, PlaceFeatureExtractor
    from dronevio.estimator.slam.keyframe import KeyframeFeatures, MapKeyframe
    from dronevio.estimator.slam.recognizer import PlaceConfig, PlaceRecognizer
    from dronevio.estimator.slam.verification import PlaceMatch, VerificationConfig

__all__ = [
    "KeyframeFeatures",
    "MapKeyframe",
    "PlaceConfig",
    "PlaceFeatureConfig",
    "PlaceFeatureExtractor",
    "PlaceMatch",
    "PlaceRecognizer",
    "VerificationConfig",
]

__getattr__, __dir__ = attach(
    __name__,
    {
        "dronevio.estimator.slam.features": ("PlaceFeatureConfig", "PlaceFeatureExtractor"),
        "dronevio.estimator.slam.keyframe": ("KeyframeFeatures", "MapKeyframe"),
        "dronevio.estimator.slam.recognizer": ("PlaceConfig", "PlaceRecognizer"),
        "dronevio.estimator.slam.verification": ("PlaceMatch", "VerificationConfig"),
    },
)
