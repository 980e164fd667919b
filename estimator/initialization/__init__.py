"""Initialization: gravity, velocity and biases from a static interval or from motion."""

from typing import TYPE_CHECKING

from dronevio._lazy import attach

if TYPE_CHECKING:
    from dronevio.estimator.initialization.dynamic import DynamicInitializationConfig, initialize_dynamic
    from dronevio.estimator.initialization.initializer import Initializer, InitializerConfig
    from dronevio.estimator.initialization.not_observable import NotObservable
    from dronevio.estimator.initialization.static import InitialSigmas, initialize_static
    from dronevio.estimator.initialization.zero_velocity import ZeroVelocityConfig, ZeroVelocityDetector

__all__ = [
    "DynamicInitializationConfig",
    "InitialSigmas",
    "Initializer",
    "InitializerConfig",
    "NotObservable",
    "ZeroVelocityConfig",
    "ZeroVelocityDetector",
    "initialize_dynamic",
    "initialize_static",
]

__getattr__, __dir__ = attach(
    __name__,
    {
        "dronevio.estimator.initialization.dynamic": ("DynamicInitializationConfig", "initialize_dynamic"),
        "dronevio.estimator.initialization.initializer": ("Initializer", "InitializerConfig"),
        "dronevio.estimator.initialization.not_observable": ("NotObservable",),
        "dronevio.estimator.initialization.static": ("InitialSigmas", "initialize_static"),
        "dronevio.estimator.initialization.zero_velocity": ("ZeroVelocityConfig", "ZeroVelocityDetector"),
    },
)
