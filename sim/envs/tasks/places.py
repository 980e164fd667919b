"""Random places in the free space of a world, at which episodes start or end."""

from functools import lru_cache

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError
from dronevio.sim.paths.space import FlightArea

_PLACES = 2048  # random places of a world, of whose free ones starts and goals are drawn
_CELL_M = 2.0
_PLACES_SEED = 0  # of the free places, which do not depend on the seed of an environment


@lru_cache(maxsize=1024)
def free_places(area: FlightArea, height_m: tuple[float, float], clearance_m: float) -> Array:
    """Return places (P, 3) in the free space of a world.

    Args:
        area: The world.
        height_m: Smallest and largest height above the floor [m].
        clearance_m: Smallest distance from obstacles [m].

    Raises:
        ConfigError: There are none at these heights with this clearance.
    """
    rng = np.random.default_rng(_PLACES_SEED)
    low, high = area.space.low.copy(), area.space.high.copy()
    low[2], high[2] = area.pad[2] + height_m[0], area.pad[2] + height_m[1]
    points = rng.uniform(low, high, (_PLACES, 3))
    points = points[np.lexsort(np.round(points[:, :2].T / _CELL_M))]  # neighbours together, which is faster
    free = points[area.space.clearance(points) >= clearance_m]
    if len(free) < 2:
        raise ConfigError(
            f"no free places {height_m[0]:g} to {height_m[1]:g} m above the floor with {clearance_m:g} m of clearance; "
            "expected another world, height_m or clearance_m"
        )
    return free
