"""Re-flying: rendering images along a recorded trajectory in a simulated world.

Motion, time stamps and body frame remain those of the recording; the world is placed around the path. The IMU samples
are either the recorded ones, with their real noise, or synthesized along a smooth spline through the path.
"""

from dataclasses import dataclass, replace

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError
from dronevio.models.imu import ImuSamples, Times
from dronevio.models.rig import Rig
from dronevio.models.state import Trajectory
from dronevio.sim.cameras.schedule import FrameSchedule, schedule_frames
from dronevio.sim.inertial.imu import ImuErrors
from dronevio.sim.paths.placement import place_path
from dronevio.sim.paths.spline import SmoothMotion
from dronevio.sim.streams import generator
from dronevio.sim.world import flight_area, resolved_world
from dronevio.sim.worlds.own.names import shown_world

MARGIN_M = 0.3
"""Smallest distance between a placed path and any surface [m]; the IMU is inside the vehicle."""


@dataclass(frozen=True, eq=False)
class FlownPath:
    """A recorded trajectory with IMU samples, frame times and its placement in a simulated world."""

    rig: Rig
    """The rig that observes the path."""
    truth: Trajectory
    """Trajectory of the IMU in the world frame of the recording."""
    imu: ImuSamples
    """IMU samples from the first pose to the last."""
    schedule: FrameSchedule
    """Recorded and true times of the frames."""
    world: str
    """Name of the simulated world."""
    T_simworld_world: Array
    """(4, 4) Pose of the recording's world frame in the simulated world."""
    real_imu: bool
    """Whether the IMU samples are recorded ones."""


def refly(
    recorded: Trajectory,
    imu: ImuSamples | None,
    rig: Rig,
    world: str,
    seed: int = 0,
    margin_m: float = MARGIN_M,
) -> FlownPath:
    """Place a recorded trajectory in a simulated world.

    Args:
        recorded: Trajectory of the IMU in a world frame with z up.
        imu: Recorded IMU samples; None synthesizes samples of the rig's IMU.
        rig: The rig that observes the path.
        world: Name of the simulated world; see `dronevio.sim.world.resolved_world`.
        seed: Seed of the world and of the errors of a synthesized IMU.
        margin_m: Smallest distance between the path and any surface [m].

    Raises:
        ConfigError: The world is unknown, or its file is damaged; the path does not fit into it, is too short or has
            gaps; or path and IMU do not overlap in time.
    """
    resolved = resolved_world(world)
    space = flight_area(resolved, seed).space
    if imu is None:
        truth, samples = _synthesized(recorded, rig, seed)
    else:
        truth, samples = _shared(recorded, imu)
    stamps = frame_stamps(samples.t_ns, rig.cameras[0].rate_hz)
    schedule = schedule_frames(stamps, generator(seed, "frames"), rig.time_offset_s).within(
        int(truth.t_ns[0]), int(truth.t_ns[-1])
    )
    T_simworld_world = place_path(truth.p_world_imu, space, margin_m, shown_world(world))
    return FlownPath(rig, truth, samples, schedule, resolved, T_simworld_world, imu is not None)


def cut(recorded: Trajectory, start_s: float, duration_s: float | None) -> Trajectory:
    """Return a section of a trajectory.

    Args:
        recorded: The whole trajectory.
        start_s: Start of the section, from the first pose [s].
        duration_s: Duration of the section [s]; None for the rest of the trajectory.

    Raises:
        ConfigError: The section has fewer than two poses.
    """
    end_s = np.inf if duration_s is None else start_s + duration_s
    stretch = recorded[(recorded.t_s >= start_s) & (recorded.t_s <= end_s)]
    if len(stretch) < 2:
        raise ConfigError(
            f"section from {start_s:g} to {end_s:g} s of a path of {recorded.t_s[-1]:.1f} s; expected two poses or more"
        )
    return stretch


def frame_stamps(imu_ns: Times, rate_hz: float) -> Times:
    """Return the IMU time stamps (M,) [ns] nearest to the nominal frame times, since both sensors share a clock."""
    nominal_ns = np.arange(imu_ns[0], imu_ns[-1] + 1, round(1e9 / rate_hz), dtype=np.int64)
    after = np.clip(np.searchsorted(imu_ns, nominal_ns), 1, len(imu_ns) - 1)
    earlier = nominal_ns - imu_ns[after - 1] < imu_ns[after] - nominal_ns
    return np.unique(np.where(earlier, imu_ns[after - 1], imu_ns[after]))


def _shared(recorded: Trajectory, imu: ImuSamples) -> tuple[Trajectory, ImuSamples]:
    """Return the sections of a trajectory and its IMU samples that cover the same time."""
    samples = imu[int(np.searchsorted(imu.t_ns, recorded.t_ns[0])) :].up_to(int(recorded.t_ns[-1]))
    if len(samples) < 2:
        raise ConfigError(
            f"IMU samples from {imu.t_ns[0]} to {imu.t_ns[-1]} ns and a path from {recorded.t_ns[0]} to"
            f" {recorded.t_ns[-1]} ns; expected overlapping times"
        )
    within = (recorded.t_ns >= samples.t_ns[0]) & (recorded.t_ns <= samples.t_ns[-1])
    return recorded[within], samples


def _synthesized(recorded: Trajectory, rig: Rig, seed: int) -> tuple[Trajectory, ImuSamples]:
    """Return the smooth motion through a trajectory and samples of the rig's IMU along it."""
    motion = SmoothMotion.through(recorded)
    t_ns = _imu_stamps(recorded.t_ns, rig.imu.rate_hz)
    imu, gyro_bias, accel_bias = ImuErrors(rig.imu, generator(seed, "imu")).add_to(motion.points(t_ns))
    return replace(motion.trajectory(t_ns), gyro_bias_rad_s=gyro_bias, accel_bias_m_s2=accel_bias), imu


def _imu_stamps(recorded_ns: Times, rate_hz: float) -> Times:
    """Return the IMU time stamps: those of the poses if they have the rate of the IMU, otherwise a uniform grid."""
    interval_ns = 1e9 / rate_hz
    if np.all(np.abs(np.diff(recorded_ns) - interval_ns) < 0.01 * interval_ns):
        return recorded_ns
    return np.arange(recorded_ns[0], recorded_ns[-1] + 1, round(interval_ns), dtype=np.int64)
