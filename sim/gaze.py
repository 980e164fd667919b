"""Where the nose points along a path: a wish for every instant, and a heading that follows it at a limited rate."""

from collections.abc import Callable
from typing import Literal

import numpy as np
import numpy.typing as npt
from scipy.interpolate import BSpline

Array = npt.NDArray[np.float64]
Gaze = Callable[[Array, Array, Array], Array]
"""Maps times (N,) since the path's start [s], positions (N, 3) [m] and velocities (N, 3) [m/s] to the headings (N,)
that are wished for [rad]; NaN where any will do."""
Heading = Literal["shape", "along", "across", "fixed", "toward"]
"""How a path may be flown: as its shape has it, nose first, right side first, always facing x, facing a point."""

_DEGREE = 5  # the angular acceleration that it asks for is smooth, too
_SLOW_M_S = 0.15  # below this speed a direction of motion is none
_NEAR_M = 0.3  # a point closer than this, in the plane, has no direction
_SPACING_S = 0.2  # between the control points of the heading
_YAW_ACCEL_RAD_S2 = 5.0  # a third of what the rotors' drag torque can do at hover
_KERNEL_PEAK = 0.55  # of a quintic B-spline, in units of its spacing: how fast it lets a rate build up
_RESERVE = 0.999


def along(t: Array, position: Array, velocity: Array) -> Array:
    """Look where the path leads."""
    moving = np.hypot(velocity[:, 0], velocity[:, 1]) > _SLOW_M_S
    return np.where(moving, np.arctan2(velocity[:, 1], velocity[:, 0]), np.nan)


def across(t: Array, position: Array, velocity: Array) -> Array:
    """Fly with the right side first: look to the left of where the path leads."""
    return along(t, position, velocity) + 0.5 * np.pi


def fixed(yaw_rad: float) -> Gaze:
    """Look one way all the time."""
    return lambda t, position, velocity: np.full(len(t), yaw_rad)


def toward(point: Array) -> Gaze:
    """Look at a point (3,) of the world [m]."""

    def gaze(t: Array, position: Array, velocity: Array) -> Array:
        ahead = point[:2] - position[:, :2]
        far = np.hypot(ahead[:, 0], ahead[:, 1]) > _NEAR_M
        return np.where(far, np.arctan2(ahead[:, 1], ahead[:, 0]), np.nan)

    return gaze


def spinning(rate_rad_s: float, lap_s: float) -> Gaze:
    """Turn one way for half a lap, and the other way for the other half."""
    return lambda t, position, velocity: rate_rad_s * np.abs((t + 0.5 * lap_s) % lap_s - 0.5 * lap_s)


def heading_curve(gaze: Gaze, path: BSpline, end_s: float, yaw_rate_rad_s: float, yaw_rad: float) -> BSpline:
    """Return the heading [rad] over the times of a path, at rest at both ends.

    Its control points follow what is wished for, the short way round and by no more than the limit allows from one to
    the next. A spline changes no faster than its control points do, so that it obeys the limit everywhere.

    Args:
        gaze: What is wished for.
        path: Positions (N, 3) over time [m].
        end_s: The path's end; it starts at 0 [s].
        yaw_rate_rad_s: How fast the heading may change [rad/s].
        yaw_rad: The heading at the start [rad].
    """
    spacing = max(_SPACING_S, _KERNEL_PEAK * yaw_rate_rad_s / _YAW_ACCEL_RAD_S2)
    intervals = max(int(np.ceil(end_s / spacing)), 1)
    spacing = end_s / intervals
    knots = spacing * np.arange(-_DEGREE, intervals + _DEGREE + 1)
    # A control point speaks for the middle of its basis function; the first ones and the last ones for standing still.
    middles = spacing * (np.arange(intervals + _DEGREE) - 0.5 * (_DEGREE - 1))
    t = np.clip(middles, 0.0, end_s)
    wishes = gaze(t, path(t), path.derivative()(t))
    wishes[:_DEGREE] = np.nan
    wishes[-_DEGREE:] = np.nan
    most, yaw, control = _RESERVE * yaw_rate_rad_s * spacing, yaw_rad, np.empty(len(t))
    for k, wish in enumerate(wishes):
        if np.isfinite(wish):
            turn = (wish - yaw + np.pi) % (2.0 * np.pi) - np.pi
            yaw += min(max(turn, -most), most)
        control[k] = yaw
    return BSpline(knots, control, _DEGREE)
