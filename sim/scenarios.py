"""The scenarios that come with the house, by name and version, and suites of them.

A version says what is flown: two runs of one name and seed are comparable, whatever has been added since. Whoever
changes a flight gives it the next number and keeps the old one.
"""

import math
from dataclasses import replace

from dronevio.models.errors import ConfigError
from dronevio.models.quadrotor import NANO
from dronevio.models.rig_presets import rig_named
from dronevio.sim.cameras.imaging import AutoExposure, Imaging
from dronevio.sim.faults import Faults
from dronevio.sim.paths.limits import LIMITS
from dronevio.sim.paths.plan import FlightPlan
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

_ROOM = FlightPlan(
    initial_rest_s=2.0,
    takeoff_s=2.0,
    tour_s=21.2,
    landing_s=3.3,
    final_rest_s=1.5,
    waypoints=_TOUR,
    waypoint_jitter=0.1,
)
_HOVER = FlightPlan(initial_rest_s=2.0, takeoff_s=2.0, tour_s=2.0, landing_s=3.0, final_rest_s=1.0)
_SHORT = FlightPlan(
    initial_rest_s=1.5,
    takeoff_s=0.9,
    tour_s=1.7,
    landing_s=1.5,
    final_rest_s=0.4,
    height_m=0.4,
    min_height_m=0.3,
    waypoints=((0.1, 0.04, 0.1),),
    waypoint_jitter=0.02,
    heading_scale=0.2,
)

_FIRST_FLIGHTS = (
    Scenario("room-v0", "a lively tour of a furnished room", _ROOM),
    Scenario("room-slow-v0", "half of that tour at walking pace", replace(_ROOM, waypoints=_TOUR[:8])),
    Scenario("hover-v0", "take off, hover on the spot, land", _HOVER),
    Scenario("short-v0", "a quick look: one small hop", _SHORT),
)

_LEVELS = ("easy", "medium", "difficult")
_PLACES = {
    "room": "a furnished room",
    "corridor": "an office floor's corridors, a closed loop",
    "warehouse": "a warehouse",
    "hall": "a machine hall",
    "forest": "a forest",
    "gates": "a field of gates",
}
_TOUR_S = {"easy": 40.0, "medium": 40.0, "difficult": 35.0}

_TOURS = tuple(
    Scenario(
        f"{world}-{level}-v0",
        f"a tour of {place}, {level}",
        FlightPlan(tour_s=_TOUR_S[level], shape="tour", limits=LIMITS[level]),
        world=world,
    )
    for world, place in _PLACES.items()
    for level in _LEVELS
)
"""Every normal world at three levels: peaks about as in EuRoC's rooms and hall of that name."""

_RACES = (
    Scenario(
        "gates-race-v0",
        "a race through the gates at up to 9 m/s",
        FlightPlan(tour_s=40.0, shape="race", limits=LIMITS["race"]),
        world="gates",
    ),
    Scenario(
        "hall-race-v0",
        "a race through the machine hall at up to 9 m/s",
        FlightPlan(tour_s=30.0, shape="race", limits=LIMITS["race"]),
        world="hall",
    ),
    Scenario(
        "room-aggressive-v0",
        "quick reversals in a room, tilting hard",
        FlightPlan(tour_s=25.0, shape="aggressive", limits=LIMITS["race"]),
    ),
)
"""As fast as UZH-FPV's."""

_MEDIUM = FlightPlan(tour_s=40.0, shape="tour", limits=LIMITS["medium"])
_HARD_WORLDS = (
    Scenario("low-texture-v0", "a tour of a white gallery, all but empty", _MEDIUM, world="low-texture"),
    Scenario(
        "repetitive-v0", "a tour of a tiled station where each place looks like the next", _MEDIUM, world="repetitive"
    ),
    Scenario(
        "dark-v0",
        "a tour of a room at night, by a camera that adapts",
        _MEDIUM,
        world="dark",
        imaging=Imaging(control=AutoExposure()),
    ),
    Scenario("mirror-v0", "a tour of a hall whose floor mirrors it", _MEDIUM, world="mirror"),
    Scenario("moving-v0", "a tour of a concourse full of people and carts", _MEDIUM, world="moving"),
)

_SHAPES = tuple(
    Scenario(f"room-{shape}-v0", description, FlightPlan(tour_s=20.0, shape=shape, limits=LIMITS["medium"]))
    for shape, description in {
        "rotation": "turning on the spot: no parallax",
        "figure-8": "figures of eight",
        "helix": "a helix",
        "square": "laps of a square that come back to where they began",
        "sideways": "flying sideways",
        "inspection": "scanning a wall, facing it",
    }.items()
)

_NANO = Scenario(
    "nano-v0",
    "30 g of drone with a small rolling-shutter camera, at walking pace",
    FlightPlan(tour_s=20.0, shape="tour", limits=LIMITS["easy"], height_m=0.8),
    rig=rig_named("nano"),
    quadrotor=NANO,
)

_STRESS = tuple(
    Scenario(f"room-{name}-v0", f"the lively tour of a room, {what}", _ROOM, faults=faults)
    for name, what, faults in (
        ("dark-1s", "the camera dark for a second", Faults(dark_from_s=12.0, dark_for_s=1.0)),
        ("dark-5s", "the camera dark for five seconds", Faults(dark_from_s=12.0, dark_for_s=5.0)),
        ("drops", "half of its frames lost", Faults(dropped_frames=0.5)),
        ("offset", "its camera 5 ms late and nobody knows", Faults(hidden_time_offset_s=0.005)),
        ("tilt", "its camera turned by 1° and nobody knows", Faults(hidden_tilt_rad=math.radians(1.0))),
        ("noise", "its IMU twice as noisy as it should be", Faults(imu_noise_factor=2.0)),
        ("saturated", "its gyroscope at its limit from 57 °/s on", Faults(gyro_range_rad_s=1.0)),
    )
)
_STRESS = (
    *_STRESS,
    Scenario("room-motion-v0", "the lively tour of a room, joined in motion", replace(_ROOM, skip_s=6.0)),
)

SCENARIOS: dict[str, Scenario] = {
    scenario.name: scenario
    for scenario in (*_FIRST_FLIGHTS, *_TOURS, *_RACES, *_SHAPES, _NANO, *_HARD_WORLDS, *_STRESS)
}
"""What can be flown, by name and version; each with seed 0."""

SUITES: dict[str, tuple[str, ...]] = {
    **{world: tuple(s.name for s in _TOURS if s.world == world) for world in _PLACES},
    **{level: tuple(s.name for s in _TOURS if f"-{level}-" in s.name) for level in _LEVELS},
    "race": tuple(s.name for s in _RACES),
    "shapes": tuple(s.name for s in _SHAPES),
    "hard": tuple(s.name for s in _HARD_WORLDS),
    "stress": tuple(s.name for s in _STRESS),
}
"""Scenarios that belong together: of one world, of one level, or of one kind."""


def scenario_named(name: str, seed: int | None = None) -> Scenario:
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
