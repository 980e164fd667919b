"""Simulation of a flight: physics, controller and IMU from take-off to landing. Images are rendered afterwards."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.imu import GRAVITY_M_S2, ImuConstants, ImuSamples, Times
from dronevio.models.progress import Progress, silent
from dronevio.models.protocols import Controller
from dronevio.models.quadrotor import Quadrotor
from dronevio.models.rig import Rig
from dronevio.models.rotation import pose_matrix
from dronevio.models.state import Trajectory
from dronevio.sim.cameras.interpolation import interpolated_poses
from dronevio.sim.cameras.schedule import FrameSchedule, nominal_stamps, schedule_frames
from dronevio.sim.inertial.imu import ImuErrors
from dronevio.sim.inertial.vibration import RotorHarmonics
from dronevio.sim.paths.course import Course, ReferencePoint
from dronevio.sim.paths.path import Reference, attitude, plan_reference
from dronevio.sim.physics.collisions import Collision
from dronevio.sim.physics.controller import SE3Controller
from dronevio.sim.physics.plant import QuadrotorPlant
from dronevio.sim.scenario import Scenario
from dronevio.sim.world import collision_spec, flight_area, illumination_and_movers

ControllerFactory = Callable[[Course, Array, Quadrotor], Controller]
"""Function that returns the controller of a flight, given its course, the mounting T_vehicle_imu (4, 4) and the
vehicle."""

_REPORT_EVERY = 100  # control steps between two reports of progress


@dataclass(frozen=True, eq=False)
class Flight:
    """Motion, IMU samples and frame times of a simulated flight, without images."""

    scenario: Scenario
    """The scenario that was simulated."""
    true_rig: Rig
    """The true rig; the rig of the scenario is the calibration that estimators receive."""
    imu: ImuSamples
    """Measured IMU samples with errors: point samples at the rate of the IMU, from t = 0 to the end."""
    truth: Trajectory
    """True pose, velocity and biases of the IMU at each of its time stamps."""
    schedule: FrameSchedule
    """Recorded and true times of the frames."""
    reference: Reference
    """The reference trajectory of the controller."""
    perfect_imu: ImuSamples
    """Noise-free IMU samples at the time stamps of ``imu``."""
    imu_constants: ImuConstants
    """Constant errors of the IMU: scale, misalignment, g-sensitivity and turn-on biases."""
    collision: Collision | None
    """The collision that ended the flight; None without a collision."""

    @property
    def frame_times_ns(self) -> Times:
        """(M,) Time stamps of the frames [ns]."""
        return self.schedule.stamps_ns

    @property
    def Ts_world_cam(self) -> Array:
        """(M, 4, 4) True poses T_world_cam of the first camera at the true times of its frames."""
        return interpolated_poses(self.truth, self.schedule.exposed_ns) @ self.true_rig.cameras[0].T_imu_cam

    @property
    def reference_distance_m(self) -> Array:
        """(K,) True distances of the centre of mass from the reference, at the IMU samples with turning rotors [m]."""
        T_vehicle_imu = self.true_rig.T_vehicle_imu
        lever = T_vehicle_imu[:3, :3].T @ T_vehicle_imu[:3, 3]
        position = self.truth.p_world_imu - self.truth.rotations @ lever
        rows = np.searchsorted(self.reference.t_ns, self.truth.t_ns[:-1], side="right") - 1
        apart_m = np.linalg.norm(position[:-1] - self.reference.position_m[rows], axis=1)
        return np.asarray(apart_m[self.reference.flying[rows]])


def plant_of(scenario: Scenario) -> QuadrotorPlant:
    """Return the vehicle of a scenario, at rest on the landing pad in the world and wind of the scenario."""
    return QuadrotorPlant(
        _at_control_rate(scenario.true_rig, scenario.control_rate_hz),
        scenario.quadrotor,
        surroundings=collision_spec(scenario.world, scenario.seed_of_world),
        movers=illumination_and_movers(scenario.world, scenario.seed_of_world)[1],
        pad_m=flight_area(scenario.world, scenario.seed_of_world).pad,
        wind=scenario.wind,
        failure=scenario.faults.motor_failure,
        rng=scenario.generator("wind"),
    )


def reference_of(scenario: Scenario, plant: QuadrotorPlant) -> Reference:
    """Return the reference trajectory of a scenario, sampled at the interval of the plant.

    Raises:
        ConfigError: The world is unknown, or the plan does not fit into it.
    """
    area = flight_area(scenario.world, scenario.seed_of_world)
    rng = scenario.generator("path")
    return plan_reference(
        scenario.plan, area, plant.standing_height_m, plant.interval_ns, rng, reverse=scenario.reverse
    )


def fly(scenario: Scenario, progress: Progress = silent, controller: ControllerFactory = SE3Controller) -> Flight:
    """Simulate a scenario: the controller tracks the reference with the true state until the end or a collision.

    The physics do not depend on the rate of the IMU if the scenario has a rate of the controller.

    Args:
        scenario: The scenario to simulate.
        progress: Callback that receives the number of completed control steps and their total.
        controller: Function that returns the controller, by default that of the scenarios.

    Returns:
        The flight; the same scenario gives the same bytes.

    Raises:
        ConfigError: The settings of the scenario are inconsistent.
    """
    rig = scenario.true_rig
    plant = plant_of(scenario)
    reference = reference_of(scenario, plant)
    if reference.flying[0]:
        start_in_air(plant, reference.point(0))
    control = controller(reference, rig.T_vehicle_imu, scenario.quadrotor)
    steps = len(reference) - 1
    for step in range(steps):
        if step % _REPORT_EVERY == 0:
            progress(step, steps)
        plant.advance(plant.t_ns + plant.interval_ns, control.command(plant.state(), plant.t_ns))
        if plant.collision is not None:
            break
    progress(steps, steps)
    interval_ns = round(1e9 / rig.imu.rate_hz)
    motion = plant.motion().at_interval(interval_ns)
    perfect = motion.points(rig.T_vehicle_imu, interval_ns * 1e-9)
    errors = imu_errors(scenario)
    imu, gyro_bias, accel_bias = errors.add_to(perfect, motion.rotor_speeds_rad_s)
    truth = replace(motion.trajectory(rig.T_vehicle_imu), gyro_bias_rad_s=gyro_bias, accel_bias_m_s2=accel_bias)
    schedule = frame_schedule(scenario, int(truth.t_ns[0]), int(truth.t_ns[-1]))
    return Flight(scenario, rig, imu, truth, schedule, reference, perfect, errors.constants, plant.collision)


def _at_control_rate(rig: Rig, rate_hz: float | None) -> Rig:
    """Return a rig whose IMU has the rate of the controller [Hz]; None for its own."""
    return rig if rate_hz is None else replace(rig, imu=replace(rig.imu, rate_hz=rate_hz))


def start_in_air(plant: QuadrotorPlant, start: ReferencePoint) -> None:
    """Set the vehicle to the state of the first point of a course that starts in motion."""
    force = start.acceleration_m_s2 + [0.0, 0.0, GRAVITY_M_S2]
    speed = plant.quadrotor.hover_speed_rad_s * np.sqrt(np.linalg.norm(force) / GRAVITY_M_S2)  # thrust ∝ ω²
    plant.reset(
        pose_matrix(attitude(force, np.asarray(start.yaw_rad)), start.position_m),
        start.velocity_m_s,
        start.rate_rad_s,
        np.full(plant.quadrotor.rotor_count, speed),
    )


def imu_errors(scenario: Scenario) -> ImuErrors:
    """Return the errors of the IMU of a scenario, from switch-on."""
    rng = scenario.generator("imu")
    rig = scenario.true_rig
    return ImuErrors(rig.imu, rng, RotorHarmonics(scenario.quadrotor, rig, rng.spawn(1)[0]))


def frame_schedule(scenario: Scenario, first_ns: int, last_ns: int) -> FrameSchedule:
    """Return the frame times of a scenario whose exposures are between two times [ns]."""
    rig, faults = scenario.true_rig, scenario.faults
    return schedule_frames(
        nominal_stamps(first_ns, last_ns, rig.cameras[0].rate_hz),
        scenario.generator("frames"),
        rig.time_offset_s,
        faults.stamp_jitter_s,
        faults.dropped_frames,
        faults.dark_from_s,
        faults.dark_for_s,
    ).within(first_ns, last_ns)
