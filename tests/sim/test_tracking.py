"""Tracking errors of the drones on a figure of eight, in calm air and in wind."""

import numpy as np
import pytest

from dronevio.models.imu import ImuModel
from dronevio.models.quadrotor import VEHICLES
from dronevio.models.rig import Rig
from dronevio.models.rotation import log_so3
from dronevio.sim.paths.path import Reference, attitude
from dronevio.sim.physics.controller import SE3Controller
from dronevio.sim.physics.plant import QuadrotorPlant
from dronevio.sim.physics.wind import CALM, Wind

RIG = Rig(cameras=(), imu=ImuModel(rate_hz=200.0))
STEP_S = 5e-3
STIFF_BREEZE = Wind((5.0, 0.0, 0.0), gusts=1.0)  # gusts of 1.1 m/s along and across, 0.6 m/s up and down
LIGHT_BREEZE = Wind((3.0, 0.0, 0.0), gusts=1.0)


def figure_of_eight(half_width_m: float, speed_m_s: float, standing_m: float, seconds: float) -> Reference:
    """Return a climb to 1.5 m, then a lemniscate with a smooth start, a crossing speed and heading along the path."""
    n = round(seconds / STEP_S)
    t = np.arange(-4, n + 4) * STEP_S
    progress = np.clip((t - 2.0) / 3.0, 0.0, 1.0)
    phase_rate = speed_m_s / (half_width_m * np.sqrt(2.0)) * progress**3 * (10.0 - 15.0 * progress + 6.0 * progress**2)
    phase = np.cumsum(phase_rate) * STEP_S
    climb = np.clip(t / 2.0, 0.0, 1.0)
    height = standing_m + (1.5 - standing_m) * climb**4 * (35.0 - 84.0 * climb + 70.0 * climb**2 - 20.0 * climb**3)
    position = np.stack([half_width_m * np.sin(phase), 0.5 * half_width_m * np.sin(2.0 * phase), height], axis=1)
    velocity, acceleration = np.gradient(position, STEP_S, axis=0), np.zeros_like(position)
    acceleration[1:-1] = (position[2:] - 2.0 * position[1:-1] + position[:-2]) / STEP_S**2
    yaw = np.unwrap(np.arctan2(np.cos(2.0 * phase), np.cos(phase)))  # the direction of the tangent, also at zero speed
    R = attitude(acceleration + [0.0, 0.0, 9.81], yaw)
    rate = np.zeros_like(position)
    rate[1:-1] = log_so3(np.swapaxes(R[:-2], 1, 2) @ R[2:]) / (2.0 * STEP_S)
    change = np.gradient(rate, STEP_S, axis=0)
    t_ns = np.arange(n, dtype=np.int64) * round(STEP_S * 1e9)
    within = slice(4, -4)
    p, v, a, yaw, rate, change = (values[within] for values in (position, velocity, acceleration, yaw, rate, change))
    return Reference(t_ns, p, v, a, yaw, rate, change, np.ones(n, dtype=bool))


@pytest.mark.slow
@pytest.mark.parametrize("name", VEHICLES)
@pytest.mark.parametrize("windy", [False, True], ids=["calm", "windy"])
@pytest.mark.parametrize(
    ("half_width_m", "speed_m_s", "limit_m"), [(2.0, 2.0, 0.10), (6.0, 5.0, 0.30)], ids=["2 m/s", "5 m/s"]
)
def test_tracking_errors_are_within_the_limits(
    name: str, windy: bool, half_width_m: float, speed_m_s: float, limit_m: float
) -> None:
    drone = VEHICLES[name]
    wind = (LIGHT_BREEZE if name == "nano" else STIFF_BREEZE) if windy else CALM
    plant = QuadrotorPlant(RIG, drone, wind=wind, rng=np.random.default_rng(0))
    reference = figure_of_eight(half_width_m, speed_m_s, plant.standing_height_m, 14.0)
    controller = SE3Controller(reference, RIG.T_vehicle_imu, drone)
    for t_ns in reference.t_ns[:-1].tolist():
        plant.advance(t_ns + plant.interval_ns, controller.command(plant.state(), t_ns))
    motion = plant.motion()
    error = np.linalg.norm(motion.pose[:, :3] - reference.position_m, axis=1)
    rms = float(np.sqrt(np.mean(error**2)))
    print(f"{name} {speed_m_s:g} m/s {'windy' if windy else 'calm'}: {rms:.3f} m RMS, at most {error.max():.3f} m")
    assert np.linalg.norm(motion.twist[:, :3], axis=1).max() > 0.97 * speed_m_s
    assert rms < (limit_m if windy else 0.12 * limit_m)
    assert error.max() < 2.5 * limit_m
    assert plant.collision is None
    if speed_m_s < 3.0 and not windy:
        expected = attitude(reference.acceleration_m_s2 + [0.0, 0.0, 9.81], reference.yaw_rad)
        # From the third second on, because the initial heading differs from the reference
        error_rad = log_so3(np.swapaxes(expected, 1, 2) @ motion.trajectory(np.eye(4)).rotations)
        assert np.degrees(np.sqrt(np.mean(error_rad[600:, 2] ** 2))) < 0.5
