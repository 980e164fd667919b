"""Simulation of a flight on the estimated state: physics, sensors, estimator and controller step by step.

The controller receives the output of an estimator at the IMU's rate in place of the true state. Errors of the estimate
therefore become errors of the path, and errors of the path change what the sensors measure. A flight on the true state
(`dronevio.sim.flight.fly`) has neither effect.
"""

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Protocol

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError
from dronevio.models.imu import ImuSamples
from dronevio.models.progress import Progress, silent
from dronevio.models.protocols import Controller, Estimator, exposure_delay_ns
from dronevio.models.quadrotor import Quadrotor
from dronevio.models.rotation import pose_matrix, rotation_z
from dronevio.models.state import CameraFrame, Estimate, Health, NavState, Trajectory
from dronevio.sim.cameras.interpolation import interpolated_poses
from dronevio.sim.closed_loop.estimated_state import EstimatedState
from dronevio.sim.closed_loop.frame_source import FrameSource
from dronevio.sim.closed_loop.settings import LoopSettings
from dronevio.sim.flight import (
    Flight,
    frame_schedule,
    imu_errors,
    plant_of,
    reference_of,
    start_in_air,
)
from dronevio.sim.paths.course import Course, ReferencePoint
from dronevio.sim.paths.path import Reference
from dronevio.sim.physics.controller import SE3Controller
from dronevio.sim.physics.plant import QuadrotorPlant
from dronevio.sim.scenario import Scenario

_REPORT_EVERY = 100  # control steps between two reports of progress
_WINDOW_NS = 100_000_000  # length of the motion before the middle of an exposure that its images depend on


class Pilot(Protocol):
    """Flies a vehicle while a flight is simulated."""

    @property
    def finished(self) -> bool:
        """Whether the flight ends before its course does."""

    def course(self, scenario: Scenario, plant: QuadrotorPlant) -> Course:
        """Return the course of a flight, given the vehicle at rest on its pad. It is asked for once, at the start."""

    def controller(self, course: Course, T_vehicle_imu: Array, quadrotor: Quadrotor) -> Controller:
        """Return the controller of the flight, given its course, the mounting (4, 4) of the IMU and the vehicle."""

    def add_imu(self, samples: ImuSamples) -> None:
        """Add the IMU samples since the last call."""

    def add_frame(self, frame: CameraFrame, estimate: Estimate, T_world_odom: Array | None) -> None:
        """Add a frame and its estimate, once the estimator has received the frame.

        Args:
            frame: The frame.
            estimate: Its estimate, in the frame of the odometry.
            T_world_odom: (4, 4) Pose of that frame in the world, as the states for the controller are placed; None
                before the first of them.
        """


class ReferencePilot:
    """Tracks the reference of the scenario to its end; implements `Pilot`."""

    finished = False

    def course(self, scenario: Scenario, plant: QuadrotorPlant) -> Course:
        """Return the reference of the scenario."""
        return reference_of(scenario, plant)

    def controller(self, course: Course, T_vehicle_imu: Array, quadrotor: Quadrotor) -> Controller:
        """Return the controller of the scenarios."""
        return SE3Controller(course, T_vehicle_imu, quadrotor)

    def add_imu(self, samples: ImuSamples) -> None:
        """Do nothing."""

    def add_frame(self, frame: CameraFrame, estimate: Estimate, T_world_odom: Array | None) -> None:
        """Do nothing."""


