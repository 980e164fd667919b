"""Pairs of poses for relative errors: a number of frames, metres, seconds or degrees apart.

``all`` selects a pair from every pose to the pose whose distance is nearest to the wanted one; ``consecutive`` selects
pairs that begin where the previous one ends, at the first pose that is at least so far away. Pairs should be selected
on the truth, so that all estimators are scored on the same ones.
"""

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from dronevio.eval.metrics.association import Rows, nearest_rows
from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError
from dronevio.models.imu import Times
from dronevio.models.quaternions import angles_rad, components, conjugate, product, select

Pairs = tuple[Rows, Rows]
"""First and second rows of pairs, each (M,)."""

Unit = Literal["frames", "m", "s", "deg"]
"""Unit of the distance between the poses of a pair: frames, metres of path, seconds, or degrees of rotation."""
Selection = Literal["all", "consecutive"]
"""Whether a pair begins at every pose, or where the previous pair ends."""
Source = Literal["truth", "estimate"]
"""Trajectory on which pairs are selected."""

_TOLERANCE = 0.1  # of metres and degrees, as a share of the distance: that of evo
_TIME_TOLERANCE = 0.03  # of seconds, likewise
_BLOCK_SIZE = 1 << 22  # orientations that are compared at a time, 32 MB per component


