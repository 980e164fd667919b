"""Flying a recorded path again: a real drone's motion, seen by a camera of ours in a world of ours.

The motion, its time stamps and its body frame stay those of the recording; the world is laid around the path. The IMU
is either the real one that was recorded with it, whose noise no model imitates, or one that feels a smooth spline
through the path.
"""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from dronevio.models.errors import ConfigError
from dronevio.models.imu import ImuSamples, Times
from dronevio.models.rig import Rig
from dronevio.models.state import Trajectory
from dronevio.sim.cameras.schedule import FrameSchedule, schedule_frames
from dronevio.sim.inertial.imu import ImuErrors
from dronevio.sim.paths.placement import place_path
from dronevio.sim.paths.spline import SmoothMotion
from dronevio.sim.streams import generator
from dronevio.sim.world import flight_area

Array = npt.NDArray[np.float64]

MARGIN_M = 0.3
"""Distance that a path laid into a world keeps from every surface [m]: the IMU is inside the drone."""


@dataclass(frozen=True, eq=False)
class FlownPath:
    """A path that was flown, with an IMU, and where the world lies around it."""

    rig: Rig
    """The sensors."""
    truth: Trajectory
    """The motion of the IMU, in the recording's world frame."""
    imu: ImuSamples
    """What the IMU measured, from the first pose to the last."""
    schedule: FrameSchedule
    """When the frames are taken."""
    world: str
    """Name of the world that is laid around it."""
    T_simworld_world: Array
    """(4, 4) Where the recording's world frame lies in the simulated world."""
    real_imu: bool
    """Whether the IMU is the recorded one."""


def refly(
    recorded: Trajectory,
    imu: ImuSamples | None,
    rig: Rig,
    world: str,
    seed: int = 0,
    margin_m: float = MARGIN_M,
) -> FlownPath:
    """Prepare to render along a recorded path.

    Args:
        recorded: The path of the IMU; z up.
        imu: What was recorded with it; an IMU of the rig's kind is synthesized where there is none.
        rig: The sensors.
        world: Name of the world that is to be seen.
        seed: Draws the world and the errors of a synthesized IMU.
        margin_m: How far the path stays from every surface [m].

    Raises:
        ConfigError: There is no such world, or the path does not fit into it, is too short or has gaps, or shares no
            time with the IMU.
    """
    space = flight_area(world, seed).space
    if imu is None:
        truth, samples = _synthesized(recorded, rig, seed)
    else:
        truth, samples = _shared(recorded, imu)
    stamps = frame_stamps(samples.t_ns, rig.cameras[0].rate_hz)
    schedule = schedule_frames(stamps, generator(seed, "frames"), rig.time_offset_s).within(
        int(truth.t_ns[0]), int(truth.t_ns[-1])
    )
    T_simworld_world = place_path(truth.p_world_imu, space, margin_m, world)
    return FlownPath(rig, truth, samples, schedule, world, T_simworld_world, imu is not None)


def cut(recorded: Trajectory, start_s: float, duration_s: float | None) -> Trajectory:
    """Return a stretch of a path.

    Args:
        recorded: The whole.
        start_s: Where to begin, from its first pose [s].
        duration_s: How long; None for all the rest.

    Raises:
        ConfigError: There is nothing in it.
    """
    end_s = np.inf if duration_s is None else start_s + duration_s
    stretch = recorded[(recorded.t_s >= start_s) & (recorded.t_s <= end_s)]
    if len(stretch) < 2:
        raise ConfigError(
            f"a stretch from {start_s:g} to {end_s:g} s of a path of {recorded.t_s[-1]:.1f} s; expected one with poses"
        )
    return stretch


def frame_stamps(imu_ns: Times, rate_hz: float) -> Times:
    """Return the IMU stamps (M,) [ns] that lie nearest to a camera's beat: sensors on one clock share their stamps."""
    nominal_ns = np.arange(imu_ns[0], imu_ns[-1] + 1, round(1e9 / rate_hz), dtype=np.int64)
    after = np.clip(np.searchsorted(imu_ns, nominal_ns), 1, len(imu_ns) - 1)
    earlier = nominal_ns - imu_ns[after - 1] < imu_ns[after] - nominal_ns
    return np.unique(np.where(earlier, imu_ns[after - 1], imu_ns[after]))


def _shared(recorded: Trajectory, imu: ImuSamples) -> tuple[Trajectory, ImuSamples]:
    """Return the stretches of a path and its IMU that cover the same time."""
    samples = imu[int(np.searchsorted(imu.t_ns, recorded.t_ns[0])) :].up_to(int(recorded.t_ns[-1]))
    if len(samples) < 2:
        raise ConfigError(
            f"an IMU from {imu.t_ns[0]} to {imu.t_ns[-1]} ns and a path from {recorded.t_ns[0]} to"
            f" {recorded.t_ns[-1]} ns; expected two that share some time"
        )
    within = (recorded.t_ns >= samples.t_ns[0]) & (recorded.t_ns <= samples.t_ns[-1])
    return recorded[within], samples


def _synthesized(recorded: Trajectory, rig: Rig, seed: int) -> tuple[Trajectory, ImuSamples]:
    """Return the smooth motion through a path, and what an IMU of the rig's kind feels on it."""
    motion = SmoothMotion.through(recorded)
    t_ns = _imu_stamps(recorded.t_ns, rig.imu.rate_hz)
    imu, gyro_bias, accel_bias = ImuErrors(rig.imu, generator(seed, "imu")).add_to(motion.points(t_ns))
    return replace(motion.trajectory(t_ns), gyro_bias_rad_s=gyro_bias, accel_bias_m_s2=accel_bias), imu


def _imu_stamps(recorded_ns: Times, rate_hz: float) -> Times:
    """Return the IMU's time stamps: the recording's own where it has its rate, else a beat from its first."""
    interval_ns = 1e9 / rate_hz
    if np.all(np.abs(np.diff(recorded_ns) - interval_ns) < 0.01 * interval_ns):
        return recorded_ns
    return np.arange(recorded_ns[0], recorded_ns[-1] + 1, round(interval_ns), dtype=np.int64)
