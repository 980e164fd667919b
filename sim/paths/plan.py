"""Flight plans: the settings of a planned trajectory."""

from dataclasses import dataclass, field
from typing import Annotated

from dronevio.models.errors import ConfigError
from dronevio.models.ranges import Range, Settings, require
from dronevio.sim.paths.heading import Heading
from dronevio.sim.paths.limits import Limits
from dronevio.sim.paths.shapes import SHAPES

TIMED_WAYPOINTS = "waypoints"
"""Name of the shape that is defined by relative waypoints and a duration instead of limits."""


@dataclass(frozen=True)
class FlightPlan(Settings):
    """Plan of a flight in a space of any size: rest, take-off, tour, landing, rest."""

    initial_rest_s: Annotated[float, Range(0.0, 300.0)] = 2.0
    """Time at rest before take-off [s]."""
    takeoff_s: Annotated[float, Range(0.1, 300.0)] = 2.0
    """Duration of the vertical climb [s]; longer if the limits require it."""
    tour_s: Annotated[float, Range(0.0, 3600.0)] = 0.0
    """Duration of the tour from the hover above the landing pad and back to it [s]. The shape ``waypoints`` takes
    exactly this time; of other shapes, as many laps are flown as come closest to it, and 0 means ``laps``."""
    landing_s: Annotated[float, Range(0.1, 300.0)] = 3.0
    """Duration of the vertical descent [s]; longer if the limits require it."""
    final_rest_s: Annotated[float, Range(0.0, 300.0)] = 1.0
    """Time at rest after the landing [s]; extended so that the whole flight takes a multiple of 0.1 s."""
    height_m: Annotated[float, Range(above=0.0, high=100.0)] = 1.2
    """Height of the hover above the standing drone [m]."""
    waypoints: Annotated[tuple[tuple[float, float, float], ...], Range(-1e4, 1e4)] = ()
    """Waypoints (x, y, z) of the shapes ``waypoints`` and ``via``. For ``waypoints`` they are relative: in x and y, 0
    is the landing pad and ±1 the edge of the usable space; in z, 0 is the hover height and ±1 the largest and smallest
    usable height. For ``via`` they are positions in the world [m]."""
    waypoint_jitter: Annotated[float, Range(0.0, 10.0)] = 0.0
    """Largest random displacement of each waypoint, relative to half the free space."""
    heading_scale: Annotated[float, Range(0.0, 10.0)] = 1.0
    """Fraction of the path's heading that the shape ``waypoints`` follows: 1 looks along the path, 0 keeps the first
    heading."""
    margin_m: Annotated[float, Range(0.0, 100.0)] = 0.4
    """Distance between the path and every surface [m]: half the size of the drone and its tracking error."""
    min_height_m: Annotated[float, Range(0.0, 100.0)] = 0.5
    """Smallest height of the tour above the standing drone [m]."""
    shape: str = TIMED_WAYPOINTS
    """Shape of the tour: ``waypoints`` or a key of `dronevio.sim.paths.shapes.SHAPES`."""
    laps: Annotated[int, Range(1, 100)] = 1
    """Number of laps of the shape."""
    limits: Limits = field(default_factory=Limits)
    """Limits of speed, acceleration and rates; not used by the shape ``waypoints``."""
    heading: Heading = "shape"
    """Heading of the drone: defined by the shape, along the path, across it, fixed along x, or toward a point."""
    heading_target_m: Annotated[tuple[float, float], Range(-1e4, 1e4)] = (0.0, 0.0)
    """Point of the heading ``toward``: x and y relative to the landing pad [m]."""
    skip_s: Annotated[float, Range(0.0, 3600.0)] = 0.0
    """Time that is omitted at the beginning [s]; the flight starts in motion if it exceeds rest and climb."""

    def __post_init__(self) -> None:
        """Check the ranges of the values.

        Raises:
            ConfigError: A value is outside its range, or the shape is unknown.
        """
        super().__post_init__()
        if self.shape != TIMED_WAYPOINTS and self.shape not in SHAPES:
            raise ConfigError(f"unknown shape {self.shape!r}; expected {TIMED_WAYPOINTS} or one of {', '.join(SHAPES)}")
        timed = self.shape == TIMED_WAYPOINTS
        require(self, self.tour_s > 0.0 or not timed, "tour_s", f"more than 0 with the shape {TIMED_WAYPOINTS}")
