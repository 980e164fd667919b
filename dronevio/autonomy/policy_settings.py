"""Settings of the planner as a policy."""

from dataclasses import dataclass, field
from typing import Annotated

from dronevio.autonomy.planning.body import Body
from dronevio.models.ranges import Range, Settings
from dronevio.sim.paths.limits import Limits


@dataclass(frozen=True)
class PlannerSettings(Settings):
    """Settings of the planner as a policy."""

    body: Body = field(default_factory=Body)
    """Space that must be known to be free around the vehicle."""
    limits: Limits = field(default_factory=lambda: Limits(speed_m_s=1.5, accel_m_s2=2.5, yaw_rate_rad_s=1.5))
    """Limits of the motion."""
    cell_m: Annotated[float, Range(0.01, 1.0)] = 0.1
    """Side of the cells of the map [m]."""
    range_m: Annotated[float, Range(0.5, 20.0)] = 4.0
    """Largest depth that enters the map [m]."""
    map_rate_hz: Annotated[float, Range(0.1, 1000.0)] = 10.0
    """Rate at which images enter the map [Hz]."""
    plan_rate_hz: Annotated[float, Range(0.1, 1000.0)] = 5.0
    """Rate of plans [Hz]."""
    horizon_m: Annotated[float, Range(0.5, 100.0)] = 4.5
    """Length of the path that is planned as a trajectory [m]."""
    start_radius_m: Annotated[float, Range(0.0, 10.0)] = 0.6
    """Radius around the start that is free by the description of the tasks [m]."""
    take_off_m: Annotated[float, Range(0.3, 10.0)] = 1.2
    """Height of the take-off from a stand [m]."""
    below_m: Annotated[float, Range(0.0, 10.0)] = 0.5
    """Height of the path below the lower one of start and goal [m]."""
    above_m: Annotated[float, Range(0.0, 10.0)] = 0.8
    """Height of the path above the higher one of start and goal [m]."""
    gain_per_s: Annotated[float, Range(0.0, 20.0)] = 2.0
    """Velocity per distance from the trajectory, and yaw rate per angle [1/s]."""
