"""Flight plans: the settings of a planned trajectory."""

from dataclasses import dataclass, field, fields

import numpy as np

from dronevio.models.errors import ConfigError
from dronevio.sim.paths.heading import Heading
from dronevio.sim.paths.limits import Limits
from dronevio.sim.paths.shapes import SHAPES

TIMED_WAYPOINTS = "waypoints"
"""Name of the shape that is defined by relative waypoints and a duration instead of limits."""


@dataclass(frozen=True)
class FlightPlan:
    """Plan of a flight in a space of any size: rest, take-off, tour, landing, rest."""

    initial_rest_s: float = 2.0
    """Time at rest before take-off [s]."""
    takeoff_s: float = 2.0
    """Duration of the vertical climb [s]; longer if the limits require it."""
    tour_s: float = 0.0
    """Duration of the tour from the hover above the landing pad and back to it [s]. The shape ``waypoints`` takes
    exactly this time; of other shapes, as many laps are flown as come closest to it, and 0 means ``laps``."""
    landing_s: float = 3.0
    """Duration of the vertical descent [s]; longer if the limits require it."""
    final_rest_s: float = 1.0
    """Time at rest after the landing [s]; extended so that the whole flight takes a multiple of 0.1 s."""
    height_m: float = 1.2
    """Height of the hover above the standing drone [m]."""
    waypoints: tuple[tuple[float, float, float], ...] = ()
    """Waypoints (x, y, z) of the shapes ``waypoints`` and ``via``. For ``waypoints`` they are relative: in x and y, 0
    is the landing pad and ±1 the edge of the usable space; in z, 0 is the hover height and ±1 the largest and smallest
    usable height. For ``via`` they are positions in the world [m]."""
    waypoint_jitter: float = 0.0
    """Largest random displacement of each waypoint, relative to half the free space."""
    heading_scale: float = 1.0
    """Fraction of the path's heading that the shape ``waypoints`` follows: 1 looks along the path, 0 keeps the first
    heading."""
    margin_m: float = 0.4
    """Distance between the path and every surface [m]: half the size of the drone and its tracking error."""
    min_height_m: float = 0.5
    """Smallest height of the tour above the standing drone [m]."""
    shape: str = TIMED_WAYPOINTS
    """Shape of the tour: ``waypoints`` or a key of `dronevio.sim.paths.shapes.SHAPES`."""
    laps: int = 1
    """Number of laps of the shape."""
    limits: Limits = field(default_factory=Limits)
    """Limits of speed, acceleration and rates; not used by the shape ``waypoints``."""
    heading: Heading = "shape"
    """Heading of the drone: defined by the shape, along the path, across it, fixed along x, or toward a point."""
    heading_target_m: tuple[float, float] = (0.0, 0.0)
    """Point of the heading ``toward``: x and y relative to the landing pad [m]."""
    skip_s: float = 0.0
    """Time that is omitted at the beginning [s]; the flight starts in motion if it exceeds rest and climb."""

    def __post_init__(self) -> None:
        """Check the ranges of the values.

        Raises:
            ConfigError: A value is outside its range, or the shape is unknown.
        """
        if self.shape != TIMED_WAYPOINTS and self.shape not in SHAPES:
            raise ConfigError(f"unknown shape {self.shape!r}; expected {TIMED_WAYPOINTS} or one of {', '.join(SHAPES)}")
        for setting in fields(self):
            value = getattr(self, setting.name)
            if isinstance(value, float) and not (np.isfinite(value) and value >= 0.0):
                raise ConfigError(f"plan's {setting.name} = {value:g}; expected a finite number, 0 or more")
        if self.laps < 1:
            raise ConfigError(f"plan's laps = {self.laps}; expected 1 or more")
        for name in ("takeoff_s", "landing_s", "height_m") + (("tour_s",) if self.shape == TIMED_WAYPOINTS else ()):
            if getattr(self, name) <= 0.0:
                raise ConfigError(f"plan's {name} = 0; expected a positive number")
        if not np.isfinite([*np.ravel(self.waypoints), *self.heading_target_m]).all():
            raise ConfigError("plan's waypoints or heading_target_m are not finite; expected finite numbers")
