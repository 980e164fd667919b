"""Figure of the experiment ``dronevio book eqvio``."""

import numpy as np
from matplotlib.figure import Figure

from dronevio.eval.colours import ESTIMATE, SURROUNDINGS, TRUTH
from dronevio.models.arrays import Array
from dronevio.models.imu import Times


def draw_two_paths(t_ns: Times, smoother_m: Array, eqvio_m: Array) -> Figure:
    """Draw two aligned paths from above and from the side, and the distance between them over time.

    Args:
        t_ns: (N,) Time stamps of both paths [ns].
        smoother_m: (N, 3) Positions of the smoother [m].
        eqvio_m: (N, 3) Positions of the filter at the same times, aligned to the smoother [m].
    """
    figure = Figure(figsize=(12.0, 7.0), layout="constrained")
    above, side, distance = figure.subplot_mosaic([["above", "side"], ["above", "distance"]]).values()
    for axes, (i, j), title in ((above, (0, 1), "From above"), (side, (0, 2), "From the side")):
        axes.plot(eqvio_m[:, i], eqvio_m[:, j], color=TRUTH, label="EqVIO (GTSAM), a filter")
        axes.plot(smoother_m[:, i], smoother_m[:, j], color=ESTIMATE, label="dronevio, a fixed-lag smoother")
        start = smoother_m[0, [i, j]]
        axes.plot(*start, "o", color=SURROUNDINGS)
        axes.annotate("start", (start[0], start[1]), textcoords="offset points", xytext=(8, -4), color=SURROUNDINGS)
        axes.set(title=title, xlabel="x [m]", ylabel=f"{'xyz'[j]} [m]", aspect="equal")
        axes.grid(alpha=0.3)
    above.legend(loc="best")
    distance.plot((t_ns - t_ns[0]) * 1e-9, 100.0 * np.linalg.norm(smoother_m - eqvio_m, axis=1), color=ESTIMATE)
    distance.set(
        title="Distance between the two",
        xlabel="time since the initialization of the smoother [s]",
        ylabel="distance [cm]",
        ylim=(0, None),
    )
    distance.grid(alpha=0.3)
    figure.suptitle("Half a minute of EuRoC V1_01: real IMU samples, real image features")
    return figure
