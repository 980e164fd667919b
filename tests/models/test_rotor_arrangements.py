"""Rotors one by one and in arrangements: places, directions, allocation, and what cannot hold or turn a vehicle."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from scipy.optimize import nnls

from dronevio.models.errors import ConfigError
from dronevio.models.quadrotor import RESEARCH, Quadrotor, VehicleError
from dronevio.models.rotation import rotation_z
from dronevio.models.rotors import ARRANGEMENTS, Direction, Rotor

SQUARE: tuple[tuple[float, float], ...] = ((0.2, 0.2), (-0.2, 0.2), (-0.2, -0.2), (0.2, -0.2))
TURNING: tuple[Direction, ...] = ("ccw", "cw", "ccw", "cw")


def arranged(name: str) -> Quadrotor:
    """Return a vehicle with an arrangement whose neighbouring discs do not overlap."""
    return replace(RESEARCH, rotors=name, arm_m=0.4)


def one_by_one(places: npt.ArrayLike, directions: tuple[Direction, ...] = TURNING) -> tuple[Rotor, ...]:
    """Return rotors at places (R, 2) in one plane."""
    return tuple(
        Rotor((x, y, 0.03), turns) for (x, y), turns in zip(np.asarray(places).tolist(), directions, strict=True)
    )


@pytest.mark.parametrize("name", ARRANGEMENTS)
def test_arrangements_are_regular_and_balanced(name: str) -> None:
    drone = arranged(name)
    places, count = drone.rotor_positions_m, drone.rotor_count
    assert count == {"quad": 4, "hexa": 6, "octo": 8}[name.partition("-")[0]]
    np.testing.assert_allclose(np.hypot(places[:, 0], places[:, 1]), 0.4, rtol=1e-12)
    bearings = np.sort(np.degrees(np.arctan2(-places[:, 1], places[:, 0])) % 360.0)
    np.testing.assert_allclose(np.diff(bearings), 360.0 / count, atol=1e-9)
    in_front = np.isclose(places[:, 0], 0.4)
    assert in_front.sum() == (1 if name.endswith("plus") else 0)
    wrench = drone.allocation @ np.full(count, drone.hover_speed_rad_s**2)
    np.testing.assert_allclose(wrench, [drone.mass_kg * 9.81, 0.0, 0.0, 0.0], atol=1e-12)
    assert np.linalg.matrix_rank(drone.allocation / np.abs(drone.allocation).max(axis=1, keepdims=True)) == 4
    around = drone.rotor_directions[np.argsort(np.arctan2(places[:, 1], places[:, 0]))]
    np.testing.assert_array_equal(around, -np.roll(around, 1))  # neighbours turn in opposite directions


def test_octo_x_is_numbered_as_by_px4() -> None:
    """The first motors of PX4's octorotor x: front right, rear left, right front, right rear."""
    x, y = arranged("octo-x").rotor_positions_m[:4, :2].T
    np.testing.assert_allclose(x / 0.4, np.cos(np.radians([22.5, 202.5, 67.5, 157.5])), atol=1e-12)
    np.testing.assert_allclose(y / 0.4, -np.sin(np.radians([22.5, 202.5, 67.5, 157.5])), atol=1e-12)
    np.testing.assert_array_equal(arranged("octo-x").rotor_directions, [-1, -1, 1, 1, 1, 1, -1, -1])


def test_quad_plus_is_quad_x_turned_by_45_degrees_clockwise() -> None:
    x, plus = arranged("quad-x"), arranged("quad-plus")
    turned = x.rotor_positions_m @ rotation_z(np.asarray(-np.pi / 4)).T
    np.testing.assert_allclose(plus.rotor_positions_m, turned, atol=1e-14)
    np.testing.assert_array_equal(plus.rotor_directions, x.rotor_directions)


