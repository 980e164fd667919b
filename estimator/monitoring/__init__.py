"""What the measurements say about the estimate and about themselves: health, consistency, and errors of sensors."""

from typing import TYPE_CHECKING

from dronevio._lazy import attach

if TYPE_CHECKING:
    from dronevio.estimator.monitoring.causes import Cause, Reason
    from dronevio.estimator.monitoring.config import HealthConfig
    from dronevio.estimator.monitoring.health import Assessment, health_report
    from dronevio.estimator.monitoring.innovation import Innovation
    from dronevio.estimator.monitoring.monitor import HealthMonitor
    from dronevio.estimator.monitoring.stamp_error import StampConfig, StampCorrection

__all__ = [
    "Assessment",
    "Cause",
    "HealthConfig",
    "HealthMonitor",
    "Innovation",
    "Reason",
    "StampConfig",
    "StampCorrection",
    "health_report",
]

__getattr__, __dir__ = attach(
    __name__,
    {
        "dronevio.estimator.monitoring.causes": (
            "Cause",
            "Reason",
        ),
        "dronevio.estimator.monitoring.config": ("HealthConfig",),
        "dronevio.estimator.monitoring.health": (
            "Assessment",
            "health_report",
        ),
        "dronevio.estimator.monitoring.innovation": ("Innovation",),
        "dronevio.estimator.monitoring.monitor": ("HealthMonitor",),
        "dronevio.estimator.monitoring.stamp_error": (
            "StampConfig",
            "StampCorrection",
        ),
    },
)
