"""Metrics of trajectories (alignment, absolute and relative errors, scale, coverage, consistency) and reconstructions.

The metrics import only numpy; bounds of χ² import scipy when they are computed. To score a trajectory:

    from dronevio.eval.metrics import score

    scores = score(truth, estimate)
    print(scores.ate_m.rmse, scores.rpe_m)

On plain arrays, ``ate(p_truth, p_estimate, "yaw").rmse`` gives the absolute trajectory error.
"""

from dronevio.eval.metrics.alignment import IDENTITY, Alignment, AlignmentMode, align, umeyama
from dronevio.eval.metrics.association import Association, associate, interpolate, nearest
from dronevio.eval.metrics.consistency import (
    Anees,
    Consistency,
    anchor_first,
    anees,
    consistency,
    nees,
    nees_bounds,
    relative_to_first,
)
from dronevio.eval.metrics.errors import (
    RelativeErrors,
    Statistics,
    ate,
    relative_errors,
    rotation_errors_rad,
    rpe,
    translation_errors_m,
)
from dronevio.eval.metrics.lengths import LengthErrors, errors_by_length
from dronevio.eval.metrics.metric import Metric
from dronevio.eval.metrics.pairs import PairRule, pairs_after_distance, pairs_after_time
from dronevio.eval.metrics.reconstruction import (
    PositionComparison,
    ReconstructionStatistics,
    ResidualField,
    compare_positions,
    reconstruction_statistics,
    residual_field,
)
from dronevio.eval.metrics.scores import (
    ScoredTrajectory,
    Scores,
    coverage_percent,
    scale_error_percent,
    score,
    score_trajectory,
)
from dronevio.eval.metrics.trajectory_errors import ScoreOptions

__all__ = [
    "IDENTITY",
    "Alignment",
    "AlignmentMode",
    "Anees",
    "Association",
    "Consistency",
    "LengthErrors",
    "Metric",
    "PairRule",
    "PositionComparison",
    "ReconstructionStatistics",
    "RelativeErrors",
    "ResidualField",
    "ScoreOptions",
    "ScoredTrajectory",
    "Scores",
    "Statistics",
    "align",
    "anchor_first",
    "anees",
    "associate",
    "ate",
    "compare_positions",
    "consistency",
    "coverage_percent",
    "errors_by_length",
    "interpolate",
    "nearest",
    "nees",
    "nees_bounds",
    "pairs_after_distance",
    "pairs_after_time",
    "reconstruction_statistics",
    "relative_errors",
    "relative_to_first",
    "residual_field",
    "rotation_errors_rad",
    "rpe",
    "scale_error_percent",
    "score",
    "score_trajectory",
    "translation_errors_m",
    "umeyama",
]
