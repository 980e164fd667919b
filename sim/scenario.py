"""Scenarios: what is flown, where, with which sensors, from which seed."""

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from dronevio.models.errors import ConfigError
from dronevio.models.quadrotor import Quadrotor
from dronevio.models.rig import Rig, euroc_rig
from dronevio.sim.plan import FlightPlan

Stream = Literal["path", "imu"]
_STREAMS: dict[Stream, int] = {"path": 10, "imu": 11}  # spawn keys; the world's are 0 and 1, the images' 20


@dataclass(frozen=True)
class Scenario:
    """One flight, complete: the same scenario gives the same bytes."""

    name: str
    """What to call it."""
    description: str
    """What is flown, for people."""
    plan: FlightPlan
    """The path, as fractions of the free space."""
    world: str = "room"
    """Where: a name that `dronevio.sim.world.build_world` knows."""
    rig: Rig = field(default_factory=euroc_rig)
    """The sensors."""
    quadrotor: Quadrotor = field(default_factory=Quadrotor)
    """The vehicle."""
    seed: int = 0
    """Draws the world's looks, the waypoints and the sensors' errors, each from a stream of its own."""

    def generator(self, stream: Stream) -> np.random.Generator:
        """Return the random numbers of one subsystem, independent of those of the others."""
        return np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(_STREAMS[stream],)))


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

SCENARIOS: dict[str, Scenario] = {
    scenario.name: scenario
    for scenario in (
        Scenario("room", "a lively tour of a furnished room", _ROOM),
        Scenario("room-slow", "half of that tour at walking pace", replace(_ROOM, waypoints=_TOUR[:8])),
        Scenario(
            "hover",
            "take off, hover on the spot, land",
            FlightPlan(rest_s=2.0, takeoff_s=2.0, tour_s=2.0, landing_s=3.0, stand_s=1.0),
        ),
        Scenario(
            "short",
            "a quick look: one small hop",
            FlightPlan(
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
            ),
        ),
    )
}
"""What can be flown, by name; each with seed 0."""


def scenario(name: str, seed: int | None = None) -> Scenario:
    """Return a scenario, with another seed if one is given.

    Raises:
        ConfigError: There is no such scenario, or the seed is negative.
    """
    if name not in SCENARIOS:
        raise ConfigError(f"unknown scenario {name!r}; expected one of {', '.join(SCENARIOS)}")
    if seed is None:
        return SCENARIOS[name]
    if seed < 0:
        raise ConfigError(f"seed {seed}; expected 0 or more")
    return replace(SCENARIOS[name], seed=seed)
