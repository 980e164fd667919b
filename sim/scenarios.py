"""The predefined scenarios, by name and version, and suites of them.

A version identifies a flight exactly: runs of one name and seed are comparable across releases. A changed flight gets
the next version, and the old version remains.
"""

import math
import re
from dataclasses import dataclass, replace
from typing import ClassVar

from dronevio.models.errors import ConfigError, unknown_name
from dronevio.models.python_names import PREFIX, PythonName
from dronevio.models.quadrotor import NANO
from dronevio.models.rig_presets import rig_named
from dronevio.sim.cameras.exposure import AutoExposure
from dronevio.sim.cameras.imaging import Imaging
from dronevio.sim.faults import Faults
from dronevio.sim.paths.limits import LIMITS
from dronevio.sim.paths.plan import FlightPlan
from dronevio.sim.physics.wind import Wind
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
"""Figures of eight and laps at changing heights that show every wall."""

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

_MINUTE = replace(_HOVER, tour_s=62.0)
"""A climb, and a minute on the spot."""

_FIRST_FLIGHTS = (
    Scenario("room-v0", "an agile tour of a furnished room", _ROOM),
    Scenario("room-slow-v0", "half of the tour of room-v0 at walking pace", replace(_ROOM, waypoints=_TOUR[:8])),
    Scenario("hover-v0", "take-off, hover, landing", _HOVER),
    Scenario("hover-minute-v0", "hover on the spot for a minute", _MINUTE),
    Scenario("hover-gusts-v0", "hover for a minute in gusts", _MINUTE, wind=Wind((3.0, 0.0, 0.0), 1.0)),
    Scenario("short-v0", "a short hop for quick tests", _SHORT),
)

_LEVELS = ("easy", "medium", "difficult")
_PLACES = {
    "room": "a furnished room",
    "corridor": "the corridor of an office floor, a closed loop",
    "warehouse": "a warehouse",
    "hall": "a machine hall",
    "forest": "a forest",
    "gates": "a race course with gates",
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
"""Every normal world at three levels, whose peak speeds and rates are close to those of EuRoC's levels."""

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
        "fast reversals in a room at large tilt angles",
        FlightPlan(tour_s=25.0, shape="aggressive", limits=LIMITS["race"]),
    ),
)
"""Flights as fast as those of the UZH-FPV dataset."""

_MEDIUM = FlightPlan(tour_s=40.0, shape="tour", limits=LIMITS["medium"])
_HARD_WORLDS = (
    Scenario("low-texture-v0", "a tour of a white gallery with little texture", _MEDIUM, world="low-texture"),
    Scenario("repetitive-v0", "a tour of a tiled station with repetitive texture", _MEDIUM, world="repetitive"),
    Scenario(
        "dark-v0",
        "a tour of a dark room with automatic exposure",
        _MEDIUM,
        world="dark",
        imaging=Imaging(control=AutoExposure()),
    ),
    Scenario("mirror-v0", "a tour of a hall with a reflecting floor", _MEDIUM, world="mirror"),
    Scenario("moving-v0", "a tour of a concourse with moving people and carts", _MEDIUM, world="moving"),
)

_SINGLE_LAPS = ("warehouse", "hall", "forest", "gates")
"""Worlds of which the tours fly one lap and revisit no place."""

_LAPS = tuple(
    Scenario(
        f"{name}-laps-v0",
        f"{laps} laps of {tour}, {level}",
        FlightPlan(shape=shape, laps=laps, limits=LIMITS[level]),
        world=world,
    )
    for name, world, tour, laps, shape, level in (
        ("room", "room", "the tour of a furnished room", 5, "tour", "easy"),
        ("room-square", "room", "a square in a furnished room", 5, "square", "medium"),
        ("corridor", "corridor", "the corridor of an office floor", 3, "tour", "easy"),
        ("hall", "hall", "the tour of a machine hall", 2, "tour", "easy"),
        ("warehouse", "warehouse", "the tour of a warehouse", 2, "tour", "easy"),
        ("forest", "forest", "the tour of a forest", 2, "tour", "medium"),
    )
)
_LOOPS = (
    *_LAPS,
    replace(
        _LAPS[0],
        name="room-laps-noisy-imu-v0",
        description="room-laps-v0 with three times the calibrated IMU noise",
        faults=Faults(imu_noise_factor=3.0),
    ),
)
"""Flights that come back: 40 to 80 % of their frames revisit a place (`dronevio.eval.metrics.revisits`). The IMU of the
last one is not as good as its calibration states, as real ones are."""

