import numpy as np
import pytest

from dronevio.models.errors import ConfigError
from dronevio.models.quadrotor import Quadrotor
from dronevio.models.rig import euroc_rig
from dronevio.models.rotation import exp_so3, pose_matrix
from dronevio.models.state import NavState
from dronevio.sim.controller import Mixer, SE3Controller
from dronevio.sim.path import Reference
from dronevio.sim.plant import QuadrotorPlant

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


def test_mixer_gives_what_is_asked_where_it_can() -> None:
    rng = np.random.default_rng(0)
    for _ in range(100):
        thrust, torque = WEIGHT_N * rng.uniform(0.7, 1.5), rng.uniform(-1, 1, 3) * [0.3, 0.3, 0.03]
        wrench = QUAD.allocation @ MIXER.speeds(thrust, torque) ** 2
        np.testing.assert_allclose(wrench, [thrust, *torque], atol=1e-9)


def test_mixer_gives_up_yaw_first() -> None:
    thrust, torque = 1.5 * WEIGHT_N, np.array([0.5, -0.3, 5.0])
    got = QUAD.allocation @ MIXER.speeds(thrust, torque) ** 2
    np.testing.assert_allclose(got[:3], [thrust, 0.5, -0.3], atol=1e-9)
    assert 0.0 < got[3] < 5.0


def test_mixer_gives_up_thrust_before_tilt() -> None:
    for thrust in (0.0, 10.0 * WEIGHT_N):
        got = QUAD.allocation @ MIXER.speeds(thrust, np.array([1.0, 0.5, 0.0])) ** 2
        np.testing.assert_allclose(got[1:], [1.0, 0.5, 0.0], atol=1e-9)


def test_mixer_never_leaves_the_rotors_range() -> None:
    rng = np.random.default_rng(1)
    for _ in range(300):
        speeds = MIXER.speeds(rng.uniform(-50, 200), rng.normal(size=3) * 20.0)
        assert np.all((speeds >= LOWEST - 1e-9) & (speeds <= HIGHEST + 1e-9))


@pytest.mark.parametrize("angle", [[0.9, 0.0, 0.0], [0.0, -0.9, 0.0], [0.0, 0.0, 2.5], [2.3, 0.8, 0.0]])
def test_recovers_from_any_tilt_and_heading(angle: list[float]) -> None:
    rig = euroc_rig()
    plant = QuadrotorPlant(rig)
    start = pose_matrix(exp_so3(np.array(angle)), TARGET + [0.5, -0.4, 0.3])
    plant.reset(start, rotor_speeds_rad_s=np.full(4, QUAD.hover_speed_rad_s))
    controller = SE3Controller(hovering(6.0, yaw_rad=0.3), rig.T_vehicle_imu)
    while plant.t_ns < 6_000_000_000:
        plant.advance(plant.t_ns + plant.interval_ns, controller.command(plant.state(), plant.t_ns))
    end = plant.vehicle_state().T_world_imu
    np.testing.assert_allclose(end[:3, 3], TARGET, atol=0.01)
    np.testing.assert_allclose(end[:3, :3], exp_so3(np.array([0.0, 0.0, 0.3])), atol=0.01)


def test_at_the_target_it_carries_the_weight() -> None:
    rig = euroc_rig()
    plant = QuadrotorPlant(rig)
    plant.reset(pose_matrix(np.eye(3), TARGET))
    command = SE3Controller(hovering(1.0), rig.T_vehicle_imu).command(plant.state(), 0)
    np.testing.assert_allclose(command, QUAD.hover_speed_rad_s, rtol=1e-5)  # 20 m up the ground still helps a little


def test_a_state_without_rates_is_refused() -> None:
    state = NavState(0, np.eye(4), np.zeros(3), np.zeros(3), np.zeros(3))
    with pytest.raises(ConfigError, match="angular velocity"):
        SE3Controller(hovering(1.0), euroc_rig().T_vehicle_imu).command(state, 0)
