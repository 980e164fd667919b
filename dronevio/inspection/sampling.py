"""Sampling of the frames of a recording: runs of consecutive frames, spread evenly over it."""

import numpy as np
import numpy.typing as npt

from dronevio.models.imu import Times

Rows = npt.NDArray[np.int64]

FRAMES = 240
"""Number of sampled frames; all frames of a shorter recording."""
RUN_S = 1.0
"""Shortest duration of a run [s], so that a drone rotates while it lasts."""
MIN_RUN_FRAMES = 16
"""Smallest number of frames of a run."""
MIN_RUNS = 6
"""Smallest number of runs, so that clocks can be compared at several times of the recording."""


def sampled_runs(frame_times_ns: Times) -> list[Rows]:
    """Return the indices of the sampled frames, in runs of consecutive frames.

    Args:
        frame_times_ns: (M,) Time stamps of all frames [ns].
    """
    count = len(frame_times_ns)
    if count <= FRAMES:
        return [np.arange(count)] if count else []
    interval_s = max(float(np.median(np.diff(frame_times_ns))) * 1e-9, 1e-4)
    length = max(MIN_RUN_FRAMES, int(np.ceil(RUN_S / interval_s)))
    runs = min(max(FRAMES // length, MIN_RUNS), count // length)
    if runs < 2:
        return [np.arange(min(count, length))]
    starts = np.linspace(0, count - length, runs).round().astype(np.int64)
    return [np.arange(start, start + length) for start in starts.tolist()]
