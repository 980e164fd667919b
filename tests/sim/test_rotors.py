import numpy as np

from dronevio.models.quadrotor import Quadrotor
from dronevio.sim.rotors import Rotors

QUAD = Quadrotor()
ROTORS = Rotors(QUAD)


def test_lag_is_first_order_and_independent_of_the_steps() -> None:
    start, command = np.array([0.0, 100.0, 500.0, 1000.0]), np.array([600.0, 600.0, 0.0, 1000.0])
    once = ROTORS.next_speeds(start, command, 0.03)
    often = start
    for _ in range(30):
        often = ROTORS.next_speeds(often, command, 0.001)
    np.testing.assert_allclose(once, often, rtol=1e-12)
    np.testing.assert_allclose(once, command + (start - command) * np.exp(-0.03 / QUAD.rotor_lag_s))


def test_speeds_stay_within_what_the_motors_can_do() -> None:
    speeds = np.full(4, 500.0)
    for _ in range(100):
        speeds = ROTORS.next_speeds(speeds, np.array([1e6, -1e6, 300.0, 5e3]), 0.01)
    np.testing.assert_allclose(speeds, [1000.0, 0.0, 300.0, 1000.0], atol=1e-9)


def test_many_simulations_at_once_are_the_same_as_one_by_one() -> None:
    rng = np.random.default_rng(0)
    speeds, velocity, rate = rng.uniform(0, 1000, (5, 7, 4)), rng.normal(size=(5, 7, 3)), rng.normal(size=(5, 7, 3))
    together = ROTORS.wrench(speeds, velocity, rate)
    assert together.shape == (5, 7, 6)
    for index in np.ndindex(5, 7):
        np.testing.assert_allclose(together[index], ROTORS.wrench(speeds[index], velocity[index], rate[index]))


def test_wrench_is_the_sum_of_the_forces_at_the_hubs() -> None:
    rng = np.random.default_rng(1)
    speeds, velocity, rate = rng.uniform(0, 1000, 4), rng.normal(size=3), rng.normal(size=3)
    force, torque = np.zeros(3), np.zeros(3)
    for omega, hub, spin in zip(speeds, QUAD.rotor_positions_m, QUAD.rotor_spins, strict=True):
        air = velocity + np.cross(rate, hub)
        f = QUAD.thrust_n_per_rad2_s2 * omega**2 * np.array([0, 0, 1.0])
        f -= QUAD.drag_n_s2_per_rad_m * omega * air * [1, 1, 0]
        force += f
        torque += np.cross(hub, f) - [0, 0, spin * QUAD.torque_nm_per_rad2_s2 * omega**2]
    np.testing.assert_allclose(ROTORS.wrench(speeds, velocity, rate), np.concatenate([force, torque]))


def test_drag_only_ever_takes_energy() -> None:
    rng = np.random.default_rng(2)
    speeds, velocity, rate = np.full((100, 4), 600.0), rng.normal(size=(100, 3)), rng.normal(size=(100, 3))
    drag = ROTORS.wrench(speeds, velocity, rate) - ROTORS.wrench(speeds, 0 * velocity, 0 * rate)
    power = np.sum(drag * np.hstack([velocity, rate]), axis=1)
    assert np.all(power < 0.0)
