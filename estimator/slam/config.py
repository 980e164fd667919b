"""Settings of visual SLAM, beside those of its odometry."""

from dataclasses import dataclass, field
from typing import Annotated

from dronevio.estimator.slam.bundle_adjustment import AdjustmentConfig
from dronevio.estimator.slam.mapping import MappingConfig
from dronevio.estimator.slam.recognizer import PlaceConfig
from dronevio.models.ranges import Range, Settings


@dataclass(frozen=True)
class SlamConfig(Settings):
    """Settings of visual SLAM, beside those of its odometry."""

    places: PlaceConfig = field(default_factory=PlaceConfig)
    """Settings of the recognition of places."""
    mapping: MappingConfig = field(default_factory=MappingConfig)
    """Settings of the mapper."""
    adjustment: AdjustmentConfig = field(default_factory=AdjustmentConfig)
    """Settings of the bundle adjustment of the final map."""
    correction_delay: Annotated[int, Range(1, 1000)] = 10
    """Number of frames after which the answer of the map to a keyframe corrects the estimate. It is fixed, so that
    results do not depend on the speed of the machine."""
