"""Segments of a flight that start and end at rest: climb, tour, descent."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.interpolate import BSpline

from dronevio.models.arrays import Array
from dronevio.sim.paths.heading import HeadingProfile, across, along, fixed, heading_curve, mirrored, toward
from dronevio.sim.paths.limits import Limits
from dronevio.sim.paths.minimum_snap import minimum_snap, minimum_time_knots
from dronevio.sim.paths.plan import FlightPlan
from dronevio.sim.paths.route import collision_free_curve, collision_free_polyline, leg_clearances
from dronevio.sim.paths.shapes import SHAPES, Arena, Course
from dronevio.sim.paths.space import FlightArea
from dronevio.sim.paths.timed_tour import timed_knots

_APART_M = 0.25  # waypoints closer than this to the previous one are omitted
_RETREATS = 6  # number of halvings of random displacements without clearance
_SLACK_M = 0.1  # additional clearance of displaced waypoints, for the deviation of the curve


@dataclass(frozen=True, eq=False)
class PathSegment:
    """A part of a flight that starts and ends at rest."""

    path: BSpline
    """Function from times (N,) since the start [s] to positions (N, 3) in the world [m]."""
    heading: BSpline
    """Function from times (N,) since the start [s] to headings (N,) [rad]."""
    duration_s: float
    """Duration of the segment [s]."""


def straight(start: Array, end: Array, least_s: float, yaw_rad: float, limits: Limits | None) -> PathSegment:
    """Return the segment between two points (3,) [m] in a time [s], or longer if limits require it."""
    points = np.stack([start, end])
    duration_s = least_s if limits is None else max(least_s, float(minimum_time_knots(points, limits)[-1]))
    knots = np.array([0.0, duration_s])
    return PathSegment(minimum_snap(knots, points), minimum_snap(knots, np.full(2, yaw_rad)), duration_s)


def timed_segment(
    plan: FlightPlan, area: FlightArea, hover: Array, reach: Array, rng: np.random.Generator, reverse: bool = False
) -> PathSegment:
    """Return the tour of a plan with relative waypoints and a duration.

    Args:
        plan: The flight plan.
        area: Bounds and obstacles of the world.
        hover: (3,) First and last point [m].
        reach: (2, 3) Usable extent relative to the hover, below and above on each axis [m].
        rng: Generator of the displacements of the waypoints.
        reverse: Whether the waypoints are flown in reverse order.
    """
    fractions = np.array(plan.waypoints).reshape(-1, 3)
    fractions = fractions + plan.waypoint_jitter * rng.uniform(-1.0, 1.0, fractions.shape)
    fractions = fractions[::-1] if reverse else fractions
    knots, offsets, yaw = timed_knots(fractions, plan.tour_s, reach)
    return PathSegment(minimum_snap(knots, offsets + hover), minimum_snap(knots, plan.heading_scale * yaw), plan.tour_s)


def shape_segment(
    plan: FlightPlan, area: FlightArea, hover: Array, reach: Array, rng: np.random.Generator, reverse: bool = False
) -> PathSegment:
    """Return the tour of a plan with a shape, as fast as its limits allow and clear of obstacles.

    Args:
        plan: The flight plan.
        area: Bounds, obstacles and route of the world.
        hover: (3,) First and last point [m].
        reach: (2, 3) Extent of the free space relative to the hover, below and above on each axis [m].
        rng: Generator of the displacements of the waypoints.
        reverse: Whether each lap is flown in the opposite direction, from the same first waypoint. The rotations of a
            shape on the spot are reversed.

    Raises:
        ConfigError: An obstacle blocks the tour.
    """
    arena = Arena(area, hover + reach[0], hover + reach[1], plan.limits, np.array(plan.waypoints).reshape(-1, 3))
    course = SHAPES[plan.shape](arena)
    knots, points = (
        _laps(plan, arena, hover, course, rng, reverse) if len(course.lap) else _on_the_spot(plan, area, hover, course)
    )
    path, end_s = minimum_snap(knots, points), float(knots[-1])
    profile = _heading_profile(plan, area, course)
    if reverse and not len(course.lap):
        profile = mirrored(profile)
    heading = heading_curve(profile, path, end_s, plan.limits.yaw_rate_rad_s, 0.0)
    return PathSegment(path, heading, end_s)


def _heading_profile(plan: FlightPlan, area: FlightArea, course: Course) -> HeadingProfile:
    """Return the desired heading of a plan."""
    profiles = {
        "shape": course.heading,
        "along": along,
        "across": across,
        "fixed": fixed(0.0),
        "toward": toward(area.pad[:2] + plan.heading_target_m),
    }
    return profiles[plan.heading]


def _on_the_spot(plan: FlightPlan, area: FlightArea, hover: Array, course: Course) -> tuple[Array, Array]:
    """Return times (2,) and points (2, 3) of laps on the spot.

    Raises:
        ConfigError: The hover is too close to a surface.
    """
    collision_free_polyline(area.space, hover[None], plan.margin_m, ["the hover above the pad"])
    laps = max(1, round(plan.tour_s / course.lap_s)) if plan.tour_s > 0.0 else plan.laps
    return np.array([0.0, laps * course.lap_s]), np.stack([hover, hover])


def _laps(
    plan: FlightPlan, arena: Arena, hover: Array, course: Course, rng: np.random.Generator, reverse: bool
) -> tuple[Array, Array]:
    """Return times (K,) and points (K, 3) of all laps of a course, from the hover and back to it.

    Raises:
        ConfigError: There is no collision-free route.
    """
    space = arena.area.space
    order = _order(len(course.lap), course.closed, reverse)
    lap = _perturbed(course.lap, plan, arena, rng)[order]
    laps = plan.laps
    if plan.tour_s > 0.0:
        one, two = (
            minimum_time_knots(_waypoint_sequence(hover, lap, n, course.closed)[0], plan.limits)[-1] for n in (1, 2)
        )
        laps = max(1, round(1.0 + (plan.tour_s - one) / (two - one)))
    points, numbers = _waypoint_sequence(hover, lap, laps, course.closed)
    names = [f"waypoint {order[k]} of the {plan.shape}" if k >= 0 else "the hover above the pad" for k in numbers]
    return collision_free_curve(
        space, collision_free_polyline(space, points, plan.margin_m, names), plan.margin_m, plan.limits
    )


def _order(count: int, closed: bool, reverse: bool) -> npt.NDArray[np.int64]:
    """Return the indices (count,) of the waypoints of a lap in the order of the flight.

    A closed lap begins with its first waypoint, which is close to the hover, in either direction.
    """
    order = np.arange(count)
    return np.roll(order[::-1], 1 if closed else 0) if reverse else order


def _waypoint_sequence(hover: Array, lap: Array, laps: int, closed: bool) -> tuple[Array, list[int]]:
    """Return the points (K, 3) of all laps from the hover and back to it, and the index of each within its lap.

    A closed course returns to its first point. The index of the hover is -1. Points that nearly coincide with the
    previous one, or at the end with the hover, are omitted, since the curve would have to reverse between them.
    """
    numbers = list(range(len(lap))) * laps + [0] * closed
    kept = [-1]
    for number in numbers:
        last = hover if kept[-1] < 0 else lap[kept[-1]]
        if np.linalg.norm(lap[number] - last) >= _APART_M:
            kept.append(number)
    while len(kept) > 1 and np.linalg.norm(lap[kept[-1]] - hover) < _APART_M:
        kept.pop()
    return np.vstack([hover, lap[kept[1:]], hover]), [*kept, -1]


def _perturbed(lap: Array, plan: FlightPlan, arena: Arena, rng: np.random.Generator) -> Array:
    """Return the waypoints (M, 3) of a lap with random displacements as large as clear legs between them allow."""
    moved = lap + plan.waypoint_jitter * arena.half * rng.uniform(-1.0, 1.0, lap.shape)
    for _ in range(_RETREATS):
        clear = leg_clearances(arena.area.space, moved, np.roll(moved, -1, axis=0)) >= plan.margin_m + _SLACK_M
        fine = clear & np.roll(clear, 1)
        moved = np.where(fine[:, None], moved, 0.5 * (moved + lap))
    return np.where(fine[:, None], moved, lap)
