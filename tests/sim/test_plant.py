from dataclasses import replace

import mujoco
import numpy as np
import pytest

from dronevio.models.errors import ConfigError
from dronevio.models.imu import ImuModel
from dronevio.models.quadrotor import ROTOR_NAMES, VEHICLES, Quadrotor
from dronevio.models.rig import Rig, euroc_rig
from dronevio.models.rotation import exp_so3, pose_matrix
from dronevio.sim.physics.plant import QuadrotorPlant

QUAD = Quadrotor()
HOVER = np.full(4, QUAD.hover_speed_rad_s)
HIGH = pose_matrix(np.eye(3), np.array([0.0, 0.0, 50.0]))
CENTRED_IMU = Rig(cameras=(), imu=ImuModel(rate_hz=200.0))
FRONT_RIGHT, REAR_LEFT, FRONT_LEFT, REAR_RIGHT = np.eye(4)
SECOND_NS = 1_000_000_000
DRAGLESS = replace(QUAD, drag_area_m2=(0.0, 0.0, 0.0))  # without drag if the rotors do not spin


@pytest.mark.parametrize("name", VEHICLES)
def test_mjcf_and_parameters_agree(name: str) -> None:
    drone = VEHICLES[name]
    model = mujoco.MjModel.from_xml_path(str(drone.mjcf))
    body = model.body("quadrotor")
    assert body.mass == drone.mass_kg
    np.testing.assert_allclose(body.inertia, drone.inertia_kg_m2)
    np.testing.assert_allclose(body.ipos, 0.0)
    for rotor, position in zip(ROTOR_NAMES, drone.rotor_positions_m, strict=True):
        np.testing.assert_allclose(model.site(rotor).pos, position, atol=1e-5)


def test_the_mass_of_the_quadrotor_is_used() -> None:
    heavy = QuadrotorPlant(euroc_rig(), replace(QUAD, mass_kg=3.0))
    heavy.reset(HIGH, rotor_speeds_rad_s=HOVER)
    accel = heavy.step_until(0, HOVER).accel_m_s2[0]
    np.testing.assert_allclose(np.linalg.norm(accel), 9.81 / 2.0, rtol=1e-3)


