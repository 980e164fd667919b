"""Scenarios: what is flown, where, with which sensors and faults, from which seed."""

from dataclasses import dataclass, field

import numpy as np

from dronevio.models.quadrotor import Quadrotor
from dronevio.models.rig import Rig, euroc_rig
from dronevio.sim.cameras.imaging import Imaging
from dronevio.sim.faults import Faults
from dronevio.sim.paths.plan import FlightPlan
from dronevio.sim.physics.wind import CALM, Wind
from dronevio.sim.streams import Stream, generator


@dataclass(frozen=True)
class Scenario:
    """One flight, complete: the same scenario gives the same bytes."""

    name: str
    """What to call it: a name and a version, which changes whenever what is flown does."""
    description: str
    """What is flown, for people."""
    plan: FlightPlan
    """The path."""
    world: str = "room"
    """Where: a name that `dronevio.sim.world.build_world` knows."""
    rig: Rig = field(default_factory=euroc_rig)
    """The sensors, as the calibration has them; what is hidden of the truth is in ``faults``."""
    quadrotor: Quadrotor = field(default_factory=Quadrotor)
    """The vehicle."""
    imaging: Imaging = field(default_factory=Imaging)
    """What the cameras' sensors make of light."""
    wind: Wind = CALM
    """How the air moves."""
    faults: Faults = field(default_factory=Faults)
    """What goes wrong."""
    seed: int = 0
    """Draws the world's looks, the waypoints, the gusts and the sensors' errors, each from a stream of its own."""

    @property
    def true_rig(self) -> Rig:
        """The rig that really flies, hidden faults and all."""
        return self.faults.true_rig(self.rig, self.generator("faults"))

    def generator(self, stream: Stream) -> np.random.Generator:
        """Return the random numbers of one subsystem, independent of those of the others."""
        return generator(self.seed, stream)
