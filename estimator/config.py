"""The settings of the visual-inertial odometry, a part of the pipeline each: one set of them serves every flight."""

from dataclasses import dataclass, field

from dronevio.estimator.backend.keyframes import KeyframeConfig
from dronevio.estimator.backend.landmarks import LandmarkConfig
from dronevio.estimator.backend.smoother import SmootherConfig
from dronevio.estimator.calibration.online import CalibrationConfig
from dronevio.estimator.frontend.tracker import TrackerConfig
from dronevio.estimator.health import HealthConfig
from dronevio.estimator.imu.noise import NoiseEstimationConfig
from dronevio.estimator.imu.preintegration import PreintegrationConfig
from dronevio.estimator.initialization.initializer import InitialiserConfig
from dronevio.estimator.initialization.zero_velocity import ZeroVelocityConfig


@dataclass(frozen=True)
class VioConfig:
    """Settings of the visual-inertial odometry."""

    tracker: TrackerConfig = field(default_factory=TrackerConfig)
    inertial: PreintegrationConfig = field(default_factory=PreintegrationConfig)
    noise: NoiseEstimationConfig = field(default_factory=NoiseEstimationConfig)
    stillness: ZeroVelocityConfig = field(default_factory=ZeroVelocityConfig)
    start: InitialiserConfig = field(default_factory=InitialiserConfig)
    keyframe: KeyframeConfig = field(default_factory=KeyframeConfig)
    smoother: SmootherConfig = field(default_factory=SmootherConfig)
    landmarks: LandmarkConfig = field(default_factory=LandmarkConfig)
    calibration: CalibrationConfig = field(default_factory=CalibrationConfig)
    health: HealthConfig = field(default_factory=HealthConfig)