_DECEPTIVE_LOOPS = tuple(
    Scenario(
        f"{world}-laps-v0",
        f"2 laps of the tour of {place}, medium",
        FlightPlan(shape="tour", laps=2, limits=LIMITS["medium"]),
        world=world,
    )
    for world, place in (
        ("repetitive", "a tiled station whose places look alike"),
        ("mirror", "a hall with a reflecting floor"),
        ("moving", "a concourse with moving people and carts"),
    )
)
"""Flights that come back in worlds in which the recognition of places errs."""

_OFFICE = tuple(
    Scenario(
        f"office-{level}-v0",
        f"a lap of an office, through some of its rooms, {level}",
        FlightPlan(shape="tour", laps=1, limits=LIMITS[level]),
        world="office",
    )
    for level in ("easy", "medium")
)
"""Tours of the office, whose doors leave little more than the clearance that tours keep."""

_SHAPES = tuple(
    Scenario(f"room-{shape}-v0", description, FlightPlan(tour_s=20.0, shape=shape, limits=LIMITS["medium"]))
    for shape, description in {
        "rotation": "rotation on the spot, without parallax",
        "figure-8": "figures of eight",
        "helix": "a helix",
        "square": "laps of a square, revisiting the same places",
        "sideways": "figures of eight flown sideways",
        "inspection": "inspection of a wall with the camera facing it",
    }.items()
)

_NANO = Scenario(
    "nano-v0",
    "a drone of 30 g with a small rolling-shutter camera at walking pace",
    FlightPlan(tour_s=20.0, shape="tour", limits=LIMITS["easy"], height_m=0.8),
    rig=rig_named("nano"),
    quadrotor=NANO,
)

_STRESS = tuple(
    Scenario(f"room-{name}-v0", f"the agile tour of a room, {what}", _ROOM, faults=faults)
    for name, what, faults in (
        ("dark-1s", "with dark images for 1 s", Faults(dark_from_s=12.0, dark_for_s=1.0)),
        ("dark-2s", "with dark images for 2 s", Faults(dark_from_s=12.0, dark_for_s=2.0)),
        ("dark-5s", "with dark images for 5 s", Faults(dark_from_s=12.0, dark_for_s=5.0)),
        ("drops-25", "with a quarter of the frames lost", Faults(dropped_frames=0.25)),
        ("drops", "with half of the frames lost", Faults(dropped_frames=0.5)),
        ("drops-75", "with three quarters of the frames lost", Faults(dropped_frames=0.75)),
        ("jitter-1ms", "with time stamps of frames that err by 1 ms", Faults(stamp_jitter_s=0.001)),
        ("jitter-3ms", "with time stamps of frames that err by 3 ms", Faults(stamp_jitter_s=0.003)),
        ("jitter-10ms", "with time stamps of frames that err by 10 ms", Faults(stamp_jitter_s=0.01)),
        ("offset-2ms", "with an uncalibrated camera time offset of 2 ms", Faults(hidden_time_offset_s=0.002)),
        ("offset", "with an uncalibrated camera time offset of 5 ms", Faults(hidden_time_offset_s=0.005)),
        ("offset-15ms", "with an uncalibrated camera time offset of 15 ms", Faults(hidden_time_offset_s=0.015)),
        ("tilt-20min", "with an uncalibrated camera rotation of 20'", Faults(hidden_tilt_rad=math.radians(1.0 / 3.0))),
        ("tilt", "with an uncalibrated camera rotation of 1°", Faults(hidden_tilt_rad=math.radians(1.0))),
        ("tilt-3deg", "with an uncalibrated camera rotation of 3°", Faults(hidden_tilt_rad=math.radians(3.0))),
        ("noise", "with twice the calibrated IMU noise", Faults(imu_noise_factor=2.0)),
        ("noise-4x", "with four times the calibrated IMU noise", Faults(imu_noise_factor=4.0)),
        ("noise-8x", "with eight times the calibrated IMU noise", Faults(imu_noise_factor=8.0)),
        ("saturated-86dps", "with a gyroscope that saturates at 86 °/s", Faults(gyro_range_rad_s=1.5)),
        ("saturated", "with a gyroscope that saturates at 57 °/s", Faults(gyro_range_rad_s=1.0)),
        ("saturated-40dps", "with a gyroscope that saturates at 40 °/s", Faults(gyro_range_rad_s=0.7)),
        ("rotor-landing", "with a rotor that fails at touch-down", Faults(rotor_fails_at_s=27.8)),
        ("rotor-low", "with a rotor that fails 0.6 m above the ground", Faults(rotor_fails_at_s=27.0)),
        ("rotor-flight", "with a rotor that fails in flight", Faults(rotor_fails_at_s=20.0)),
    )
)
"""Every fault at three strengths, in ascending order."""
_STRESS = (
    *_STRESS,
    Scenario("room-motion-v0", "the agile tour of a room, started in motion", replace(_ROOM, skip_s=6.0)),
)

