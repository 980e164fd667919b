"""What the measurements say about the estimate and about themselves: health, consistency, and errors of sensors."""

from typing import TYPE_CHECKING

from dronevio._lazy import attach

if TYPE_CHECKING:
    from dronevio.estimator.monitoring.health import HealthConfig, HealthMonitor
    from dronevio.estimator.monitoring.innovation import Innovation
    from dronevio.estimator.monitoring.stamp_error import StampConfig, StampCorrection

__all__ = [
    "HealthConfig",
    "HealthMonitor",
    "Innovation",
    "StampConfig",
    "StampCorrection",
]

__getattr__, __dir__ = attach(
    __name__,
    {
        "dronevio.estimator.monitoring.health": (
            "HealthConfig",
            "HealthMonitor",
        ),
        "dronevio.estimator.monitoring.innovation": ("Innovation",),
        "dronevio.estimator.monitoring.stamp_error": (
            "StampConfig",
            "StampCorrection",
        ),
    },
)