def test_rotors_one_by_one_equal_the_arrangement_of_the_same_places() -> None:
    listed = tuple(
        Rotor((place[0], place[1], place[2]), "ccw" if turns > 0.0 else "cw")
        for place, turns in zip(RESEARCH.rotor_positions_m.tolist(), RESEARCH.rotor_directions, strict=True)
    )
    own = replace(RESEARCH, rotors=listed)
    np.testing.assert_array_equal(own.allocation, RESEARCH.allocation)
    assert own.reach_m == pytest.approx(RESEARCH.reach_m)


def test_allocation_sums_the_rotors_as_by_hand() -> None:
    """Two rotors of 1 N on the left side, 0.2 m from the axis: 2 N and 0.4 N m of roll, without pitch or yaw."""
    drone = replace(RESEARCH, rotors=one_by_one(SQUARE))
    squares = np.array([1.0, 1.0, 0.0, 0.0]) / drone.thrust_n_per_rad2_s2
    np.testing.assert_allclose(drone.allocation @ squares, [2.0, 0.4, 0.0, 0.0], atol=1e-12)


@pytest.mark.parametrize("name", ["hexa-x", "hexa-plus", "octo-x"])
def test_five_or_seven_rotors_can_still_hold_the_vehicle_level(name: str) -> None:
    drone = arranged(name)
    weight = np.array([drone.mass_kg * 9.81, 0.0, 0.0, 0.0])
    scale = 1.0 / np.abs(drone.allocation).max(axis=1)
    for failed in range(drone.rotor_count):
        left = np.delete(drone.allocation, failed, axis=1)
        squares, residual = nnls(scale[:, None] * left, scale * weight)
        assert residual < 1e-9
        assert np.sqrt(squares.max()) < drone.rotor_speed_max_rad_s
    three = np.delete(arranged("quad-x").allocation, 0, axis=1)
    assert nnls(scale[:, None] * three, scale * weight)[1] > 1e-3  # without one of four, the yaw is lost


@pytest.mark.parametrize(
    ("rotors", "found"),
    [
        (one_by_one(SQUARE, ("ccw",) * 4), "4 rotors turn anticlockwise \\(ccw\\) and 0 clockwise"),
        (one_by_one(SQUARE, ("ccw", "ccw", "cw", "cw")), "about y \\(pitch\\) alone|about x \\(roll\\) alone"),
        (one_by_one(np.array(SQUARE) + [0.05, 0.0]), "centre of the rotors is at x = 0.05 m, y = 0 m"),
        (one_by_one([(0.3, 0), (0.1, 0), (-0.3, 0), (-0.1, 0)]), "about x \\(roll\\) alone"),
        (one_by_one(SQUARE)[:3], "3 rotors; expected 4 to 16"),
        (one_by_one(SQUARE) * 5, "20 rotors; expected 4 to 16"),
        (list(one_by_one(SQUARE)), "list; expected the name of an arrangement, or a tuple of Rotor"),
    ],
)
def test_rotors_that_cannot_hold_or_turn_a_vehicle_are_refused(rotors: tuple[Rotor, ...], found: str) -> None:
    with pytest.raises(VehicleError, match=f"rotors: .*({found})"):
        replace(RESEARCH, rotors=rotors)


def test_unknown_arrangements_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"unknown arrangement of rotors 'hexa-y'.*did you mean hexa-x"):
        replace(RESEARCH, rotors="hexa-y")


def test_full_speed_is_where_the_voltage_under_load_allows_no_more() -> None:
    drone = replace(RESEARCH, rotor_speed_per_v=60.0)
    speed = drone.full_speed_rad_s
    power_w = 10.0 + 4.0 * drone.torque_nm_per_rad2_s2 * speed**3 / drone.motor_efficiency
    E = float(drone.battery.open_circuit_v(np.array(1.0)))
    voltage = 0.5 * (E + np.sqrt(E * E - 4.0 * 0.02 * power_w))
    assert speed == pytest.approx(60.0 * voltage, rel=1e-9)
    assert drone.thrust_to_weight == pytest.approx(4.0 * drone.thrust_n_per_rad2_s2 * speed**2 / (1.5 * 9.81))
    assert replace(RESEARCH, rotor_speed_per_v=120.0).full_speed_rad_s == RESEARCH.rotor_speed_max_rad_s
