"""Reference trajectories: from rest on the landing pad through a shape to rest on the pad.

Positions are minimum-snap splines (`dronevio.sim.paths.minimum_snap`), headings follow at a limited rate
(`dronevio.sim.paths.heading`). Attitude, angular rates and torques of a quadrotor follow from position and heading
(differential flatness; Mellinger and Kumar, "Minimum snap trajectory generation and control for quadrotors", 2011), so
that the rotors can follow a smooth trajectory.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Self

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError
from dronevio.models.imu import GRAVITY_M_S2, Times
from dronevio.models.rotation import log_so3
from dronevio.sim.paths.course import ReferencePoint
from dronevio.sim.paths.plan import TIMED_WAYPOINTS, FlightPlan
from dronevio.sim.paths.route import leg_clearances
from dronevio.sim.paths.segments import PathSegment, shape_segment, straight, timed_segment
from dronevio.sim.paths.space import FlightArea

_SINK_M = 0.015  # the descent ends below the floor, so that the drone touches it
_TOUCHDOWN_M = 0.004  # depth of the feet at which the rotors stop
_WHOLE_NS = 100_000_000  # the final rest is extended to a multiple of this


@dataclass(frozen=True, eq=False)
class Reference:
    """Reference trajectory of a controller, sampled on a uniform grid of times; implements `Course`."""

    t_ns: Times
    """(N,) Times from 0 at equal intervals [ns]."""
    position_m: Array
    """(N, 3) Positions of the centre of mass in the world frame [m]."""
    velocity_m_s: Array
    """(N, 3) Velocities of the centre of mass in the world frame [m/s]."""
    acceleration_m_s2: Array
    """(N, 3) Accelerations of the centre of mass in the world frame [m/s²]."""
    yaw_rad: Array
    """(N,) Headings, the yaw angle [rad]."""
    rate_rad_s: Array
    """(N, 3) Angular velocities in the vehicle frame [rad/s]."""
    angular_acceleration_rad_s2: Array
    """(N, 3) Angular accelerations in the vehicle frame [rad/s²]."""
    flying: npt.NDArray[np.bool_]
    """(N,) Whether the rotors turn."""

    @classmethod
    def of(cls, points: Sequence[ReferencePoint], interval_ns: int) -> Self:
        """Return the reference of points at equal intervals [ns], from t = 0 on."""
        columns = [np.array(column) for column in zip(*points, strict=True)]
        return cls(np.arange(len(points), dtype=np.int64) * interval_ns, *columns)

    def __len__(self) -> int:
        return len(self.t_ns)

    @property
    def interval_ns(self) -> int:
        """Time between two rows [ns]."""
        return int(self.t_ns[1] - self.t_ns[0])

    @property
    def end_ns(self) -> int:
        """Time of the last row [ns]."""
        return int(self.t_ns[-1])

    def point(self, t_ns: int) -> ReferencePoint:
        """Return the last row not after ``t_ns``.

        Raises:
            ConfigError: The time is outside the reference.
        """
        row = self.row(t_ns)
        return ReferencePoint(
            self.position_m[row],
            self.velocity_m_s[row],
            self.acceleration_m_s2[row],
            float(self.yaw_rad[row]),
            self.rate_rad_s[row],
            self.angular_acceleration_rad_s2[row],
            bool(self.flying[row]),
        )

    def row(self, t_ns: int) -> int:
        """Return the last row not after ``t_ns``.

        Raises:
            ConfigError: The time is outside the reference.
        """
        index = int(np.searchsorted(self.t_ns, t_ns, side="right")) - 1
        if index < 0 or t_ns > self.t_ns[-1]:
            raise ConfigError(f"reference asked for {t_ns} ns; expected 0 to {self.t_ns[-1]} ns")
        return index

    @property
    def duration_s(self) -> float:
        """Time from the first to the last row [s]."""
        return float(self.t_ns[-1] - self.t_ns[0]) * 1e-9

    @property
    def peak_speed_m_s(self) -> float:
        """Largest speed [m/s]."""
        return float(np.linalg.norm(self.velocity_m_s, axis=1).max())

    @property
    def peak_rate_rad_s(self) -> float:
        """Largest angular velocity [rad/s]."""
        return float(np.linalg.norm(self.rate_rad_s, axis=1).max())


def plan_reference(
    plan: FlightPlan,
    area: FlightArea,
    standing_height_m: float,
    interval_ns: int,
    rng: np.random.Generator,
    *,
    reverse: bool = False,
) -> Reference:
    """Return the reference trajectory of a plan in a world.

    Args:
        plan: The flight plan.
        area: Bounds, obstacles and landing pad of the world.
        standing_height_m: Height of the centre of mass of the standing drone [m].
        interval_ns: Time between rows [ns].
        rng: Generator of the displacements of the waypoints.
        reverse: Whether the tour is flown in the opposite direction, through the same waypoints.

    Returns:
        Rows from t = 0, at rest on the pad or in the motion after ``skip_s``, to rest on the pad.

    Raises:
        ConfigError: The plan does not fit into the world.
    """
    stand = area.pad + [0.0, 0.0, standing_height_m]
    hover = stand + [0.0, 0.0, plan.height_m]
    reach = _reach(plan, area, stand, hover)
    tour = (timed_segment if plan.shape == TIMED_WAYPOINTS else shape_segment)(plan, area, hover, reach, rng, reverse)
    # Given durations of tour, climb and descent are exact.
    limits = None if plan.shape == TIMED_WAYPOINTS else plan.limits
    climb = straight(stand, hover, plan.takeoff_s, 0.0, limits)
    yaw_rad = float(tour.heading(tour.duration_s))
    descent = straight(hover, stand - [0.0, 0.0, _SINK_M], plan.landing_s, yaw_rad, limits)
    segments = (climb, tour, descent)
    starts = plan.initial_rest_s + np.cumsum([0.0, *(segment.duration_s for segment in segments)])
    end_ns = -(-round((starts[-1] + plan.final_rest_s) * 1e9) // _WHOLE_NS) * _WHOLE_NS
    t_ns = np.arange(end_ns // interval_ns + 1, dtype=np.int64) * interval_ns
    t = np.asarray(t_ns * 1e-9, dtype=np.float64)
    position, velocity, acceleration = (_evaluate(segments, starts, stand, t, order) for order in range(3))
    yaw = _headings(segments, starts, t)
    landed = (t > starts[2]) & (position[:, 2] < stand[2] - _TOUCHDOWN_M)
    flying = (t >= plan.initial_rest_s) & ~landed
    rate = _rates(acceleration, yaw, interval_ns * 1e-9)
    change = np.gradient(rate, interval_ns * 1e-9, axis=0)
    return _begun_later(Reference(t_ns, position, velocity, acceleration, yaw, rate, change, flying), plan.skip_s)


def attitude(thrust_direction: Array, yaw_rad: Array) -> Array:
    """Return attitudes (…, 3, 3) with the z axis along a vector (…, 3) and the x axis heading to ``yaw_rad`` (…)."""
    z = thrust_direction / np.linalg.norm(thrust_direction, axis=-1, keepdims=True)
    heading = np.stack([np.cos(yaw_rad), np.sin(yaw_rad), np.zeros_like(yaw_rad)], axis=-1)
    y = np.cross(z, heading)
    y /= np.linalg.norm(y, axis=-1, keepdims=True)
    return np.stack([np.cross(y, z), y, z], axis=-1)


def _reach(plan: FlightPlan, area: FlightArea, stand: Array, hover: Array) -> Array:
    """Return the usable extent (2, 3) of the free box relative to the hover point, below and above on each axis [m].

    Raises:
        ConfigError: The plan does not fit into the space, or an obstacle is above the pad.
    """
    low, high = area.free_box[0] + plan.margin_m, area.free_box[1] - plan.margin_m
    low[2] = stand[2] + plan.min_height_m
    reach = np.stack([low - hover, high - hover])
    if np.any(reach[0] > 0.0) or np.any(reach[1] < 0.0):
        raise ConfigError(
            f"hover at {np.round(hover, 2).tolist()} m; expected between {np.round(low, 2).tolist()} and"
            f" {np.round(high, 2).tolist()} m, the free space less its margins"
        )
    bottomless = replace(area.space, low=np.array([*area.space.low[:2], -np.inf]))
    clearance = float(leg_clearances(bottomless, stand[None], hover[None])[0])
    if clearance < plan.margin_m:
        raise ConfigError(
            f"the climb from the pad to {np.round(hover, 2).tolist()} m has {clearance:.2f} m of clearance; expected"
            f" {plan.margin_m:.2f} m"
        )
    return reach


def _begun_later(reference: Reference, skip_s: float) -> Reference:
    """Return a reference without its first seconds, on a clock that starts at 0.

    Raises:
        ConfigError: The reference is not longer than ``skip_s``.
    """
    first = int(np.searchsorted(reference.t_ns, round(skip_s * 1e9)))
    if first > len(reference) - 2:
        raise ConfigError(f"plan's skip_s = {skip_s:g} of a flight of {reference.duration_s:g} s; expected less")
    rest = {part.name: getattr(reference, part.name)[first:] for part in fields(reference)}
    return replace(Reference(**rest), t_ns=rest["t_ns"] - rest["t_ns"][0])


def _evaluate(segments: Sequence[PathSegment], starts: Array, stand: Array, t: Array, order: int) -> Array:
    """Return derivatives (N, 3) of the paths of consecutive segments, at rest before the first and after the last."""
    values = np.tile(stand if order == 0 else np.zeros(3), (len(t), 1))
    for segment, start in zip(segments, starts[:-1], strict=True):
        begun = t > start
        values[begun] = segment.path.derivative(order)(np.minimum(t[begun] - start, segment.duration_s))
    return values


def _headings(segments: Sequence[PathSegment], starts: Array, t: Array) -> Array:
    """Return headings (N,) of consecutive segments [rad], 0 before the first."""
    values = np.zeros(len(t))
    for segment, start in zip(segments, starts[:-1], strict=True):
        begun = t > start
        values[begun] = segment.heading(np.minimum(t[begun] - start, segment.duration_s))
    return values


def _rates(acceleration: Array, yaw_rad: Array, dt_s: float) -> Array:
    """Return angular velocities (N, 3) in the vehicle frame [rad/s]: central differences of the flat attitude."""
    R = attitude(acceleration + [0.0, 0.0, GRAVITY_M_S2], yaw_rad)
    rate = np.zeros((len(R), 3))
    rate[1:-1] = log_so3(np.swapaxes(R[:-2], 1, 2) @ R[2:]) / (2.0 * dt_s)
    return rate
