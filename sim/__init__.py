"""Simulator of the quadrotor, its sensors and its worlds; the only package that imports MuJoCo."""

from typing import TYPE_CHECKING

from dronevio._lazy import attach
from dronevio.sim.cameras.gl import choose_backend

if TYPE_CHECKING:
    from dronevio.sim.flight import Flight, fly
    from dronevio.sim.scenario import Scenario
    from dronevio.sim.scenarios import scenario_named
    from dronevio.sim.world import World, build_world

__all__ = [
    "Flight",
    "Scenario",
    "World",
    "build_world",
    "fly",
    "scenario_named",
]

choose_backend()  # before any module imports MuJoCo, which reads MUJOCO_GL on import

__getattr__, __dir__ = attach(
    __name__,
    {
        "dronevio.sim.flight": ("Flight", "fly"),
        "dronevio.sim.scenario": ("Scenario",),
        "dronevio.sim.scenarios": ("scenario_named",),
        "dronevio.sim.world": ("World", "build_world"),
    },
)
