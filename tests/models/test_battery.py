"""Battery model: voltage, load and charge, against values worked out by hand."""

import numpy as np
import pytest

from dronevio.models.battery import Battery

PACK = Battery(cells=3, capacity_ah=2.0, resistance_ohm=0.03)


def test_open_circuit_voltage_increases_with_charge() -> None:
    voltage = PACK.open_circuit_v(np.linspace(0.0, 1.0, 101))
    assert np.all(np.diff(voltage) > 0.0)
    np.testing.assert_allclose(voltage[[0, 50, 100]] / 3.0, [2.654, 3.80, 4.103], atol=0.01)


def test_load_reduces_the_voltage_by_the_resistance() -> None:
    charge, power = np.array([1.0, 0.6, 0.2]), np.array([50.0, 200.0, 300.0])
    voltage = PACK.loaded_v(charge, power)
    np.testing.assert_allclose(voltage, PACK.open_circuit_v(charge) - 0.03 * power / voltage)
    np.testing.assert_array_equal(PACK.loaded_v(charge, np.zeros(3)), PACK.open_circuit_v(charge))


def test_excessive_power_halves_the_voltage() -> None:
    assert PACK.loaded_v(np.array(1.0), np.array(1e6)) == pytest.approx(0.5 * PACK.open_circuit_v(np.array(1.0)))


def test_current_reduces_the_charge() -> None:
    assert PACK.charge_after(np.array(1.0), np.array(20.0), 36.0) == pytest.approx(0.9)  # 0.2 of 2 A h
    assert PACK.charge_after(np.array(0.01), np.array(20.0), 36.0) == 0.0
