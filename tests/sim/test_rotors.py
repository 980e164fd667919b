"""The rotor model against formulas, the measurements of a thrust stand, and the laws of mechanics."""

from dataclasses import replace

import numpy as np
import pytest

from dronevio.models.errors import ConfigError
from dronevio.models.quadrotor import NANO, RESEARCH, VEHICLES, Quadrotor
from dronevio.sim.physics.ground_effect import GroundEffect
from dronevio.sim.physics.rotors import Airflow, MotorFailure, Rotors, RotorState

Array = np.ndarray
UP = np.array([0.0, 0.0, 1.0])
HIGH_M = 1e9  # without ground effect


@pytest.fixture(params=list(VEHICLES))
def drone(request: pytest.FixtureRequest) -> Quadrotor:
    return VEHICLES[request.param]


def rotor_state(drone: Quadrotor, speeds: Array, change: Array | float = 0.0) -> RotorState:
    state = Rotors(drone).steady_state(speeds)
    return replace(state, acceleration_rad_s2=np.broadcast_to(change, speeds.shape))


def flow(velocity: Array, rate: Array, height: float = HIGH_M, up: Array = UP) -> Airflow:
    shape = velocity.shape[:-1]
    return Airflow(velocity, rate, np.broadcast_to(up, velocity.shape), np.broadcast_to(height, shape))


STILL_AIR = flow(np.zeros(3), np.zeros(3))


def test_lag_is_first_order_and_independent_of_the_steps(drone: Quadrotor) -> None:
    rotors, fastest = Rotors(drone), drone.rotor_speed_max_rad_s
    start, command = fastest * np.array([0.0, 0.1, 0.5, 0.9]), fastest * np.array([0.6, 0.6, 0.0, 0.8])
    once = rotors.step(rotors.steady_state(start), command, 0.03).speed_rad_s
    often = rotors.steady_state(start)
    for _ in range(30):
        often = rotors.step(often, command, 0.001)
    np.testing.assert_allclose(once, often.speed_rad_s, rtol=1e-12)
    np.testing.assert_allclose(once, command + (start - command) * np.exp(-0.03 / drone.rotor_time_constant_s))


def test_speeds_stay_within_what_the_motors_can_do() -> None:
    rotors = Rotors(RESEARCH)
    state = rotors.steady_state(np.full(4, 500.0))
    for _ in range(100):
        state = rotors.step(state, np.array([900.0, -1e6, 300.0, 700.0]), 0.01)
    np.testing.assert_allclose(state.speed_rad_s, [900.0, 0.0, 300.0, 700.0], atol=1e-9)
    for _ in range(100):
        state = rotors.step(state, np.full(4, 1e6), 0.01)
    limit = RESEARCH.rotor_speed_per_v * float(state.voltage_v)
    assert np.all(state.speed_rad_s <= 1000.0)
    np.testing.assert_allclose(state.speed_rad_s, min(limit, 1000.0), rtol=1e-3)


def test_a_tired_battery_turns_the_rotors_more_slowly(drone: Quadrotor) -> None:
    rotors = Rotors(drone)
    fastest = []
    for charge in (1.0, 0.5, 0.1):
        state = replace(rotors.steady_state(np.zeros(4)), charge=np.array(charge))
        for _ in range(400):
            state = rotors.step(state, np.full(4, 1e6), 0.005)
        fastest.append(float(state.speed_rad_s[0]))
        assert state.charge < charge
    assert fastest[0] > 1.02 * fastest[1] > 1.04 * fastest[2]


def test_a_hover_drains_the_battery_by_its_current(drone: Quadrotor) -> None:
    rotors, hover = Rotors(drone), np.full(4, drone.hover_speed_rad_s)
    state = rotors.steady_state(hover)
    used = 0.0
    for _ in range(2000):
        state = rotors.step(state, hover, 0.005)
        used += float(rotors.power_w(state) / state.voltage_v) * 0.005
    np.testing.assert_allclose((1.0 - state.charge) * drone.battery.capacity_ah * 3600.0, used, rtol=1e-9)
    endurance_min = 10.0 / 60.0 / (1.0 - float(state.charge))
    assert 4.0 < endurance_min < 20.0


BITCRAZE = np.array(
    # current [A], thrust of four [g], voltage [V], throttle [%], speed [1/min]: the upper half of Bitcraze's table
    [
        [1.83, 24.4, 3.71, 50.0, 15924.0],
        [2.11, 28.6, 3.67, 56.25, 17174.0],
        [2.71, 37.3, 3.62, 68.75, 19397.0],
        [3.46, 46.0, 3.48, 81.25, 21692.0],
        [4.44, 57.9, 3.30, 93.75, 23882.0],
    ]
)


