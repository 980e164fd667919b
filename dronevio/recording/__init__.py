"""Recordings that the application makes: simulated flights, excerpts, and videos with an unknown IMU rotation."""

from typing import TYPE_CHECKING

from dronevio._lazy import attach

if TYPE_CHECKING:
    from dronevio.recording.excerpts import excerpt_of
    from dronevio.recording.imu_rotation import with_estimated_rotation
    from dronevio.recording.recorder import record_closed_loop, record_flight, record_refly

__all__ = [
    "excerpt_of",
    "record_closed_loop",
    "record_flight",
    "record_refly",
    "with_estimated_rotation",
]

__getattr__, __dir__ = attach(
    __name__,
    {
        "dronevio.recording.excerpts": ("excerpt_of",),
        "dronevio.recording.imu_rotation": ("with_estimated_rotation",),
        "dronevio.recording.recorder": (
            "record_closed_loop",
            "record_flight",
            "record_refly",
        ),
    },
)
