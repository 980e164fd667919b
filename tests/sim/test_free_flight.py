"""Free flight against exact solutions, conservation laws, an independent integrator and MuJoCo."""

import mujoco
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from dronevio.models.arrays import Array
from dronevio.models.imu import GRAVITY_M_S2
from dronevio.models.quadrotor import RESEARCH
from dronevio.models.rig import euroc_rig
from dronevio.models.rotation import matrix_from_quat_wxyz, skew
from dronevio.sim.physics.contact_simulation import ContactSimulation, body_constants, moved_ahead
from dronevio.sim.physics.free_flight import FreeFlight, diverging
from dronevio.sim.physics.vehicle import physics_model, physics_spec
from dronevio.sim.physics.vehicle_states import VehicleParameters

INTERVAL_S = 5e-3


def drawn(count: int, rate_rad_s: float, seed: int = 0) -> tuple[Array, Array, VehicleParameters]:
    """Return motion (13, n), wrench (n, 6) and parameters of vehicles far above the ground."""
    rng = np.random.default_rng(seed)
    motion = rng.standard_normal((13, count))
    motion[2] += 100.0
    motion[3:7] /= np.linalg.norm(motion[3:7], axis=0)
    motion[10:] *= rate_rad_s / np.linalg.norm(motion[10:], axis=0)
    wrench = rng.standard_normal((count, 6)) * [1.0, 1.0, 5.0, 0.02, 0.02, 0.01] + [0.0, 0.0, 15.0, 0.0, 0.0, 0.0]
    nominal = VehicleParameters.of(RESEARCH, count)
    factors = rng.uniform(0.8, 1.2, (count, 4))
    scales = nominal.rotor_time_constant_s, nominal.thrust_scale, nominal.drag_scale
    return (
        motion,
        wrench,
        VehicleParameters(factors[:, 0] * nominal.mass_kg, factors[:, 1:] * nominal.inertia_kg_m2, *scales),
    )


def derivative(_: float, state: Array, wrench: Array, mass_kg: float, inertia: Array) -> Array:
    """Return the time derivative of position, rotation matrix, velocity and angular velocity (18,) of one vehicle."""
    R, v, rate = state[3:12].reshape(3, 3), state[12:15], state[15:]
    accel = R @ wrench[:3] / mass_kg - [0.0, 0.0, GRAVITY_M_S2]
    turning = (wrench[3:] - np.cross(rate, inertia * rate)) / inertia
    return np.concatenate([v, (R @ skew(rate)).ravel(), accel, turning])


def flown(motion: Array, wrench: Array, vehicles: VehicleParameters, duration_s: float, interval_s: float) -> Array:
    flight = FreeFlight(interval_s)
    for _ in range(round(duration_s / interval_s)):
        motion = flight.run(motion, wrench, vehicles).end
    return motion


@pytest.mark.parametrize(("rate_rad_s", "bound"), [(1.0, 1e-10), (10.0, 1e-7), (30.0, 1e-5)])
def test_it_agrees_with_an_integrator_of_order_eight_and_is_of_fourth_order(rate_rad_s: float, bound: float) -> None:
    motion, wrench, vehicles = drawn(3, rate_rad_s)
    errors = []
    for interval_s in (INTERVAL_S, 0.5 * INTERVAL_S):
        found, error = flown(motion, wrench, vehicles, 0.5, interval_s), 0.0
        for k in range(3):
            R = matrix_from_quat_wxyz(motion[3:7, k])
            start = np.concatenate([motion[:3, k], R.ravel(), motion[7:, k]])
            body = wrench[k], vehicles.mass_kg[k], vehicles.inertia_kg_m2[k]
            solved = solve_ivp(derivative, (0.0, 0.5), start, "DOP853", args=body, rtol=1e-12, atol=1e-13).y[:, -1]
            R = matrix_from_quat_wxyz(found[3:7, k])
            reached = np.concatenate([found[:3, k], R.ravel(), found[7:, k]])
            error = max(error, float(np.abs(reached - solved).max()))
        errors.append(error)
    assert errors[0] < bound
    assert errors[1] < errors[0] / 12.0 or errors[1] < 1e-11


def test_a_body_without_forces_keeps_energy_and_angular_momentum() -> None:
    motion, wrench, vehicles = drawn(50, 10.0)
    inertia = vehicles.inertia_kg_m2.T
    after = flown(motion, np.zeros_like(wrench), vehicles, 1.4, INTERVAL_S)
    energy = [0.5 * (inertia * each[10:] ** 2).sum(axis=0) for each in (motion, after)]
    np.testing.assert_allclose(energy[1], energy[0], rtol=1e-6)  # MuJoCo's Euler integrator at 1 kHz errs by 1 %
    turned = [matrix_from_quat_wxyz(each[3:7].T) for each in (motion, after)]
    momentum = [
        (R @ (inertia * each[10:]).T[..., None])[..., 0] for R, each in zip(turned, (motion, after), strict=True)
    ]
    np.testing.assert_allclose(momentum[1], momentum[0], atol=1e-6 * np.abs(momentum[0]).max())
    np.testing.assert_allclose(after[:2], motion[:2] + 1.4 * motion[7:9], atol=1e-9)
    fallen = motion[2] + 1.4 * motion[9] - 0.5 * GRAVITY_M_S2 * 1.4**2
    np.testing.assert_allclose(after[2], fallen, atol=1e-9)


