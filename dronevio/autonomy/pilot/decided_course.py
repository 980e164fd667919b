"""A course that is decided during the flight: motions follow each other, and after the last one its end is held."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from dronevio.autonomy.pilot.heading import Turn
from dronevio.autonomy.planning.trajectory import CorridorTrajectory
from dronevio.models.arrays import Array
from dronevio.models.imu import GRAVITY_M_S2
from dronevio.models.rotation import log_so3
from dronevio.sim.paths.course import ReferencePoint
from dronevio.sim.paths.path import attitude


@dataclass(frozen=True, eq=False)
class Motion:
    """A motion at equal intervals, at rest at the end."""

    begins_ns: int
    """Time of the first row on the clock of the course [ns]."""
    states: Array
    """(N, 4, 3) Position, velocity, acceleration and jerk [m, s]."""
    yaw_rad: Array
    """(N,) Headings [rad]."""
    yaw_rate_rad_s: Array
    """(N,) Their rates [rad/s]."""
    rate_rad_s: Array
    """(N, 3) Angular velocities in the vehicle frame [rad/s]."""
    angular_acceleration_rad_s2: Array
    """(N, 3) Angular accelerations in the vehicle frame [rad/s²]."""

    @classmethod
    def of(cls, trajectory: CorridorTrajectory, turn: Turn, begins_ns: int, interval_ns: int) -> Self:
        """Return a trajectory with a turn, from a time on [ns]; it ends when both have ended."""
        interval_s = interval_ns * 1e-9
        duration_s = max(trajectory.duration_s, turn.duration_s)
        t = np.asarray(np.arange(-1, int(np.ceil(duration_s / interval_s)) + 2) * interval_s, np.float64)
        states = _states(trajectory, t)
        yaw, yaw_rate = turn.at(t)
        # Angular rates of the flat attitude by central differences, for which the motion is extended by an interval.
        R = attitude(states[:, 2] + [0.0, 0.0, GRAVITY_M_S2], yaw)
        rate = log_so3(np.swapaxes(R[:-1], 1, 2) @ R[1:]) / interval_s
        change = np.diff(rate, axis=0) / interval_s
        rows = slice(1, -1)
        middle = 0.5 * (rate[:-1] + rate[1:])
        return cls(begins_ns, states[rows], yaw[rows], yaw_rate[rows], middle, change)


def _states(trajectory: CorridorTrajectory, t: Array) -> Array:
    """Return position, velocity, acceleration and jerk (N, 4, 3) at times (N,), at rest after the end."""
    path, end = trajectory.path, trajectory.duration_s
    within = np.minimum(t, end)
    states = np.stack([path(within), *(path.derivative(order)(within) for order in (1, 2, 3))], axis=1)
    states[t >= end, 1:] = 0.0
    return np.asarray(states)


class DecidedCourse:
    """Motions one after another, with the rotors stopped before the first; implements `Course`."""

    def __init__(self, stand: Array, yaw_rad: float, interval_ns: int, end_ns: int) -> None:
        """Stand on the ground.

        Args:
            stand: (3,) Position of the centre of mass of the standing vehicle in the world [m].
            yaw_rad: Its heading [rad].
            interval_ns: Time between two commands [ns].
            end_ns: Time at which the flight ends at the latest [ns].
        """
        self.interval_ns, self.end_ns, self.now_ns = interval_ns, end_ns, 0
        still = np.zeros(3)
        self._standing = ReferencePoint(stand, still, still, yaw_rad, still, still, False)
        self._motions: tuple[Motion, ...] = ()
        self._lands_ns: int | None = None

    def follow(self, motion: Motion) -> None:
        """Follow a motion from its beginning on; what was decided for later times is dropped."""
        kept = tuple(each for each in self._motions if each.begins_ns < motion.begins_ns)
        self._motions = (*kept, motion)

    def stop_rotors(self, t_ns: int) -> None:
        """Stop the rotors at a time [ns]."""
        self._lands_ns = t_ns

    def point(self, t_ns: int) -> ReferencePoint:
        """Return what is tracked at a time [ns], not before that of the last call."""
        self.now_ns = t_ns
        self._motions = self._motions[self._index(t_ns) :] if self._motions else ()
        if not self._motions or t_ns < self._motions[0].begins_ns:
            return self._standing
        motion, row = self._row(t_ns)
        position, velocity, acceleration, _ = motion.states[row]
        return ReferencePoint(
            position,
            velocity,
            acceleration,
            float(motion.yaw_rad[row]),
            motion.rate_rad_s[row],
            motion.angular_acceleration_rad_s2[row],
            self._lands_ns is None or t_ns < self._lands_ns,
        )

    def planned(self, t_ns: int) -> tuple[Array, float, float]:
        """Return the state (4, 3), the heading and its rate at a time to come, as decided so far [m, rad, s]."""
        motion, row = self._row(t_ns)
        return motion.states[row], float(motion.yaw_rad[row]), float(motion.yaw_rate_rad_s[row])

    def positions_from(self, t_ns: int) -> Array:
        """Return the positions (N, 3) from a time to the end of the motion that is flown then [m]."""
        motion, row = self._row(t_ns)
        return np.asarray(motion.states[row:, 0])

    @property
    def decided_until_ns(self) -> int:
        """Time at which the last motion ends [ns]; 0 without one."""
        if not self._motions:
            return 0
        last = self._motions[-1]
        return last.begins_ns + (len(last.states) - 1) * self.interval_ns

    def _index(self, t_ns: int) -> int:
        """Return the index of the motion that is flown at a time [ns]."""
        return max(sum(each.begins_ns <= t_ns for each in self._motions) - 1, 0)

    def _row(self, t_ns: int) -> tuple[Motion, int]:
        """Return the motion at a time [ns], and its row."""
        motion = self._motions[self._index(t_ns)]
        row = (t_ns - motion.begins_ns) // self.interval_ns
        return motion, min(max(row, 0), len(motion.states) - 1)