def fly_closed_loop(
    scenario: Scenario,
    estimator: Estimator,
    frames: FrameSource,
    settings: LoopSettings | None = None,
    progress: Progress = silent,
    on_frame: Callable[[CameraFrame], None] = lambda frame: None,
    pilot: Pilot | None = None,
    true_state: bool = False,
) -> Flight:
    """Simulate a scenario with an estimator, whose state the pilot receives, until the end or a collision.

    The vehicle stands on its pad, with the rotors stopped, until the estimator has a state; the pose at the start of
    the course places the estimate in the world. A scenario that starts in motion is flown on the true state until the
    first estimate, which the true pose places in the world.

    Args:
        scenario: The scenario to simulate; the estimator should have its calibrated rig.
        estimator: Estimator before its first measurement.
        frames: Renderer of the frames.
        settings: Latencies.
        progress: Callback that receives the number of completed control steps and their total.
        on_frame: Callback that receives every frame, after the estimator and before the pilot.
        pilot: Pilot of the vehicle; by default the controller of the scenarios, which tracks the reference.
        true_state: Whether the pilot receives true states instead, of commands and of frames. The estimator runs, too,
            without influence, so that flights on both states can be compared.

    Returns:
        The flight, with the reference as it was flown, including the wait on the pad. The flight ends on the pad if the
        estimator has no state within the longest wait. The same scenario and estimator give the same bytes.

    Raises:
        ConfigError: The settings of the scenario are inconsistent.
    """
    settings = settings or LoopSettings()
    _check_control_rate(scenario)
    plant, pilot = plant_of(scenario), pilot or ReferencePilot()
    course = pilot.course(scenario, plant)
    start = course.point(0)
    if start.flying:
        start_in_air(plant, start)
    estimated = EstimatedState(estimator, None if start.flying else _pose_on_pad(start, scenario))
    sensors = _Sensors(scenario, plant, frames, settings, course.end_ns)
    control = pilot.controller(course, scenario.rig.T_vehicle_imu, scenario.quadrotor)
    commands = deque([np.zeros(4)] * round(settings.command_latency_s / plant.interval_s))
    longest_wait = round(settings.max_wait_s / plant.interval_s)
    step, waited, steps = 0, 0, course.end_ns // plant.interval_ns
    tracked: list[ReferencePoint] = []

    def sense(samples: ImuSamples) -> None:
        estimator.add_imu(samples)
        pilot.add_imu(samples)

    def see(frame: CameraFrame, exposed_ns: int) -> None:
        estimate = estimator.add_frame(frame)
        on_frame(frame)
        if true_state:
            pilot.add_frame(frame, sensors.true_estimate(frame.t_ns, exposed_ns), np.eye(4))
        else:
            pilot.add_frame(frame, estimate, estimated.T_world_odom)

    sense(sensors.imu())
    while step < steps and waited <= longest_wait and plant.collision is None and not pilot.finished:
        if (step + waited) % _REPORT_EVERY == 0:
            progress(step, steps)
        for seen in sensors.frames():
            see(*seen)
        if start.flying:
            estimated.start_at(plant.state().T_world_imu)
        state = estimated.at(plant.t_ns)
        if true_state or (state is None and start.flying):
            state = plant.state()
        t_ns = step * plant.interval_ns
        point = course.point(t_ns)
        waits = state is None and point.flying
        tracked.append(tracked[-1] if waits and tracked else point)
        commands.append(np.zeros(4) if state is None else control.command(state, t_ns))
        sense(sensors.imu(commands.popleft()))
        step, waited = step + (not waits), waited + waits
    for seen in sensors.frames(end=True):
        see(*seen)
    progress(steps, steps)
    tracked.append(course.point(step * plant.interval_ns))
    return sensors.flight(Reference.of(tracked, plant.interval_ns))


def _check_control_rate(scenario: Scenario) -> None:
    """Check that the controller has the rate of the IMU, since each command follows a sample.

    Raises:
        ConfigError: The rates differ.
    """
    rate_hz, imu_rate_hz = scenario.control_rate_hz, scenario.rig.imu.rate_hz
    if rate_hz not in (None, imu_rate_hz):
        raise ConfigError(
            f"a controller at {rate_hz:g} Hz with an IMU at {imu_rate_hz:g} Hz; expected the same rate for a flight on "
            "the estimate"
        )


