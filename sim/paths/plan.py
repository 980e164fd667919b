"""What to fly, in numbers and names that a command line can change."""

from dataclasses import dataclass, field, fields

import numpy as np

from dronevio.models.errors import ConfigError
from dronevio.sim.paths.heading import Heading
from dronevio.sim.paths.limits import Limits
from dronevio.sim.paths.shapes import SHAPES

TIMED_WAYPOINTS = "waypoints"
"""The shape that is given by the plan's own waypoints and time instead of limits."""


@dataclass(frozen=True)
class FlightPlan:
    """What to fly, in a space of any size: stand, take off, tour, land, stand."""

    initial_rest_s: float = 2.0
    """Standing still before take-off [s]."""
    takeoff_s: float = 2.0
    """Climbing straight up [s]; longer where the limits want it."""
    tour_s: float = 0.0
    """From hovering above the pad, through the shape, and back to hovering above the pad [s]. ``waypoints`` take
    exactly this long; of other shapes as many laps are flown as come closest to it, 0 for ``laps``."""
    landing_s: float = 3.0
    """Sinking straight down [s]; longer where the limits want it."""
    final_rest_s: float = 1.0
    """Standing still after the landing [s]; up to a tenth longer, for a whole number of tenths in all."""
    height_m: float = 1.2
    """Height of the hover above the standing drone [m]."""
    waypoints: tuple[tuple[float, float, float], ...] = ()
    """The tour of the shape ``waypoints``, (x, y, z) as fractions: ±1 in x and y is the edge of the space that the
    drone may use, 0 its centre and the pad; in z, 0 is the hover's height, ±1 the highest and lowest it may fly.
    Those of the shape ``via`` are metres in the world."""
    waypoint_jitter: float = 0.0
    """How far a seed moves each waypoint at most, as a fraction of half the free space."""
    heading_scale: float = 1.0
    """How far the camera looks along the path of ``waypoints``: 1 always, 0 never, which keeps the first heading."""
    margin_m: float = 0.4
    """Distance that the path keeps from everything: half the drone and its tracking error [m]."""
    min_height_m: float = 0.5
    """Least height of the tour above the standing drone [m]."""
    shape: str = TIMED_WAYPOINTS
    """What to fly: ``waypoints``, or one of `dronevio.sim.paths.shapes.SHAPES`."""
    laps: int = 1
    """How often."""
    limits: Limits = field(default_factory=Limits)
    """How quickly; ``waypoints`` are as quick as their time makes them."""
    heading: Heading = "shape"
    """Where the nose points: as the shape has it, along the path, across it, fixed along x, toward a point."""
    heading_target_m: tuple[float, float] = (0.0, 0.0)
    """That point, x and y from the pad [m]."""
    skip_s: float = 0.0
    """What is left out at the beginning [s]; the flight starts in motion where this is longer than rest and climb."""

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ConfigError: One of them makes no sense, or there is no such shape.
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
                raise ConfigError(f"plan's {name} = 0; expected more")
        if not np.isfinite([*np.ravel(self.waypoints), *self.heading_target_m]).all():
            raise ConfigError(
                "plan's waypoints or heading_target_m hold something that is no number; expected finite ones"
            )
