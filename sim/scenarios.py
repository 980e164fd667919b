"""The scenarios that come with the house, by name and version, and suites of them.

A version says what is flown: two runs of one name and seed are comparable, whatever has been added since. Whoever
changes a flight gives it the next number and keeps the old one.
"""

from dataclasses import replace

from dronevio.models.errors import ConfigError
from dronevio.sim.limits import Limits
from dronevio.sim.plan import FlightPlan
from dronevio.sim.scenario import Scenario

_TOUR = (
    (0.7, -0.8, -0.2),
    (0.9, 0.6, 0.4),
    (-0.15, 0.1, -0.5),
    (-0.9, -0.7, 0.2),
    (-0.9, 0.7, 0.6),
    (0.1, 0.9, -0.4),
    (1.0, 0.3, 0.2),
    (0.45, -0.85, 0.7),
    (-0.7, -0.85, 0.2),
    (-0.9, 0.6, -0.3),
    (0.1, 0.1, 0.5),
    (0.95, -0.6, 0.0),
    (0.9, 0.7, 0.2),
    (0.2, 0.9, 0.0),
    (-0.8, 0.8, 0.4),
    (-0.9, -0.6, 0.2),
    (0.0, -0.8, -0.2),
)
"""Figures of eight and laps that see every wall, at changing heights."""

_ROOM = FlightPlan(rest_s=2.0, takeoff_s=2.0, tour_s=21.2, landing_s=3.3, stand_s=1.5, waypoints=_TOUR, jitter=0.1)
_HOVER = FlightPlan(rest_s=2.0, takeoff_s=2.0, tour_s=2.0, landing_s=3.0, stand_s=1.0)
_SHORT = FlightPlan(
    rest_s=1.5,
    takeoff_s=0.9,
    tour_s=1.7,
    landing_s=1.5,
    stand_s=0.4,
    height_m=0.4,
    floor_m=0.3,
    waypoints=((0.1, 0.04, 0.1),),
    jitter=0.02,
    turning=0.2,
)

_FIRST_FLIGHTS = (
    Scenario("room-v0", "a lively tour of a furnished room", _ROOM),
    Scenario("room-slow-v0", "half of that tour at walking pace", replace(_ROOM, waypoints=_TOUR[:8])),
    Scenario("hover-v0", "take off, hover on the spot, land", _HOVER),
    Scenario("short-v0", "a quick look: one small hop", _SHORT),
)

_LEVELS: dict[str, Limits] = {
    "easy": Limits(speed_m_s=0.8, accel_m_s2=0.8, yaw_rate_rad_s=0.6, tilt_rate_rad_s=2.0),
    "medium": Limits(speed_m_s=2.2, accel_m_s2=2.5, yaw_rate_rad_s=1.6, tilt_rate_rad_s=4.0),
    "difficult": Limits(speed_m_s=4.0, accel_m_s2=5.0, yaw_rate_rad_s=3.0, tilt_rate_rad_s=6.0),
}
"""How quickly each level is flown: about as EuRoC's rooms and hall named so."""
_PLACES = {
    "room": "a furnished room",
    "corridor": "the corridors of an office floor, a closed loop",
    "forest": "a forest",
}

_BY_WORLD = tuple(
    Scenario(
        f"{world}-{level}-v0",
        f"a {level} tour of {place}",
        FlightPlan(tour_s=35.0, shape="tour", limits=limits),
        world=world,
    )
    for world, place in _PLACES.items()
    for level, limits in _LEVELS.items()
)

SCENARIOS: dict[str, Scenario] = {scenario.name: scenario for scenario in (*_FIRST_FLIGHTS, *_BY_WORLD)}
"""What can be flown, by name and version; each with seed 0."""

SUITES: dict[str, tuple[str, ...]] = {
    **{world: tuple(s.name for s in _BY_WORLD if s.world == world) for world in _PLACES},
    **{level: tuple(s.name for s in _BY_WORLD if f"-{level}-" in s.name) for level in _LEVELS},
}
"""Scenarios that belong together, by the name of their world or level."""


def scenario(name: str, seed: int | None = None) -> Scenario:
    """Return a scenario, with another seed if one is given.

    Args:
        name: One of `SCENARIOS`; without its version, the latest of that name.
        seed: Zero or more.

    Raises:
        ConfigError: There is no such scenario, or the seed is negative.
    """
    versions = [known for known in SCENARIOS if known == name or known.rpartition("-v")[0] == name]
    if not versions:
        raise ConfigError(f"unknown scenario {name!r}; expected one of {', '.join(SCENARIOS)}")
    if seed is None:
        return SCENARIOS[versions[-1]]
    if seed < 0:
        raise ConfigError(f"seed {seed}; expected 0 or more")
    return replace(SCENARIOS[versions[-1]], seed=seed)
