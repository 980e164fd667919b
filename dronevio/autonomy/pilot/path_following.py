"""Following a path through space that is known only in part: fly, stop, look, and look from another place."""

from dataclasses import dataclass, replace
from math import radians, remainder, tau

import numpy as np

from dronevio.autonomy.pilot.moment import Moment
from dronevio.autonomy.planning.known_space import LocalSpace
from dronevio.autonomy.planning.local_plan import at_rest, place_above, place_beside, stop, trajectory_along
from dronevio.autonomy.planning.trajectory import CorridorTrajectory
from dronevio.models.arrays import Array
from dronevio.sim.paths.limits import Limits

STILL_M_S = 0.1
"""Speed up to which the vehicle stands [m/s]."""
_ASKEW_RAD = radians(50.0)  # between heading and path, from where on the vehicle turns before it flies
_SLOW_M_S = 0.5  # while it turns
_LEAST_STEP_M, _PROGRESS_M = 0.15, 0.6  # lengths of a plan that is worth to be flown, and that leads on
_STUCK_NS = 2_000_000_000  # without progress, after which the path is looked at from another place
_PEEKS = 3  # such places
_AWAY_M = 1.3  # from where a vehicle was stuck, beyond which these places are behind


@dataclass(frozen=True, eq=False)
class Step:
    """What is flown next."""

    what: str | None
    """What was decided; None if what is flown goes on."""
    trajectory: CorridorTrajectory | None
    """What is flown instead of that."""
    is_stuck: bool = False
    """Whether the path has been looked at from all places, and nothing leads on."""


class PathFollowing:
    """Decides how a path is followed, and remembers where that was stuck."""

    def __init__(self, limits: Limits) -> None:
        """Begin with a path."""
        self._limits = limits
        self._stuck_at = np.full(3, np.inf)
        self._peeks = self._progress_ns = self._peeking_until_ns = 0

    def begin(self, now_ns: int) -> None:
        """Begin with another path at a time [ns]."""
        self._progress_ns, self._peeks = now_ns, 0

    def wait(self, now_ns: int) -> None:
        """Wait for what will be seen on a changed path, as if there had been progress at a time [ns]."""
        self._progress_ns = now_ns

    def step(
        self, m: Moment, space: LocalSpace, ahead: Array, rest: Array, askew_rad: float | None, *, peeks: bool = True
    ) -> Step:
        """Return what is flown next.

        Args:
            m: What is known.
            space: Where the vehicle may be.
            ahead: (N, 3) Next points of the path in the odometry frame [m].
            rest: (K, 3) Points of what is still to be flown if nothing is decided [m].
            askew_rad: Angle from the heading to that of the path [rad]; None if it does not matter.
            peeks: Whether a path that leads no further is looked at from other places.
        """
        # Turn before flying where the cameras do not see
        is_askew = askew_rad is not None and abs(remainder(askew_rad, tau)) > _ASKEW_RAD
        if is_askew and m.speed_m_s < STILL_M_S:
            self._progress_ns = m.now_ns
            return Step("turn", self.halt(m, space))
        # Fly as far as is known to be free
        slow = max(_SLOW_M_S, 0.8 * m.speed_m_s)
        limits = replace(self._limits, speed_m_s=slow) if is_askew else self._limits
        trajectory = trajectory_along(space, ahead, m.start, m.body, limits)
        if trajectory is not None and self._leads_on(m, trajectory.control_points[-1, -1]):
            return Step("fly", trajectory)
        # Without a new trajectory: fly on if the last one is still free, otherwise stop
        if m.speed_m_s > 0.5 * STILL_M_S and is_blocked(m, space, rest):
            return Step("the trajectory is blocked: stop", stop(space, m.start, m.body, self._limits))
        if not m.is_at_rest or m.now_ns <= self._peeking_until_ns:
            return Step(None, None)
        # At rest: look, and after a while from another place
        if m.now_ns - self._progress_ns <= _STUCK_NS:
            return Step("look", at_rest(m.position_m))
        there = self._peek(m, space, ahead) if peeks else None
        if there is None:
            return Step("look", at_rest(m.position_m), is_stuck=True)
        return Step("look from another place", there)

    def halt(self, m: Moment, space: LocalSpace) -> CorridorTrajectory:
        """Return the trajectory to rest, or at rest."""
        return at_rest(m.position_m) if m.is_at_rest else stop(space, m.start, m.body, self._limits)

    def _leads_on(self, m: Moment, end: Array) -> bool:
        """Return whether a plan to an end (3,) is worth to be flown, and remember its progress."""
        length_m = float(np.linalg.norm(end - m.position_m))
        if length_m <= (_LEAST_STEP_M if m.now_ns > self._peeking_until_ns else _PROGRESS_M):
            return False
        if length_m > _PROGRESS_M:
            self._progress_ns = m.now_ns
        if np.linalg.norm(end - self._stuck_at) > _AWAY_M:
            self._peeks = 0
        return True

    def _peek(self, m: Moment, space: LocalSpace, ahead: Array) -> CorridorTrajectory | None:
        """Return a trajectory to the next place from which the path is looked at; None after the last."""
        if self._peeks == _PEEKS:
            return None
        find = place_above if self._peeks == 1 else place_beside
        place = find(space, m.position_m, ahead[-1], m.body)
        there = None if place is None else trajectory_along(space, place[None], m.start, m.body, self._limits)
        if there is None:
            return None
        if self._peeks == 0:
            self._stuck_at = m.position_m
        self._peeks += 1
        duration_ns = round(1e9 * there.duration_s)
        self._progress_ns = m.now_ns + duration_ns - _STUCK_NS // 2
        self._peeking_until_ns = m.begins_ns + duration_ns
        return there


def is_blocked(m: Moment, space: LocalSpace, rest: Array) -> bool:
    """Return whether points (K, 3) of what is still to be flown have less room than the body, or than it has now."""
    room_m = space.clearances(rest)
    return bool(np.any(room_m < min(m.body.radius_m, float(room_m[0])) - space.grid.cell_m))
