"""Mechanics of flight: energy, momentum, collisions, and batches of simulations."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from dronevio.models.imu import ImuModel
from dronevio.models.quadrotor import RESEARCH, VEHICLES, Quadrotor
from dronevio.models.rig import Rig
from dronevio.models.rotation import exp_so3, matrix_from_quat_wxyz, pose_matrix
from dronevio.sim.physics.collisions import COLLISION_GROUP
from dronevio.sim.physics.motion import Motion
from dronevio.sim.physics.plant import QuadrotorPlant
from dronevio.sim.physics.rotors import Airflow, MotorFailure, Rotors
from dronevio.sim.physics.vehicle import physics_model
from dronevio.sim.physics.wind import Wind

Array = np.ndarray
RIG = Rig(cameras=(), imu=ImuModel(rate_hz=200.0))
SECOND_NS = 1_000_000_000
HIGH = pose_matrix(np.eye(3), np.array([0.0, 0.0, 50.0]))
AIRLESS = replace(RESEARCH, drag_area_m2=(0.0, 0.0, 0.0))


@pytest.fixture(params=list(VEHICLES))
def drone(request: pytest.FixtureRequest) -> Quadrotor:
    return VEHICLES[request.param]


def states(motion: Motion) -> tuple[Array, Array, Array, Array]:
    """Return positions, velocities, rotations and angular velocities of the vehicle at the same instants."""
    truth = motion.trajectory(np.eye(4))
    assert truth.velocity_m_s is not None
    return truth.p_world_imu, truth.velocity_m_s, truth.rotations, motion.angular_velocity_rad_s(np.eye(4))


def energy(drone: Quadrotor, motion: Motion) -> Array:
    position, velocity, _, rate = states(motion)
    kinetic = 0.5 * drone.mass_kg * (velocity**2).sum(axis=1) + 0.5 * rate**2 @ np.array(drone.inertia_kg_m2)
    return np.asarray(kinetic + drone.mass_kg * 9.81 * position[:, 2])


def test_trajectory_in_vacuum_is_a_parabola() -> None:
    plant = QuadrotorPlant(RIG, AIRLESS)
    start, velocity = HIGH[:3, 3], np.array([2.0, -1.0, 6.0])
    plant.reset(HIGH, velocity, np.array([0.5, -0.3, 2.0]))
    plant.advance(2 * SECOND_NS, np.zeros(4))
    motion = plant.motion()
    t = motion.t_ns[:, None] * 1e-9
    expected = start + velocity * t - 0.5 * 9.81 * t**2 * [0.0, 0.0, 1.0]
    np.testing.assert_allclose(states(motion)[0] - states(motion)[0][0], expected - start, atol=1e-3)
    kept = energy(AIRLESS, motion)
    np.testing.assert_allclose(kept, kept[0], rtol=2e-5)


def test_free_rotation_conserves_angular_momentum() -> None:
    plant = QuadrotorPlant(RIG, AIRLESS)
    plant.reset(HIGH, rate_rad_s=np.array([3.0, 0.5, 4.0]))
    plant.advance(2 * SECOND_NS, np.zeros(4))
    _, _, R, rate = states(plant.motion())
    momentum = np.einsum("nij,nj->ni", R, rate * AIRLESS.inertia_kg_m2)
    np.testing.assert_allclose(
        momentum, np.tile(momentum[0], (len(R), 1)), atol=0.01 * float(np.linalg.norm(momentum[0]))
    )
    assert np.ptp(rate[:, 0]) > 3.0  # while the angular velocity changes


def test_body_and_rotors_conserve_angular_momentum() -> None:
    """In a vacuum, accelerating rotors exchange angular momentum with the body."""
    vacuum = replace(
        AIRLESS,
        thrust_n_per_rad2_s2=1e-20,
        torque_nm_per_rad2_s2=1e-20,
        drag_n_s2_per_rad_m=0.0,
        inflow_n_s2_per_rad_m=0.0,
    )
    plant = QuadrotorPlant(RIG, vacuum)
    plant.reset(HIGH, rate_rad_s=np.array([0.5, -0.4, 0.0]), rotor_speeds_rad_s=np.array([500.0, 300.0, 400.0, 100.0]))
    for step, command in enumerate(([900.0, 900.0, 0.0, 0.0], [0.0, 300.0, 800.0, 500.0])):
        plant.advance((step + 1) * SECOND_NS, np.array(command))
    motion = plant.motion()
    _, _, R, rate = states(motion)
    # The reaction torque is constant over an interval of the command, as the thrust is
    held = np.vstack([motion.rotor_speeds_rad_s[:1], motion.rotor_speeds_rad_s[:-1]])
    spin = vacuum.rotor_inertia_kg_m2 * held @ vacuum.rotor_directions
    body = rate * vacuum.inertia_kg_m2
    total = np.einsum("nij,nj->ni", R, body + spin[:, None] * [0.0, 0.0, 1.0])
    np.testing.assert_allclose(total, np.tile(total[0], (len(R), 1)), atol=0.02 * np.ptp(spin))
    assert np.ptp(body[:, 2]) > 0.5 * np.ptp(spin) > 0.0


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_falling_body_reaches_its_terminal_velocity(axis: int, drone: Quadrotor) -> None:
    down = [(0.0, 0.5 * np.pi, 0.0), (0.5 * np.pi, 0.0, 0.0), (0.0, 0.0, 0.0)][axis]
    terminal = np.sqrt(2.0 * drone.mass_kg * 9.81 / (1.225 * drone.drag_area_m2[axis]))
    plant = QuadrotorPlant(RIG, drone)
    plant.reset(pose_matrix(exp_so3(np.array(down)), np.array([0.0, 0.0, 5e3])))
    plant.advance(20 * SECOND_NS, np.zeros(4))
    np.testing.assert_allclose(plant.vehicle_state().velocity_m_s, [0.0, 0.0, -terminal], rtol=5e-3, atol=1e-6)


def test_drag_vanishes_at_the_velocity_of_the_wind(drone: Quadrotor) -> None:
    wind = np.array([2.0, -1.0, 0.0])
    plant = QuadrotorPlant(RIG, drone, wind=Wind(tuple(wind)))
    hover = np.full(4, drone.hover_speed_rad_s)
    plant.reset(HIGH, rotor_speeds_rad_s=hover)
    accel = plant.step_until(0, hover).accel_m_s2[0] - [0.0, 0.0, 9.81]
    rotors = 4.0 * drone.drag_n_s2_per_rad_m * drone.hover_speed_rad_s
    body = 0.5 * 1.225 * drone.drag_area_m2[0] * np.linalg.norm(wind)
    np.testing.assert_allclose(accel, (rotors + body) * wind / drone.mass_kg, rtol=0.02, atol=2e-3)
    plant.reset(HIGH, velocity_m_s=wind, rotor_speeds_rad_s=hover)
    np.testing.assert_allclose(plant.step_until(0, hover).accel_m_s2[0], [0.0, 0.0, 9.81], atol=1e-3)


def test_the_accelerometer_measures_drag_and_thrust(drone: Quadrotor) -> None:
    plant, hover = QuadrotorPlant(RIG, drone), np.full(4, drone.hover_speed_rad_s)
    for velocity in np.vstack([np.eye(3), -np.eye(3)]):
        plant.reset(HIGH, velocity_m_s=velocity, rotor_speeds_rad_s=hover)
        accel = plant.step_until(0, hover).accel_m_s2[0] - [0.0, 0.0, 9.81]
        assert accel @ velocity < -0.05
        np.testing.assert_allclose(accel - (accel @ velocity) * velocity, 0.0, atol=0.02)
    plant.reset(HIGH, rotor_speeds_rad_s=1.1 * hover)
    np.testing.assert_allclose(plant.step_until(0, hover).accel_m_s2[0], [0.0, 0.0, 1.21 * 9.81], atol=0.01)


def test_a_bounce_never_adds_energy(drone: Quadrotor) -> None:
    plant = QuadrotorPlant(RIG, drone)
    plant.reset(pose_matrix(exp_so3(np.array([0.3, -0.2, 1.0])), np.array([0.0, 0.0, 0.8])), np.array([1.0, 0.5, 0.0]))
    plant.advance(4 * SECOND_NS, np.zeros(4))
    left = energy(drone, plant.motion())
    lost = np.maximum.accumulate(left[::-1])[::-1]  # the largest energy from then on
    assert np.all(lost <= left[0] * (1.0 + 1e-6))
    assert np.all(lost - left < 0.1 * left[0])  # stored in the contact springs and returned
    position, velocity, _, _ = states(plant.motion())
    assert np.linalg.norm(velocity[-1]) < 0.01
    assert position[:, 2].min() > 0.0


def test_ground_effect_adds_thrust_near_the_ground(drone: Quadrotor) -> None:
    plant, hover = QuadrotorPlant(RIG, drone), np.full(4, drone.hover_speed_rad_s)
    rise = []
    for height in (1.0 * drone.rotor_radius_m, 4.0 * drone.rotor_radius_m, 50.0):
        at = pose_matrix(np.eye(3), np.array([0.0, 0.0, plant.standing_height_m + height]))
        plant.reset(at, rotor_speeds_rad_s=hover)
        plant.advance(SECOND_NS // 20, hover)
        rise.append(plant.vehicle_state().velocity_m_s[2])
    assert rise[0] > 2.0 * rise[1] > 0.0
    assert abs(rise[2]) < 1e-3 * rise[1] + 1e-6


def test_a_motor_failure_rotates_the_drone_towards_it(drone: Quadrotor) -> None:
    plant = QuadrotorPlant(RIG, drone, failure=MotorFailure(0, 0.1))  # front right
    hover = np.full(4, drone.hover_speed_rad_s)
    plant.reset(HIGH, rotor_speeds_rad_s=hover)
    plant.advance(SECOND_NS // 10, hover)
    np.testing.assert_allclose(plant.rotor_speeds_rad_s, hover, rtol=1e-12)
    plant.advance(SECOND_NS // 4, hover)
    rate = plant.vehicle_state().angular_velocity_rad_s
    assert rate is not None
    assert rate[0] > 0.5 and rate[1] > 0.5  # to the right, nose down
    assert plant.rotor_speeds_rad_s[0] < 0.9 * hover[0]
    np.testing.assert_allclose(plant.rotor_speeds_rad_s[1:], hover[1:], rtol=1e-9)


def floor_and_wall() -> mujoco.MjSpec:
    """Return a floor, a wall at x = 2, and a box in front of it without collisions."""
    spec = mujoco.MjSpec()
    spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0.0, 0.0, 1.0], group=COLLISION_GROUP)
    spec.worldbody.add_geom(
        name="wall",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[0.0, 0.0, 1.0],
        pos=[2.0, 0.0, 0.0],
        zaxis=[-1.0, 0.0, 0.0],
        group=COLLISION_GROUP,
    )
    spec.worldbody.add_geom(
        name="visual", type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.5, 0.5, 0.5], pos=[1.5, 0.0, 1.0], contype=0
    )
    return spec


def test_a_collision_reports_the_object_the_time_and_the_speed(drone: Quadrotor) -> None:
    plant = QuadrotorPlant(RIG, drone, surroundings=floor_and_wall())
    plant.reset(pose_matrix(np.eye(3), np.array([1.2, 0.0, 1.0])), np.array([3.0, 0.0, 0.0]))
    plant.advance(SECOND_NS // 10, np.zeros(4))
    before = plant.collision
    plant.advance(2 * SECOND_NS, np.zeros(4))
    collision = plant.collision
    assert before is None and collision is not None
    assert collision.against == "wall" and collision.part.startswith("propeller_front")
    assert 3.0 < collision.speed_m_s < 4.0  # gravity has added to it
    assert str(collision) == (
        f"crashed at t = {collision.t_ns * 1e-9:.2f} s: {collision.part} against wall at {collision.speed_m_s:.1f} m/s"
    )
    positions, _, _, _ = states(plant.motion())
    assert positions[:, 0].max() < 2.0 - 0.5 * drone.arm_m
    radius = drone.arm_m / np.sqrt(2.0) + drone.rotor_radius_m
    np.testing.assert_allclose(np.interp(collision.t_ns, plant.motion().t_ns, positions[:, 0]), 2.0 - radius, atol=0.03)
    plant.reset()
    assert plant.collision is None


def test_propellers_collide_with_the_floor_and_feet_do_not(drone: Quadrotor) -> None:
    plant = QuadrotorPlant(RIG, drone, surroundings=floor_and_wall())
    plant.advance(SECOND_NS // 2, np.zeros(4))
    standing = plant.collision
    plant.reset(pose_matrix(exp_so3(np.array([2.0, 0.0, 0.0])), np.array([0.0, 0.0, 1.0])))
    plant.advance(SECOND_NS, np.zeros(4))
    assert standing is None and plant.collision is not None
    assert plant.collision.against == "floor"


def test_a_foot_collides_with_the_side_of_a_kerb_only() -> None:
    kerb = mujoco.MjSpec()
    kerb.worldbody.add_geom(
        name="kerb", type=mujoco.mjtGeom.mjGEOM_BOX, size=[1.0, 1.0, 0.05], pos=[1.3, 0.0, -0.01], group=COLLISION_GROUP
    )
    kerb.worldbody.add_geom(name="road", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0.0, 0.0, 1.0], group=COLLISION_GROUP)
    plant = QuadrotorPlant(RIG, surroundings=kerb)
    plant.reset(velocity_m_s=np.array([2.5, 0.0, 0.0]))
    plant.advance(SECOND_NS, np.zeros(4))
    collision = plant.collision
    assert collision is not None and collision.against == "kerb" and collision.part.startswith("foot_front")
    plant.reset(pose_matrix(np.eye(3), np.array([1.0, 0.0, 0.2])))
    plant.advance(SECOND_NS, np.zeros(4))
    assert plant.collision is None


def test_gusts_differ_between_flights_and_repeat_with_the_seed() -> None:
    def wind_after(plant: QuadrotorPlant) -> Array:
        plant.reset(HIGH)
        plant.advance(SECOND_NS // 2, np.zeros(4))
        return plant.wind_m_s

    wind = Wind((4.0, 0.0, 0.0), gusts=1.0)
    plant, same = (QuadrotorPlant(RIG, wind=wind, rng=np.random.default_rng(1)) for _ in range(2))
    first, second = wind_after(plant), wind_after(plant)
    assert not np.any(first == second)
    np.testing.assert_array_equal(wind_after(same), first)
    before = plant.wind_m_s
    plant.reset(HIGH)
    assert np.linalg.norm(plant.wind_m_s - before) > 0.3  # not the gusts at the end of the previous flight
    before = plant.wind_m_s
    plant.advance(SECOND_NS, np.zeros(4))
    assert not np.any(plant.wind_m_s == before)  # gusts change along the path of the fall


def test_the_drone_starts_standing_on_its_pad(drone: Quadrotor) -> None:
    pad = np.array([-3.0, 1.0, 0.0])
    plant = QuadrotorPlant(RIG, drone, surroundings=floor_and_wall(), pad_m=pad)
    samples = plant.step_until(SECOND_NS // 2, np.zeros(4))
    np.testing.assert_allclose(
        plant.vehicle_state().T_world_imu[:3, 3], pad + [0, 0, plant.standing_height_m], atol=1e-6
    )
    np.testing.assert_allclose(samples.accel_m_s2, np.tile([0.0, 0.0, 9.81], (101, 1)), atol=1e-6)


def test_the_state_is_the_last_of_the_motion(drone: Quadrotor) -> None:
    rig = replace(RIG, T_vehicle_imu=pose_matrix(exp_so3(np.array([0.3, 1.0, -2.0])), np.array([0.05, -0.02, 0.03])))
    plant = QuadrotorPlant(rig, drone)
    plant.reset(HIGH, np.array([1.0, 2.0, 3.0]), np.array([5.0, -3.0, 2.0]), np.full(4, drone.hover_speed_rad_s))
    plant.advance(SECOND_NS // 3, np.full(4, 1.1 * drone.hover_speed_rad_s))
    state, truth = plant.state(), plant.motion().trajectory(rig.T_vehicle_imu)
    assert truth.velocity_m_s is not None and state.angular_velocity_rad_s is not None
    np.testing.assert_allclose(state.T_world_imu, truth.Ts_world_imu[-1], atol=1e-12)
    np.testing.assert_allclose(state.velocity_m_s, truth.velocity_m_s[-1], atol=1e-12)
    rates = plant.motion().angular_velocity_rad_s(rig.T_vehicle_imu)
    np.testing.assert_allclose(state.angular_velocity_rad_s, rates[-1], atol=1e-12)


def test_a_batch_equals_single_simulations(drone: Quadrotor) -> None:
    """A rotor model that is evaluated once for all drones gives each of them the motion of a single simulation."""
    rng, count, steps, dt = np.random.default_rng(5), 3, 100, 5e-3
    commands = drone.hover_speed_rad_s * rng.uniform(0.8, 1.2, (steps, count, 4))
    starts, rates = np.array([0.0, 0.0, 0.5]) + rng.uniform(0, 0.3, (count, 3)), rng.normal(size=(count, 3))
    hover = np.full((count, 4), drone.hover_speed_rad_s)

    model, rotors = physics_model(drone, RIG, 1e-3), Rotors(drone)
    batch = [mujoco.MjData(model) for _ in range(count)]
    for data, position, rate in zip(batch, starts, rates, strict=True):
        data.qpos[:3], data.qvel[3:] = position, rate
    state = rotors.steady_state(hover)
    for command in commands:
        R = matrix_from_quat_wxyz(np.array([data.qpos[3:] for data in batch]))
        twist = np.array([data.qvel for data in batch])
        heights = np.array([data.qpos[2] for data in batch])
        airflow = Airflow(np.einsum("nji,nj->ni", R, twist[:, :3]), twist[:, 3:], R[:, 2], heights)
        for data, wrench in zip(batch, rotors.wrench(state, airflow), strict=True):
            data.ctrl[:] = wrench
            mujoco.mj_step(model, data, 5)
        state = rotors.step(state, command, dt)

    plant = QuadrotorPlant(RIG, drone)
    for k, data in enumerate(batch):
        plant.reset(pose_matrix(np.eye(3), starts[k]), rate_rad_s=rates[k], rotor_speeds_rad_s=hover[k])
        for command in commands[:, k]:
            plant.advance(plant.t_ns + plant.interval_ns, command)
        motion = plant.motion()
        np.testing.assert_allclose(data.qpos, motion.pose[-1], atol=1e-11)
        np.testing.assert_allclose(data.qvel, motion.twist[-1], atol=1e-10)
