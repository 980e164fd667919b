from dataclasses import replace

import numpy as np
import pytest

from dronevio.models.errors import ConfigError
from dronevio.models.quadrotor import VEHICLES, Quadrotor
from dronevio.models.rig import euroc_rig
from dronevio.models.rotation import exp_so3, pose_matrix
from dronevio.models.state import NavState
from dronevio.sim.paths.path import Reference
from dronevio.sim.physics.controller import SE3Controller
from dronevio.sim.physics.disturbance import DisturbanceObserver
from dronevio.sim.physics.drive import Mixer, RotorDrive
from dronevio.sim.physics.plant import QuadrotorPlant
from dronevio.sim.physics.rotors import Rotors
from dronevio.sim.physics.wind import Wind

QUAD = Quadrotor()
MIXER = Mixer(QUAD)
WEIGHT_N = QUAD.mass_kg * 9.81
LOWEST, HIGHEST = 0.1 * QUAD.rotor_speed_max_rad_s, QUAD.rotor_speed_max_rad_s
TARGET = np.array([0.0, 0.0, 20.0])


def hovering(seconds: float, yaw_rad: float = 0.0) -> Reference:
    n = round(seconds * 200) + 1
    zero = np.zeros((n, 3))
    t_ns = np.arange(n, dtype=np.int64) * 5_000_000
    return Reference(t_ns, zero + TARGET, zero, zero, np.full(n, yaw_rad), zero, zero, np.ones(n, dtype=bool))


def test_mixer_inverts_the_allocation_within_the_limits() -> None:
    rng = np.random.default_rng(0)
    for _ in range(100):
        thrust, torque = WEIGHT_N * rng.uniform(0.7, 1.5), rng.uniform(-1, 1, 3) * [0.3, 0.3, 0.03]
        wrench = QUAD.allocation @ MIXER.speeds(thrust, torque) ** 2
        np.testing.assert_allclose(wrench, [thrust, *torque], atol=1e-9)


def test_mixer_reduces_the_yaw_torque_first() -> None:
    thrust, torque = 1.5 * WEIGHT_N, np.array([0.5, -0.3, 5.0])
    wrench = QUAD.allocation @ MIXER.speeds(thrust, torque) ** 2
    np.testing.assert_allclose(wrench[:3], [thrust, 0.5, -0.3], atol=1e-9)
    assert 0.0 < wrench[3] < 5.0


def test_mixer_reduces_thrust_before_roll_and_pitch() -> None:
    for thrust in (0.0, 10.0 * WEIGHT_N):
        wrench = QUAD.allocation @ MIXER.speeds(thrust, np.array([1.0, 0.5, 0.0])) ** 2
        np.testing.assert_allclose(wrench[1:], [1.0, 0.5, 0.0], atol=1e-9)


def test_mixer_respects_the_range_of_rotor_speeds() -> None:
    rng = np.random.default_rng(1)
    for _ in range(300):
        speeds = MIXER.speeds(rng.uniform(-50, 200), rng.normal(size=3) * 20.0)
        assert np.all((speeds >= LOWEST - 1e-9) & (speeds <= HIGHEST + 1e-9))


def fly_reference(plant: QuadrotorPlant, reference: Reference, drone: Quadrotor) -> np.ndarray:
    """Fly a reference with a controller that is designed for a drone, and return the poses (N, 4, 4)."""
    controller = SE3Controller(reference, plant.rig.T_vehicle_imu, drone)
    for t_ns in reference.t_ns[:-1].tolist():
        plant.advance(t_ns + plant.interval_ns, controller.command(plant.state(), t_ns))
    return plant.motion().trajectory(np.eye(4)).Ts_world_imu


@pytest.mark.parametrize("name", VEHICLES)
@pytest.mark.parametrize("angle", [[0.9, 0.0, 0.0], [0.0, -0.9, 0.0], [0.0, 0.0, 2.5], [2.3, 0.8, 0.0]])
def test_recovers_from_any_tilt_and_heading(name: str, angle: list[float]) -> None:
    drone = VEHICLES[name]
    plant = QuadrotorPlant(euroc_rig(), drone)
    start = pose_matrix(exp_so3(np.array(angle)), TARGET + [0.5, -0.4, 0.3])
    plant.reset(start, rotor_speeds_rad_s=np.full(4, drone.hover_speed_rad_s))
    end = fly_reference(plant, hovering(6.0, yaw_rad=0.3), drone)[-1]
    np.testing.assert_allclose(end[:3, 3], TARGET, atol=0.01)
    np.testing.assert_allclose(end[:3, :3], exp_so3(np.array([0.0, 0.0, 0.3])), atol=0.01)


@pytest.mark.parametrize("name", VEHICLES)
def test_a_steady_wind_leaves_no_position_error(name: str) -> None:
    drone = VEHICLES[name]
    plant = QuadrotorPlant(euroc_rig(), drone, wind=Wind((-2.0, 3.0, 0.5)))
    plant.reset(pose_matrix(np.eye(3), TARGET), rotor_speeds_rad_s=np.full(4, drone.hover_speed_rad_s))
    end = fly_reference(plant, hovering(6.0), drone)[-1]
    np.testing.assert_allclose(end[:3, 3], TARGET, atol=2e-3)
    assert end[0, 2] > 0.02 and end[1, 2] < -0.03  # into the wind