def test_the_nano_has_the_thrust_and_power_of_its_test_stand() -> None:
    current, grams, voltage, throttle, rpm = BITCRAZE.T
    speeds = np.repeat((rpm * np.pi / 30.0)[:, None], 4, axis=1)
    state = rotor_state(NANO, speeds)
    calm = flow(np.zeros((5, 3)), np.zeros((5, 3)))
    np.testing.assert_allclose(Rotors(NANO).wrench(state, calm)[:, 2], grams * 9.81e-3, rtol=0.04)
    np.testing.assert_allclose(Rotors(NANO).power_w(state), current * voltage, rtol=0.2)
    np.testing.assert_allclose(speeds[-1, 0], NANO.rotor_speed_per_v * voltage[-1] * throttle[-1] / 100.0, rtol=0.02)


def test_batches_equal_single_simulations(drone: Quadrotor) -> None:
    rng, rotors = np.random.default_rng(0), Rotors(drone)
    speeds, commands = drone.rotor_speed_max_rad_s * rng.uniform(0.0, 1.2, (2, 5, 7, 4))
    velocity, rate = 5.0 * rng.normal(size=(2, 5, 7, 3))
    up = rng.normal(size=(5, 7, 3))
    up /= np.linalg.norm(up, axis=-1, keepdims=True)
    height, charge = rng.uniform(0.0, 1.0, (2, 5, 7))
    powered = rng.random((5, 7, 4)) < 0.8
    start = replace(rotors.steady_state(speeds), charge=charge)
    together = rotors.step(start, commands, 0.005, powered)
    wrenches = rotors.wrench(together, Airflow(velocity, rate, up, height))
    assert wrenches.shape == (5, 7, 6)
    for index in np.ndindex(5, 7):
        alone = replace(rotors.steady_state(speeds[index]), charge=charge[index])
        alone = rotors.step(alone, commands[index], 0.005, powered[index])
        np.testing.assert_allclose(alone.speed_rad_s, together.speed_rad_s[index], rtol=1e-13)
        np.testing.assert_allclose(alone.charge, together.charge[index], rtol=1e-13)
        np.testing.assert_allclose(alone.voltage_v, together.voltage_v[index], rtol=1e-13)
        wrench = rotors.wrench(alone, Airflow(velocity[index], rate[index], up[index], height[index]))
        np.testing.assert_allclose(wrenches[index], wrench, rtol=1e-12, atol=1e-12 * np.abs(wrench).max())


def test_wrench_is_the_sum_of_the_forces_at_the_hubs(drone: Quadrotor) -> None:
    rng = np.random.default_rng(1)
    speeds, change = drone.rotor_speed_max_rad_s * rng.uniform(0, 1, 4), 1e3 * rng.normal(size=4)
    velocity, rate = rng.normal(size=3), rng.normal(size=3)
    force = -0.5 * 1.225 * np.array(drone.drag_area_m2) * np.linalg.norm(velocity) * velocity
    torque = np.zeros(3)
    for omega, faster, hub, spin in zip(speeds, change, drone.rotor_positions_m, drone.rotor_directions, strict=True):
        air = velocity + np.cross(rate, hub)
        f = (drone.thrust_n_per_rad2_s2 * omega**2 - drone.inflow_n_s2_per_rad_m * omega * air[2]) * UP
        f -= drone.drag_n_s2_per_rad_m * omega * air * [1, 1, 0]
        force += f
        momentum = drone.rotor_inertia_kg_m2 * spin * omega * UP
        torque += np.cross(hub, f) - spin * drone.torque_nm_per_rad2_s2 * omega**2 * UP
        torque -= drone.rotor_inertia_kg_m2 * spin * faster * UP + np.cross(rate, momentum)
    wrench = Rotors(drone).wrench(rotor_state(drone, speeds, change), flow(velocity, rate))
    np.testing.assert_allclose(wrench, np.concatenate([force, torque]), rtol=1e-10)


def test_aerodynamic_drag_dissipates_energy(drone: Quadrotor) -> None:
    rng, rotors = np.random.default_rng(2), Rotors(drone)
    state = rotor_state(drone, drone.hover_speed_rad_s * rng.uniform(0.5, 1.3, (500, 4)))
    velocity, rate = 3.0 * rng.normal(size=(2, 500, 3))
    passive = rotors.wrench(state, flow(velocity, rate)) - rotors.wrench(state, flow(0 * velocity, 0 * rate))
    assert np.all(np.sum(passive * np.hstack([velocity, rate]), axis=1) < 0.0)


def test_gyroscopic_torque_of_the_rotors() -> None:
    one = np.array([600.0, 0.0, 0.0, 0.0])  # anticlockwise: its angular momentum points upwards
    bare = replace(RESEARCH, drag_n_s2_per_rad_m=0.0, inflow_n_s2_per_rad_m=0.0)
    rolling = np.array([2.0, 0.0, 0.0])
    torque = [
        Rotors(bare).wrench(rotor_state(bare, one), flow(np.zeros(3), rate))[3:] for rate in (rolling, 0 * rolling)
    ]
    # A roll to the right changes the angular momentum towards −y, and the reaction on the body is towards +y
    np.testing.assert_allclose(torque[0] - torque[1], [0.0, 2.0 * RESEARCH.rotor_inertia_kg_m2 * 600.0, 0.0])


