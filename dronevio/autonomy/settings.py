"""Settings of flights through unknown space."""

from dataclasses import dataclass, field
from typing import Annotated, Literal

from dronevio.autonomy.planning.body import Body
from dronevio.estimator.mapping.config import DenseMapConfig
from dronevio.models.ranges import Range, Settings
from dronevio.sim.paths.limits import Limits


@dataclass(frozen=True)
class ExploreSettings(Settings):
    """Settings of a flight through unknown space."""

    body: Body = field(default_factory=Body)
    """Space that must be known to be free around the vehicle."""
    limits: Limits = field(default_factory=lambda: Limits(speed_m_s=2.0, accel_m_s2=3.0, yaw_rate_rad_s=1.5))
    """Limits of the motion; the rate of the heading is at most 90 °/s."""
    map: DenseMapConfig = field(default_factory=DenseMapConfig)
    """The map: its cells, and to which depth it is filled."""
    height_m: Annotated[float, Range(0.3, 100.0)] = 1.2
    """Height to which the vehicle takes off, above the ground [m]."""
    pad_radius_m: Annotated[float, Range(0.3, 100.0)] = 0.9
    """Radius of the column above the pad that is known to be free before the take-off [m]; the cameras see nothing
    below, above and within half a metre."""
    lowest_m: Annotated[float, Range(0.0, 1000.0)] = 0.5
    """Least height of routes above the ground of the take-off [m]."""
    highest_m: Annotated[float, Range(0.0, 1000.0)] = 2.0
    """Greatest height of routes above the ground of the take-off [m]."""
    horizon_m: Annotated[float, Range(0.5, 100.0)] = 4.5
    """Length of the route that is planned as a trajectory [m]."""
    views: Literal["gain", "nearest"] = "gain"
    """How the next view of coverage is chosen: the unknown volume that it is expected to show for its time, or the
    nearest frontier."""
    plan_rate_hz: Annotated[float, Range(0.1, 100.0)] = 5.0
    """Rate of plans [Hz]."""
    depth_latency_s: Annotated[float, Range(0.0, 1.0)] = 0.04
    """Time from the estimate of a frame to its depth image [s]."""
    map_latency_s: Annotated[float, Range(0.0, 1.0)] = 0.01
    """Time from a depth image until it is in the map [s]."""
    plan_latency_s: Annotated[float, Range(0.0, 1.0)] = 0.2
    """Time from the map until the vehicle follows a plan that was made with it [s]."""

    @property
    def latency_s(self) -> float:
        """Time from the estimate of a frame until the vehicle follows a plan that was made with it [s]."""
        return self.depth_latency_s + self.map_latency_s + self.plan_latency_s
