"""Errors by sub-trajectory length: how the error grows with the length of the path.

From every pose on, the estimate is compared with the truth after a given length of the true path. For the relative
error, the complete first poses are aligned. For the drift, only their position and yaw are aligned: gravity makes roll
and pitch observable, so that an error of theirs is an error of the estimator.

Reference: Zhang and Scaramuzza, "A tutorial on quantitative trajectory evaluation for visual(-inertial) odometry", IROS
2018, section IV.C.
"""

from dataclasses import dataclass

import numpy as np

from dronevio.eval.metrics.errors import Statistics, relative_errors, rotation_between
from dronevio.eval.metrics.pairs import Pairs, pairs_after_distance
from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError
from dronevio.models.quaternions import components, conjugate, euler_zyx_rad, product, yaw_rad

DEFAULT_SHARES = (0.1, 0.2, 0.3, 0.4, 0.5)
"""Default lengths as shares of the length of the path."""
_TOLERANCE = 0.2  # of a sub-trajectory, as a share of the length: that of the rpg toolbox
_MAX_PAIRS = 100_000  # of one length; more overlap so much that every k-th of them suffices


@dataclass(frozen=True)
class LengthErrors:
    """Errors over sub-trajectories of one length."""

    length_m: float
    """Length of the true path [m]."""
    translation_m: Statistics
    """Relative position errors [m]."""
    translation_percent: Statistics
    """Relative position errors as a share of the length [%]."""
    rotation_deg: Statistics
    """Relative orientation errors [°]."""
    yaw_deg: Statistics
    """Magnitudes of the yaw of these errors [°]."""
    tilt_deg: Statistics
    """Root sum squares of pitch and roll of these errors [°]."""
    drift_percent: Statistics
    """Position errors at the end, with position and yaw aligned at the beginning, as a share of the length [%]."""


def errors_by_length(
    p_truth: Array, quat_truth_wxyz: Array, p_estimate: Array, quat_estimate_wxyz: Array, lengths_m: tuple[float, ...]
) -> tuple[LengthErrors, ...]:
    """Return the errors over sub-trajectories of several lengths; lengths that do not occur are omitted.

    Args:
        p_truth: (N, 3) True positions [m].
        quat_truth_wxyz: (N, 4) True orientations.
        p_estimate: (N, 3) Estimated positions [m].
        quat_estimate_wxyz: (N, 4) Estimated orientations, in a world frame whose z axis is up.
        lengths_m: Lengths of the true path [m].

    Raises:
        ConfigError: A length is not positive.
    """
    truth, estimate = (p_truth, quat_truth_wxyz), (p_estimate, quat_estimate_wxyz)
    errors_of_lengths = []
    for length_m in lengths_m:
        pairs = pairs_of_length(p_truth, length_m)
        if not len(pairs[0]):
            continue
        errors_m, errors_rad = relative_errors(*truth, *estimate, pairs)
        yaw, tilt = _yaw_and_tilt_rad(quat_truth_wxyz, quat_estimate_wxyz, pairs)
        errors_of_lengths.append(
            LengthErrors(
                length_m,
                translation_m=Statistics.of(errors_m),
                translation_percent=Statistics.of(100.0 / length_m * errors_m),
                rotation_deg=Statistics.of(np.degrees(errors_rad)),
                yaw_deg=Statistics.of(np.degrees(yaw)),
                tilt_deg=Statistics.of(np.degrees(tilt)),
                drift_percent=Statistics.of(100.0 / length_m * drifts_m(*truth, *estimate, pairs)),
            )
        )
    return tuple(errors_of_lengths)


def pairs_of_length(p_truth: Array, length_m: float) -> Pairs:
    """Return first and last rows (M,), (M,) of the sub-trajectories of a length, at most 100 000, evenly spread.

    Args:
        p_truth: (N, 3) True positions [m].
        length_m: Length of the true path [m].

    Raises:
        ConfigError: The length is not positive.
    """
    if not 0.0 < length_m < 1e9:
        raise ConfigError(f"sub-trajectories of {length_m:g} m; expected a length above zero")
    first, last = pairs_after_distance(p_truth, length_m, _TOLERANCE * length_m)
    step = 1 + max(len(first) - 1, 0) // _MAX_PAIRS
    return first[::step], last[::step]


def drifts_m(
    p_truth: Array, quat_truth_wxyz: Array, p_estimate: Array, quat_estimate_wxyz: Array, pairs: Pairs
) -> Array:
    """Return the position errors (M,) [m] at the end of pairs whose beginnings are aligned in position and yaw.

    Args:
        p_truth: (N, 3) True positions [m].
        quat_truth_wxyz: (N, 4) True orientations.
        p_estimate: (N, 3) Estimated positions [m].
        quat_estimate_wxyz: (N, 4) Estimated orientations.
        pairs: Rows at the beginning (M,) and at the end (M,).
    """
    i, j = pairs
    yaw = yaw_rad(product(components(quat_truth_wxyz[i]), conjugate(components(quat_estimate_wxyz[i]))))
    c, s = np.cos(yaw), np.sin(yaw)
    a, b = p_truth[j] - p_truth[i], p_estimate[j] - p_estimate[i]
    x = a[:, 0] - (c * b[:, 0] - s * b[:, 1])
    y = a[:, 1] - (s * b[:, 0] + c * b[:, 1])
    z = a[:, 2] - b[:, 2]
    return np.asarray(np.sqrt(x * x + y * y + z * z))


def _yaw_and_tilt_rad(quat_truth_wxyz: Array, quat_estimate_wxyz: Array, pairs: Pairs) -> tuple[Array, Array]:
    """Return the magnitude of yaw (M,) and the tilt (M,) of the relative orientation errors [rad].

    The error in the estimate's world frame is decomposed into yaw, pitch and roll; the tilt is the root sum square of
    the latter two, as in the rpg toolbox.
    """
    end = components(quat_estimate_wxyz[pairs[1]])
    error = rotation_between(quat_truth_wxyz, quat_estimate_wxyz, pairs)
    yaw, pitch, roll = euler_zyx_rad(product(product(end, error), conjugate(end)))
    return np.abs(yaw), np.hypot(pitch, roll)
