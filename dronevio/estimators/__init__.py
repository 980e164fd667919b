"""Estimators by name, the user's classes and other programs among them, and the loop that runs one on a recording."""

from typing import TYPE_CHECKING

from dronevio._lazy import attach

if TYPE_CHECKING:
    from dronevio.estimators.driver import TimedEstimator, estimate_recording
    from dronevio.estimators.registry import EstimatorKind, NamedEstimator, estimator_named

__all__ = [
    "EstimatorKind",
    "NamedEstimator",
    "TimedEstimator",
    "estimate_recording",
    "estimator_named",
]

__getattr__, __dir__ = attach(
    __name__,
    {
        "dronevio.estimators.driver": (
            "TimedEstimator",
            "estimate_recording",
        ),
        "dronevio.estimators.registry": (
            "EstimatorKind",
            "NamedEstimator",
            "estimator_named",
        ),
    },
)
