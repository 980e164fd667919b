"""Settings of visual SLAM."""

from dataclasses import dataclass, field
from typing import Annotated

from dronevio.estimator.config import VioConfig
from dronevio.estimator.slam.recognizer import PlaceConfig
from dronevio.models.ranges import Range, Settings


@dataclass(frozen=True)
class SlamConfig(Settings):
    """Settings of visual SLAM."""

    odometry: VioConfig = field(default_factory=VioConfig)
    """Settings of the odometry."""
    places: PlaceConfig = field(default_factory=PlaceConfig)
    """Settings of the recognition of places."""
    optimization_interval_s: Annotated[float, Range(low=0.0)] = 1.0
    """Shortest time of flight between two optimizations of the pose graph [s]."""
    correction_delay: Annotated[int, Range(1, 1000)] = 10
    """Number of frames after which the map's answer to a keyframe corrects the estimate. It is fixed, so that results do
    not depend on the speed of the machine."""
