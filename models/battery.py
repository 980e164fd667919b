"""Battery model: the voltage as a function of the state of charge and of the power drawn."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.ranges import Range, Settings


@dataclass(frozen=True)
class Battery(Settings):
    """Lithium polymer cells in series, as an open-circuit voltage with a series resistance (zero-order Thévenin model).

    The open-circuit voltage as a function of the state of charge is that of Chen and Rincón-Mora ("Accurate electrical
    battery model capable of predicting runtime and I–V performance", IEEE Trans. Energy Conversion 21(2), 2006, eq. 2).
    """

    cells: Annotated[int, Range(1, 100)]
    """Number of cells in series."""
    capacity_ah: Annotated[float, Range(above=0.0, high=1e4)]
    """Charge of the full battery [A h]."""
    resistance_ohm: Annotated[float, Range(0.0, 10.0)]
    """Total resistance of cells, leads and switches [Ω]."""

    def open_circuit_v(self, charge: Array) -> Array:
        """Return the voltage without load (…) [V] at states of charge (…), from 0 (empty) to 1 (full)."""
        cell = -1.031 * np.exp(-35.0 * charge) + 3.685 + charge * (0.2156 + charge * (-0.1178 + charge * 0.3201))
        return np.asarray(self.cells * cell)

    def loaded_v(self, charge: Array, power_w: Array) -> Array:
        """Return the voltage under load (…) [V] at states of charge (…) and powers (…) [W].

        It solves V = E − R P / V for the open-circuit voltage E. Above the largest power that the battery can deliver,
        E² / 4R, the voltage stays at E / 2.
        """
        E = self.open_circuit_v(charge)
        return np.asarray(0.5 * (E + np.sqrt(np.maximum(E * E - 4.0 * self.resistance_ohm * power_w, 0.0))))

    def charge_after(self, charge: Array, current_a: Array, dt_s: float) -> Array:
        """Return the states of charge (…), 0 or more, after currents (…) [A] for a time ``dt_s`` [s]."""
        return np.asarray(np.maximum(charge - current_a * (dt_s / (3600.0 * self.capacity_ah)), 0.0))
