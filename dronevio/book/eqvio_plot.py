"""The picture of ``dronevio book eqvio``: two estimators' paths of one real flight."""

from pathlib import Path

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure

from dronevio.eval.style import ESTIMATE, ROOM, TRUTH
from dronevio.models.imu import Times

Array = npt.NDArray[np.float64]


def draw_two_paths(t_ns: Times, ours_m: Array, theirs_m: Array, path: Path) -> None:
    """Draw two aligned paths from above and from the side, and their distance over time.

    Args:
        t_ns: (N,) Time stamps of both [ns].
        ours_m: (N, 3) Positions of the smoother [m].
        theirs_m: (N, 3) Positions of the filter at the same times, aligned [m].
        path: PNG file to write.
    """
    figure = Figure(figsize=(12.0, 7.0), layout="constrained")
    above, side, distance = figure.subplot_mosaic([["above", "side"], ["above", "distance"]]).values()
    for axes, (i, j), title in ((above, (0, 1), "from above"), (side, (0, 2), "from the side")):
        axes.plot(theirs_m[:, i], theirs_m[:, j], color=TRUTH, label="EqVIO (gtsam), a filter")
        axes.plot(ours_m[:, i], ours_m[:, j], color=ESTIMATE, label="dronevio, a fixed-lag smoother")
        axes.plot(*ours_m[0, [i, j]], "o", color=ROOM)
        axes.annotate("start", (ours_m[0, i], ours_m[0, j]), textcoords="offset points", xytext=(8, -4), color=ROOM)
        axes.set(title=title, xlabel="x [m]", ylabel=f"{'xyz'[j]} [m]", aspect="equal")
        axes.grid(alpha=0.3)
    above.legend(loc="best")
    distance.plot((t_ns - t_ns[0]) * 1e-9, 100.0 * np.linalg.norm(ours_m - theirs_m, axis=1), color=ESTIMATE)
    distance.set(
        title="between the two", xlabel="time since the smoother's start [s]", ylabel="distance [cm]", ylim=(0, None)
    )
    distance.grid(alpha=0.3)
    figure.suptitle("Half a minute of EuRoC V1_01: real IMU, real image features")
    figure.savefig(path, dpi=120)