@dataclass(frozen=True)
class PairRule:
    """The rule by which the pairs of poses of relative errors are selected."""

    delta: float = 1.0
    """Distance between the poses of a pair, in the unit."""
    unit: Unit = "s"
    """Unit of the distance."""
    selection: Selection = "all"
    """Whether a pair begins at every pose, or where the previous pair ends."""
    source: Source = "truth"
    """Trajectory on which pairs are selected."""
    tolerance: float | None = None
    """Largest deviation of ``all`` pairs from the distance, as a share of it; None for 0.1 of metres and degrees, and
    for seconds that of `pairs_after_time`."""

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ConfigError: A value is out of range.
        """
        for value, kind in ((self.unit, Unit), (self.selection, Selection), (self.source, Source)):
            if value not in get_args(kind):
                raise ConfigError(f"pairs by {value!r}; expected one of {', '.join(get_args(kind))}")
        if not 0.0 < self.delta < 1e6:
            raise ConfigError(f"a relative error over {self.delta:g} {self.unit}; expected a distance above zero")
        if self.unit == "frames" and self.delta != round(self.delta):
            raise ConfigError(f"a relative error over {self.delta:g} frames; expected a whole number")
        if self.unit == "deg" and self.selection == "all" and self.delta > 180.0:
            raise ConfigError(f"orientations {self.delta:g}° apart; expected 180° at most, or consecutive pairs")
        if self.tolerance is not None and not 0.0 <= self.tolerance < 1.0:
            raise ConfigError(f"pairs within {self.tolerance:g} of their distance; expected a share of 0 to below 1")

    @property
    def label(self) -> str:
        """The distance with its unit as text, such as ``1 s``."""
        return f"{self.delta:g}{'°' if self.unit == 'deg' else ' ' + self.unit}"

    @property
    def delta_s(self) -> float | None:
        """The distance [s]; None if its unit is not the second."""
        return self.delta if self.unit == "s" else None

    def select(self, t_ns: Times, p: Array, quat_wxyz: Array) -> Pairs:
        """Return the pairs of poses with time stamps (N,), positions (N, 3) and orientations (N, 4)."""
        if self.selection == "consecutive":
            return consecutive_pairs(self._progress(t_ns, p, quat_wxyz), self.delta)
        if self.unit == "frames":
            return pairs_after_frames(len(t_ns), round(self.delta))
        if self.unit == "s":
            return pairs_after_time(t_ns, self.delta, None if self.tolerance is None else self.tolerance * self.delta)
        share = _TOLERANCE if self.tolerance is None else self.tolerance
        if self.unit == "m":
            return pairs_after_distance(p, self.delta, share * self.delta)
        return pairs_after_rotation(quat_wxyz, np.radians(self.delta), share * np.radians(self.delta))

    def _progress(self, t_ns: Times, p: Array, quat_wxyz: Array) -> Array:
        """Return the progress along the trajectory at each pose (N,), in the unit."""
        if self.unit == "frames":
            return np.arange(len(t_ns), dtype=np.float64)
        if self.unit == "s":
            return np.asarray((t_ns - t_ns[:1]) * 1e-9)
        return path_lengths_m(p) if self.unit == "m" else np.degrees(accumulated_rotation_rad(quat_wxyz))


def path_lengths_m(p: Array) -> Array:
    """Return the length of the path up to each position (N, 3): (N,) [m]."""
    return _cumulative(np.linalg.norm(np.diff(p, axis=0), axis=1), len(p))


def accumulated_rotation_rad(quat_wxyz: Array) -> Array:
    """Return the sum of the rotation angles between successive orientations (N, 4), up to each of them: (N,) [rad]."""
    q = components(quat_wxyz)
    before, after = select(q, slice(None, -1)), select(q, slice(1, None))
    return _cumulative(angles_rad(product(conjugate(before), after)), len(quat_wxyz))


def consecutive_pairs(progress: Array, delta: float) -> Pairs:
    """Return the pairs of rows (M,), (M,) that follow one another, each at least ``delta`` of progress (N,) long."""
    following = np.searchsorted(progress, progress + delta).tolist()
    rows = [0] if len(progress) else []
    while rows and (row := following[rows[-1]]) < len(progress):
        rows.append(row)
    chain = np.array(rows, dtype=np.int64)
    return chain[:-1], chain[1:]


def pairs_after_frames(n: int, delta: int) -> Pairs:
    """Return the pairs of rows (M,), (M,) out of n that are ``delta`` rows apart."""
    first = np.arange(max(n - delta, 0))
    return first, first + delta


def pairs_after_time(t_ns: Times, delta_s: float, tolerance_s: float | None = None) -> Pairs:
    """Return the pairs of rows (M,), (M,) that are ``delta_s`` apart in time.

    Every row begins at most one pair. A gap in the time stamps removes pairs but does not shift them.

    Args:
        t_ns: (N,) Increasing time stamps [ns].
        delta_s: Time between the rows of a pair [s].
        tolerance_s: Largest deviation from it [s]; None for 3 %, or for half of the median interval between time stamps
            if that is more, so that regular time stamps always have a pair.
    """
    if len(t_ns) < 2:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    wanted = t_ns + round(delta_s * 1e9)
    second = nearest_rows(t_ns, wanted)
    if tolerance_s is None:
        tolerance_ns = max(_TIME_TOLERANCE * delta_s * 1e9, 0.5 * float(np.median(np.diff(t_ns))))
    else:
        tolerance_ns = tolerance_s * 1e9
    first = np.flatnonzero((np.abs(t_ns[second] - wanted) <= tolerance_ns) & (second > np.arange(len(t_ns))))
    return first, second[first]


def pairs_after_distance(p: Array, delta_m: float, tolerance_m: float | None = None) -> Pairs:
    """Return the pairs of rows (M,), (M,) that are ``delta_m`` apart along a path.

    Args:
        p: (N, 3) Positions, usually the true ones [m].
        delta_m: Length of the path between the rows of a pair [m].
        tolerance_m: Largest deviation from it [m]; None for 10 %.
    """
    if len(p) == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    lengths = path_lengths_m(p)
    wanted = lengths + delta_m
    after = np.clip(np.searchsorted(lengths, wanted), 0, len(lengths) - 1)
    before = np.searchsorted(lengths, lengths[np.maximum(after - 1, 0)])  # the first of several equal positions
    second = np.where(wanted - lengths[before] <= np.abs(lengths[after] - wanted), before, after)
    tolerance_m = _TOLERANCE * delta_m if tolerance_m is None else tolerance_m
    first = np.flatnonzero((np.abs(lengths[second] - wanted) <= tolerance_m) & (second > np.arange(len(lengths))))
    return first, second[first]


def pairs_after_rotation(quat_wxyz: Array, delta_rad: float, tolerance_rad: float | None = None) -> Pairs:
    """Return all pairs of rows (M,), (M,), first before second, whose orientations (N, 4) differ by an angle.

    Every orientation is compared with every later one, in blocks: time is proportional to N², memory to N and M.

    Args:
        quat_wxyz: (N, 4) Orientations as quaternions.
        delta_rad: Angle between the orientations of a pair, at most π [rad].
        tolerance_rad: Largest deviation from it [rad]; None for 10 %.
    """
    n = len(quat_wxyz)
    tolerance_rad = _TOLERANCE * delta_rad if tolerance_rad is None else tolerance_rad
    q = components(quat_wxyz)
    rows = max(1, _BLOCK_SIZE // max(n, 1))
    blocks = [(np.zeros(0, np.int64), np.zeros(0, np.int64))]
    for start in range(0, n, rows):
        block = np.arange(start, min(start + rows, n))
        rotation = product(select(conjugate(q), (block, None)), select(q, (None, slice(start, None))))
        near = np.abs(angles_rad(rotation) - delta_rad) <= tolerance_rad
        first, second = np.nonzero(near & (np.arange(n - start) > (block - start)[:, None]))
        blocks.append((first + start, second + start))
    return np.concatenate([pair[0] for pair in blocks]), np.concatenate([pair[1] for pair in blocks])


def _cumulative(steps: Array, n: int) -> Array:
    """Return the cumulative sum (n,) of n − 1 steps, which begins with zero."""
    total = np.zeros(n)
    np.cumsum(steps, out=total[1:])
    return total
