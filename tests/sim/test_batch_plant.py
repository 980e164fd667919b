"""The batch plant against the single plant, and the independence of its rows."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError
from dronevio.models.quadrotor import VEHICLES, Quadrotor
from dronevio.models.rig import Rig, euroc_rig
from dronevio.models.rotation import exp_so3, pose_matrix
from dronevio.sim.physics.batch_plant import BatchPlant, PlantWorld
from dronevio.sim.physics.collisions import COLLISION_GROUP, add_floor
from dronevio.sim.physics.plant import QuadrotorPlant
from dronevio.sim.physics.vehicle_states import VehicleParameters, VehicleStates
from dronevio.sim.physics.wind import Wind, Winds

RIG = euroc_rig()
EVERY = np.ones(3, dtype=bool)
MIDDLE = np.array([False, True, False])
WIND = Wind((1.0, -2.0, 0.3))


def drawn_states(drone: Quadrotor, rng: np.random.Generator, count: int = 3) -> VehicleStates:
    return VehicleStates.at(
        rng.uniform([-1.0, -1.0, 3.0], [1.0, 1.0, 5.0], (count, 3)),
        exp_so3(0.3 * rng.standard_normal((count, 3))),
        rng.standard_normal((count, 3)),
        rng.standard_normal((count, 3)),
        drone.hover_speed_rad_s * rng.uniform(0.8, 1.2, (count, 4)),
    )


def drawn_parameters(drone: Quadrotor, rng: np.random.Generator, count: int = 3) -> VehicleParameters:
    return VehicleParameters(
        drone.mass_kg * rng.uniform(0.8, 1.2, count),
        np.array(drone.inertia_kg_m2) * rng.uniform(0.8, 1.2, (count, 3)),
        drone.rotor_time_constant_s * rng.uniform(0.8, 1.2, count),
        rng.uniform(0.8, 1.2, count),
        rng.uniform(0.5, 1.5, count),
    )


def with_parameters(drone: Quadrotor, parameters: VehicleParameters, row: int) -> Quadrotor:
    thrust, drag = float(parameters.thrust_scale[row]), float(parameters.drag_scale[row])
    along, across, up = drone.drag_area_m2
    x, y, z = parameters.inertia_kg_m2[row].tolist()
    return replace(
        drone,
        mass_kg=float(parameters.mass_kg[row]),
        inertia_kg_m2=(x, y, z),
        rotor_time_constant_s=float(parameters.rotor_time_constant_s[row]),
        thrust_n_per_rad2_s2=thrust * drone.thrust_n_per_rad2_s2,
        torque_nm_per_rad2_s2=thrust * drone.torque_nm_per_rad2_s2,
        drag_n_s2_per_rad_m=drag * drone.drag_n_s2_per_rad_m,
        inflow_n_s2_per_rad_m=drag * drone.inflow_n_s2_per_rad_m,
        drag_area_m2=(drag * along, drag * across, drag * up),
    )


def measured(plant: QuadrotorPlant) -> np.ndarray:
    """Return the state of a plant at its next IMU sample, and the sample."""
    sample, true = plant.step_until(plant.t_ns, np.zeros(4)), plant.vehicle_state()
    T, battery = true.T_world_imu, (plant.battery_charge, plant.battery_v)
    values = (T[:3, 3], T[:3, :3].ravel(), true.velocity_m_s, plant.rotor_speeds_rad_s, battery)
    return np.concatenate([*values, sample.gyro_rad_s[0], sample.accel_m_s2[0]])


def measured_batch(plant: BatchPlant, row: int) -> np.ndarray:
    """Return the same values of a row of a batch."""
    true, sample = plant.states.rows(np.array([row])), plant.now.samples
    battery = (float(true.battery_charge[0]), float(true.battery_v[0]))
    R, rotors = true.R_world_vehicle[0].ravel(), true.rotor_speed_rad_s[0]
    values = (true.position_m[0], R, true.velocity_m_s[0], rotors, battery)
    return np.concatenate([*values, sample.gyro_rad_s[row], sample.accel_m_s2[row]])


def single_flight(
    monkeypatch: pytest.MonkeyPatch, step_s: float, rig: Rig, drone: Quadrotor, state: VehicleStates, commands: Array
) -> np.ndarray:
    """Return the values of each IMU sample of a single plant with a time step of MuJoCo."""
    monkeypatch.setattr("dronevio.sim.physics.vehicle.LONGEST_STEP_S", step_s)
    single = QuadrotorPlant(rig, drone, wind=WIND)
    pose = pose_matrix(state.R_world_vehicle[0], state.position_m[0])
    single.reset(pose, state.velocity_m_s[0], state.rate_rad_s[0], state.rotor_speed_rad_s[0])
    rows = [measured(single)]
    for command in commands:
        single.advance(single.t_ns + single.interval_ns, command)
        rows.append(measured(single))
    return np.array(rows)


@pytest.mark.parametrize(("name", "rate_hz"), [("research", 200.0), ("nano", 200.0), ("research", 100.0)])
def test_a_row_is_the_limit_of_a_single_plant_at_small_time_steps(
    name: str, rate_hz: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """MuJoCo's errors are proportional to its time step: they cancel in twice the result of 4 kHz less that of 2."""
    rig = replace(RIG, imu=replace(RIG.imu, rate_hz=rate_hz))
    drone, rng = VEHICLES[name], np.random.default_rng(0)
    states, parameters = drawn_states(drone, rng), drawn_parameters(drone, rng)
    commands = drone.hover_speed_rad_s * rng.uniform(0.9, 1.1, (100, 3, 4))
    batch = BatchPlant(3, rig, drone)
    batch.reset(EVERY, states, parameters, Winds.of(WIND, 3))
    rows = [[measured_batch(batch, k) for k in range(3)]]
    for each in commands:
        batch.advance(each)
        rows.append([measured_batch(batch, k) for k in range(3)])
    for k, found in enumerate(np.array(rows).transpose(1, 0, 2)):
        one, own = states.rows(np.array([k])), with_parameters(drone, parameters, k)
        coarse, fine = (single_flight(monkeypatch, h, rig, own, one, commands[:, k]) for h in (5e-4, 2.5e-4))
        error = np.abs(2.0 * fine - coarse - found)
        assert error[:, :15].max() < 1e-5 * max(1.0, np.abs(one.velocity_m_s).max())  # pose and velocity
        assert error[:, 15:21].max() < 1e-8  # rotors and battery
        assert error[:, 21:24].max() < 1e-5  # gyroscope
        assert error[:, 24:].max() < 3e-4  # accelerometer: the middle of an interval is interpolated
        assert np.abs(fine - found)[:, :15].max() < 0.6 * np.abs(coarse - found)[:, :15].max()


