"""Errors by sub-trajectory length: how the error grows with the way flown.

From every pose on, the estimate is compared with the truth after a certain length of the true path. Two numbers come
out of every such piece: the relative error, for which the whole first pose is made to meet, and the drift, for which
only its position and yaw are, because gravity tells a visual-inertial estimator roll and pitch and a tilt that it has
wrong is an error of its own making.

Reference: Zhang and Scaramuzza, "A tutorial on quantitative trajectory evaluation for visual(-inertial) odometry", IROS
2018, section IV.C.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dronevio.eval.metrics.errors import Statistics, relative_errors, rotation_between
from dronevio.eval.metrics.pairs import Pairs, pairs_after_distance
from dronevio.models.errors import ConfigError
from dronevio.models.quaternions import components, conjugate, euler_zyx_rad, product, yaw_rad

Array = npt.NDArray[np.float64]

SHARES = (0.1, 0.2, 0.3, 0.4, 0.5)
"""The usual lengths, as shares of the whole path."""
_TOLERANCE = 0.2  # of the length, by which a piece may miss it; that of the reference's toolbox
_MOST = 100_000  # pieces of one length; of more, which overlap all the more, every so-many-th says as much


@dataclass(frozen=True)
class LengthErrors:
    """Errors after one length of path."""

    length_m: float
    """Length of the true path [m]."""
    translation_m: Statistics
    """Relative errors of position [m]."""
    translation_percent: Statistics
    """The same by the length [%]."""
    rotation_deg: Statistics
    """Relative errors of orientation [°]."""
    yaw_deg: Statistics
    """Their part about the vertical [°]."""
    tilt_deg: Statistics
    """Their part that leaves the vertical [°]."""
    drift_percent: Statistics
    """Errors of position, position and yaw aligned where the piece begins, by the length [%]."""


def errors_by_length(
    p_truth: Array, quat_truth_wxyz: Array, p_estimate: Array, quat_estimate_wxyz: Array, lengths_m: tuple[float, ...]
) -> tuple[LengthErrors, ...]:
    """Return the errors after each of some lengths that occurs on the path.

    Args:
        p_truth: (N, 3) True positions [m].
        quat_truth_wxyz: (N, 4) True orientations.
        p_estimate: (N, 3) Estimated positions [m].
        quat_estimate_wxyz: (N, 4) Estimated orientations, in a world whose z axis is up.
        lengths_m: Lengths of the true path [m].

    Raises:
        ConfigError: A length is not above zero.
    """
    truth, estimate = (p_truth, quat_truth_wxyz), (p_estimate, quat_estimate_wxyz)
    found = []
    for length_m in lengths_m:
        if not 0.0 < length_m < 1e9:
            raise ConfigError(f"sub-trajectories of {length_m:g} m; expected a length above zero")
        first, second = pairs_after_distance(p_truth, length_m, _TOLERANCE * length_m)
        if not len(first):
            continue
        every = 1 + (len(first) - 1) // _MOST
        pairs = first[::every], second[::every]
        errors_m, errors_rad = relative_errors(*truth, *estimate, pairs)
        yaw, tilt = _yaw_and_tilt_rad(quat_truth_wxyz, quat_estimate_wxyz, pairs)
        found.append(
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
    return tuple(found)


def drifts_m(
    p_truth: Array, quat_truth_wxyz: Array, p_estimate: Array, quat_estimate_wxyz: Array, pairs: Pairs
) -> Array:
    """Return the errors (M,) [m] of position at the ends of pairs whose beginnings meet in position and yaw.

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
    """Return the parts (M,), (M,) [rad] of the rotation errors about the vertical and away from it.

    The error, seen in the estimate's world, is taken apart into yaw, pitch and roll; the tilt is the root of the
    squares of the last two, as in the reference's toolbox.
    """
    end = components(quat_estimate_wxyz[pairs[1]])
    error = rotation_between(quat_truth_wxyz, quat_estimate_wxyz, pairs)
    yaw, pitch, roll = euler_zyx_rad(product(product(end, error), conjugate(end)))
    return np.abs(yaw), np.hypot(pitch, roll)
