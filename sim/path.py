"""The path to fly: smooth splines through waypoints, from standing on the floor to standing on it again.

Position and heading are minimum-snap splines (Mellinger and Kumar, "Minimum snap trajectory generation and control for
quadrotors", 2011): of all curves through the waypoints at the given times, the spline of degree 7 with velocity,
acceleration and jerk zero at both ends has the least snap. A quadrotor's attitude, rates and torques follow from
position and heading (differential flatness), so a smooth path is one that the rotors can follow.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.interpolate import BSpline, make_interp_spline

from dronevio.models.errors import ConfigError
from dronevio.models.imu import GRAVITY_M_S2, Times
from dronevio.models.rotation import log_so3

Array = npt.NDArray[np.float64]

_DEGREE = 7
_ZERO_AT_ENDS = (1, 2, 3)  # velocity, acceleration and jerk: the orders of derivatives
_CHECK_STEP_S = 0.01  # how densely a path is compared with the free box
_SINK_M = 0.015  # the landing aims this far below the floor: a path that ends on it would never touch it
_TOUCHDOWN_M = 0.004  # and the rotors stop when it says that the feet are this deep


@dataclass(frozen=True)
class FlightPlan:
    """What to fly, in a space of any size: stand, take off, tour, land, stand."""

    rest_s: float
    """Standing still before take-off [s]."""
    takeoff_s: float
    """Climbing straight up [s]."""
    tour_s: float
    """From hovering above the pad, through the waypoints, and back to hovering above the pad [s]."""
    landing_s: float
    """Sinking straight down [s]."""
    stand_s: float
    """Standing still after the landing [s]."""
    height_m: float = 1.2
    """Height of the hover above the standing drone [m]."""
    waypoints: tuple[tuple[float, float, float], ...] = ()
    """The tour, (x, y, z) as fractions: ±1 in x and y is the edge of the space that the drone may use, 0 its centre
    and the pad; in z, 0 is the hover's height and ±1 the highest and lowest that it may fly."""
    jitter: float = 0.0
    """How far a seed moves each waypoint at most, as a fraction like theirs."""
    turning: float = 1.0
    """How far the camera looks along the path: 1 always, 0 never, which keeps the first heading."""
    margin_m: float = 0.4
    """Distance that the path keeps from the free space's walls: half the drone and its tracking error [m]."""
    floor_m: float = 0.5
    """Least height of the tour above the standing drone [m]."""

    @property
    def duration_s(self) -> float:
        """From the first to the last instant [s]."""
        return round(self.rest_s + self.takeoff_s + self.tour_s + self.landing_s + self.stand_s, 9)


@dataclass(frozen=True, eq=False)
class Reference:
    """Where the vehicle should be, row by row on a grid of time stamps; what a controller tracks."""

    t_ns: Times
    """(N,) Time stamps from 0 at equal intervals [ns]."""
    position_m: Array
    """(N, 3) Position of the centre of mass in the world [m]."""
    velocity_m_s: Array
    """(N, 3) Its velocity [m/s]."""
    acceleration_m_s2: Array
    """(N, 3) Its acceleration [m/s²]."""
    yaw_rad: Array
    """(N,) Heading [rad]."""
    rate_rad_s: Array
    """(N, 3) Angular velocity in the vehicle frame [rad/s]."""
    angular_acceleration_rad_s2: Array
    """(N, 3) Its time derivative [rad/s²]."""
    flying: npt.NDArray[np.bool_]
    """(N,) Whether the rotors should turn."""

    def __len__(self) -> int:
        return len(self.t_ns)

    def row(self, t_ns: int) -> int:
        """Return the last row not after ``t_ns``.

        Raises:
            ConfigError: The reference says nothing about that time.
        """
        index = int(np.searchsorted(self.t_ns, t_ns, side="right")) - 1
        if index < 0 or t_ns > self.t_ns[-1]:
            raise ConfigError(f"reference asked for {t_ns} ns; expected 0 to {self.t_ns[-1]} ns")
        return index

    @property
    def peak_speed_m_s(self) -> float:
        """Greatest speed [m/s]."""
        return float(np.linalg.norm(self.velocity_m_s, axis=1).max())

    @property
    def peak_rate_rad_s(self) -> float:
        """Greatest angular velocity [rad/s]."""
        return float(np.linalg.norm(self.rate_rad_s, axis=1).max())


