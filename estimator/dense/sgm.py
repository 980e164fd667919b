"""Semi-global matching: aggregation of a cost volume along eight directions.

Source: Hirschmüller, "Stereo processing by semiglobal matching and mutual information", PAMI 2008, section 2.2.
"""

from typing import TypeVar

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Floats

Number = TypeVar("Number", np.float32, np.uint16)
Costs = npt.NDArray[np.uint8]
Sums = npt.NDArray[np.uint16]

_EDGE_GREY = 20.0  # difference of grey values of neighbours at which the penalty of a jump is halved


def aggregate(costs: Costs, grey: Floats, small_penalty: float, large_penalty: float) -> Sums:
    """Return the sum over eight directions r of the path costs L_r.

        L_r(p, d) = C(p, d) + min(L_r(p−r, d), L_r(p−r, d±1) + P1, min_i L_r(p−r, i) + P2) − min_k L_r(p−r, k).

    The penalty P2 is smaller where the grey values of p and p − r differ.

    Args:
        costs: (H, D, W) Costs, at most 250.
        grey: (H, W) Grey values, 0 to 255.
        small_penalty: P1, for a change by one step, in units of the costs.
        large_penalty: P2, for a larger change; the sum of both is at most 1000.

    Returns:
        (H, D, W) Sums in the units of the costs.
    """
    P1, P2 = np.uint16(round(small_penalty)), large_penalty
    total = np.zeros(costs.shape, np.uint16)
    _add_paths(costs, grey, P1, P2, (-1, 0, 1), total)
    # Rows of the transposed volume are columns.
    turned = np.ascontiguousarray(costs.transpose(2, 1, 0))
    sums = np.zeros(turned.shape, np.uint16)
    _add_paths(turned, np.ascontiguousarray(grey.T), P1, P2, (0,), sums)
    total += sums.transpose(2, 1, 0)
    return total


def _add_paths(volume: Costs, grey: Floats, P1: np.uint16, P2: float, shifts: tuple[int, ...], total: Sums) -> None:
    """Add the path costs that run down and up the rows, with some shifts of the column from row to row."""
    H, D, W = volume.shape
    for rows in (range(H), range(H - 1, -1, -1)):
        paths = np.zeros((len(shifts), D, W), np.uint16)
        previous = None
        for y in rows:
            if previous is not None:
                paths = _step(paths, volume[y], _penalties(grey[y], grey[previous], shifts, P1, P2), P1, shifts)
            else:
                paths[:] = volume[y]
            total[y] += paths.sum(axis=0, dtype=np.uint16)
            previous = y


def _penalties(row: Floats, previous: Floats, shifts: tuple[int, ...], P1: np.uint16, P2: float) -> Sums:
    """Return the penalty of a jump (S, 1, W) between the pixels of a row and their predecessors."""
    difference = np.stack([np.abs(row - _shifted(previous, s)) for s in shifts])
    return np.maximum(P2 / (1.0 + difference / _EDGE_GREY), P1 + 1.0).astype(np.uint16)[:, None]


def _step(paths: Sums, costs: Costs, P2: Sums, P1: np.uint16, shifts: tuple[int, ...]) -> Sums:
    """Return the path costs (S, D, W) of the next row."""
    if shifts != (0,):
        paths = np.stack([_shifted(path, s) for path, s in zip(paths, shifts, strict=True)])
    lowest = paths.min(axis=1, keepdims=True)
    new: Sums = np.minimum(paths, lowest + P2)
    raised = paths + P1
    np.minimum(new[:, 1:], raised[:, :-1], out=new[:, 1:])
    np.minimum(new[:, :-1], raised[:, 1:], out=new[:, :-1])
    new -= lowest
    new += costs
    return new


def _shifted(row: npt.NDArray[Number], shift: int) -> npt.NDArray[Number]:
    """Return values (…, W) moved by one column; the first or last column is repeated."""
    if shift == 0:
        return row
    if shift > 0:
        return np.concatenate([row[..., :1], row[..., :-1]], axis=-1)
    return np.concatenate([row[..., 1:], row[..., -1:]], axis=-1)


def subpixel_minimum(total: Sums) -> tuple[npt.NDArray[np.int64], Floats]:
    """Return the index of the lowest cost (H, W), and the offset (H, W) from it to the vertex of a parabola.

    Args:
        total: (H, D, W) Costs, D ≥ 3.
    """
    lowest = np.argmin(total, axis=1)
    inner = np.clip(lowest, 1, total.shape[1] - 2)
    before, here, after = (
        np.take_along_axis(total, (inner + k)[:, None], axis=1)[:, 0].astype(np.float32) for k in (-1, 0, 1)
    )
    curvature = before - 2.0 * here + after
    offset = np.where(curvature > 0.0, 0.5 * (before - after) / np.maximum(curvature, 1.0), 0.0)
    return lowest, np.where(lowest == inner, offset, 0.0).astype(np.float32)
