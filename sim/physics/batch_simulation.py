"""Simulation of many vehicles of one type in one world: free flight, and contacts where there may be some."""

from dataclasses import dataclass

import mujoco
import numpy as np

from dronevio.models.arrays import Array, Mask
from dronevio.sim.physics.clearance_grid import ClearanceGrid
from dronevio.sim.physics.contact_simulation import ContactSimulation
from dronevio.sim.physics.free_flight import FreeFlight
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

    def __init__(self, spec: mujoco.MjSpec, count: int, substeps: int, nthread: int) -> None:
        """Compile the models.

        Args:
            spec: Specification of the physics; it is not changed.
            count: Largest number of vehicles.
            substeps: Number of MuJoCo's time steps of an IMU interval.
            nthread: Number of threads; 0 means one for each processor.
        """
        planes, full = spec.copy(), spec.copy()
        for geom in planes.worldbody.geoms:
            if geom.type != mujoco.mjtGeom.mjGEOM_PLANE:
                planes.delete(geom)
        planes.option.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_SLEEP)
        self._low = ContactSimulation(planes, count, substeps, nthread)
        self._near = ContactSimulation(full, count, substeps, nthread)
        interval_s = substeps * spec.option.timestep
        self._free = FreeFlight(interval_s)
        self._grid = ClearanceGrid(self._near.model, interval_s)
        self._solids = ClearanceGrid(self._near.model, interval_s, with_planes=False)

    def run(self, start: Array, wrench: Array, vehicles: VehicleParameters, touched: Mask, diverged: Mask) -> Interval:
        """Run k vehicles for an interval. A diverging vehicle is held at its pose at the start.

        Args:
            start: (13, k) Their motion at the start.
            wrench: (k, 6) Constant forces [N] and torques [N m].
            vehicles: Masses and moments of inertia of the k vehicles.
            touched: (k,) Which vehicles have collided before.
            diverged: (k,) Which vehicles have diverged before.
        """
        free = self._grid.clear(start[:3], start[7:10])
        near = ~free
        near[near] = ~self._solids.clear(start[:3, near], start[7:10, near])
        middle, end = np.empty_like(start), np.empty_like(start)
        touched, failed = touched.copy(), diverged.copy()
        for simulation, some in ((self._free, free), (self._low, ~free & ~near), (self._near, near)):
            if not some.any():
                continue
            rows = slice(None) if some.all() else np.flatnonzero(some)
            stepped = simulation.run(start[:, rows], wrench[rows], vehicles.rows(rows))
            middle[:, rows], end[:, rows] = stepped.middle, stepped.end
            touched[rows] |= stepped.collided
            failed[rows] |= stepped.diverged
        if failed.any():
            start = start.copy()
            start[7:, failed] = 0.0
            middle[:, failed] = end[:, failed] = start[:, failed]
        return Interval(start, middle, end, touched, failed)