def test_rotor_acceleration_has_an_opposite_reaction_torque(drone: Quadrotor) -> None:
    speeds = np.full(4, drone.hover_speed_rad_s)
    for rotor, spin in enumerate(drone.rotor_directions):
        change = np.zeros(4)
        change[rotor] = 100.0
        torque = Rotors(drone).wrench(rotor_state(drone, speeds, change), STILL_AIR)[5]
        np.testing.assert_allclose(torque, -spin * 100.0 * drone.rotor_inertia_kg_m2, rtol=1e-9)


def test_electrical_power_covers_the_shaft_power(drone: Quadrotor) -> None:
    rng, rotors = np.random.default_rng(3), Rotors(drone)
    state = rotors.steady_state(drone.hover_speed_rad_s * rng.uniform(0.7, 1.2, 4))
    command = drone.hover_speed_rad_s * rng.uniform(0.7, 1.2, 4)
    after = rotors.step(state, command, 0.001)
    middle = 0.5 * (state.speed_rad_s + after.speed_rad_s)
    air = drone.torque_nm_per_rad2_s2 * middle**3
    stored = 0.5 * drone.rotor_inertia_kg_m2 * (after.speed_rad_s**2 - state.speed_rad_s**2) / 0.001
    shafts = (air + stored).clip(0.0).sum()
    electrical = float(rotors.power_w(after)) - drone.avionics_w
    np.testing.assert_allclose(electrical * drone.motor_efficiency, shafts, rtol=0.05)
    thrust_n = float(rotors.wrench(after, STILL_AIR)[2])
    ideal_w = thrust_n * np.sqrt(thrust_n / (2.0 * 1.225 * 4.0 * np.pi * drone.rotor_radius_m**2))
    assert 0.3 < ideal_w / shafts < 0.8  # momentum theory's least power: the figure of merit of small propellers


def test_a_rotor_without_power_coasts_and_gives_no_torque(drone: Quadrotor) -> None:
    rotors, hover = Rotors(drone), np.full(4, drone.hover_speed_rad_s)
    powered = np.array([True, False, True, True])
    state = rotors.steady_state(hover)
    often = rotors.steady_state(hover)
    for _ in range(100):
        state = rotors.step(state, hover, 0.005, powered)
        often = rotors.step(rotors.step(often, hover, 0.0025, powered), hover, 0.0025, powered)
    np.testing.assert_allclose(state.speed_rad_s, often.speed_rad_s, rtol=1e-12)
    np.testing.assert_allclose(state.speed_rad_s[[0, 2, 3]], hover[0], rtol=1e-12)
    assert 0.0 < state.speed_rad_s[1] < 0.6 * hover[0]
    shaft = drone.torque_nm_per_rad2_s2 * state.speed_rad_s**2 + drone.rotor_inertia_kg_m2 * state.acceleration_rad_s2
    assert abs(shaft[1]) < 0.02 * shaft[0]


def test_ground_effect_follows_cheeseman_and_bennett() -> None:
    R, lone = RESEARCH.rotor_radius_m, replace(RESEARCH, arm_m=10.0)
    heights = R * np.array([0.7, 1.0, 2.0, 4.0])
    alone = GroundEffect(lone).ratio(heights)
    np.testing.assert_allclose(alone, 1.0 / (1.0 - (R / (4.0 * heights)) ** 2), rtol=1e-5)
    four = GroundEffect(RESEARCH).ratio(heights)
    assert np.all(four > alone)
    assert np.all(np.diff(four) < 0.0)
    assert four[0] < 1.4 and four[-1] < 1.02
    # The third term of the paper's equation at a height of one radius
    d = RESEARCH.arm_m * np.sqrt(2.0)
    images = 1 / 16 + R**3 / (d**2 + 4 * R**2) ** 1.5 + 0.5 * R**3 / (2 * d**2 + 4 * R**2) ** 1.5
    np.testing.assert_allclose(four[1], 1.0 / (1.0 - images))
    lowest = GroundEffect(RESEARCH).ratio(np.array(0.5 * R))
    np.testing.assert_allclose(GroundEffect(RESEARCH).ratio(np.array([0.0, -1.0])), lowest)


def test_ground_effect_reduces_tilt_unless_inverted(drone: Quadrotor) -> None:
    state = rotor_state(drone, np.full(4, drone.hover_speed_rad_s))
    low = 2.0 * drone.rotor_radius_m
    right_side_down = np.array([0.0, np.sin(0.1), np.cos(0.1)])  # the world's z in the frame of a roll by 0.1 rad
    wrench = Rotors(drone).wrench(state, flow(np.zeros(3), np.zeros(3), low, right_side_down))
    assert wrench[3] < 0.0
    inverted = Rotors(drone).wrench(state, flow(np.zeros(3), np.zeros(3), low, -UP))
    np.testing.assert_allclose(inverted, Rotors(drone).wrench(state, STILL_AIR), rtol=1e-12, atol=1e-12)


def test_invalid_failures_are_refused() -> None:
    with pytest.raises(ConfigError, match="rotor = 16"):
        MotorFailure(16, 1.0)
    with pytest.raises(ConfigError, match=r"t_s = -1\.0"):
        MotorFailure(0, -1.0)
