"""Quadrotor parameters: geometry, control allocation and validation."""

from dataclasses import replace

import numpy as np
import pytest

from dronevio.models.errors import ConfigError
from dronevio.models.quadrotor import NANO, RESEARCH, VEHICLES, Quadrotor, vehicle_named

FRONT_RIGHT, REAR_LEFT, FRONT_LEFT, REAR_RIGHT = range(4)


@pytest.fixture(params=list(VEHICLES))
def drone(request: pytest.FixtureRequest) -> Quadrotor:
    return vehicle_named(request.param)


def test_rotors_are_at_the_places_of_their_names(drone: Quadrotor) -> None:
    x, y, _ = drone.rotor_positions_m.T
    assert x[FRONT_RIGHT] > 0 > y[FRONT_RIGHT]
    assert x[REAR_LEFT] < 0 < y[REAR_LEFT]
    assert x[FRONT_LEFT] > 0 and y[FRONT_LEFT] > 0
    assert x[REAR_RIGHT] < 0 and y[REAR_RIGHT] < 0
    np.testing.assert_allclose(np.hypot(x, y), drone.arm_m)
    assert np.sqrt(2.0) * drone.arm_m > 2.0 * drone.rotor_radius_m  # adjacent discs do not overlap


def test_equal_rotor_speeds_cause_no_torque(drone: Quadrotor) -> None:
    wrench = drone.allocation @ np.full(4, drone.hover_speed_rad_s**2)
    np.testing.assert_allclose(wrench, [drone.mass_kg * 9.81, 0.0, 0.0, 0.0], atol=1e-12)


@pytest.mark.parametrize(
    ("rotor", "signs"),
    [(FRONT_RIGHT, (-1, -1, -1)), (REAR_LEFT, (1, 1, -1)), (FRONT_LEFT, (1, -1, 1)), (REAR_RIGHT, (-1, 1, 1))],
)
def test_each_rotor_has_the_right_torque_signs(drone: Quadrotor, rotor: int, signs: tuple[int, int, int]) -> None:
    # Left rotors roll right (+x), rear rotors pitch down (+y), clockwise rotors yaw left (+z).
    squares = np.zeros(4)
    squares[rotor] = 1e5
    np.testing.assert_array_equal(np.sign(drone.allocation[1:] @ squares), signs)


def test_thrust_to_weight_ratio_exceeds_two(drone: Quadrotor) -> None:
    ratio = (drone.rotor_speed_max_rad_s / drone.hover_speed_rad_s) ** 2
    assert 2.0 < ratio < 3.0


def test_inertia_is_physically_possible(drone: Quadrotor) -> None:
    x, y, z = drone.inertia_kg_m2
    assert max(x, y, z) < 0.5 * (x + y + z)
    for moment in (x, y, z):
        assert moment < drone.mass_kg * (drone.arm_m + drone.rotor_radius_m) ** 2


def test_vehicles_are_found_by_name() -> None:
    assert vehicle_named("research") is RESEARCH == Quadrotor()
    assert vehicle_named("nano") is NANO
    assert 0.025 < NANO.mass_kg < 0.035
    with pytest.raises(ConfigError, match=r"'blimp'.*research, nano"):
        vehicle_named("blimp")


@pytest.mark.parametrize(
    "change", [{"mass_kg": 0.0}, {"rotor_time_constant_s": -0.1}, {"inertia_kg_m2": (0.1, np.nan, 0.1)}]
)
def test_invalid_parameters_are_refused(change: dict[str, object]) -> None:
    with pytest.raises(ConfigError, match=next(iter(change))):
        replace(RESEARCH, **change)  # type: ignore[arg-type]
