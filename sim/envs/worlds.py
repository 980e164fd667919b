"""The worlds of environments: one, or several of which one is drawn for each episode."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from dronevio.models.errors import ConfigError
from dronevio.models.quadrotor import Quadrotor
from dronevio.sim.envs.episodes.endings import GROUND_M, Bounds
from dronevio.sim.envs.tasks import AnyTask
from dronevio.sim.paths.space import FlightArea
from dronevio.sim.physics.batch_plant import PlantWorld
from dronevio.sim.physics.vehicle_states import VehicleStates, joined
from dronevio.sim.world import collision_spec, flight_area, illumination_and_movers

Indices = npt.NDArray[np.intp]


class WorldPool:
    """Worlds of one name that differ by their seeds, and what a task needs of each."""

    def __init__(self, name: str, seeds: Sequence[int], task: AnyTask) -> None:
        """Build the layouts of all worlds.

        Args:
            name: Name of the worlds.
            seeds: Their seeds, in any order.
            task: The task.

        Raises:
            ConfigError: The world is unknown, or the floors of the worlds have different heights.
        """
        self._task = task
        self.seeds = np.unique(np.array(seeds, dtype=np.int64))
        """(W,) Seeds of the worlds, in ascending order; their indices are those of the worlds."""
        built = [_built(name, seed, task.obstacles) for seed in self.seeds.tolist()]
        self.areas, self.plant_worlds = zip(*built, strict=True)
        """Space, pad and route of each world, and the worlds as the physics has them."""
        self.floor_m = float(self.areas[0].pad[2])
        """Height of the floor [m]."""
        if any(area.pad[2] != self.floor_m for area in self.areas):
            raise ConfigError(f"worlds {name!r} with floors at different heights; expected one height")

    def index(self, seeds: npt.NDArray[np.int64]) -> Indices:
        """Return the indices (k,) of worlds by their seeds (k,).

        Raises:
            ConfigError: A world is not one of these.
        """
        unknown = ~np.isin(seeds, self.seeds)
        if unknown.any():
            known = ", ".join(map(str, self.seeds.tolist()))
            raise ConfigError(f"world_seed {int(seeds[unknown][0])} of an episode; expected one of {known}")
        return np.searchsorted(self.seeds, seeds)

    def begin(
        self, quadrotor: Quadrotor, rng: np.random.Generator, world: Indices, standing_m: float
    ) -> tuple[VehicleStates, Any]:
        """Draw initial states, of which none is below that of a standing vehicle, and goals of the task.

        Args:
            quadrotor: The vehicle.
            rng: Generator of the random numbers.
            world: (k,) Indices of the worlds of the episodes.
            standing_m: Height of the centre of mass of a vehicle that stands on the floor above it [m].

        Raises:
            ConfigError: The task does not return states of vehicles with as many rotors.
        """
        groups = [np.flatnonzero(world == number) for number in np.unique(world)]
        parts = [self._task.begin(self.areas[world[rows[0]]], quadrotor, rng, rows.size) for rows in groups]
        order = np.argsort(np.concatenate(groups))
        states, goals = (joined(tables).rows(order) for tables in zip(*parts, strict=True))
        if states.rotor_speed_rad_s.shape[1] != quadrotor.rotor_count:
            raise ConfigError(
                f"{type(self._task).__name__}.begin returns states of {states.rotor_speed_rad_s.shape[1]} rotors for a"
                f" vehicle with {quadrotor.rotor_count}; expected VehicleStates.at(…, rotors=quadrotor.rotor_count)"
            )
        height = np.maximum(states.position_m[:, 2:], self.floor_m + standing_m)
        return replace(states, position_m=np.hstack([states.position_m[:, :2], height])), goals

    def bounds(self, world: Indices, standing_m: float) -> Bounds:
        """Return the limits of flights in worlds (k,) of vehicles that stand at a height above the floor [m]."""
        boxes = np.stack([self._task.bounds_m(area) for area in self.areas])
        lowest_m = -np.inf if self._task.lands else self.floor_m + standing_m + GROUND_M
        return Bounds(boxes[world], np.full(len(world), lowest_m))


def _built(name: str, seed: int, obstacles: bool) -> tuple[FlightArea, PlantWorld]:
    """Return a world as tasks and physics have it: its solids, or a floor alone."""
    area = flight_area(name, seed)
    ground_m = float(area.pad[2])
    if not obstacles:
        return area, PlantWorld(ground_m=ground_m)
    return area, PlantWorld(collision_spec(name, seed), illumination_and_movers(name, seed)[1], ground_m)