class _Sensors:
    """Measurements of a flight that goes on."""

    def __init__(
        self, scenario: Scenario, plant: QuadrotorPlant, frames: FrameSource, settings: LoopSettings, planned_ns: int
    ) -> None:
        self._scenario, self._plant, self._frames = scenario, plant, frames
        self._errors = imu_errors(scenario)
        self._perfect: list[ImuSamples] = []
        self._measured: list[tuple[ImuSamples, Array, Array]] = []
        self._schedule = frame_schedule(scenario, 0, planned_ns + round(settings.max_wait_s * 1e9))
        latest = np.maximum(
            self._schedule.exposed_ns + round(settings.frame_latency_s * 1e9),
            self._schedule.stamps_ns + exposure_delay_ns(scenario.rig),
        )
        self._available_ns = [
            max(frames.ready_ns(t), due)
            for t, due in zip(self._schedule.exposed_ns.tolist(), latest.tolist(), strict=True)
        ]
        self._next = 0

    def imu(self, command: Array | None = None) -> ImuSamples:
        """Apply a command (R,) for one IMU interval, if there is one, and return the new samples."""
        plant = self._plant
        perfect = plant.step_until(
            plant.t_ns + (0 if command is None else plant.interval_ns), np.zeros(4) if command is None else command
        )
        self._perfect.append(perfect)
        self._measured.append(self._errors.add_to(perfect, plant.rotor_speeds_rad_s[None]))
        return self._measured[-1][0]

    def frames(self, end: bool = False) -> Iterator[tuple[CameraFrame, int]]:
        """Yield the frames that have become available, with the true middles of their exposures [ns].

        At the end, they include those whose exposure has begun before it.
        """
        now_ns, schedule = self._plant.t_ns, self._schedule
        due_ns = schedule.exposed_ns + 1 if end else self._available_ns
        while self._next < len(schedule) and due_ns[self._next] <= now_ns:
            k, self._next = self._next, self._next + 1
            exposed_ns = int(schedule.exposed_ns[k])
            recent = self._recent(exposed_ns)
            yield self._frames.frame(int(schedule.stamps_ns[k]), exposed_ns, bool(schedule.lit[k]), recent), exposed_ns

    def true_estimate(self, t_ns: int, exposed_ns: int) -> Estimate:
        """Return the true state in the middle of an exposure [ns] in place of the estimate for a time stamp [ns]."""
        recent = self._recent(exposed_ns)
        row = max(int(np.searchsorted(recent.t_ns, exposed_ns, side="right")) - 1, 0)
        assert recent.velocity_m_s is not None
        T = interpolated_poses(recent, np.array([exposed_ns]))[0]
        state = NavState(t_ns, T, recent.velocity_m_s[row], np.zeros(3), np.zeros(3))
        return Estimate(t_ns, Health.TRACKING, state, T_map_odom=np.eye(4), exposed=state)

    def flight(self, reference: Reference) -> Flight:
        """Return the whole flight."""
        scenario, rig = self._scenario, self._scenario.true_rig
        measured, gyro_bias, accel_bias = zip(*self._measured, strict=True)
        truth = replace(
            self._plant.motion().trajectory(rig.T_vehicle_imu),
            gyro_bias_rad_s=np.concatenate(gyro_bias),
            accel_bias_m_s2=np.concatenate(accel_bias),
        )
        return Flight(
            scenario,
            rig,
            ImuSamples.concatenated(measured),
            truth,
            self._schedule[: self._next],
            reference,
            ImuSamples.concatenated(self._perfect),
            self._errors.constants,
            self._plant.collision,
        )

    def _recent(self, exposed_ns: int) -> Trajectory:
        """Return the true motion of the IMU around an exposure."""
        first = max((exposed_ns - _WINDOW_NS) // self._plant.interval_ns, 0)
        return self._plant.motion(first).trajectory(self._scenario.true_rig.T_vehicle_imu)


def _pose_on_pad(start: ReferencePoint, scenario: Scenario) -> Array:
    """Return the planned pose T_world_imu (4, 4) at the start of a course."""
    T_world_vehicle = pose_matrix(rotation_z(start.yaw_rad), start.position_m)
    return np.asarray(T_world_vehicle @ scenario.rig.T_vehicle_imu)
