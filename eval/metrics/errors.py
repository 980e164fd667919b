"""Errors of poses: absolute trajectory errors (ATE) and relative pose errors (RPE).

References: Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012; Zhang and Scaramuzza, "A
tutorial on quantitative trajectory evaluation for visual(-inertial) odometry", IROS 2018.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np

from dronevio.eval.metrics.alignment import AlignmentMode, align
from dronevio.eval.metrics.association import Rows
from dronevio.eval.metrics.pairs import PairRule, Pairs, Selection, Source, Unit
from dronevio.models.arrays import Array
from dronevio.models.errors import EvaluationError
from dronevio.models.imu import Times
from dronevio.models.quaternions import (
    Components,
    angles_rad,
    components,
    conjugate,
    product,
    rotate,
)
from dronevio.models.rotation import nearest_rotations, quat_wxyz_from_matrix


@dataclass(frozen=True)
class Statistics:
    """Statistics of errors, in the unit of the errors."""

    rmse: float
    """Root mean square error."""
    mean: float
    """Mean of the errors."""
    median: float
    """Median of the errors."""
    max: float
    """Largest error of all."""
    min: float
    """Smallest error of all."""
    std: float
    """Standard deviation about the mean."""
    n: int
    """Number of the errors."""

    @classmethod
    def of(cls, errors: Array) -> Self:
        """Return the statistics of errors (N,), N > 0.

        Raises:
            EvaluationError: There are no errors, or one of them is not finite.
        """
        e = np.asarray(errors, dtype=np.float64)
        if not e.size or not np.isfinite(e).all():
            raise EvaluationError(
                "errors that are missing or not finite; expected at least one pose, all numbers finite"
            )
        return cls(
            rmse=float(np.sqrt(np.mean(e * e))),
            mean=float(e.mean()),
            median=float(np.median(e)),
            max=float(e.max()),
            min=float(e.min()),
            std=float(e.std()),
            n=int(e.size),
        )


@dataclass(frozen=True, eq=False)
class RelativeErrors:
    """Relative errors of many pairs of poses."""

    first: Rows
    """(M,) Rows of the first poses of the pairs."""
    second: Rows
    """(M,) Rows of the second poses of the pairs."""
    errors_m: Array
    """(M,) Relative position errors [m]."""
    errors_rad: Array
    """(M,) Relative orientation errors [rad]."""

    @property
    def translation_m(self) -> Statistics:
        """Statistics of the position errors [m]."""
        return Statistics.of(self.errors_m)

    @property
    def rotation_deg(self) -> Statistics:
        """Statistics of the orientation errors [°]."""
        return Statistics.of(np.degrees(self.errors_rad))


def ate(
    p_truth: Array,
    p_estimate: Array,
    mode: AlignmentMode = "yaw",
    *,
    n: int | None = None,
    quat_truth_wxyz: Array | None = None,
    quat_estimate_wxyz: Array | None = None,
) -> Statistics:
    """Return the absolute trajectory error [m] of positions (N, 3) at the same times, after alignment.

    For example:

        ate(p_truth, p_estimate).rmse  # yaw and position aligned, over all poses
        ate(p_truth, p_estimate, "sim3", n=500).max

    Args:
        p_truth: (N, 3) True positions [m].
        p_estimate: (N, 3) Estimated positions [m].
        mode: What is aligned; see `align`.
        n: Number of poses to align, from the first on; None for all.
        quat_truth_wxyz: (N, 4) True orientations, which only alignments to the first pose need.
        quat_estimate_wxyz: (N, 4) Estimated orientations, likewise.

    Raises:
        ConfigError: The alignment does not exist.
        EvaluationError: The positions cannot be aligned.
    """
    motion = align(
        p_truth, p_estimate, mode, n=n, quat_truth_wxyz=quat_truth_wxyz, quat_estimate_wxyz=quat_estimate_wxyz
    )
    return Statistics.of(translation_errors_m(p_truth, motion.positions(p_estimate)))


def rpe(
    p_truth: Array,
    quat_truth_wxyz: Array,
    p_estimate: Array,
    quat_estimate_wxyz: Array,
    delta: float = 1.0,
    unit: Unit = "m",
    *,
    selection: Selection = "all",
    source: Source = "truth",
    tolerance: float | None = None,
    t_ns: Times | None = None,
) -> RelativeErrors:
    """Return the relative pose errors over pairs of poses that are a given distance apart.

    For example:

        rpe(p_truth, q_truth, p_estimate, q_estimate, 10.0, "m").translation_m.rmse
        rpe(p_truth, q_truth, p_estimate, q_estimate, 1.0, "s", t_ns=t_ns).rotation_deg.median

    Alignments do not change these errors, except that of the scale.

    Args:
        p_truth: (N, 3) True positions [m].
        quat_truth_wxyz: (N, 4) True orientations, or (N, 3, 3) matrices; see `relative_errors`.
        p_estimate: (N, 3) Estimated positions [m] at the same times.
        quat_estimate_wxyz: (N, 4) Estimated orientations, or (N, 3, 3) matrices.
        delta: Distance between the poses of a pair.
        unit: Unit of the distance: frames, metres, seconds or degrees.
        selection: Whether a pair begins at every pose, or where the previous pair ends.
        source: Trajectory on which pairs are selected.
        tolerance: Largest deviation of pairs from the distance, as a share of it; see `PairRule`.
        t_ns: (N,) Time stamps [ns], which only pairs by seconds need.

    Raises:
        ConfigError: The rule for pairs is invalid.
        EvaluationError: Pairs by seconds have no time stamps.
    """
    rule = PairRule(delta, unit, selection, source, tolerance)
    if t_ns is None:
        if unit == "s":
            raise EvaluationError("pairs by seconds without time stamps; expected t_ns")
        t_ns = np.arange(len(p_truth))
    chosen = (p_truth, quat_truth_wxyz) if source == "truth" else (p_estimate, quat_estimate_wxyz)
    pairs = rule.select(t_ns, chosen[0], quaternions_of(chosen[1]) if unit == "deg" else chosen[1])
    errors = relative_errors(p_truth, quat_truth_wxyz, p_estimate, quat_estimate_wxyz, pairs)
    return RelativeErrors(*pairs, *errors)


def translation_errors_m(p_truth: Array, p_estimate: Array) -> Array:
    """Return the distances (N,) [m] between positions (N, 3)."""
    d = np.subtract(p_truth, p_estimate)
    return np.asarray(np.sqrt(np.einsum("...i,...i->...", d, d)))


def rotation_errors_rad(quat_truth_wxyz: Array, quat_estimate_wxyz: Array) -> Array:
    """Return the angles (N,) [rad], 0 to π, between orientations (N, 4)."""
    return angles_rad(product(conjugate(components(quat_truth_wxyz)), components(quat_estimate_wxyz)))


def relative_errors(
    p_truth: Array, quat_truth_wxyz: Array, p_estimate: Array, quat_estimate_wxyz: Array, pairs: Pairs
) -> tuple[Array, Array]:
    """Return the relative errors (M,) [m] and (M,) [rad] over pairs of poses.

    With true poses Q and estimated poses P, these are the lengths of the translations and the angles of the rotations
    of E = (Qᵢ⁻¹Qⱼ)⁻¹(Pᵢ⁻¹Pⱼ) (Sturm 2012, eq. 1). Alignments do not change them, except that of the scale.

    Orientations may also be matrices (N, 3, 3). Matrices from a text file are orthonormal up to rounding only; they are
    applied to displacements as they are, as other programs do.

    Args:
        p_truth: (N, 3) True positions [m].
        quat_truth_wxyz: (N, 4) True orientations.
        p_estimate: (N, 3) Estimated positions [m].
        quat_estimate_wxyz: (N, 4) Estimated orientations.
        pairs: Rows i (M,) and j (M,) of the pairs.
    """
    # The translation of E is the difference of the displacements in another frame, and has the same length.
    of_truth = _displacements(p_truth, quat_truth_wxyz, pairs)
    of_estimate = _displacements(p_estimate, quat_estimate_wxyz, pairs)
    squares = ((a - b) ** 2 for a, b in zip(of_truth, of_estimate, strict=True))
    return np.sqrt(sum(squares)), angles_rad(rotation_between(quat_truth_wxyz, quat_estimate_wxyz, pairs))


def rotation_between(quat_truth_wxyz: Array, quat_estimate_wxyz: Array, pairs: Pairs) -> Components:
    """Return the rotations of E (M,), see `relative_errors`, in the IMU frame at the second pose of each pair."""
    i, j = pairs
    rotations = [
        product(conjugate(components(q[i])), components(q[j]))
        for q in (quaternions_of(quat_truth_wxyz), quaternions_of(quat_estimate_wxyz))
    ]
    return product(conjugate(rotations[0]), rotations[1])


def distance_errors_percent(p_truth: Array, p_estimate: Array, pairs: Pairs) -> Array:
    """Return the errors (K,) of the distances between the positions of pairs [% of the true distance].

    They do not depend on orientations. Pairs whose true positions coincide are omitted.
    """
    i, j = pairs
    true, estimated = (translation_errors_m(p[j], p[i]) for p in (p_truth, p_estimate))
    distinct = true > 0.0
    return np.asarray(100.0 * np.abs(true - estimated)[distinct] / true[distinct])


def quaternions_of(orientations: Array) -> Array:
    """Return orientations, which are quaternions (N, 4) or matrices (N, 3, 3), as quaternions (N, 4)."""
    return quat_wxyz_from_matrix(nearest_rotations(orientations)) if orientations.ndim == 3 else orientations


def _displacements(p: Array, orientations: Array, pairs: Pairs) -> tuple[Array, Array, Array]:
    """Return the displacements of pairs in the IMU frames of their first poses, as x, y and z (M,) each [m]."""
    i, j = pairs
    displacement = p[j] - p[i]
    if orientations.ndim == 3:
        x, y, z = np.einsum("nji,nj->in", orientations[i], displacement)
    else:
        in_world = displacement[:, 0], displacement[:, 1], displacement[:, 2]
        x, y, z = rotate(conjugate(components(orientations[i])), in_world)
    return x, y, z
