"""The settings of the visual-inertial odometry, one section per part of the pipeline."""

from dataclasses import dataclass, field
from typing import Annotated

from dronevio.estimator.backend.config import SmootherConfig
from dronevio.estimator.backend.keyframes import KeyframeConfig
from dronevio.estimator.backend.landmarks import LandmarkConfig
from dronevio.estimator.calibration.config import CalibrationConfig
from dronevio.estimator.frontend.tracker import TrackerConfig
from dronevio.estimator.imu.noise import NoiseEstimationConfig
from dronevio.estimator.imu.preintegration import PreintegrationConfig
from dronevio.estimator.initialization.initializer import InitializerConfig
from dronevio.estimator.initialization.zero_velocity import ZeroVelocityConfig
from dronevio.estimator.monitoring.config import HealthConfig
from dronevio.estimator.monitoring.stamp_error import StampConfig
from dronevio.models.imu import GRAVITY_M_S2
from dronevio.models.ranges import Range, Settings


@dataclass(frozen=True)
class VioConfig(Settings):
    """Settings of the visual-inertial odometry. The defaults serve all flights."""

    gravity_m_s2: Annotated[float, Range(1.0, 30.0)] = GRAVITY_M_S2
    """Magnitude of gravity at the place of the flight [m/s²]: 9.780 at the equator, 9.832 at the poles, 9.81 in the
    simulator. An error of 0.03 m/s² is a scale error of 0.3 to 0.4 % of a single camera."""
    tracker: TrackerConfig = field(default_factory=TrackerConfig)
    """Settings of the feature tracker."""
    preintegration: PreintegrationConfig = field(default_factory=PreintegrationConfig)
    """Settings of the IMU preintegration."""
    noise: NoiseEstimationConfig = field(default_factory=NoiseEstimationConfig)
    """Settings of the estimation of the IMU noise."""
    zero_velocity: ZeroVelocityConfig = field(default_factory=ZeroVelocityConfig)
    """Settings of the zero-velocity detection."""
    initialization: InitializerConfig = field(default_factory=InitializerConfig)
    """Settings of the initialization."""
    keyframe: KeyframeConfig = field(default_factory=KeyframeConfig)
    """Settings of the keyframe selection."""
    smoother: SmootherConfig = field(default_factory=SmootherConfig)
    """Settings of the fixed-lag smoother."""
    landmarks: LandmarkConfig = field(default_factory=LandmarkConfig)
    """Settings of the landmarks."""
    calibration: CalibrationConfig = field(default_factory=CalibrationConfig)
    """Settings of the online calibration."""
    stamps: StampConfig = field(default_factory=StampConfig)
    """Settings of the correction of frames' time stamps."""
    health: HealthConfig = field(default_factory=HealthConfig)
    """Settings of the health monitor."""