def test_a_rotation_about_a_principal_axis_and_a_rotating_thrust_are_exact() -> None:
    motion, wrench, vehicles = drawn(1, 1.0)
    motion[:, 0] = [0, 0, 100, 1, 0, 0, 0, 0, 0, 0, 0, 0, 2.0]
    wrench[0] = [3.0, 0, 0, 0, 0, 0]
    after, a = flown(motion, wrench, vehicles, 1.0, INTERVAL_S), 3.0 / vehicles.mass_kg[0]
    np.testing.assert_allclose(after[3:7, 0], [np.cos(1.0), 0, 0, np.sin(1.0)], atol=1e-12)
    np.testing.assert_allclose(after[7:9, 0], [a * np.sin(2.0) / 2.0, a * (1.0 - np.cos(2.0)) / 2.0], atol=1e-10)
    np.testing.assert_allclose(after[0, 0], a * (1.0 - np.cos(2.0)) / 4.0, atol=1e-10)


def test_a_row_does_not_depend_on_the_others() -> None:
    motion, wrench, vehicles = drawn(7, 10.0)
    together = flown(motion, wrench, vehicles, 0.5, INTERVAL_S)
    for k in range(7):
        alone = flown(motion[:, [k]], wrench[[k]], vehicles.rows(np.array([k])), 0.5, INTERVAL_S)
        np.testing.assert_allclose(alone[:, 0], together[:, k], rtol=0.0, atol=1e-12)


def test_it_agrees_with_mujocos_runge_kutta_method() -> None:
    motion, wrench, vehicles = drawn(1, 10.0)
    model = physics_model(RESEARCH, euroc_rig(), 2.5e-4)
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
    body = model.body("quadrotor").id
    model.body_mass[body], model.body_inertia[body] = vehicles.mass_kg[0], vehicles.inertia_kg_m2[0]
    data = mujoco.MjData(model)
    mujoco.mj_setConst(model, data)
    data.qpos[:], data.qvel[:], data.ctrl[:] = motion[:7, 0], motion[7:, 0], wrench[0]
    mujoco.mj_step(model, data, 2000)
    found = flown(motion, wrench, vehicles, 0.5, INTERVAL_S)
    np.testing.assert_allclose(found[:, 0], np.concatenate([data.qpos, data.qvel]), atol=1e-6)


def test_an_interval_in_mujoco_ends_where_free_flight_ends() -> None:
    motion, wrench, vehicles = drawn(20, 2.0)
    errors = []
    for steps in (5, 20):
        spec = physics_spec(RESEARCH, euroc_rig(), INTERVAL_S / steps)
        contacts = ContactSimulation(spec, 20, steps, nthread=1).run(motion, wrench, vehicles)
        free = FreeFlight(INTERVAL_S).run(motion, wrench, vehicles)
        assert not contacts.collided.any() and not contacts.diverged.any()
        errors.append([np.abs(contacts.end - free.end).max(), np.abs(contacts.middle - free.middle).max()])
    assert np.max(errors[0]) < 2e-4
    assert errors[1][0] < 0.3 * errors[0][0]
    assert errors[1][1] < 0.3 * errors[0][1]


def test_poses_are_moved_and_moved_back() -> None:
    motion, _, _ = drawn(5, 20.0)
    there = moved_ahead(motion, 5e-4)
    np.testing.assert_allclose(there[:3], motion[:3] + 5e-4 * motion[7:10])
    np.testing.assert_allclose(moved_ahead(there, -5e-4), motion, atol=1e-13)


def test_body_constants_are_those_of_mujoco() -> None:
    _, _, vehicles = drawn(1, 1.0)
    model = physics_model(RESEARCH, euroc_rig(), 1e-3)
    body = model.body("quadrotor").id
    before = {name: np.array(getattr(model, name)) for name in dir(model) if name.startswith(("body_", "dof_"))}
    model.body_mass[body], model.body_inertia[body] = vehicles.mass_kg[0], vehicles.inertia_kg_m2[0]
    mujoco.mj_setConst(model, mujoco.MjData(model))
    constants = body_constants(vehicles)
    for name, values in constants.items():
        np.testing.assert_allclose(values[0], getattr(model, name), rtol=1e-12, err_msg=name)
    others = [
        name for name in before if not np.array_equal(before[name], getattr(model, name)) and name not in constants
    ]
    assert others == []  # there are no further fields that depend on the vehicle


def test_divergence_is_told_and_does_not_warn() -> None:
    motion, wrench, vehicles = drawn(3, 1.0)
    wrench[1, 3] = 1e12
    motion[0, 2] = np.nan
    stepped = FreeFlight(INTERVAL_S).run(motion, wrench, vehicles)
    np.testing.assert_array_equal(stepped.diverged, [False, True, True])
    np.testing.assert_array_equal(diverging(motion), [False, False, True])
