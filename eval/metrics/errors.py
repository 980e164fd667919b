"""Errors of poses: absolute (ATE) and relative (RPE).

References: Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012; Zhang and Scaramuzza, "A
tutorial on quantitative trajectory evaluation for visual(-inertial) odometry", IROS 2018.
"""

from dataclasses import dataclass
from typing import Self

import numpy as np
import numpy.typing as npt

from dronevio.eval.metrics.alignment import AlignmentMode, align
from dronevio.eval.metrics.association import Rows
from dronevio.eval.metrics.pairs import PairRule, Pairs, Source, Unit, Which
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
    min: float
    """Smallest."""
    std: float
    """Standard deviation about the mean."""
    n: int
    """How many errors they are."""

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
    """(M,) Row of the pose with which each pair begins."""
    second: Rows
    """(M,) Row of the pose with which it ends."""
    errors_m: Array
    """(M,) Errors of position [m]."""
    errors_rad: Array
    """(M,) Errors of orientation [rad]."""

    @property
    def translation_m(self) -> Statistics:
        """The errors of position [m] in figures."""
        return Statistics.of(self.errors_m)

    @property
    def rotation_deg(self) -> Statistics:
        """The errors of orientation [°] in figures."""
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
    """Return the absolute trajectory error [m] of positions (N, 3) at the same instants, after alignment.

    For example:

        ate(p_truth, p_estimate).rmse  # yaw and position aligned, over all poses
        ate(p_truth, p_estimate, "sim3", n=500).max

    Args:
        p_truth: (N, 3) True positions [m].
        p_estimate: (N, 3) Estimated positions [m].
        mode: What to take out; see `align`, also for the other arguments.
        n: Over how many poses to align, from the first on; None for all.
        quat_truth_wxyz: (N, 4) True orientations; only the alignments to the first pose need them.
        quat_estimate_wxyz: (N, 4) Estimated orientations.

    Raises:
        ConfigError: There is no such alignment.
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
    which: Which = "all",
    source: Source = "truth",
    tolerance: float | None = None,
    t_ns: Times | None = None,
) -> RelativeErrors:
    """Return the relative pose errors of poses at the same instants, over pairs that lie some way apart.

    For example:

        rpe(p_truth, q_truth, p_estimate, q_estimate, 10.0, "m").translation_m.rmse
        rpe(p_truth, q_truth, p_estimate, q_estimate, 1.0, "s", t_ns=t_ns).rotation_deg.median

    No alignment changes them but that of the scale.

    Args:
        p_truth: (N, 3) True positions [m].
        quat_truth_wxyz: (N, 4) True orientations; or (N, 3, 3) matrices, see `relative_errors`.
        p_estimate: (N, 3) Estimated positions [m].
        quat_estimate_wxyz: (N, 4) Estimated orientations, or (N, 3, 3) matrices.
        delta: How far apart the poses of a pair are.
        unit: In frames, metres, seconds or degrees.
        which: Pairs from every pose on, or one behind the other.
        source: On whose path they are chosen.
        tolerance: By what share of delta all pairs may miss it; see `PairRule`.
        t_ns: (N,) Time stamps [ns], for pairs by seconds.

    Raises:
        ConfigError: There are no such pairs.
        EvaluationError: There are no time stamps for pairs by seconds.
    """
    rule = PairRule(delta, unit, which, source, tolerance)
    if t_ns is None:
        if unit == "s":
            raise EvaluationError("pairs by seconds without time stamps; expected t_ns as well")
        t_ns = np.arange(len(p_truth))
    chosen = (p_truth, quat_truth_wxyz) if source == "truth" else (p_estimate, quat_estimate_wxyz)
    pairs = rule.choose(t_ns, chosen[0], quaternions_of(chosen[1]) if unit == "deg" else chosen[1])
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

    With true poses Q and estimated ones P, it is the size of E = (Qᵢ⁻¹Qⱼ)⁻¹(Pᵢ⁻¹Pⱼ) (Sturm 2012, eq. 1). No alignment
    but that of the scale changes it.

    Orientations may also be matrices (N, 3, 3). Those of a text file are rotations to its digits only; steps are turned
    by them as they are, as other programs do.

    Args:
        p_truth: (N, 3) True positions [m].
        quat_truth_wxyz: (N, 4) True orientations.
        p_estimate: (N, 3) Estimated positions [m].
        quat_estimate_wxyz: (N, 4) Estimated orientations.
        pairs: Rows i (M,) and j (M,).
    """
    # The translation of E is the difference of the steps, turned: of the same length.
    step_truth = _steps(p_truth, quat_truth_wxyz, pairs)
    step_estimate = _steps(p_estimate, quat_estimate_wxyz, pairs)
    squares = ((a - b) ** 2 for a, b in zip(step_truth, step_estimate, strict=True))
    return np.sqrt(sum(squares)), angles_rad(rotation_between(quat_truth_wxyz, quat_estimate_wxyz, pairs))


def rotation_between(quat_truth_wxyz: Array, quat_estimate_wxyz: Array, pairs: Pairs) -> Components:
    """Return the rotations of E (M,), see `relative_errors`, in the frame at the end of each estimated step."""
    i, j = pairs
    turns = [
        product(conjugate(components(q[i])), components(q[j]))
        for q in (quaternions_of(quat_truth_wxyz), quaternions_of(quat_estimate_wxyz))
    ]
    return product(conjugate(turns[0]), turns[1])


def distance_errors_percent(p_truth: Array, p_estimate: Array, pairs: Pairs) -> Array:
    """Return by how much the distances between the positions of pairs are wrong (M,) [% of the true distance].

    Orientations play no part in it. Pairs of which the true positions are one are left out.
    """
    i, j = pairs
    true, estimated = (translation_errors_m(p[j], p[i]) for p in (p_truth, p_estimate))
    apart = true > 0.0
    return np.asarray(100.0 * np.abs(true - estimated)[apart] / true[apart])


def quaternions_of(orientations: Array) -> Array:
    """Return orientations as quaternions (N, 4), which they are, or were matrices (N, 3, 3)."""
    return quat_wxyz_from_matrix(nearest_rotations(orientations)) if orientations.ndim == 3 else orientations


def _steps(p: Array, orientations: Array, pairs: Pairs) -> tuple[Array, Array, Array]:
    """Return the ways from the first to the second positions of pairs, in the frames of the first (3 × (M,)) [m]."""
    i, j = pairs
    step = p[j] - p[i]
    if orientations.ndim == 3:
        x, y, z = np.einsum("nji,nj->in", orientations[i], step)
    else:
        x, y, z = rotate(conjugate(components(orientations[i])), (step[:, 0], step[:, 1], step[:, 2]))
    return x, y, z
