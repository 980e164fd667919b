"""A picture of a score: the path from above, and the errors over time."""

from pathlib import Path

import numpy as np

from dronevio.eval.metrics import ScoredTrajectory
from dronevio.eval.report.drawing import figure, save_png
from dronevio.eval.report.plots import ABOVE, draw_orientation_error, draw_path, draw_position_error
from dronevio.models.recordings.files import check_place


def write_score_plot(path: Path, scored: ScoredTrajectory) -> None:
    """Draw an estimate beside the truth into a PNG file.

    Args:
        path: Where to; folders that are missing on the way are made.
        scored: The estimate beside the truth.

    Raises:
        InputError: A folder is there, or a file where one of its folders should be.
    """
    check_place(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    origin_ns = int(scored.truth.t_ns[0])
    with figure(14.0, 4.6, columns=3) as (fig, axes):
        draw_path(axes[0], ABOVE, scored.estimate, scored.truth, np.zeros((0, 2, 3)))
        draw_position_error(axes[1], scored, origin_ns)
        draw_orientation_error(axes[2], scored, origin_ns)
    save_png(fig, path)
