"""A flight: physics, controller and IMU from take-off to landing; the images are rendered from it afterwards."""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from dronevio.models.errors import ConfigError
from dronevio.models.imu import ImuConstants, ImuSamples, Times
from dronevio.models.progress import Progress, silent
from dronevio.models.state import Trajectory
from dronevio.sim.controller import SE3Controller
from dronevio.sim.imu import ImuErrors
from dronevio.sim.interpolation import interpolated_poses
from dronevio.sim.path import Reference, plan_reference
from dronevio.sim.plant import QuadrotorPlant
from dronevio.sim.scenario import Scenario
from dronevio.sim.vibration import RotorTones
from dronevio.sim.world import place_of

Array = npt.NDArray[np.float64]

_REPORT_EVERY = 100  # control steps between two reports of progress


@dataclass(frozen=True, eq=False)
class Flight:
    """What was flown and what the IMU sensed; everything but the images."""

    scenario: Scenario
    """What was to be flown."""
    imu: ImuSamples
    """What the IMU measured, with its errors: points at its rate, from t = 0 to the end."""
    truth: Trajectory
    """The IMU's true motion at each of its time stamps, with velocity and the true biases."""
    frame_times_ns: Times
    """(M,) When the camera exposes [ns], from t = 0."""
    Ts_world_cam: Array
    """(M, 4, 4) True poses of the main camera at those times."""
    reference: Reference
    """The path that the controller was given."""
    perfect_imu: ImuSamples
    """What a perfect IMU would have read, at the time stamps of ``imu``."""
    imu_constants: ImuConstants
    """What is constant of the IMU's errors: scale, misalignment, g-sensitivity and the biases at switch-on."""


def reference_of(scenario: Scenario, plant: QuadrotorPlant) -> Reference:
    """Return the path of a scenario on the plant's clock.

    Raises:
        ConfigError: There is no such world, or the plan does not fit into it.
    """
    place = place_of(scenario.world, scenario.seed)
    return plan_reference(scenario.plan, place, plant.standing_height_m, plant.interval_ns, scenario.generator("path"))


def fly(scenario: Scenario, progress: Progress = silent) -> Flight:
    """Fly a scenario: the controller follows the path by the true state.

    Args:
        scenario: What to fly.
        progress: Hears of the control steps done.

    Returns:
        The flight; the same scenario gives the same bytes.

    Raises:
        ConfigError: The scenario does not fit together.
    """
    plant = QuadrotorPlant(scenario.rig, scenario.quadrotor)
    reference = reference_of(scenario, plant)
    controller = SE3Controller(reference, scenario.rig.T_vehicle_imu, scenario.quadrotor)
    steps = len(reference) - 1
    for step in range(steps):
        if step % _REPORT_EVERY == 0:
            progress(step, steps)
        plant.advance(plant.t_ns + plant.interval_ns, controller.command(plant.state(), plant.t_ns))
    progress(steps, steps)
    motion = plant.motion()
    perfect = motion.points(scenario.rig.T_vehicle_imu, plant.interval_s)
    rng = scenario.generator("imu")
    vibration = RotorTones(scenario.quadrotor, scenario.rig, rng.spawn(1)[0])
    errors = ImuErrors(scenario.rig.imu, rng, vibration)
    imu, gyro_bias, accel_bias = errors.add_to(perfect, motion.rotor_speeds_rad_s)
    truth = replace(
        motion.trajectory(scenario.rig.T_vehicle_imu), gyro_bias_rad_s=gyro_bias, accel_bias_m_s2=accel_bias
    )
    frame_times_ns, Ts_world_cam = _camera_poses(scenario, truth)
    return Flight(scenario, imu, truth, frame_times_ns, Ts_world_cam, reference, perfect, errors.constants)


def _camera_poses(scenario: Scenario, truth: Trajectory) -> tuple[Times, Array]:
    """Return the frames' time stamps (M,) [ns] and the main camera's poses (M, 4, 4) when they were really taken.

    Raises:
        ConfigError: The rig has no camera.
    """
    if not scenario.rig.cameras:
        raise ConfigError("rig without a camera; expected one at least")
    camera = scenario.rig.cameras[0]
    interval_ns = round(1e9 / camera.rate_hz)
    stamps_ns = np.arange(0, int(truth.t_ns[-1]), interval_ns, dtype=np.int64)
    taken_ns = stamps_ns + round(scenario.rig.time_offset_s * 1e9)
    seen = (taken_ns >= truth.t_ns[0]) & (taken_ns <= truth.t_ns[-1])
    return stamps_ns[seen], interpolated_poses(truth, taken_ns[seen]) @ camera.T_imu_cam