def plan_reference(
    plan: FlightPlan, free_box: Array, standing_height_m: float, interval_ns: int, rng: np.random.Generator
) -> Reference:
    """Return the reference of a plan in a given space.

    Args:
        plan: What to fly.
        free_box: (2, 3) Corners of the space free of obstacles [m]; the pad is on the floor at its centre.
        standing_height_m: Height of the centre of mass of the standing drone [m].
        interval_ns: Time between rows [ns].
        rng: Moves the waypoints.

    Returns:
        Rows from t = 0 to the plan's duration.
    """
    t_ns = np.arange(round(plan.duration_s * 1e9) // interval_ns + 1, dtype=np.int64) * interval_ns
    t = np.asarray(t_ns * 1e-9, dtype=np.float64)
    pad = np.array([*free_box.mean(axis=0)[:2], standing_height_m])
    tour_start = plan.rest_s + plan.takeoff_s
    tour_end = tour_start + plan.tour_s
    knots, tour = _tour(plan, _reach(plan, free_box, standing_height_m), rng)
    up = np.array([[0.0, 0.0, 0.0, 0.0], [0.0, 0.0, plan.height_m, 0.0]])
    down = np.array([tour[-1], [0.0, 0.0, -_SINK_M, tour[-1, 3]]])
    pieces = (
        _minimum_snap(np.array([plan.rest_s, tour_start]), up),
        _minimum_snap(tour_start + knots, tour),
        _minimum_snap(np.array([tour_end, tour_end + plan.landing_s]), down),
    )
    position, velocity, acceleration = (_evaluate(pieces, t, order) for order in range(3))
    landed = (t > tour_end) & (position[:, 2] < -_TOUCHDOWN_M)
    flying = (t >= plan.rest_s) & ~landed
    rate = _rates(acceleration[:, :3], position[:, 3], interval_ns * 1e-9)
    return Reference(
        t_ns,
        position[:, :3] + pad,
        velocity[:, :3],
        acceleration[:, :3],
        position[:, 3],
        rate,
        np.gradient(rate, interval_ns * 1e-9, axis=0),
        flying,
    )


def attitude(thrust_direction: Array, yaw_rad: Array) -> Array:
    """Return attitudes (…, 3, 3) with the z axis along a vector (…, 3) and the x axis heading to ``yaw_rad`` (…)."""
    z = thrust_direction / np.linalg.norm(thrust_direction, axis=-1, keepdims=True)
    heading = np.stack([np.cos(yaw_rad), np.sin(yaw_rad), np.zeros_like(yaw_rad)], axis=-1)
    y = np.cross(z, heading)
    y /= np.linalg.norm(y, axis=-1, keepdims=True)
    return np.stack([np.cross(y, z), y, z], axis=-1)


def _reach(plan: FlightPlan, free_box: Array, standing_height_m: float) -> Array:
    """Return (2, 3) how far the path may go from the hover point, down and up each axis [m].

    Raises:
        ConfigError: The plan does not fit into the space.
    """
    hover = np.array([*free_box.mean(axis=0)[:2], standing_height_m + plan.height_m])
    low, high = free_box[0] + plan.margin_m, free_box[1] - plan.margin_m
    low[2] = standing_height_m + plan.floor_m
    reach = np.stack([low - hover, high - hover])
    if np.any(reach[0] > 0.0) or np.any(reach[1] < 0.0):
        raise ConfigError(
            f"hover at {np.round(hover, 2).tolist()} m; expected between {np.round(low, 2).tolist()} and"
            f" {np.round(high, 2).tolist()} m, the free space less its margins"
        )
    return reach


def _tour(plan: FlightPlan, reach: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return times (K,) from 0 [s] and points (K, 4) of the tour: x, y, z from the pad [m], yaw [rad].

    The waypoints are scaled together, axis by axis, until the spline between them stays within reach.
    """
    hover = np.array([0.0, 0.0, plan.height_m])
    if not plan.waypoints:
        return np.array([0.0, plan.tour_s]), np.tile([*hover, 0.0], (2, 1))
    fractions = np.array(plan.waypoints)
    fractions = fractions + plan.jitter * rng.uniform(-1.0, 1.0, fractions.shape)
    offsets = np.where(fractions < 0.0, -fractions * reach[0], fractions * reach[1])
    offsets = np.vstack([np.zeros(3), offsets, np.zeros(3)])
    knots = _allot_time(offsets, plan.tour_s)
    dense = np.arange(0.0, plan.tour_s, _CHECK_STEP_S)
    excursion = _minimum_snap(knots, offsets)(dense)
    overshoot = np.maximum(excursion / np.where(reach[1] > 0.0, reach[1], np.inf), 0.0)
    undershoot = np.maximum(excursion / np.where(reach[0] < 0.0, reach[0], -np.inf), 0.0)
    offsets = offsets / np.maximum(1.0, np.maximum(overshoot, undershoot).max(axis=0))
    yaw = plan.turning * _headings(knots, offsets)
    return knots, np.column_stack([offsets + hover, yaw])


def _allot_time(points: Array, total_s: float) -> Array:
    """Return times (K,) of points (K, 3): by distance, with half as much again where the drone starts and stops."""
    weight = np.linalg.norm(np.diff(points, axis=0), axis=1) ** 0.6  # long legs are flown faster
    weight[[0, -1]] *= 1.5
    return np.asarray(np.concatenate([[0.0], np.cumsum(weight)]) * total_s / weight.sum())


def _headings(knots: Array, points: Array) -> Array:
    """Return headings (K,) [rad] that look along the path, smoothed; 0 at first, and the last one kept at the end."""
    velocity = _minimum_snap(knots, points).derivative()(knots[1:-1])
    along = np.unwrap(np.concatenate([[0.0], np.arctan2(velocity[:, 1], velocity[:, 0])]))
    along = np.append(along, along[-1])
    smooth = along.copy()
    smooth[1:-1] = 0.2 * along[:-2] + 0.6 * along[1:-1] + 0.2 * along[2:]
    return smooth


def _minimum_snap(knots: Array, points: Array) -> BSpline:
    """Return the minimum-snap curve through points (K, D) at times (K,), at rest at both ends."""
    at_rest = [(order, np.zeros(points.shape[1])) for order in _ZERO_AT_ENDS]
    return make_interp_spline(knots, points, k=_DEGREE, bc_type=(at_rest, at_rest))


def _evaluate(pieces: tuple[BSpline, ...], t: Array, order: int) -> Array:
    """Return derivatives (N, D) of consecutive curves, constant before, between and after them."""
    values = np.zeros((len(t), 4))
    for piece in pieces:
        start, end = piece.t[0], piece.t[-1]
        values[t >= start] = piece.derivative(order)(np.minimum(t[t >= start], end))
    return values


def _rates(acceleration: Array, yaw_rad: Array, dt_s: float) -> Array:
    """Return angular velocities (N, 3) [rad/s] in the vehicle frame: central differences of the flat attitude."""
    R = attitude(acceleration + [0.0, 0.0, GRAVITY_M_S2], yaw_rad)
    rate = np.zeros((len(R), 3))
    rate[1:-1] = log_so3(np.swapaxes(R[:-2], 1, 2) @ R[2:]) / (2.0 * dt_s)
    return rate
