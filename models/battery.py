"""The battery: a voltage that falls with the charge taken out and with the power drawn."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Battery:
    """Lithium polymer cells in series, each an open-circuit voltage behind a resistance (the simplest Thévenin model).

    The open-circuit voltage of a cell over its charge is Chen and Rincón-Mora's ("Accurate electrical battery model
    capable of predicting runtime and I–V performance", IEEE Trans. Energy Conversion 21(2), 2006, eq. 2).
    """

    cells: int
    """How many are in series."""
    capacity_ah: float
    """Charge of the full battery [A h]."""
    resistance_ohm: float
    """Of all cells, leads and switches together [Ω]."""

    def open_circuit_v(self, charge: Array) -> Array:
        """Return the voltage without load [V] at charges (…), 1 full and 0 empty."""
        cell = -1.031 * np.exp(-35.0 * charge) + 3.685 + charge * (0.2156 + charge * (-0.1178 + charge * 0.3201))
        return np.asarray(self.cells * cell)

    def loaded_v(self, charge: Array, power_w: Array) -> Array:
        """Return the voltage [V] at charges (…) while a power (…) [W] is drawn.

        It solves V = E − R P / V. Beyond the greatest power that the battery can give, E² / 4R, the voltage stays at
        half of E.
        """
        E = self.open_circuit_v(charge)
        return np.asarray(0.5 * (E + np.sqrt(np.maximum(E * E - 4.0 * self.resistance_ohm * power_w, 0.0))))

    def charge_after(self, charge: Array, current_a: Array, dt_s: float) -> Array:
        """Return the charges (…) after a current (…) [A] has flown for ``dt_s``; never below 0."""
        return np.asarray(np.maximum(charge - current_a * (dt_s / (3600.0 * self.capacity_ah)), 0.0))