@pytest.mark.parametrize("name", VEHICLES)
@pytest.mark.parametrize(
    ("more", "less", "axis", "sign"),
    [
        (FRONT_LEFT + REAR_LEFT, FRONT_RIGHT + REAR_RIGHT, 0, 1),
        (REAR_LEFT + REAR_RIGHT, FRONT_LEFT + FRONT_RIGHT, 1, 1),
        (FRONT_LEFT + REAR_RIGHT, FRONT_RIGHT + REAR_LEFT, 2, 1),
        (FRONT_RIGHT + REAR_RIGHT, FRONT_LEFT + REAR_LEFT, 0, -1),
        (FRONT_LEFT + FRONT_RIGHT, REAR_LEFT + REAR_RIGHT, 1, -1),
        (FRONT_RIGHT + REAR_LEFT, FRONT_LEFT + REAR_RIGHT, 2, -1),
    ],
    ids=["roll right", "nose down", "yaw left", "roll left", "nose up", "yaw right"],
)
def test_torques_agree_with_the_gyroscope(name: str, more: np.ndarray, less: np.ndarray, axis: int, sign: int) -> None:
    plant = QuadrotorPlant(CENTRED_IMU, VEHICLES[name])
    hover = np.full(4, plant.quadrotor.hover_speed_rad_s)
    plant.reset(HIGH, rotor_speeds_rad_s=hover)
    gyro = plant.step_until(SECOND_NS // 5, hover * (1.0 + 0.03 * (more - less))).gyro_rad_s
    assert np.all(sign * gyro[3:, axis] > 0.0)
    assert sign * gyro[-1, axis] > 0.05
    assert np.all(np.abs(np.delete(gyro[-1], axis)) < 0.05 * abs(gyro[-1, axis]))
    up = plant.vehicle_state().T_world_imu[:3, :3] @ np.eye(3)[(axis + 1) % 3]
    assert sign * up[(axis + 2) % 3] > 0.0  # a right-handed rotation: y toward z, z toward x, x toward y


@pytest.mark.parametrize("name", VEHICLES)
@pytest.mark.parametrize(("share", "sign"), [(1.1, 1), (0.9, -1)])
def test_thrust_changes_velocity_and_specific_force(name: str, share: float, sign: int) -> None:
    plant = QuadrotorPlant(CENTRED_IMU, VEHICLES[name])
    hover = np.full(4, plant.quadrotor.hover_speed_rad_s)
    plant.reset(HIGH, rotor_speeds_rad_s=hover)
    accel = plant.step_until(SECOND_NS // 2, share * hover).accel_m_s2
    velocity = plant.vehicle_state().velocity_m_s
    assert sign * velocity[2] > 0.4
    assert np.all(sign * (accel[3:, 2] - 9.81) > 0.0)
    np.testing.assert_allclose(velocity[:2], 0.0, atol=1e-9)


@pytest.mark.parametrize("name", VEHICLES)
@pytest.mark.parametrize(("angle", "expected"), [([0.0, 0.2, 0.0], [1, 0]), ([0.2, 0.0, 0.0], [0, -1])])
def test_tilt_accelerates_in_its_direction(name: str, angle: list[float], expected: list[int]) -> None:
    plant = QuadrotorPlant(CENTRED_IMU, VEHICLES[name])
    hover = np.full(4, plant.quadrotor.hover_speed_rad_s)
    plant.reset(pose_matrix(exp_so3(np.array(angle)), HIGH[:3, 3]), rotor_speeds_rad_s=hover)
    plant.advance(SECOND_NS // 5, hover)
    np.testing.assert_array_equal(np.sign(np.round(plant.vehicle_state().velocity_m_s[:2], 3)), expected)


def test_hover_measures_gravity_in_the_imu_frame() -> None:
    plant = QuadrotorPlant(euroc_rig())
    plant.reset(HIGH, rotor_speeds_rad_s=HOVER)
    samples = plant.step_until(SECOND_NS, HOVER)
    assert len(samples) == 201
    # EuRoC: x is up; at a height of 50 m the ground effect is about 1e-6 of the thrust
    np.testing.assert_allclose(samples.accel_m_s2, np.tile([9.81, 0.0, 0.0], (201, 1)), atol=1e-3)
    np.testing.assert_allclose(samples.gyro_rad_s, 0.0, atol=1e-9)


def test_a_standing_drone_does_not_move() -> None:
    plant = QuadrotorPlant(euroc_rig())
    samples = plant.step_until(3 * SECOND_NS, np.zeros(4))
    np.testing.assert_allclose(samples.accel_m_s2, np.tile([9.81, 0.0, 0.0], (601, 1)), atol=1e-9)
    np.testing.assert_allclose(samples.gyro_rad_s, 0.0, atol=1e-12)
    np.testing.assert_allclose(np.ptp(plant.motion().pose, axis=0), 0.0, atol=1e-12)
    assert 0.10 < plant.standing_height_m < 0.112


def test_comes_to_rest_after_a_hard_tilted_landing() -> None:
    plant = QuadrotorPlant(euroc_rig())
    start = pose_matrix(exp_so3(np.array([0.2, -0.1, 0.5])), np.array([0.3, 0.2, 0.3]))
    plant.reset(start, velocity_m_s=np.array([0.3, 0.0, -0.5]))
    plant.advance(3 * SECOND_NS, np.zeros(4))
    samples = plant.step_until(4 * SECOND_NS, np.zeros(4))[-100:]
    np.testing.assert_allclose(samples.accel_m_s2, np.tile([9.81, 0.0, 0.0], (100, 1)), atol=1e-3)
    np.testing.assert_allclose(samples.gyro_rad_s, 0.0, atol=1e-4)


def test_free_fall_has_no_specific_force() -> None:
    plant = QuadrotorPlant(euroc_rig(), DRAGLESS)
    plant.reset(HIGH, velocity_m_s=np.array([1.0, -2.0, 3.0]))
    samples = plant.step_until(SECOND_NS, np.zeros(4))
    np.testing.assert_allclose(samples.accel_m_s2, 0.0, atol=1e-9)


def test_lever_arm_and_mounting_of_a_rotating_imu() -> None:
    rig, spin = euroc_rig(), np.array([0.0, 0.0, 4.0])
    plant = QuadrotorPlant(rig, DRAGLESS)
    plant.reset(HIGH, rate_rad_s=spin)
    samples = plant.step_until(SECOND_NS, np.zeros(4))
    R, lever = rig.T_vehicle_imu[:3, :3], rig.T_vehicle_imu[:3, 3]
    np.testing.assert_allclose(samples.gyro_rad_s @ R.T, np.tile(spin, (201, 1)), atol=1e-9)
    centripetal = np.cross(spin, np.cross(spin, lever))
    np.testing.assert_allclose(samples.accel_m_s2 @ R.T, np.tile(centripetal, (201, 1)), atol=1e-3)
    assert np.linalg.norm(centripetal) > 1.0


def test_true_velocity_is_that_of_the_imu() -> None:
    rig, spin = euroc_rig(), np.array([0.0, 0.0, 4.0])
    plant = QuadrotorPlant(rig)
    plant.reset(HIGH, rate_rad_s=spin)
    state = plant.state()
    np.testing.assert_allclose(state.velocity_m_s, np.cross(spin, rig.T_vehicle_imu[:3, 3]), atol=1e-3)


def test_samples_do_not_depend_on_the_time_steps() -> None:
    command = HOVER + [10.0, -10.0, 5.0, 0.0]
    whole, split = QuadrotorPlant(euroc_rig()), QuadrotorPlant(euroc_rig())
    for plant in (whole, split):
        plant.reset(HIGH, rotor_speeds_rad_s=HOVER)
    at_once = whole.step_until(SECOND_NS, command)
    parts = split.step_until(0, command)
    for t_ns in (1, 4_999_999, 5_000_000, 33_000_000, 640_000_000, SECOND_NS):
        parts = parts.extended(split.step_until(t_ns, command))
    np.testing.assert_array_equal(parts.t_ns, at_once.t_ns)
    np.testing.assert_array_equal(parts.gyro_rad_s, at_once.gyro_rad_s)
    np.testing.assert_array_equal(parts.accel_m_s2, at_once.accel_m_s2)


def test_a_reset_restores_the_initial_state() -> None:
    plant = QuadrotorPlant(euroc_rig())
    first = plant.step_until(SECOND_NS // 2, 1.1 * HOVER)
    plant.reset()
    again = plant.step_until(SECOND_NS // 2, 1.1 * HOVER)
    np.testing.assert_array_equal(again.accel_m_s2, first.accel_m_s2)
    np.testing.assert_array_equal(again.t_ns, first.t_ns)


@pytest.mark.parametrize("rate_hz", [100.0, 400.0, 1000.0])
def test_other_imu_rates_are_supported(rate_hz: float) -> None:
    rig = Rig(cameras=(), imu=ImuModel(rate_hz=rate_hz))
    plant = QuadrotorPlant(rig, DRAGLESS)
    plant.reset(HIGH, velocity_m_s=np.array([1.0, 0.0, 0.0]))
    samples = plant.step_until(SECOND_NS, np.zeros(4))
    assert len(samples) == rate_hz + 1
    assert samples.t_ns[-1] == SECOND_NS
    np.testing.assert_allclose(plant.vehicle_state().T_world_imu[:3, 3], [1.0, 0.0, 50.0 - 9.81 / 2.0], atol=1e-3)


def test_an_imu_slower_than_the_rotors_is_refused() -> None:
    with pytest.raises(ConfigError, match="50 Hz"):
        QuadrotorPlant(Rig(cameras=(), imu=ImuModel(rate_hz=50.0)))
