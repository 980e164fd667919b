"""Samples and states of a batch plant."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array, Mask
from dronevio.sim.physics.rotors import RotorState
from dronevio.sim.physics.vehicle_states import Table, VehicleParameters, with_rows
from dronevio.sim.physics.wind import AirState


@dataclass(frozen=True, eq=False)
class PointSamples(Table):
    """One noise-free point sample of the IMU of each of n vehicles."""

    gyro_rad_s: Array
    """(n, 3) Angular velocities in the IMU frame [rad/s]."""
    accel_m_s2: Array
    """(n, 3) Specific forces in the IMU frame [m/s²]."""


@dataclass(frozen=True, eq=False)
class PlantState:
    """State of the vehicles of a `BatchPlant` at its clock, beside those of physics and air."""

    parameters: VehicleParameters
    """Physical parameters of the vehicles."""
    rotors: RotorState
    """States of rotors and batteries."""
    elapsed: npt.NDArray[np.int64]
    """(n,) IMU intervals since the resets."""
    world: npt.NDArray[np.intp]
    """(n,) Indices of the worlds of the vehicles."""
    touched: Mask
    """(n,) Which vehicles have collided."""
    diverged: Mask
    """(n,) Which simulations have diverged."""
    motion: Array
    """(13, n) Motion at the clock."""
    ahead: Array
    """(13, n) Motion one interval later, which does not depend on the current commands."""
    velocity_between: Array
    """(3, n) Velocities of the IMUs half an interval after the clock [m/s]."""
    samples: PointSamples
    """IMU samples of the clock."""

    def with_vehicles(self, rows: npt.NDArray[np.intp], part: "PlantState") -> "PlantState":
        """Return a copy in which k vehicles (k,) have another state."""
        return PlantState(
            parameters=with_rows(self.parameters, rows, part.parameters),
            rotors=with_rows(self.rotors, rows, part.rotors),
            elapsed=with_rows(self.elapsed, rows, part.elapsed),
            world=with_rows(self.world, rows, part.world),
            touched=with_rows(self.touched, rows, part.touched),
            diverged=with_rows(self.diverged, rows, part.diverged),
            motion=_with_columns(self.motion, rows, part.motion),
            ahead=_with_columns(self.ahead, rows, part.ahead),
            velocity_between=_with_columns(self.velocity_between, rows, part.velocity_between),
            samples=with_rows(self.samples, rows, part.samples),
        )


@dataclass(frozen=True, eq=False)
class SavedPlant:
    """Complete state of a `BatchPlant`."""

    air: AirState
    """State of the air."""
    vehicles: PlantState
    """State of the vehicles."""


def _with_columns(table: Array, columns: npt.NDArray[np.intp], part: Array) -> Array:
    """Return a copy of an array (d, n) in which k columns (k,) are replaced."""
    copy = table.copy()
    copy[:, columns] = part
    return copy
