"""Where the nose points along a path: a wish for every instant, and a heading that follows it at a limited rate."""

import math
from collections.abc import Callable
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from scipy.interpolate import BSpline

Array = npt.NDArray[np.float64]
HeadingProfile = Callable[[Array, Array, Array], Array]
"""Maps times (N,) since the path's start [s], positions (N, 3) [m] and velocities (N, 3) [m/s] to the headings (N,)
that are wished for [rad]; NaN where any will do."""
Heading = Literal["shape", "along", "across", "fixed", "toward"]
"""How a path may be flown: as its shape has it, nose first, right side first, always facing x, facing a point."""

_DEGREE = 5  # the angular acceleration that it asks for is smooth, too
_SLOW_M_S = 0.15  # below this speed a direction of motion is none
_NEAR_M = 0.3  # a point closer than this, in the plane, has no direction
_SPACING_S = 0.1  # between the control points of the heading
_YAW_ACCEL_RAD_S2 = 5.0  # a third of what the rotors' drag torque can do at hover
_SOFT_S = 0.3  # how quickly a small error is made good
_RESERVE = 0.999


def along(t: Array, position: Array, velocity: Array) -> Array:
    """Look where the path leads."""
    moving = np.hypot(velocity[:, 0], velocity[:, 1]) > _SLOW_M_S
    return np.where(moving, np.arctan2(velocity[:, 1], velocity[:, 0]), np.nan)


def across(t: Array, position: Array, velocity: Array) -> Array:
    """Fly with the right side first: look to the left of where the path leads."""
    return along(t, position, velocity) + 0.5 * np.pi


def fixed(yaw_rad: float) -> HeadingProfile:
    """Look one way all the time."""
    return lambda t, position, velocity: np.full(len(t), yaw_rad)


def toward(point: Array) -> HeadingProfile:
    """Look at a point (3,) of the world [m]."""

    def profile(t: Array, position: Array, velocity: Array) -> Array:
        ahead = point[:2] - position[:, :2]
        far = np.hypot(ahead[:, 0], ahead[:, 1]) > _NEAR_M
        return np.where(far, np.arctan2(ahead[:, 1], ahead[:, 0]), np.nan)

    return profile


def spinning(rate_rad_s: float, turn_s: float, lap_s: float) -> HeadingProfile:
    """Turn one way for half of some seconds, the other way for the other half, and stay so for the rest of a lap."""

    def profile(t: Array, position: Array, velocity: Array) -> Array:
        phase = t % lap_s
        return rate_rad_s * np.maximum(np.minimum(phase, turn_s - phase), 0.0)

    return profile


def heading_curve(
    profile: HeadingProfile, path: BSpline, end_s: float, yaw_rate_rad_s: float, yaw_rad: float
) -> BSpline:
    """Return the heading [rad] over the times of a path, at rest at both ends.

    Its control points follow what is wished for, the short way round. A spline changes no faster than its control
    points do, and neither does its rate: what they keep to, the heading keeps to everywhere.

    Args:
        profile: What is wished for.
        path: Positions (N, 3) over time [m].
        end_s: The path's end; it starts at 0 [s].
        yaw_rate_rad_s: How fast the heading may change [rad/s].
        yaw_rad: The heading at the start [rad].
    """
    intervals = max(int(np.ceil(end_s / _SPACING_S)), 1)
    spacing = end_s / intervals
    knots = spacing * np.arange(-_DEGREE, intervals + _DEGREE + 1)
    # A control point speaks for the middle of its basis function.
    t = np.clip(spacing * (np.arange(intervals + _DEGREE) - 0.5 * (_DEGREE - 1)), 0.0, end_s)
    wishes = profile(t, path(t), path.derivative()(t))
    braking = int(np.ceil(yaw_rate_rad_s / (_YAW_ACCEL_RAD_S2 * spacing)))
    wishes[:_DEGREE] = wishes[max(len(wishes) - _DEGREE - braking, 0) :] = np.nan
    return BSpline(knots, _rate_limited(wishes, spacing, _RESERVE * yaw_rate_rad_s, yaw_rad), _DEGREE)


def _rate_limited(wishes: Array, step_s: float, rate_rad_s: float, yaw_rad: float) -> Array:
    """Return headings (N,) that follow wishes (N,) at a limited rate and angular acceleration; NaN wishes for rest."""
    gain = _YAW_ACCEL_RAD_S2 * step_s
    ahead = np.append(_wrapped(np.diff(wishes)) / step_s, np.nan)
    yaw, rate, headings = yaw_rad, 0.0, np.empty(len(wishes))
    for k, wish in enumerate(wishes.tolist()):
        wanted = 0.0
        if np.isfinite(wish):
            error = _wrapped(wish - yaw)
            brisk = math.sqrt(2.0 * _YAW_ACCEL_RAD_S2 * abs(error))  # it can still be stopped in time
            wanted = math.copysign(min(brisk, abs(error) / _SOFT_S), error)
            wanted += ahead[k] if abs(ahead[k]) < rate_rad_s else 0.0
        wanted = min(max(wanted, -rate_rad_s), rate_rad_s)
        rate = min(max(wanted, rate - gain), rate + gain)
        yaw += rate * step_s
        headings[k] = yaw
    return headings


def _wrapped(angle: Any) -> Any:
    """Return angles between -π and π [rad]."""
    return (angle + np.pi) % (2.0 * np.pi) - np.pi
