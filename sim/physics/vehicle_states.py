"""True states and physical parameters of many vehicles of one type, as arrays with one row a vehicle."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Self, TypeVar

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError
from dronevio.models.quadrotor import Quadrotor

Rows = slice | npt.NDArray[np.intp]
"""Selection of rows: all of them as ``slice(None)``, or an array of indices."""

Batch = TypeVar("Batch")
Rowed = TypeVar("Rowed", bound="Table")


class Table:
    """Base of dataclasses whose fields are arrays with one row a vehicle."""

    def __len__(self) -> int:
        return len(getattr(self, fields(self)[0].name))  # type: ignore[arg-type]

    def rows(self, rows: Rows) -> Self:
        """Return the selected rows."""
        return type(self)(**{field.name: getattr(self, field.name)[rows] for field in fields(self)})  # type: ignore[arg-type]


def joined(tables: Sequence[Rowed]) -> Rowed:
    """Return tables of one type as one, whose rows are those of the first, then those of the second, and so on."""
    if len(tables) == 1:
        return tables[0]
    names = [field.name for field in fields(tables[0])]  # type: ignore[arg-type]
    return type(tables[0])(**{name: np.concatenate([getattr(table, name) for table in tables]) for name in names})


def with_rows(table: Batch, rows: npt.NDArray[np.intp], part: Batch) -> Batch:
    """Return a copy of an array, or of a dataclass of arrays, with some rows replaced.

    Args:
        table: Arrays of n rows.
        rows: (k,) Indices of the rows to replace.
        part: The same arrays of k new rows.
    """
    if isinstance(table, np.ndarray):
        copy = table.copy()
        copy[rows] = part
        return copy
    names = [field.name for field in fields(table)]  # type: ignore[arg-type]
    changes = {name: with_rows(getattr(table, name), rows, getattr(part, name)) for name in names}
    return replace(table, **changes)  # type: ignore[type-var]


@dataclass(frozen=True, eq=False)
class VehicleStates(Table):
    """True states of n vehicles, at their centres of mass."""

    position_m: Array
    """(n, 3) Positions of the centres of mass in the world [m]."""
    R_world_vehicle: Array
    """(n, 3, 3) Rotations from the vehicle frames to the world."""
    velocity_m_s: Array
    """(n, 3) Velocities in the world frame [m/s]."""
    rate_rad_s: Array
    """(n, 3) Angular velocities in the vehicle frame [rad/s]."""
    rotor_speed_rad_s: Array
    """(n, R) Speeds of the rotors [rad/s]."""
    battery_charge: Array
    """(n,) States of charge of the batteries, from 1 (full) to 0 (empty)."""
    battery_v: Array
    """(n,) Voltages of the batteries under load [V]; computed from charge and rotor speeds when a plant is reset."""

    @classmethod
    def at(
        cls,
        position_m: Array,
        R_world_vehicle: Array | None = None,
        velocity_m_s: npt.ArrayLike = 0.0,
        rate_rad_s: npt.ArrayLike = 0.0,
        rotor_speed_rad_s: npt.ArrayLike = 0.0,
        battery_charge: npt.ArrayLike = 1.0,
        *,
        rotors: int = 4,
    ) -> Self:
        """Return states at positions (n, 3) [m]; other values are broadcast to n rows, level and at rest by default.

        ``rotors`` is the number R of rotors of the vehicle (`Quadrotor.rotor_count`).
        """
        n = len(position_m)
        return cls(
            np.array(position_m, dtype=np.float64),
            _filled(np.eye(3) if R_world_vehicle is None else R_world_vehicle, (n, 3, 3)),
            _filled(velocity_m_s, (n, 3)),
            _filled(rate_rad_s, (n, 3)),
            _filled(rotor_speed_rad_s, (n, rotors)),
            _filled(battery_charge, (n,)),
            np.zeros(n),
        )

    def check(self, fastest: float) -> None:
        """Check that the physics can start from these states.

        Args:
            fastest: Smallest component of a velocity [m/s] or angular velocity [rad/s] that is refused.

        Raises:
            ConfigError: A value is not finite, or a vehicle is too fast.
        """
        for field in fields(self):
            if not np.isfinite(getattr(self, field.name)).all():
                raise ConfigError(f"initial {field.name} is not finite; expected finite numbers")
        if max(np.abs(self.velocity_m_s).max(), np.abs(self.rate_rad_s).max()) >= fastest:
            raise ConfigError(f"initial velocity or angular velocity of {fastest:g} or more; expected less")


@dataclass(frozen=True, eq=False)
class VehicleParameters(Table):
    """Physical parameters of n vehicles that may differ from those of their type."""

    mass_kg: Array
    """(n,) Total masses [kg]."""
    inertia_kg_m2: Array
    """(n, 3) Principal moments of inertia about x, y, z [kg m²]."""
    rotor_time_constant_s: Array
    """(n,) Time constants of the response of the rotor speeds to commands [s]."""
    thrust_scale: Array
    """(n,) Thrust and torque coefficients of the rotors relative to those of the type."""
    drag_scale: Array
    """(n,) Drag coefficients of rotors and body, and the inflow coefficient, relative to those of the type."""

    def __post_init__(self) -> None:
        """Check the ranges of the values.

        Raises:
            ConfigError: A mass, inertia, time constant or thrust is not positive, or a drag is negative.
        """
        for field in fields(self):
            low, high = float(np.min(getattr(self, field.name))), float(np.max(getattr(self, field.name)))
            if not ((low >= 0.0 if field.name == "drag_scale" else low > 0.0) and high < np.inf):  # false for NaN
                raise ConfigError(f"{field.name} of {low:g} to {high:g}; expected positive numbers")

    @classmethod
    def of(cls, quadrotor: Quadrotor, count: int) -> Self:
        """Return the parameters of ``count`` vehicles of one type."""
        return cls(
            _filled(quadrotor.mass_kg, (count,)),
            _filled(quadrotor.inertia_kg_m2, (count, 3)),
            _filled(quadrotor.rotor_time_constant_s, (count,)),
            np.ones(count),
            np.ones(count),
        )


def _filled(value: npt.ArrayLike, shape: tuple[int, ...]) -> Array:
    """Return a value broadcast to a shape, as an array of its own."""
    return np.array(np.broadcast_to(np.asarray(value, dtype=np.float64), shape))
