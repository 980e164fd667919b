"""Heading along a path: a desired heading at every time, and a heading that follows it at limited rate."""

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from dronevio.models.arrays import Array

if TYPE_CHECKING:
    from scipy.interpolate import BSpline

HeadingProfile = Callable[[Array, Array, Array], Array]
"""Function from times (N,) since the start of the path [s], positions (N, 3) [m] and velocities (N, 3) [m/s] to the
desired headings (N,) [rad]; NaN where the heading is arbitrary."""
Heading = Literal["shape", "along", "across", "fixed", "toward"]
"""Modes of the heading: as defined by the shape, along the path, across it, fixed along x, or toward a point."""

_DEGREE = 5  # the angular acceleration is smooth, too
_SLOW_M_S = 0.15  # below this speed, the direction of motion is undefined
_NEAR_M = 0.3  # horizontal distance below which the direction to a point is undefined
_SPACING_S = 0.1  # between the control points of the heading
_YAW_ACCEL_RAD_S2 = 5.0  # a third of the capability of the rotors at hover
_SOFT_S = 0.3  # time constant of the correction of small errors
_RESERVE = 0.999


def along(t: Array, position: Array, velocity: Array) -> Array:
    """Return the headings along the velocity."""
    moving = np.hypot(velocity[:, 0], velocity[:, 1]) > _SLOW_M_S
    return np.where(moving, np.arctan2(velocity[:, 1], velocity[:, 0]), np.nan)


def across(t: Array, position: Array, velocity: Array) -> Array:
    """Return the headings perpendicular to the velocity, with the right side of the drone first."""
    return along(t, position, velocity) + 0.5 * np.pi


def fixed(yaw_rad: float) -> HeadingProfile:
    """Return the profile of a constant heading."""
    return lambda t, position, velocity: np.full(len(t), yaw_rad)


def toward(point: Array) -> HeadingProfile:
    """Return the profile of headings toward a point (3,) in the world [m]."""

    def profile(t: Array, position: Array, velocity: Array) -> Array:
        ahead = point[:2] - position[:, :2]
        far = np.hypot(ahead[:, 0], ahead[:, 1]) > _NEAR_M
        return np.where(far, np.arctan2(ahead[:, 1], ahead[:, 0]), np.nan)

    return profile


def mirrored(profile: HeadingProfile) -> HeadingProfile:
    """Return the profile of headings that turn in the opposite direction."""
    return lambda t, position, velocity: -profile(t, position, velocity)


def spinning(rate_rad_s: float, turn_s: float, lap_s: float) -> HeadingProfile:
    """Return the profile of a rotation back and forth.

    Args:
        rate_rad_s: Angular velocity [rad/s].
        turn_s: Duration of the rotation, half of it in each direction [s].
        lap_s: Duration of a lap, in whose rest the heading is constant [s].
    """

    def profile(t: Array, position: Array, velocity: Array) -> Array:
        phase = t % lap_s
        return rate_rad_s * np.maximum(np.minimum(phase, turn_s - phase), 0.0)

    return profile


def heading_curve(
    profile: HeadingProfile, path: "BSpline", end_s: float, yaw_rate_rad_s: float, yaw_rad: float
) -> "BSpline":
    """Return the heading [rad] over the time of a path, at rest at both ends.

    The control points follow the desired headings on the shorter way. The derivatives of a spline are bounded by the
    differences of its control points, so the limits that these keep hold everywhere.

    Args:
        profile: The desired headings.
        path: Positions (N, 3) over time [m].
        end_s: End time of the path, which starts at 0 [s].
        yaw_rate_rad_s: Largest rate of the heading [rad/s].
        yaw_rad: The heading at the start [rad].
    """
    from scipy.interpolate import BSpline  # its import takes 0.7 s, and flight plans alone do not need it

    intervals = max(int(np.ceil(end_s / _SPACING_S)), 1)
    spacing = end_s / intervals
    knots = spacing * np.arange(-_DEGREE, intervals + _DEGREE + 1)
    # A control point belongs to the middle of its basis function.
    t = np.clip(spacing * (np.arange(intervals + _DEGREE) - 0.5 * (_DEGREE - 1)), 0.0, end_s)
    desired = profile(t, path(t), path.derivative()(t))
    braking = int(np.ceil(yaw_rate_rad_s / (_YAW_ACCEL_RAD_S2 * spacing)))
    desired[:_DEGREE] = desired[max(len(desired) - _DEGREE - braking, 0) :] = np.nan
    return BSpline(knots, _rate_limited(desired, spacing, _RESERVE * yaw_rate_rad_s, yaw_rad), _DEGREE)


def _rate_limited(desired: Array, step_s: float, rate_rad_s: float, yaw_rad: float) -> Array:
    """Return headings (N,) that follow desired ones (N,) at limited rate and angular acceleration; NaN means rest."""
    gain = _YAW_ACCEL_RAD_S2 * step_s
    ahead = np.append(_wrapped(np.diff(desired)) / step_s, np.nan)
    yaw, rate, headings = yaw_rad, 0.0, np.empty(len(desired))
    for k, target in enumerate(desired.tolist()):
        wanted = 0.0
        if np.isfinite(target):
            error = _wrapped(target - yaw)
            brisk = math.sqrt(2.0 * _YAW_ACCEL_RAD_S2 * abs(error))  # can still be stopped in time
            wanted = math.copysign(min(brisk, abs(error) / _SOFT_S), error)
            wanted += ahead[k] if abs(ahead[k]) < rate_rad_s else 0.0
        wanted = min(max(wanted, -rate_rad_s), rate_rad_s)
        rate = min(max(wanted, rate - gain), rate + gain)
        yaw += rate * step_s
        headings[k] = yaw
    return headings


def _wrapped(angle: Any) -> Any:
    """Return angles wrapped to [−π, π) [rad]."""
    return (angle + np.pi) % (2.0 * np.pi) - np.pi
