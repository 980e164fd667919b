"""Visual-inertial odometry and structure from motion; the only package that imports GTSAM."""

from typing import TYPE_CHECKING

from dronevio._lazy import attach

if TYPE_CHECKING:
    from dronevio.estimator.baselines.dead_reckoning import DeadReckoning, DeadReckoningConfig
    from dronevio.estimator.config import VioConfig
    from dronevio.estimator.frontend.protocol import FrontEnd, PredictingFrontEnd
    from dronevio.estimator.imu.forward_propagation import ImuRatePropagator
    from dronevio.estimator.odometry import VisualInertialOdometry
    from dronevio.estimator.types import Calibration, ExpectedFeatures, FramePacket, Matches, Observations

__all__ = [
    "Calibration",
    "DeadReckoning",
    "DeadReckoningConfig",
    "ExpectedFeatures",
    "FramePacket",
    "FrontEnd",
    "ImuRatePropagator",
    "Matches",
    "Observations",
    "PredictingFrontEnd",
    "VioConfig",
    "VisualInertialOdometry",
]

__getattr__, __dir__ = attach(
    __name__,
    {
        "dronevio.estimator.baselines.dead_reckoning": ("DeadReckoning", "DeadReckoningConfig"),
        "dronevio.estimator.config": ("VioConfig",),
        "dronevio.estimator.frontend.protocol": ("FrontEnd", "PredictingFrontEnd"),
        "dronevio.estimator.imu.forward_propagation": ("ImuRatePropagator",),
        "dronevio.estimator.types": ("Calibration", "ExpectedFeatures", "FramePacket", "Matches", "Observations"),
        "dronevio.estimator.odometry": ("VisualInertialOdometry",),
    },
)