@pytest.mark.parametrize("name", VEHICLES)
@pytest.mark.parametrize("change", [{"mass_kg": 1.15}, {"thrust_n_per_rad2_s2": 0.88}, {"rotor_time_constant_s": 1.3}])
def test_errors_of_the_vehicle_model_are_compensated(name: str, change: dict[str, float]) -> None:
    drone = VEHICLES[name]
    true = replace(drone, **{field: share * getattr(drone, field) for field, share in change.items()})
    plant = QuadrotorPlant(euroc_rig(), true)
    plant.reset(pose_matrix(np.eye(3), TARGET), rotor_speeds_rad_s=np.full(4, drone.hover_speed_rad_s))
    poses = fly_reference(plant, hovering(6.0), drone)
    np.testing.assert_allclose(poses[-1, :3, 3], TARGET, atol=5e-3)
    assert np.abs(poses[:, :3, 3] - TARGET).max() < 0.3


def test_disturbance_observer_has_its_poles_and_its_limit() -> None:
    observer, pole, disturbance_m_s2 = DisturbanceObserver(8.0, 3.0, 5e-3), 8.0, np.array([1.0, -2.0, 9.0])
    velocity, found = np.zeros(3), []
    state = observer.at(velocity)
    for _ in range(400):
        state = observer.update(state, velocity, np.array([0.0, 0.0, 0.5]))
        velocity = velocity + 5e-3 * (disturbance_m_s2 + [0.0, 0.0, 0.5])
        found.append(state.disturbance)
    t = 5e-3 * np.arange(400)
    step = 1.0 - (1.0 + pole * t) * np.exp(-pole * t)  # of a double pole
    np.testing.assert_allclose(np.array(found)[:, :2], step[:, None] * disturbance_m_s2[:2], atol=0.05)
    np.testing.assert_allclose(found[-1], [1.0, -2.0, 3.0], rtol=1e-3)


def test_lead_compensation_of_slow_rotors_only() -> None:
    for drone, compensated in ((QUAD, False), (VEHICLES["nano"], True)):
        drive, rotors = RotorDrive(drone, 0.03, 5e-3), Rotors(drone)
        model = drive.at(np.full(4, drone.hover_speed_rad_s))
        state = rotors.steady_state(model.speeds_rad_s)
        wanted = 1.05 * model.speeds_rad_s
        commands = []
        for _ in range(6):
            command, model = drive.towards(model, wanted)
            commands.append(command)
            state = rotors.step(state, commands[-1], 5e-3)
        reached = (state.speed_rad_s - drone.hover_speed_rad_s) / (0.05 * drone.hover_speed_rad_s)
        # After 30 ms, with any time constant of the rotors
        np.testing.assert_allclose(reached, 1.0 - np.exp(-1.0), rtol=1e-6)
        np.testing.assert_allclose(model.speeds_rad_s, state.speed_rad_s, rtol=1e-9)
        assert bool(np.all(commands[0] > 1.01 * wanted)) is compensated


def test_a_yaw_step_neither_overshoots_nor_lags() -> None:
    """The controller accounts for the reaction to rotor acceleration as well as for rotor drag."""
    plant = QuadrotorPlant(euroc_rig())
    plant.reset(pose_matrix(np.eye(3), TARGET), rotor_speeds_rad_s=np.full(4, QUAD.hover_speed_rad_s))
    poses = fly_reference(plant, hovering(3.0, yaw_rad=0.5), QUAD)
    yaw = np.arctan2(poses[:, 1, 0], poses[:, 0, 0])
    assert yaw.max() < 0.55
    assert yaw[200] > 0.4
    assert yaw[-1] == pytest.approx(0.5, abs=1e-3)
    np.testing.assert_allclose(poses[:, :3, 3], np.tile(TARGET, (len(poses), 1)), atol=0.02)


def test_command_at_the_target_is_hover() -> None:
    rig = euroc_rig()
    plant = QuadrotorPlant(rig)
    plant.reset(pose_matrix(np.eye(3), TARGET))
    command = SE3Controller(hovering(1.0), rig.T_vehicle_imu).command(plant.state(), 0)
    # At 20 m the ground effect is small but not zero
    np.testing.assert_allclose(command, QUAD.hover_speed_rad_s, rtol=1e-5)


def test_gyroscopic_torque_is_compensated() -> None:
    rig = euroc_rig()
    plant = QuadrotorPlant(rig)
    plant.reset(pose_matrix(np.eye(3), TARGET), rate_rad_s=np.array([2.0, 0.0, 3.0]))
    command = SE3Controller(hovering(1.0), rig.T_vehicle_imu).command(plant.state(), 0)
    x, _, z = QUAD.inertia_kg_m2
    torque = QUAD.allocation[1:] @ command**2
    np.testing.assert_allclose(torque[1], (x - z) * 2.0 * 3.0, rtol=1e-2)  # of Ω × IΩ about y, where the rate is zero
    assert torque[0] < -0.1 and torque[2] < 0.0


def test_a_state_without_rates_is_refused() -> None:
    state = NavState(0, np.eye(4), np.zeros(3), np.zeros(3), np.zeros(3))
    with pytest.raises(ConfigError, match="angular velocity"):
        SE3Controller(hovering(1.0), euroc_rig().T_vehicle_imu).command(state, 0)
