"""The control loops of many vehicles against those of each alone."""

from typing import Any

import numpy as np
import pytest

from dronevio.models.quadrotor import VEHICLES
from dronevio.models.rotation import exp_so3
from dronevio.sim.paths.path import attitude
from dronevio.sim.physics.cascade import Body, Cascade, CascadeState, attitude_along
from dronevio.sim.physics.drive import Mixer
from dronevio.sim.physics.gains import Gains

COUNT = 4


def row(values: Any, k: int) -> Any:
    """Return one row of nested tuples of arrays."""
    if isinstance(values, tuple):
        return type(values)(*(row(value, k) for value in values))
    return values[k]


def bodies(rng: np.random.Generator) -> Body:
    position, velocity, rate = rng.standard_normal((3, COUNT, 3))
    return Body(position + [0.0, 0.0, 4.0], exp_so3(0.3 * rng.standard_normal((COUNT, 3))), velocity, rate)


def stepped(
    cascade: Cascade, state: CascadeState, body: Body, wanted: np.ndarray, yaw: np.ndarray | float
) -> tuple[np.ndarray, CascadeState]:
    """Return commands and state after one call of all stages, with the position, velocity and rates in ``wanted``."""
    position, velocity, rate = wanted[..., 0, :], wanted[..., 1, :], wanted[..., 2, :]
    loads = cascade.loads(state, body)
    state = cascade.observe(state, body, loads)
    force = cascade.specific_force(state, body, position, velocity, 0.1 * velocity)
    acceleration = cascade.angular_acceleration(state, body, attitude_along(force, yaw), rate, 0.1 * rate)
    return cascade.commands(state, loads, 1.5 * np.vecdot(force, body.R_world_vehicle[..., 2]), acceleration)


@pytest.mark.parametrize("name", VEHICLES)
def test_rows_equal_single_vehicles(name: str) -> None:
    drone, rng = VEHICLES[name], np.random.default_rng(0)
    cascade, body = Cascade(drone, Gains(), 5e-3), bodies(rng)
    state = cascade.at(drone.hover_speed_rad_s * rng.uniform(0.5, 1.0, (COUNT, 4)), body.velocity_m_s, body.rate_rad_s)
    singles = [row(state, k) for k in range(COUNT)]
    for _ in range(5):
        body, wanted, yaw = bodies(rng), rng.standard_normal((COUNT, 3, 3)), rng.uniform(-3.0, 3.0, COUNT)
        commands, state = stepped(cascade, state, body, wanted, yaw)
        for k in range(COUNT):
            command, singles[k] = stepped(cascade, singles[k], row(body, k), wanted[k], float(yaw[k]))
            np.testing.assert_allclose(commands[k], command, rtol=1e-9)
            np.testing.assert_allclose(state.force.disturbance[k], singles[k].force.disturbance, rtol=1e-9)
            np.testing.assert_allclose(state.torque.disturbance[k], singles[k].torque.disturbance, rtol=1e-9)


def test_mixer_rows_equal_single_calls_beyond_the_limits() -> None:
    rng, mixer = np.random.default_rng(1), Mixer(VEHICLES["research"])
    thrust, torque = rng.uniform(-50.0, 200.0, (5, 20)), 5.0 * rng.standard_normal((5, 20, 3))
    speeds = mixer.speeds(thrust, torque)
    for index in np.ndindex(5, 20):
        np.testing.assert_allclose(speeds[index], mixer.speeds(thrust[index], torque[index]), rtol=1e-12)


def test_attitudes_of_any_shape() -> None:
    rng = np.random.default_rng(2)
    force, yaw = rng.standard_normal((6, 3)), rng.uniform(-3.0, 3.0, 6)
    np.testing.assert_allclose(attitude_along(force, yaw), attitude(force, yaw), atol=1e-12)
    np.testing.assert_allclose(attitude_along(force[0], float(yaw[0])), attitude(force, yaw)[0], atol=1e-12)


def test_rates_alone_leave_the_attitude_free() -> None:
    cascade, body = Cascade(VEHICLES["research"], Gains(), 5e-3), bodies(np.random.default_rng(3))
    state = cascade.at(np.full((COUNT, 4), 500.0), body.velocity_m_s, body.rate_rad_s)
    steady = cascade.angular_acceleration(state, body, body.R_world_vehicle, body.rate_rad_s)
    np.testing.assert_allclose(steady, 0.0, atol=1e-12)
    rate = body.rate_rad_s + [0.1, 0.0, 0.0]
    faster = cascade.angular_acceleration(state, body, body.R_world_vehicle, rate) + np.cross(body.rate_rad_s, rate)
    np.testing.assert_allclose(faster, np.tile([0.1 * Gains().tilt_rate_per_s, 0.0, 0.0], (COUNT, 1)), atol=1e-12)
