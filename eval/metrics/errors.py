"""Errors of poses: absolute (ATE) and relative (RPE).

References: Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012; Zhang and Scaramuzza, "A
tutorial on quantitative trajectory evaluation for visual(-inertial) odometry", IROS 2018.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np
import numpy.typing as npt

from dronevio.eval.metrics.alignment import AlignmentMode, align, quat_product_wxyz
from dronevio.eval.metrics.association import Rows, nearest_rows
from dronevio.models.errors import EvaluationError
from dronevio.models.imu import Times
from dronevio.models.rotation import matrix_from_quat_wxyz

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Statistics:
    """What is said of many errors, in their unit."""

    rmse: float
    """Root of the mean square."""
    mean: float
    """Mean."""
    median: float
    """Median."""
    max: float
    """Largest."""

    @classmethod
    def of(cls, errors: Array) -> Self:
        """Return the statistics of errors (N,), N > 0.

        Raises:
            EvaluationError: There are none, or one is not finite.
        """
        e = np.asarray(errors, dtype=np.float64)
        if not e.size or not np.isfinite(e).all():
            raise EvaluationError(
                "errors that are missing or not finite; expected at least one pose, all numbers finite"
            )
        return cls(float(np.sqrt(np.mean(e * e))), float(e.mean()), float(np.median(e)), float(e.max()))


def translation_errors_m(p_truth: Array, p_estimate: Array) -> Array:
    """Return the distances (N,) [m] between positions (N, 3)."""
    return np.asarray(np.linalg.norm(p_truth - p_estimate, axis=-1))


def rotation_errors_rad(quat_truth_wxyz: Array, quat_estimate_wxyz: Array) -> Array:
    """Return the angles (N,) [rad], 0 to π, between orientations (N, 4)."""
    return _angles_rad(_conjugate(quat_truth_wxyz), quat_estimate_wxyz)


def ate(p_truth: Array, p_estimate: Array, mode: AlignmentMode = "yaw") -> Statistics:
    """Return the absolute trajectory error [m] of positions (N, 3) at the same instants, after alignment.

    Raises:
        EvaluationError: The positions cannot be aligned.
    """
    return Statistics.of(translation_errors_m(p_truth, align(p_truth, p_estimate, mode).positions(p_estimate)))


def pairs_after_time(t_ns: Times, delta_s: float, tolerance_s: float | None = None) -> tuple[Rows, Rows]:
    """Return the pairs of rows (M,), (M,) that lie ``delta_s`` apart in time.

    They depend on time stamps only, never on what an estimator says, so that all are scored on the same ones. Every row
    starts at most one pair, and a gap in the stamps loses pairs but never shifts them.

    Args:
        t_ns: (N,) Time stamps [ns], increasing.
        delta_s: How far apart [s].
        tolerance_s: How much the time between the two may differ from it [s]; None for 3 %.
    """
    if len(t_ns) == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    wanted = t_ns + round(delta_s * 1e9)
    second = nearest_rows(t_ns, wanted)
    tolerance_ns = (0.03 * delta_s if tolerance_s is None else tolerance_s) * 1e9
    first = np.flatnonzero((np.abs(t_ns[second] - wanted) <= tolerance_ns) & (second > np.arange(len(t_ns))))
    return first, second[first]


def pairs_after_distance(p_truth: Array, delta_m: float, tolerance_m: float | None = None) -> tuple[Rows, Rows]:
    """Return the pairs of rows (M,), (M,) that lie ``delta_m`` apart on the true path.

    Args:
        p_truth: (N, 3) True positions [m].
        delta_m: How far apart along the path [m].
        tolerance_m: How much the way between the two may differ from it [m]; None for 10 %.
    """
    way_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(p_truth, axis=0), axis=1))])
    wanted = way_m + delta_m
    after = np.clip(np.searchsorted(way_m, wanted), 0, len(way_m) - 1)
    before = np.searchsorted(way_m, way_m[np.maximum(after - 1, 0)])  # the first of those where it stood still
    second = np.where(wanted - way_m[before] <= np.abs(way_m[after] - wanted), before, after)
    tolerance_m = 0.1 * delta_m if tolerance_m is None else tolerance_m
    first = np.flatnonzero((np.abs(way_m[second] - wanted) <= tolerance_m) & (second > np.arange(len(way_m))))
    return first, second[first]


def relative_errors(
    p_truth: Array, quat_truth_wxyz: Array, p_estimate: Array, quat_estimate_wxyz: Array, pairs: tuple[Rows, Rows]
) -> tuple[Array, Array]:
    """Return the relative errors (M,) [m] and (M,) [rad] over pairs of poses.

    With true poses Q and estimated ones P, it is the size of E = (Qᵢ⁻¹Qⱼ)⁻¹(Pᵢ⁻¹Pⱼ) (Sturm 2012, eq. 1). No alignment
    but that of the scale changes it.

    Args:
        p_truth: (N, 3) True positions [m].
        quat_truth_wxyz: (N, 4) True orientations.
        p_estimate: (N, 3) Estimated positions [m].
        quat_estimate_wxyz: (N, 4) Estimated orientations.
        pairs: Rows i (M,) and j (M,).
    """
    i, j = pairs
    step_truth = _in_frame(quat_truth_wxyz[i], p_truth[j] - p_truth[i])
    step_estimate = _in_frame(quat_estimate_wxyz[i], p_estimate[j] - p_estimate[i])
    turn_truth = quat_product_wxyz(_conjugate(quat_truth_wxyz[i]), quat_truth_wxyz[j])
    turn_estimate = quat_product_wxyz(_conjugate(quat_estimate_wxyz[i]), quat_estimate_wxyz[j])
    # The translation of E is this difference, rotated: of the same length.
    return translation_errors_m(step_truth, step_estimate), _angles_rad(_conjugate(turn_truth), turn_estimate)


def _in_frame(quat_wxyz: Array, v: Array) -> Array:
    """Return vectors (N, 3) of the world in frames of the given orientations (N, 4)."""
    return np.asarray(np.einsum("nji,nj->ni", matrix_from_quat_wxyz(quat_wxyz), v))


def _conjugate(quat_wxyz: Array) -> Array:
    """Return the inverse rotations (…, 4)."""
    return np.asarray(quat_wxyz * np.array([1.0, -1.0, -1.0, -1.0]))


def _angles_rad(q: Array, r: Array) -> Array:
    """Return the angles (N,) [rad] of the products of quaternions (N, 4) of any length."""
    product = quat_product_wxyz(q, r)
    # From the vector part: exact for small angles, where the arc cosine of w loses half the digits.
    return np.asarray(2.0 * np.arctan2(np.linalg.norm(product[..., 1:], axis=-1), np.abs(product[..., 0])))
