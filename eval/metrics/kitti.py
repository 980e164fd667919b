"""The errors of the KITTI odometry benchmark in its own arithmetic, so that they are comparable with its tables.

From every tenth frame on, segments of 100 to 800 m of the true path are compared, and their errors relative to the
length are averaged (Geiger, Lenz, Urtasun, CVPR 2012). The matrices are used as rounded in the file, and the angle is
the arc cosine of the trace, which loses half of the digits: small rotation errors, such as those from frame to frame,
are wrong by up to a few per cent. All published figures were computed in this way; `relative_errors` is exact.
"""

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt

from dronevio.eval.metrics.alignment import umeyama
from dronevio.eval.metrics.pairs import path_lengths_m
from dronevio.models.arrays import Array
from dronevio.models.errors import EvaluationError, unknown_name

Frames = npt.NDArray[np.int64]

LENGTHS_M = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)
"""Lengths of the segments [m]."""
STEP = 10
"""Number of frames between the beginnings of segments."""

KittiAlignment = Literal["first", "se3", "sim3", "scale"]
"""What is aligned besides the first pose: nothing; rotation and position; these and the scale; or the scale only."""


@dataclass(frozen=True)
class KittiScores:
    """Scores of the KITTI odometry benchmark."""

    translation_percent: float | None
    """Mean position error of all segments relative to their length [%]; None if the path is too short."""
    rotation_deg_per_100_m: float | None
    """Mean orientation error of all segments relative to their length [°/100 m]; None if the path is too short."""
    segments: int
    """Number of segments of all lengths."""
    ate_m: float
    """Root mean square position error [m]."""
    rpe_m: float
    """Mean relative position error from frame to frame [m]."""
    rpe_deg: float
    """Mean relative orientation error from frame to frame [°]."""
    by_length: tuple[tuple[float, float, float], ...]
    """Length [m], mean position error [%] and mean orientation error [°/100 m] for each length that occurs."""


def kitti_scores(
    Ts_truth: Array,
    Ts_estimate: Array,
    frames: Frames | None = None,
    alignment: KittiAlignment = "first",
    lengths_m: tuple[float, ...] = LENGTHS_M,
) -> KittiScores:
    """Return the scores of the KITTI odometry benchmark.

    Args:
        Ts_truth: (N, 3, 4) True poses of frames 0 to N − 1.
        Ts_estimate: (M, 3, 4) Estimated poses.
        frames: (M,) Increasing indices of the estimated frames; None for all frames.
        alignment: What is aligned besides the first pose.
        lengths_m: Lengths of the segments [m].

    Raises:
        ConfigError: There is no such alignment.
        EvaluationError: An estimated frame has no true pose, or truth and estimate cannot be aligned.
    """
    if alignment not in get_args(KittiAlignment):
        raise unknown_name("alignment", alignment, get_args(KittiAlignment))
    frames = np.arange(len(Ts_estimate)) if frames is None else frames
    if len(frames) != len(Ts_estimate) or len(frames) < 2 or frames[-1] >= len(Ts_truth):
        raise EvaluationError(
            f"{len(Ts_estimate)} estimated poses of {len(frames)} frames, {len(Ts_truth)} true ones;"
            " expected two or more, of frames with a true pose"
        )
    truth, estimate = _homogeneous(Ts_truth), _homogeneous(Ts_estimate)
    at_frames = np.linalg.inv(truth[frames[0]]) @ truth[frames]
    estimate = _aligned(at_frames, np.linalg.inv(estimate[0]) @ estimate, alignment)
    lengths, errors_m, errors_rad = _segment_errors(truth, estimate, frames, lengths_m)
    i = np.flatnonzero(np.diff(frames) == 1)
    step_m, step_rad = _errors(_motions(at_frames, i, i + 1), _motions(estimate, i, i + 1))
    difference = at_frames[:, :3, 3] - estimate[:, :3, 3]
    percent, per_100_m = 100.0 * errors_m / lengths, 100.0 * np.degrees(errors_rad) / lengths
    return KittiScores(
        translation_percent=float(percent.mean()) if len(lengths) else None,
        rotation_deg_per_100_m=float(per_100_m.mean()) if len(lengths) else None,
        segments=len(lengths),
        ate_m=float(np.sqrt(np.mean(np.sum(difference * difference, axis=1)))),
        rpe_m=float(step_m.mean()) if len(i) else 0.0,
        rpe_deg=float(np.degrees(step_rad.mean())) if len(i) else 0.0,
        by_length=tuple(
            (length, float(percent[lengths == length].mean()), float(per_100_m[lengths == length].mean()))
            for length in lengths_m
            if np.any(lengths == length)
        ),
    )


def _segment_errors(
    truth: Array, estimate: Array, frames: Frames, lengths_m: tuple[float, ...]
) -> tuple[Array, Array, Array]:
    """Return length [m], position error [m] and orientation error [rad] of all segments (S,)."""
    path = path_lengths_m(truth[:, :3, 3])
    row_of_frame = np.full(len(truth), -1)
    row_of_frame[frames] = np.arange(len(frames))
    starts = np.arange(0, len(truth), STEP)
    first, last, lengths = [], [], []
    for length_m in lengths_m:
        ends = np.searchsorted(path, path[starts] + length_m, side="right")  # the first frame beyond the length
        reached = ends < len(path)
        i, j = starts[reached], ends[reached]
        both = (row_of_frame[i] >= 0) & (row_of_frame[j] >= 0)
        first.append(i[both])
        last.append(j[both])
        lengths.append(np.full(int(both.sum()), length_m))
    i, j = np.concatenate(first), np.concatenate(last)
    motions = _motions(estimate, row_of_frame[i], row_of_frame[j])
    return np.concatenate(lengths), *_errors(motions, _motions(truth, i, j))


def _aligned(truth: Array, estimate: Array, alignment: KittiAlignment) -> Array:
    """Return estimated poses (M, 4, 4), whose first one coincides with the truth, after the alignment."""
    aligned, p = estimate.copy(), estimate[:, :3, 3]
    if alignment == "scale":
        aligned[:, :3, 3] *= np.sum(truth[:, :3, 3] * p) / np.sum(p * p)
    elif alignment != "first":
        motion = umeyama(truth[:, :3, 3], p, with_scale=alignment == "sim3")
        aligned[:, :3, :3] = motion.R_truth_estimate @ estimate[:, :3, :3]
        aligned[:, :3, 3] = motion.positions(p)
    return aligned


def _motions(Ts: Array, i: Frames, j: Frames) -> Array:
    """Return the relative poses (P, 4, 4) from poses i (P,) to poses j (P,)."""
    return np.asarray(np.linalg.inv(Ts[i]) @ Ts[j])


def _errors(a: Array, b: Array) -> tuple[Array, Array]:
    """Return the translation lengths (P,) [m] and rotation angles (P,) [rad] of a⁻¹ b."""
    E = np.linalg.inv(a) @ b
    cosine = 0.5 * (np.trace(E[:, :3, :3], axis1=1, axis2=2) - 1.0)
    return np.linalg.norm(E[:, :3, 3], axis=1), np.arccos(np.clip(cosine, -1.0, 1.0))


def _homogeneous(Ts: Array) -> Array:
    """Return poses (N, 3, 4) or (N, 4, 4) as homogeneous matrices (N, 4, 4)."""
    T = np.zeros((len(Ts), 4, 4))
    T[:, :3] = Ts[:, :3]
    T[:, 3, 3] = 1.0
    return T
