"""The settings of the visual-inertial odometry, a part of the pipeline each: one set of them serves every flight."""

from dataclasses import dataclass, field

from dronevio.estimator.calibration import CalibrationConfig
from dronevio.estimator.health import HealthConfig
from dronevio.estimator.imu_noise import NoiseLevelConfig
from dronevio.estimator.inertial import InertialConfig
from dronevio.estimator.initialiser import InitialiserConfig
from dronevio.estimator.keyframes import KeyframeConfig
from dronevio.estimator.landmarks import LandmarkConfig
from dronevio.estimator.smoother import SmootherConfig
from dronevio.estimator.stillness import StillnessConfig
from dronevio.estimator.tracker import TrackerConfig


@dataclass(frozen=True)
class VioConfig:
    """Settings of the visual-inertial odometry."""

    tracker: TrackerConfig = field(default_factory=TrackerConfig)
    inertial: InertialConfig = field(default_factory=InertialConfig)
    noise: NoiseLevelConfig = field(default_factory=NoiseLevelConfig)
    stillness: StillnessConfig = field(default_factory=StillnessConfig)
    start: InitialiserConfig = field(default_factory=InitialiserConfig)
    keyframe: KeyframeConfig = field(default_factory=KeyframeConfig)
    smoother: SmootherConfig = field(default_factory=SmootherConfig)
    landmarks: LandmarkConfig = field(default_factory=LandmarkConfig)
    calibration: CalibrationConfig = field(default_factory=CalibrationConfig)
    health: HealthConfig = field(default_factory=HealthConfig)
