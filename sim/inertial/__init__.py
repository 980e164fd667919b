"""IMU errors: biases, noise, vibration and output limits."""

from typing import TYPE_CHECKING

from dronevio._lazy import attach

if TYPE_CHECKING:
    from dronevio.sim.inertial.imu import ImuErrors

__all__ = [
    "ImuErrors",
]

__getattr__, __dir__ = attach(
    __name__,
    {
        "dronevio.sim.inertial.imu": ("ImuErrors",),
    },
)
