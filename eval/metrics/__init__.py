"""How good an estimate is: alignment, absolute and relative errors, scale, coverage, consistency.

Needs nothing but numpy. A trajectory's score in three lines::

    from dronevio.eval.metrics import score

    scores = score(truth, estimate)
    print(scores.ate_m.rmse, scores.rpe_m)

and on plain arrays, ``ate(p_truth, p_estimate, "yaw").rmse``.
"""

from dronevio.eval.metrics.alignment import IDENTITY, Alignment, AlignmentMode, align, umeyama
from dronevio.eval.metrics.association import interpolate, nearest
from dronevio.eval.metrics.consistency import Consistency, anchor_first, consistency, nees
from dronevio.eval.metrics.errors import (
    Statistics,
    ate,
    pairs_after_distance,
    pairs_after_time,
    relative_errors,
    rotation_errors_rad,
    translation_errors_m,
)
from dronevio.eval.metrics.scores import (
    Association,
    ScoredTrajectory,
    Scores,
    associate,
    coverage_percent,
    scale_error_percent,
    score,
    score_trajectory,
)

__all__ = [
    "IDENTITY",
    "Alignment",
    "AlignmentMode",
    "Association",
    "Consistency",
    "ScoredTrajectory",
    "Scores",
    "Statistics",
    "align",
    "anchor_first",
    "associate",
    "ate",
    "consistency",
    "coverage_percent",
    "interpolate",
    "nearest",
    "nees",
    "pairs_after_distance",
    "pairs_after_time",
    "relative_errors",
    "rotation_errors_rad",
    "scale_error_percent",
    "score",
    "score_trajectory",
    "translation_errors_m",
    "umeyama",
]
