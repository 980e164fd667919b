"""IMU samples that arrive in bursts: drivers of serial ports read several at once and give them one time stamp."""

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array
from dronevio.models.imu import Times

Rows = npt.NDArray[np.int64]


def spread_bursts(t_ns: Times, values: Array) -> tuple[Times, Rows]:
    """Spread samples that have one time stamp evenly over the time since the previous stamp.

    Samples arrive in bursts if at least half of them share their stamp with another one of different values. Then, the
    n samples of the stamp t get the stamps t − Δt + k Δt / n for k = 1 … n, where Δt is the time since the previous
    stamp. Where that is unknown, or more than twice as long as n samples usually take, it is what they usually take.
    Other stamps that occur twice are left to the reader.

    Args:
        t_ns: (N,) Time stamps in the order of the rows [ns].
        values: (N, C) Values of the samples.

    Returns:
        The time stamps (N,) [ns], and the first row of each burst; the stamps themselves and none without bursts.
    """
    n = len(t_ns)
    if n < 2:
        return t_ns, np.zeros(0, np.int64)
    begins = np.concatenate([[True], np.diff(t_ns) != 0])
    is_copy = np.concatenate([[False], ~begins[1:] & (values[1:] == values[:-1]).all(axis=1)])
    run = np.cumsum(begins) - 1
    distinct = np.bincount(run, weights=~is_copy)
    if np.median(distinct[run]) < 2:
        return t_ns, np.zeros(0, np.int64)
    first = np.flatnonzero(begins)
    count = np.diff(np.concatenate([first, [n]]))
    since_ns = np.concatenate([[0], np.diff(t_ns[first])])
    known = since_ns > 0
    usual_ns = float(np.median((since_ns / count)[known])) * count if known.any() else np.zeros(len(first))
    covered_ns = np.where(known & (since_ns <= 2.0 * usual_ns), since_ns, usual_ns).astype(np.int64)
    later = (count - 1)[run] - (np.arange(n) - first[run])  # samples of the burst that follow
    return t_ns - later * covered_ns[run] // count[run], first[count > 1]
