"""Settings of visual SLAM, beside those of its odometry."""

from dataclasses import dataclass, field

from dronevio.estimator.slam.adjustment.bundle_adjustment import AdjustmentConfig
from dronevio.estimator.slam.mapper import MappingConfig
from dronevio.estimator.slam.places.recognizer import PlaceConfig
from dronevio.estimator.slam.schedule import AdjustmentScheduleConfig, DelayConfig
from dronevio.models.ranges import Settings


@dataclass(frozen=True)
class SlamConfig(Settings):
    """Settings of visual SLAM, beside those of its odometry."""

    places: PlaceConfig = field(default_factory=PlaceConfig)
    """Settings of the recognition of places."""
    mapping: MappingConfig = field(default_factory=MappingConfig)
    """Settings of the mapper."""
    adjustment: AdjustmentConfig = field(default_factory=AdjustmentConfig)
    """Settings of the bundle adjustment of the map, during the flight and after it."""
    adjustment_schedule: AdjustmentScheduleConfig = field(default_factory=AdjustmentScheduleConfig)
    """When the map is adjusted during the flight."""
    correction_delay: DelayConfig = field(default_factory=DelayConfig)
    """Delay between a keyframe that joins the map and the correction of the estimate by it."""
    worker: bool = True
    """Build the map in a worker process, while the odometry goes on; results do not depend on it."""
