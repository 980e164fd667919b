"""Scenarios: world, vehicle, flight plan, sensors, wind, faults and seed of one simulated flight."""

from dataclasses import dataclass, field, replace

import numpy as np

from dronevio.models.quadrotor import Quadrotor
from dronevio.models.rig import Rig, euroc_rig
from dronevio.sim.cameras.imaging import Imaging
from dronevio.sim.faults import Faults
from dronevio.sim.paths.plan import FlightPlan
from dronevio.sim.physics.wind import CALM, Wind
from dronevio.sim.streams import Stream, generator
from dronevio.sim.worlds.own.names import recorded_world


@dataclass(frozen=True)
class Scenario:
    """Complete description of one flight: the same scenario gives the same bytes."""

    name: str
    """Name with a version, which increases whenever the flight changes."""
    description: str
    """Short description of the flight for listings."""
    plan: FlightPlan
    """The plan of the path."""
    world: str = "room"
    """Name of the world, a key of `dronevio.sim.world.WORLDS` or a world of one's own
    (`dronevio.sim.world.resolved_world`)."""
    rig: Rig = field(default_factory=euroc_rig)
    """The calibrated sensors; deviations of the true rig are in ``faults``."""
    quadrotor: Quadrotor = field(default_factory=Quadrotor)
    """The vehicle that flies."""
    imaging: Imaging = field(default_factory=Imaging)
    """Exposure control and noise of the image sensors."""
    wind: Wind = CALM
    """Mean wind and gusts."""
    faults: Faults = field(default_factory=Faults)
    """Faults of vehicle and sensors."""
    seed: int = 0
    """Seed of the waypoints, the gusts and the sensor errors, each with its own random stream, and of the world."""
    world_seed: int | None = None
    """Seed of layout, textures and moving objects of the world instead of ``seed``; None for ``seed``."""
    light_seed: int | None = None
    """Seed of other light in the world (`dronevio.sim.worlds.lighting`); None for the light of the world itself."""
    reverse: bool = False
    """Whether the tour is flown in the opposite direction, through the same waypoints."""
    control_rate_hz: float | None = None
    """Rate of the controller [Hz], a multiple or half of that of the IMU; None for that of the IMU. With a given rate,
    the path is the same with IMUs of several rates (`Motion.at_interval`)."""

    @property
    def seed_of_world(self) -> int:
        """Seed of layout, textures and moving objects of the world."""
        return self.seed if self.world_seed is None else self.world_seed

    @property
    def recorded(self) -> "Scenario":
        """The scenario as recordings and reports state it: with the seed of its world, and with the name of the file of
        a world of one's own and its hash, without the folder.

        Raises:
            ConfigError: The world is unknown, or its file is damaged.
        """
        from dronevio.sim.world import resolved_world

        return replace(self, world=recorded_world(resolved_world(self.world)), world_seed=self.seed_of_world)

    @property
    def true_rig(self) -> Rig:
        """The true rig, including hidden faults."""
        return self.faults.true_rig(self.rig, self.generator("faults"))

    def generator(self, stream: Stream) -> np.random.Generator:
        """Return the random generator of one subsystem, independent of those of the others."""
        return generator(self.seed, stream)
