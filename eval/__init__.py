"""Scores estimates, and shows them: metrics, reports, rerun recordings.

On plain arrays, in three lines:

    from dronevio.eval import ate, rpe

    print(ate(p_truth, p_estimate, "yaw").rmse)
    print(rpe(p_truth, q_truth, p_estimate, q_estimate, 10.0, "m").translation_m.rmse)

Importing this package loads nothing; `dronevio.eval.metrics`, behind these names, needs nothing but numpy.
"""

from importlib import import_module
from typing import TYPE_CHECKING

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
    from dronevio.eval.run import running_scores

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
    "running_scores",
    "score",
    "score_trajectory",
]

_ELSEWHERE = {
    "estimate_time_offset_s": "dronevio.eval.metrics.time_offset",
    "kitti_scores": "dronevio.eval.metrics.kitti",
    "running_scores": "dronevio.eval.run",
}


def __getattr__(name: str) -> object:
    """Import a public name when it is asked for (PEP 562)."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_ELSEWHERE.get(name, "dronevio.eval.metrics")), name)
