"""The inertial side: buffered increments, preintegration, noise and covariance propagation."""

from typing import TYPE_CHECKING

from dronevio._lazy import attach

if TYPE_CHECKING:
    from dronevio.estimator.imu.buffer import ImuBuffer, Increments
    from dronevio.estimator.imu.covariance import propagate_covariance
    from dronevio.estimator.imu.forward_propagation import ImuRatePropagator
    from dronevio.estimator.imu.noise import ImuNoiseEstimator, NoiseEstimationConfig
    from dronevio.estimator.imu.preintegration import Preintegration, PreintegrationConfig, PreintegrationParams

__all__ = [
    "ImuBuffer",
    "ImuNoiseEstimator",
    "ImuRatePropagator",
    "Increments",
    "NoiseEstimationConfig",
    "Preintegration",
    "PreintegrationConfig",
    "PreintegrationParams",
    "propagate_covariance",
]

__getattr__, __dir__ = attach(
    __name__,
    {
        "dronevio.estimator.imu.buffer": ("ImuBuffer", "Increments"),
        "dronevio.estimator.imu.covariance": ("propagate_covariance",),
        "dronevio.estimator.imu.forward_propagation": ("ImuRatePropagator",),
        "dronevio.estimator.imu.noise": ("ImuNoiseEstimator", "NoiseEstimationConfig"),
        "dronevio.estimator.imu.preintegration": ("Preintegration", "PreintegrationConfig", "PreintegrationParams"),
    },
)
