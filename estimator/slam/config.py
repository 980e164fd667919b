"""Settings of visual SLAM, beside those of its odometry."""

from dataclasses import dataclass, field

from dronevio.estimator.slam.bundle_adjustment import AdjustmentConfig
from dronevio.estimator.slam.mapping import MappingConfig
from dronevio.estimator.slam.recognizer import PlaceConfig
from dronevio.estimator.slam.schedule import DelayConfig
from dronevio.models.ranges import Settings


@dataclass(frozen=True)
class SlamConfig(Settings):
    """Settings of visual SLAM, beside those of its odometry."""

    places: PlaceConfig = field(default_factory=PlaceConfig)
    """Settings of the recognition of places."""
    mapping: MappingConfig = field(default_factory=MappingConfig)
    """Settings of the mapper."""
    adjustment: AdjustmentConfig = field(default_factory=AdjustmentConfig)
    """Settings of the bundle adjustment of the final map."""
    correction_delay: DelayConfig = field(default_factory=DelayConfig)
    """Delay between a keyframe that joins the map and the correction of the estimate by it."""
    worker: bool = True
    """Build the map in a worker process, while the odometry goes on; results do not depend on it."""