def test_a_landing_equals_that_of_a_single_plant() -> None:
    R, position = exp_so3(np.array([0.1, -0.05, 0.3])), np.array([0.0, 0.0, 0.3])
    batch, single = BatchPlant(1, RIG), QuadrotorPlant(RIG)
    batch.reset(np.ones(1, dtype=bool), VehicleStates.at(position[None], R))
    single.reset(pose_matrix(R, position))
    for _ in range(100):
        batch.advance(np.zeros((1, 4)))
    single.advance(100 * single.interval_ns, np.zeros(4))
    np.testing.assert_allclose(batch.states.position_m[0], single.vehicle_state().T_world_imu[:3, 3], atol=1e-9)
    assert not batch.now.touched[0] and single.collision is None


def test_obstacles_of_a_world_are_touched() -> None:
    world = mujoco.MjSpec()
    add_floor(world)
    world.worldbody.add_geom(
        name="wall", type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.1, 5.0, 5.0], pos=[1.0, 0.0, 0.0], group=COLLISION_GROUP
    )
    plant = BatchPlant(3, RIG, worlds=[PlantWorld(world)])
    speeds = plant.quadrotor.hover_speed_rad_s
    velocity = np.array([[3.0, 0.0, 0.0], [-3.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    plant.reset(EVERY, VehicleStates.at(np.tile([0.0, 0.0, 2.0], (3, 1)), None, velocity, 0.0, speeds))
    for _ in range(60):
        plant.advance(np.full((3, 4), speeds))
    np.testing.assert_array_equal(plant.now.touched, [True, False, False])


def flown(plant: BatchPlant, steps: int, first: int = 0, spoilt: int | None = None) -> list[np.ndarray]:
    """Return states and samples after each step of flights under commands that depend on the number of the step."""
    rows = []
    for step in range(first, first + steps):
        rng = np.random.default_rng(step)
        commands = plant.quadrotor.hover_speed_rad_s * rng.uniform(0.9, 1.1, (plant.count, 4))
        if step == spoilt:
            commands[1, 2] = np.nan
        samples, states = plant.advance(commands), plant.states
        rows.append(np.hstack([states.position_m, states.velocity_m_s, samples.gyro_rad_s, samples.accel_m_s2]))
    return rows


def gusty_plant(nthread: int = 1) -> BatchPlant:
    plant = BatchPlant(3, RIG, rng=np.random.default_rng(2), nthread=nthread)
    rng = np.random.default_rng(3)
    states, parameters = drawn_states(plant.quadrotor, rng), drawn_parameters(plant.quadrotor, rng)
    plant.reset(EVERY, states, parameters, Winds.of(Wind((3.0, 1.0, 0.0), gusts=1.0), 3))
    return plant


def test_the_number_of_threads_does_not_change_the_bytes() -> None:
    np.testing.assert_array_equal(flown(gusty_plant(1), 40), flown(gusty_plant(2), 40))


def test_a_reset_of_one_row_leaves_the_others_identical() -> None:
    undisturbed, plant = flown(gusty_plant(), 40), gusty_plant()
    before = flown(plant, 20)
    states = drawn_states(plant.quadrotor, np.random.default_rng(4))
    plant.reset(MIDDLE, states, drawn_parameters(plant.quadrotor, np.random.default_rng(5)))
    np.testing.assert_array_equal(plant.t_ns // plant.interval_ns, [20, 0, 20])
    np.testing.assert_allclose(plant.states.position_m[1], states.position_m[1], atol=1e-2)
    rows = flown(plant, 20, first=20)
    np.testing.assert_array_equal(np.array(before + rows)[:, ~MIDDLE], np.array(undisturbed)[:, ~MIDDLE])


def test_a_command_of_nan_is_marked_and_stays_in_its_row() -> None:
    undisturbed, plant = flown(gusty_plant(), 30), gusty_plant()
    rows = flown(plant, 30, spoilt=10)
    np.testing.assert_array_equal(plant.now.diverged, MIDDLE)
    assert np.isfinite(rows).all()
    np.testing.assert_array_equal(np.array(rows)[10:, 1, 3:6], 0.0)  # it stops at once
    np.testing.assert_array_equal(np.array(rows)[:, ~MIDDLE], np.array(undisturbed)[:, ~MIDDLE])
    plant.reset(MIDDLE, drawn_states(plant.quadrotor, np.random.default_rng(4)))
    assert not plant.now.diverged.any()


def test_divergence_is_marked_and_stays_in_its_row() -> None:
    plants = gusty_plant(), gusty_plant()
    for plant, inertia in zip(plants, (1e-2, 1e-9), strict=True):
        parameters = replace(plant.now.parameters, inertia_kg_m2=np.full((3, 3), inertia))
        plant.reset(MIDDLE, plant.states, parameters)
    undisturbed, rows = flown(plants[0], 30), flown(plants[1], 30)
    np.testing.assert_array_equal(plants[1].now.diverged, MIDDLE)
    assert np.isfinite(rows).all()
    np.testing.assert_array_equal(np.array(rows)[:, ~MIDDLE], np.array(undisturbed)[:, ~MIDDLE])


@pytest.mark.parametrize("value", [np.nan, 1e5])
def test_impossible_initial_states_are_refused(value: float) -> None:
    plant = gusty_plant()
    states = plant.states
    states.velocity_m_s[1] = value
    with pytest.raises(ConfigError, match="velocity"):
        plant.reset(MIDDLE, states)


def test_collisions_are_contacts_other_than_standing() -> None:
    plant = BatchPlant(3, RIG)
    stand = plant.standing_height_m
    tilted = np.stack([np.eye(3), exp_so3(np.array([np.pi, 0.0, 0.0])), np.eye(3)])
    plant.reset(EVERY, VehicleStates.at(np.array([[0.0, 0.0, stand], [0.0, 0.0, 0.3], [0.0, 0.0, 2.0]]), tilted))
    for _ in range(60):
        plant.advance(np.zeros((3, 4)))
    np.testing.assert_array_equal(plant.now.touched, MIDDLE)
    np.testing.assert_allclose(plant.states.position_m[0], [0.0, 0.0, stand], atol=1e-9)
    plant.reset(MIDDLE, VehicleStates.at(np.tile([0.0, 0.0, 2.0], (3, 1))))
    assert not plant.now.touched.any()


def outputs(plant: BatchPlant, commands: np.ndarray) -> list[bytes]:
    """Return the bytes of IMU samples and states of some intervals."""
    found = []
    for command in commands:
        sampled, reached = plant.advance(command), plant.states
        values = (sampled.gyro_rad_s, sampled.accel_m_s2, reached.position_m, reached.battery_charge, plant.wind_m_s)
        found.append(b"".join(value.tobytes() for value in values))
    return found


def windy_plant(seed: int) -> BatchPlant:
    drone, rng = VEHICLES["research"], np.random.default_rng(seed)
    plant = BatchPlant(3, RIG, drone, rng=rng)
    winds = Winds.of(Wind((1.0, -2.0, 0.3), 1.0), 3)
    plant.reset(EVERY, drawn_states(drone, rng), drawn_parameters(drone, rng), winds)
    return plant


def test_a_restored_plant_continues_with_the_same_bytes() -> None:
    plant, other = windy_plant(0), windy_plant(1)
    commands = 650.0 * np.random.default_rng(2).uniform(0.9, 1.1, (12, 3, 4))
    outputs(plant, commands[:4])
    saved = plant.save()
    expected = outputs(plant, commands[4:])
    assert outputs(plant, commands[4:]) != expected
    plant.restore(saved)
    assert outputs(plant, commands[4:]) == expected
    other.restore(saved)
    assert outputs(other, commands[4:]) == expected


def test_a_new_generator_determines_the_gusts() -> None:
    plant, results = windy_plant(0), []
    for seed in (5, 5, 6):
        plant.reseed(np.random.default_rng(seed))
        plant.reset(EVERY, VehicleStates.at(np.tile([0.0, 0.0, 4.0], (3, 1))))
        results.append(outputs(plant, np.full((4, 3, 4), 650.0)))
    assert results[0] == results[1] != results[2]