_NORMAL = (*_FIRST_FLIGHTS, *_TOURS, *_RACES, *_SHAPES, _NANO, *_HARD_WORLDS)

SCENARIOS: dict[str, Scenario] = {
    scenario.name: scenario
    for scenario in (
        *_NORMAL,
        *_LOOPS,
        *_DECEPTIVE_LOOPS,
        *_OFFICE,
        *_STRESS,
    )
}
"""All scenarios by name and version, each with seed 0."""

SUITES: dict[str, tuple[str, ...]] = {
    **{world: tuple(s.name for s in _TOURS if s.world == world) for world in _PLACES},
    **{level: tuple(s.name for s in _TOURS if f"-{level}-" in s.name) for level in _LEVELS},
    "reference": tuple(s.name for s in _TOURS if s.world in ("room", "hall", "corridor")),
    "hovering": ("hover-minute-v0", "hover-gusts-v0"),
    "race": tuple(s.name for s in _RACES),
    "shapes": tuple(s.name for s in _SHAPES),
    "hard": tuple(s.name for s in _HARD_WORLDS),
    "loops": tuple(s.name for s in _LOOPS),
    "loops-deceptive": tuple(s.name for s in _DECEPTIVE_LOOPS),
    "no-revisits": tuple(s.name for s in _TOURS if s.world in _SINGLE_LAPS),
    "office": tuple(s.name for s in _OFFICE),
    "normal": tuple(s.name for s in _NORMAL),
    "stress": ("room-v0", *(s.name for s in _STRESS)),
}
"""Names of the scenarios of each suite: those of one world, of one level, or of one kind. The suite ``reference`` has
the nine flights on which the accuracy of the odometry is stated; ``normal`` has all flights without a fault, except for
those of several laps and of the office; ``stress`` begins with the flight without a fault."""


@dataclass(frozen=True)
class PythonScenario(PythonName):
    """Name of a scenario in a module."""

    what: ClassVar[str] = "scenario"


def scenario_named(name: str, seed: int | None = None) -> Scenario:
    """Return a scenario, optionally with another seed.

    Args:
        name: A key of `SCENARIOS`; without a version, the latest version of that name. Or
            ``python:package.module:NAME``, a `Scenario` of your own.
        seed: Zero or more.

    Raises:
        ConfigError: The scenario is unknown, or the seed is negative.
    """
    if seed is not None and seed < 0:
        raise ConfigError(f"seed {seed}; expected 0 or more")
    found = _own(name) if name.startswith(PREFIX) else _known(name)
    return found if seed is None else replace(found, seed=seed)


def _known(name: str) -> Scenario:
    versions = [known for known in SCENARIOS if known == name or known.rpartition("-v")[0] == name]
    if not versions:
        expected = f"one that `dronevio scenarios` lists, such as room-v0, or {PREFIX}package.module:NAME"
        raise unknown_name("scenario", name, SCENARIOS, expected)
    return SCENARIOS[versions[-1]]


def _own(name: str) -> Scenario:
    """Return a scenario of a module. Its own name becomes a part of file names.

    Raises:
        ConfigError: There is none, or its name cannot be a part of a file name.
    """
    found = PythonScenario.parse(name).instance_of(Scenario)
    if not re.fullmatch(r"\w[\w.-]*", found.name):
        raise ConfigError(f"scenario {name}: its name {found.name!r}; expected letters, digits, hyphens and dots")
    return found
