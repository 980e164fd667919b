"""Simulation of many vehicles of one type, each in one of some worlds: free flight, and contacts where need be."""

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from dronevio.models.arrays import Array, Mask
from dronevio.sim.physics.clearance_grid import ClearanceGrid, ClearanceGrids, Indices
from dronevio.sim.physics.contact_simulation import ContactSimulation
from dronevio.sim.physics.free_flight import FreeFlight, Stepped
from dronevio.sim.physics.vehicle_states import VehicleParameters


@dataclass(frozen=True, eq=False)
class Interval:
    """One IMU interval of k vehicles."""

    start: Array
    """(13, k) Motion at its start; that of diverging vehicles is stopped."""
    middle: Array
    """(13, k) Motion in its middle."""
    end: Array
    """(13, k) Motion at its end."""
    touched: Mask
    """(k,) Which vehicles have collided so far."""
    diverged: Mask
    """(k,) Which simulations have diverged so far."""


class BatchSimulation:
    """Physics of vehicles, which advance by IMU intervals.

    Most vehicles can touch nothing during an interval: they are in `FreeFlight`. Those that can touch planes only, such
    as the floor on which they stand, are simulated by MuJoCo in a world of planes, the others among all solids.
    """

    def __init__(
        self,
        planes: Sequence[mujoco.MjSpec],
        solids: Sequence[mujoco.MjSpec],
        count: int,
        substeps: int,
        nthread: int,
    ) -> None:
        """Compile the models.

        Args:
            planes: Specifications of the physics among the planes of each world, which get sensors of contacts.
            solids: Specifications of the physics among all solids of each world, which get sensors of contacts.
            count: Largest number of vehicles.
            substeps: Number of MuJoCo's time steps of an IMU interval.
            nthread: Number of threads; 0 means one for each processor.
        """
        interval_s = substeps * solids[0].option.timestep
        self._free = FreeFlight(interval_s)
        self._low = [ContactSimulation(spec, count, substeps, nthread) for spec in planes]
        self._near = [ContactSimulation(spec, count, substeps, nthread) for spec in solids]
        models = [simulation.model for simulation in self._near]
        self._all = ClearanceGrids([ClearanceGrid(model, interval_s) for model in models])
        self._solids = ClearanceGrids([ClearanceGrid(model, interval_s, with_planes=False) for model in models])

    def run(
        self,
        start: Array,
        wrench: Array,
        vehicles: VehicleParameters,
        world: Indices,
        touched: Mask,
        diverged: Mask,
    ) -> Interval:
        """Run k vehicles for an interval. A diverging vehicle is held at its pose at the start.

        Args:
            start: (13, k) Their motion at the start.
            wrench: (k, 6) Constant forces [N] and torques [N m].
            vehicles: Masses and moments of inertia of the k vehicles.
            world: (k,) Indices of their worlds.
            touched: (k,) Which vehicles have collided before.
            diverged: (k,) Which vehicles have diverged before.
        """
        middle, end = np.empty_like(start), np.empty_like(start)
        touched, failed = touched.copy(), diverged.copy()

        def run(simulation: FreeFlight | ContactSimulation, some: Mask) -> None:
            rows = slice(None) if some.all() else np.flatnonzero(some)
            stepped: Stepped = simulation.run(start[:, rows], wrench[rows], vehicles.rows(rows))
            middle[:, rows], end[:, rows] = stepped.middle, stepped.end
            touched[rows] |= stepped.collided
            failed[rows] |= stepped.diverged

        free = self._all.clear(start[:3], start[7:10], world)
        if free.any():
            run(self._free, free)
        near = ~free
        near[near] = ~self._solids.clear(start[:3, near], start[7:10, near], world[near])
        for simulations, some in ((self._low, ~free & ~near), (self._near, near)):
            for number in np.unique(world[some]).tolist():
                run(simulations[number], some & (world == number))
        if failed.any():
            start = start.copy()
            start[7:, failed] = 0.0
            middle[:, failed] = end[:, failed] = start[:, failed]
        return Interval(start, middle, end, touched, failed)
