"""Vehicles with any number of rotors: wrench, ground effect, allocation, bodies, flights; and results of before."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import mujoco
import numpy as np
import numpy.typing as npt
import pytest

import dronevio.envs  # noqa: F401 registers the environments
from dronevio.models.battery import Battery
from dronevio.models.errors import ConfigError, InputError
from dronevio.models.quadrotor import NANO, RESEARCH, Quadrotor
from dronevio.models.rig import euroc_rig
from dronevio.models.rotation import exp_so3, pose_matrix, rotation_z
from dronevio.models.rotors import ARRANGEMENTS, Rotor
from dronevio.models.vehicles import check_vehicle
from dronevio.models.vibration import EUROC_VIBRATION
from dronevio.sim.flight import fly
from dronevio.sim.inertial.batch_vibration import BatchHarmonics
from dronevio.sim.physics.batch_plant import BatchPlant
from dronevio.sim.physics.collisions import COLLISION_GROUP
from dronevio.sim.physics.drive import Mixer
from dronevio.sim.physics.ground_effect import GroundEffect
from dronevio.sim.physics.plant import QuadrotorPlant
from dronevio.sim.physics.rotors import Airflow, MotorFailure, Rotors
from dronevio.sim.physics.vehicle import physics_model, quadrotor_spec
from dronevio.sim.physics.vehicle_states import VehicleStates
from dronevio.sim.scenarios import scenario_named

RIG = euroc_rig()
HEXA = Quadrotor(
    mass_kg=3.2,
    inertia_kg_m2=(0.055, 0.055, 0.100),
    rotors="hexa-x",
    arm_m=0.30,
    rotor_height_m=0.04,
    battery=Battery(4, 8.0, 0.02),
)
OCTO = Quadrotor(  # 9 kg with 15-inch propellers, whose rotors take 60 ms to follow a command
    mass_kg=9.0,
    inertia_kg_m2=(0.45, 0.45, 0.80),
    rotors="octo-plus",
    arm_m=0.55,
    rotor_height_m=0.08,
    thrust_n_per_rad2_s2=4.3e-5,
    torque_nm_per_rad2_s2=1.0e-6,
    drag_n_s2_per_rad_m=2.7e-4,
    inflow_n_s2_per_rad_m=1.1e-3,
    rotor_radius_m=0.19,
    rotor_speed_max_rad_s=740.0,
    rotor_speed_per_v=37.0,
    rotor_time_constant_s=0.06,
    rotor_inertia_kg_m2=3.0e-4,
    battery=Battery(6, 16.0, 0.012),
    drag_area_m2=(0.06, 0.06, 0.15),
)
COAXIAL = replace(
    HEXA,
    rotors=tuple(
        Rotor((x, y, z), "ccw" if x * y * (z - 0.02) > 0.0 else "cw")
        for z in (0.05, -0.02)
        for x, y in ((0.25, 0.2), (-0.25, 0.2), (-0.25, -0.2), (0.25, -0.2))
    ),
)
VEHICLES = {"hexa": HEXA, "octo": OCTO, "coaxial": COAXIAL, "quad-plus": replace(RESEARCH, rotors="quad-plus")}
HIGH = pose_matrix(np.eye(3), np.array([0.0, 0.0, 50.0]))


@pytest.mark.parametrize("drone", VEHICLES.values(), ids=VEHICLES)
def test_the_wrench_is_the_sum_of_the_rotors(drone: Quadrotor) -> None:
    rng, inertia = np.random.default_rng(0), drone.rotor_inertia_kg_m2
    state = Rotors(drone).steady_state(drone.hover_speed_rad_s * rng.uniform(0.7, 1.2, drone.rotor_count))
    state = replace(state, acceleration_rad_s2=rng.normal(0.0, 300.0, drone.rotor_count))
    velocity, rate = rng.normal(size=3), rng.normal(size=3)
    force, torque = np.zeros(3), np.zeros(3)
    for place, turns, speed, change in zip(
        drone.rotor_positions_m, drone.rotor_directions, state.speed_rad_s, state.acceleration_rad_s2, strict=True
    ):
        u, v, w = velocity + np.cross(rate, place)
        across, along = drone.drag_n_s2_per_rad_m, drone.inflow_n_s2_per_rad_m
        thrust = drone.thrust_n_per_rad2_s2 * speed**2 - along * speed * w
        on_hub = np.array([-across * speed * u, -across * speed * v, thrust])
        force += on_hub
        drag_nm = drone.torque_nm_per_rad2_s2 * speed**2 + inertia * change
        torque += np.cross(place, on_hub) - [0.0, 0.0, turns * drag_nm]
        torque -= np.cross(rate, [0.0, 0.0, inertia * turns * speed])
    force -= 0.5 * 1.225 * np.array(drone.drag_area_m2) * np.linalg.norm(velocity) * velocity
    still = Airflow(velocity, rate, np.array([0.0, 0.0, 1.0]), np.array(1e6))
    np.testing.assert_allclose(Rotors(drone).wrench(state, still), [*force, *torque], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("drone", [RESEARCH, *VEHICLES.values()], ids=["research", *VEHICLES])
def test_ground_effect_sums_the_images_of_all_rotors(drone: Quadrotor) -> None:
    R, places = drone.rotor_radius_m, drone.rotor_positions_m
    height = 1.3 * R + places[:, 2] - places[:, 2].min()
    expected = []
    for place, z in zip(places, height, strict=True):
        images = sum(0.5 * z * R**2 / (np.sum((place - other)[:2] ** 2) + 4.0 * z**2) ** 1.5 for other in places)
        expected.append(1.0 / (1.0 - images))
    np.testing.assert_allclose(GroundEffect(drone).ratio(height), expected, rtol=1e-9)
    centre = np.array([height[0] - places[0, 2]])
    np.testing.assert_allclose(GroundEffect(drone).mean_ratio(centre), [np.mean(expected)], rtol=1e-9)


@pytest.mark.parametrize("drone", VEHICLES.values(), ids=VEHICLES)
def test_mixer_gives_what_is_asked_for_within_the_range_of_the_rotors(drone: Quadrotor) -> None:
    mixer, rng, weight_n = Mixer(drone), np.random.default_rng(0), 9.81 * drone.mass_kg
    arm_nm = weight_n * drone.reach_m
    for thrust in (0.8, 1.0, 1.2):
        torque = arm_nm * rng.uniform(-1.0, 1.0, 3) * [0.05, 0.05, 0.002]
        wrench = drone.allocation @ mixer.speeds(thrust * weight_n, torque) ** 2
        np.testing.assert_allclose(wrench, [thrust * weight_n, *torque], rtol=1e-9, atol=1e-9)
    excessive = mixer.speeds(rng.uniform(-1.0, 5.0, 100) * weight_n, arm_nm * rng.normal(size=(100, 3)))
    assert excessive.shape == (100, drone.rotor_count)
    assert excessive.min() >= 0.1 * drone.rotor_speed_max_rad_s * (1.0 - 1e-9)
    assert excessive.max() <= drone.rotor_speed_max_rad_s * (1.0 + 1e-9)


def test_quad_plus_flies_as_quad_x_turned_by_45_degrees() -> None:
    """The same speeds in the same order, in wind and near the ground, of frames that differ by 45° of yaw."""
    commands = RESEARCH.hover_speed_rad_s * np.random.default_rng(0).uniform(0.9, 1.1, (40, 4))
    reached = []
    for name, yaw in (("quad-x", 0.0), ("quad-plus", np.pi / 4)):
        plant = QuadrotorPlant(RIG, replace(RESEARCH, rotors=name))
        R = exp_so3(np.array([0.2, -0.1, 0.3])) @ rotation_z(np.asarray(yaw))
        start = pose_matrix(R, np.array([0.0, 0.0, 0.6]))
        plant.reset(start, np.array([1.0, -2.0, 0.5]), R.T @ [0.5, -0.4, 0.3], commands[0])
        for command in commands:
            plant.advance(plant.t_ns + plant.interval_ns, command)
        reached.append(plant.vehicle_state())
    x, plus = reached
    np.testing.assert_allclose(plus.T_world_imu[:3, 3], x.T_world_imu[:3, 3], atol=1e-9)
    turned = x.T_world_imu[:3, :3] @ rotation_z(np.asarray(np.pi / 4))
    np.testing.assert_allclose(plus.T_world_imu[:3, :3], turned, atol=1e-9)
    np.testing.assert_allclose(plus.velocity_m_s, x.velocity_m_s, atol=1e-9)


@pytest.mark.parametrize("drone", VEHICLES.values(), ids=VEHICLES)
def test_generated_bodies_have_the_stated_mass_and_stand_on_their_feet(drone: Quadrotor) -> None:
    check_vehicle(drone)
    model = physics_model(drone, RIG, 1e-3)
    body = model.body("quadrotor")
    assert body.mass == drone.mass_kg
    np.testing.assert_allclose(body.inertia, drone.inertia_kg_m2)
    np.testing.assert_allclose(body.ipos, 0.0)
    assert model.nu == 6
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    for k, place in enumerate(drone.rotor_positions_m):
        for part in (data.site(f"rotor_{k}").xpos, data.geom(f"propeller_{k}").xpos):
            np.testing.assert_allclose(part - data.body("quadrotor").xpos, place, atol=1e-12)
    plant = QuadrotorPlant(RIG, drone)
    plant.advance(10**9, np.zeros(drone.rotor_count))
    assert plant.collision is None
    T = plant.vehicle_state().T_world_imu
    np.testing.assert_allclose(T[:3, :3], np.eye(3), atol=1e-4)
    assert 0.4 * drone.reach_m < T[2, 3] == pytest.approx(plant.standing_height_m, rel=1e-3)
    resting = plant.motion().points(RIG.T_vehicle_imu, plant.interval_s).accel_m_s2[-1]
    np.testing.assert_allclose(RIG.T_vehicle_imu[:3, :3] @ resting, [0.0, 0.0, 9.81], atol=0.02)


def test_a_fall_on_the_propellers_of_a_generated_body_is_a_collision() -> None:
    plant = QuadrotorPlant(RIG, HEXA)
    plant.reset(pose_matrix(exp_so3(np.array([np.pi, 0.0, 0.0])), np.array([0.0, 0.0, 0.3])))
    plant.advance(10**9, np.zeros(6))
    assert plant.collision is not None and plant.collision.part.startswith(("propeller_", "body", "arm_"))


@pytest.mark.parametrize("drone", [HEXA, COAXIAL], ids=["hexa", "coaxial"])
def test_a_batch_equals_single_vehicles(drone: Quadrotor) -> None:
    rng, count = np.random.default_rng(0), 2
    speeds = drone.hover_speed_rad_s * rng.uniform(0.8, 1.2, (count, drone.rotor_count))
    states = VehicleStates.at(
        rng.uniform(0.6, 2.0, (count, 3)),
        exp_so3(0.3 * rng.standard_normal((count, 3))),
        rng.standard_normal((count, 3)),
        rng.standard_normal((count, 3)),
        speeds,
        rotors=drone.rotor_count,
    )
    commands = drone.hover_speed_rad_s * rng.uniform(0.9, 1.1, (50, count, drone.rotor_count))
    batch = BatchPlant(count, RIG, drone)
    batch.reset(np.ones(count, dtype=bool), states)
    for command in commands:
        batch.advance(command)
    for k in range(count):
        single = QuadrotorPlant(RIG, drone)
        pose = pose_matrix(states.R_world_vehicle[k], states.position_m[k])
        single.reset(pose, states.velocity_m_s[k], states.rate_rad_s[k], speeds[k])
        for command in commands:
            single.advance(single.t_ns + single.interval_ns, command[k])
        T = single.vehicle_state().T_world_imu
        np.testing.assert_allclose(batch.states.position_m[k], T[:3, 3], atol=1e-9)
        np.testing.assert_allclose(batch.states.R_world_vehicle[k], T[:3, :3], atol=1e-9)
        np.testing.assert_allclose(batch.states.rotor_speed_rad_s[k], single.rotor_speeds_rad_s, atol=1e-9)


@pytest.mark.parametrize("action", ["rotors", "rates", "velocity"])
def test_environments_fly_a_hexacopter(action: str) -> None:
    observed = ("position", "rate", "rotors", "imu", "last_action")
    arguments: dict[str, Any] = {
        "vehicle": replace(HEXA, vibration=EUROC_VIBRATION),
        "action": action,
        "observations": observed,
    }
    one = gymnasium.make("dronevio/Hover-v0", **arguments)
    many = gymnasium.make_vec("dronevio/Hover-v0", num_envs=1, **arguments)
    numbers = 6 if action == "rotors" else 4
    assert one.action_space == gymnasium.spaces.Box(-1.0, 1.0, (numbers,), np.float32)
    seen: dict[str, npt.NDArray[np.float32]] = one.reset(seed=3)[0]
    assert (seen["rotors"].shape, seen["last_action"].shape) == ((6,), (numbers,))
    many.reset(seed=3)
    for k in range(25):
        chosen = np.random.default_rng(k).uniform(-0.1, 0.1, numbers).astype(np.float32)
        seen, reward, terminated, *_ = one.step(chosen)
        together, rewards, *_ = many.step(chosen[None])
        assert not terminated
        assert reward == rewards[0]
        for name in observed:
            np.testing.assert_array_equal(seen[name], together[name][0])
    with pytest.raises(ConfigError, match=rf"expected \({numbers},\)"):
        one.step(np.zeros(5, np.float32))


def test_an_environment_refuses_a_vehicle_that_cannot_fly() -> None:
    with pytest.raises(ConfigError, match="thrust-to-weight ratio of 0"):
        gymnasium.make("dronevio/Hover-v0", vehicle=replace(HEXA, mass_kg=20.0))


@pytest.mark.parametrize("drone", [HEXA, OCTO, COAXIAL], ids=["hexa", "octo", "coaxial"])
def test_multirotors_of_several_sizes_take_off_follow_waypoints_and_land(drone: Quadrotor) -> None:
    room = scenario_named("room", 0)
    plan = replace(room.plan, waypoints=room.plan.waypoints[:2], initial_rest_s=0.5, tour_s=5.0)
    flight = fly(replace(room, quadrotor=drone, plan=plan))
    assert flight.collision is None
    truth, reference = flight.truth, flight.reference
    T = truth.Ts_world_imu @ np.linalg.inv(flight.true_rig.T_vehicle_imu)
    wanted = np.array([reference.point(t_ns).position_m for t_ns in truth.t_ns.tolist()])
    error_m = np.linalg.norm(T[:, :3, 3] - wanted, axis=1)
    assert np.ptp(wanted, axis=0).max() > 1.0
    assert np.sqrt(np.mean(error_m**2)) < 0.02
    assert error_m.max() < 0.06


def test_vibration_of_six_rotors() -> None:
    """At rest there is none; a batch equals the sum of sines by hand for an imbalance."""
    drone = replace(HEXA, vibration=replace(EUROC_VIBRATION, blade_pass_m=0.0, blade_pass_rad=0.0, imbalance_rad=0.0))
    rig = replace(RIG, imu=replace(RIG.imu, accel_bandwidth_hz=1e9), T_vehicle_imu=np.eye(4))
    tones = BatchHarmonics(drone, rig, 1)
    tones.renew(np.array([0]), np.random.default_rng(0))
    np.testing.assert_array_equal(tones.first(None, np.array([0])), np.zeros((1, 6)))
    speeds = np.linspace(300.0, 500.0, 6)
    tones.first(speeds[None], np.array([0]))
    angle = tones.state.angle_rad[0]
    swing = drone.vibration.imbalance_m * speeds**2
    expected = [np.sum(swing * np.cos(angle)), np.sum(drone.rotor_directions * swing * np.sin(angle)), 0.0]
    np.testing.assert_allclose(tones.first(speeds[None], np.array([0]))[0, 3:], expected, atol=1e-12)


def test_a_failing_rotor_must_exist() -> None:
    plant = QuadrotorPlant(RIG, HEXA, failure=MotorFailure(5, 0.0))
    plant.reset(HIGH, rotor_speeds_rad_s=np.full(6, HEXA.hover_speed_rad_s))
    plant.advance(10**8, np.full(6, HEXA.hover_speed_rad_s))
    assert np.argmin(plant.rotor_speeds_rad_s) == 5
    with pytest.raises(ConfigError, match="failure of rotor 6 of 6; expected an index from 0 to 5"):
        QuadrotorPlant(RIG, HEXA, failure=MotorFailure(6, 0.0))


OLD: dict[str, tuple[Quadrotor, list[float], list[float]]] = {
    "research": (
        RESEARCH,
        [
            *(-0.23748342128613506, 0.48032446191132355, 16.520441725560442),
            *(-0.06397440494427627, 0.15637075434825146, -0.7836776072472242),
        ],
        [619.6079303794266, 712.7330602427706, 828.7922679841133, 560.9575208056351],
    ),
    "nano": (
        NANO,
        [
            *(-0.009060775270216495, 0.018194570065399353, 0.3338914954462251),
            *(-0.0003809692921414047, 0.0008199266248521538, -0.0003866289965809661),
        ],
        [1743.6468236612027, 1999.1787268286714, 2283.396131423872, 1531.2295336036282],
    ),
}
"""Wrench and rotor speeds of allocation, by the code of before that had four rotors in a square only."""


@pytest.mark.parametrize(("drone", "wrench", "speeds"), OLD.values(), ids=OLD)
def test_quadrotors_by_name_have_the_wrench_and_allocation_of_before(
    drone: Quadrotor, wrench: list[float], speeds: list[float]
) -> None:
    rotors, hover = Rotors(drone), drone.hover_speed_rad_s
    state = rotors.steady_state(hover * np.array([0.9, 1.0, 1.1, 1.2]))
    state = rotors.step(state, hover * np.array([1.2, 1.1, 0.9, 0.8]), 0.005)
    near_ground = Airflow(
        np.array([1.0, -2.0, 0.5]),
        np.array([0.3, -0.2, 0.7]),
        np.array([0.0, 0.28, 0.96]),
        np.array(1.5 * drone.rotor_radius_m),
    )
    np.testing.assert_allclose(rotors.wrench(state, near_ground), wrench, rtol=1e-13)
    torque = drone.mass_kg * drone.arm_m * np.array([2.0, -1.0, 0.05])
    np.testing.assert_allclose(Mixer(drone).speeds(1.1 * 9.81 * drone.mass_kg, torque), speeds, rtol=1e-13)


BODY = """<mujoco><worldbody><body name="frame" pos="0 0 0.2">
  <geom type="box" size="0.1 0.1 0.05" group="3"/><geom type="box" size="0.2 0.1 0.05" group="2" mass="7"/>
  <geom name="foot_1" type="sphere" size="0.02" pos="0.1 0.1 -0.18" group="3"/>
  <geom name="foot_2" type="sphere" size="0.02" pos="-0.1 0.1 -0.18" group="3"/>
  <geom name="foot_3" type="sphere" size="0.02" pos="0 -0.1 -0.18" group="3"/>
