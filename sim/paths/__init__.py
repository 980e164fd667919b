"""Path planning: shapes, minimum-snap trajectories within limits and clear of obstacles, and recorded trajectories."""

from typing import TYPE_CHECKING

from dronevio._lazy import attach

if TYPE_CHECKING:
    from dronevio.sim.paths.limits import Limits
    from dronevio.sim.paths.path import plan_reference
    from dronevio.sim.paths.plan import FlightPlan

__all__ = [
    "FlightPlan",
    "Limits",
    "plan_reference",
]

__getattr__, __dir__ = attach(
    __name__,
    {
        "dronevio.sim.paths.limits": ("Limits",),
        "dronevio.sim.paths.path": ("plan_reference",),
        "dronevio.sim.paths.plan": ("FlightPlan",),
    },
)
