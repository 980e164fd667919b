"""Place recognition: features, a vocabulary and its index, and the verification of matches by geometry."""

from typing import TYPE_CHECKING

from dronevio._lazy import attach

if TYPE_CHECKING:
    from dronevio.estimator.slam.places.features import PlaceFeatureConfig, PlaceFeatureExtractor
    from dronevio.estimator.slam.places.localization import LocalizationConfig, Localizer
    from dronevio.estimator.slam.places.recognizer import PlaceConfig, PlaceRecognizer
    from dronevio.estimator.slam.places.verification import PlaceMatch, VerificationConfig

__all__ = [
    "LocalizationConfig",
    "Localizer",
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
        "dronevio.estimator.slam.places.features": (
            "PlaceFeatureConfig",
            "PlaceFeatureExtractor",
        ),
        "dronevio.estimator.slam.places.localization": (
            "LocalizationConfig",
            "Localizer",
        ),
        "dronevio.estimator.slam.places.recognizer": (
            "PlaceConfig",
            "PlaceRecognizer",
        ),
        "dronevio.estimator.slam.places.verification": (
            "PlaceMatch",
            "VerificationConfig",
        ),
    },
)
