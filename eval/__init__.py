"""Evaluation of estimates: metrics, benchmarks, reports and rerun recordings.

On plain arrays, in three lines:

    from dronevio.eval import ate, rpe

    print(ate(p_truth, p_estimate, "yaw").rmse)
    print(rpe(p_truth, q_truth, p_estimate, q_estimate, 10.0, "m").translation_m.rmse)

Importing this package loads nothing. The metrics need only numpy, and scipy for bounds of χ².
"""

from typing import TYPE_CHECKING

from dronevio._lazy import attach

if TYPE_CHECKING:
    from dronevio.eval.metrics import (
        align,
        anees,
        associate,
        ate,
        errors_by_length,
        nees,
        nees_bounds,
        rpe,
        score,
        score_trajectory,
    )
    from dronevio.eval.metrics.kitti import kitti_scores
    from dronevio.eval.metrics.time_offset import estimate_time_offset_s
    from dronevio.eval.run import score_run

__all__ = [
    "align",
    "anees",
    "associate",
    "ate",
    "errors_by_length",
    "estimate_time_offset_s",
    "kitti_scores",
    "nees",
    "nees_bounds",
    "rpe",
    "score",
    "score_run",
    "score_trajectory",
]

__getattr__, __dir__ = attach(
    __name__,
    {
        "dronevio.eval.metrics": (
            "align",
            "anees",
            "associate",
            "ate",
            "errors_by_length",
            "nees",
            "nees_bounds",
            "rpe",
            "score",
            "score_trajectory",
        ),
        "dronevio.eval.metrics.kitti": ("kitti_scores",),
        "dronevio.eval.metrics.time_offset": ("estimate_time_offset_s",),
        "dronevio.eval.run": ("score_run",),
    },
)