</body></worldbody></mujoco>
"""


def with_body(folder: Path, text: str) -> Quadrotor:
    """Return a vehicle with an MJCF file of its own."""
    (folder / "body.xml").write_text(text, encoding="utf-8")
    return replace(HEXA, mjcf_file=folder / "body.xml")


def test_a_body_of_ones_own_has_the_mass_of_the_vehicle_and_stands(tmp_path: Path) -> None:
    drone = with_body(tmp_path, BODY)
    model = physics_model(drone, RIG, 1e-3)
    assert model.body("quadrotor").mass == 3.2
    np.testing.assert_allclose(model.body("quadrotor").inertia, drone.inertia_kg_m2)
    assert [model.geom(k).name for k in range(1, 5)] == ["part_0", "foot_1", "foot_2", "foot_3"]
    assert len([geom for geom in quadrotor_spec(drone, RIG).geoms if geom.group != COLLISION_GROUP]) == 1
    plant = QuadrotorPlant(RIG, drone)
    assert plant.collision is None
    assert plant.standing_height_m == pytest.approx(0.2, abs=0.02)


@pytest.mark.parametrize(
    ("old", "new", "found"),
    [
        ("<worldbody>", '<include file="other.xml"/><worldbody>', "an element <include>"),
        ("<worldbody>", "<extension/><worldbody>", "an element <extension>"),
        ("<worldbody>", '<compiler meshdir="/"/><worldbody>', "meshdir = '/'"),
        ("<worldbody>", '<asset><mesh file="../a.stl"/></asset><worldbody>', "file = '../a.stl', outside"),
        ("<mujoco>", '<!DOCTYPE m [<!ENTITY a "b">]><mujoco>', "entities"),
        ("foot_3", "leg", "fewer than 3 feet"),
        ("</worldbody>", '<geom size="1"/></worldbody>', "1 bodies and 1 geoms beside them"),
        ("</mujoco>", "", "no XML"),
        ('type="sphere"', 'type="spher"', "body.xml: "),
    ],
)
def test_bodies_that_are_not_permitted_are_refused(tmp_path: Path, old: str, new: str, found: str) -> None:
    with pytest.raises(InputError, match=found):
        quadrotor_spec(with_body(tmp_path, BODY.replace(old, new)), RIG)


@pytest.mark.parametrize("name", ARRANGEMENTS)
def test_packaged_bodies_are_for_quadrotors(name: str) -> None:
    drone = replace(RESEARCH, rotors=name, arm_m=0.4, mjcf_name="quadrotor")
    if drone.rotor_count == 4:
        assert quadrotor_spec(drone, RIG).body("quadrotor").mass == 1.5
    else:
        with pytest.raises(ConfigError, match="expected None, for a generated body"):
            quadrotor_spec(drone, RIG)
