"""Pairs of poses for relative errors: so many frames, metres, seconds or degrees apart.

``all`` pairs start one at every pose and end at the pose that comes closest to the wanted distance; ``consecutive``
ones start where the one before ended, at the first pose that is at least so far away. Choose them on the truth, so that
every estimator is scored on the same ones.
"""

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt

from dronevio.eval.metrics.association import Rows, nearest_rows
from dronevio.models.errors import ConfigError
from dronevio.models.imu import Times
from dronevio.models.quaternions import angles_rad, components, conjugate, product, select

Array = npt.NDArray[np.float64]
Pairs = tuple[Rows, Rows]
"""First and second rows, each (M,)."""

Unit = Literal["frames", "m", "s", "deg"]
"""What lies between the two poses of a pair: frames, metres of path, seconds, or degrees of turning."""
Which = Literal["all", "consecutive"]
"""Pairs from every pose on, or one behind the other."""
Source = Literal["truth", "estimate"]
"""On whose path the pairs are chosen."""

_SHARE = 0.1  # of metres and degrees, by which a pair may miss them: evo's
_SHARE_OF_TIME = 0.03
_BLOCK = 1 << 22  # orientations compared at once in the search for pairs by angle: 32 MB a component


@dataclass(frozen=True)
class PairRule:
    """Which pairs of poses a relative error looks at."""

    delta: float = 1.0
    """How far apart the two are."""
    unit: Unit = "s"
    """In what."""
    which: Which = "all"
    """From every pose on, or one behind the other."""
    source: Source = "truth"
    """On whose path they are chosen."""
    tolerance: float | None = None
    """By what share of delta all pairs may miss it; None for 10 % of metres and degrees, and for seconds as in
    `pairs_after_time`."""

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ConfigError: One makes no sense.
        """
        for value, kind in ((self.unit, Unit), (self.which, Which), (self.source, Source)):
            if value not in get_args(kind):
                raise ConfigError(f"pairs by {value!r}; expected one of {', '.join(get_args(kind))}")
        if not 0.0 < self.delta < 1e6:
            raise ConfigError(f"a relative error over {self.delta:g} {self.unit}; expected a distance above zero")
        if self.unit == "frames" and self.delta != round(self.delta):
            raise ConfigError(f"a relative error over {self.delta:g} frames; expected a whole number")
        if self.unit == "deg" and self.which == "all" and self.delta > 180.0:
            raise ConfigError(f"orientations {self.delta:g}° apart; expected 180° at most, or consecutive pairs")
        if self.tolerance is not None and not 0.0 <= self.tolerance < 1.0:
            raise ConfigError(f"pairs within {self.tolerance:g} of their distance; expected a share of 0 to below 1")

    @property
    def label(self) -> str:
        """The distance, for people: ``1 s``."""
        return f"{self.delta:g}{'°' if self.unit == 'deg' else ' ' + self.unit}"

    def choose(self, t_ns: Times, p: Array, quat_wxyz: Array) -> Pairs:
        """Return the pairs of poses with the given stamps (N,), positions (N, 3) and orientations (N, 4)."""
        if self.which == "consecutive":
            return consecutive_pairs(self._progress(t_ns, p, quat_wxyz), self.delta)
        if self.unit == "frames":
            return pairs_after_frames(len(t_ns), round(self.delta))
        if self.unit == "s":
            return pairs_after_time(t_ns, self.delta, None if self.tolerance is None else self.tolerance * self.delta)
        share = _SHARE if self.tolerance is None else self.tolerance
        if self.unit == "m":
            return pairs_after_distance(p, self.delta, share * self.delta)
        return pairs_after_turning(quat_wxyz, np.radians(self.delta), share * np.radians(self.delta))

    def _progress(self, t_ns: Times, p: Array, quat_wxyz: Array) -> Array:
        """Return how far along each pose is (N,), in the unit."""
        if self.unit == "frames":
            return np.arange(len(t_ns), dtype=np.float64)
        if self.unit == "s":
            return np.asarray((t_ns - t_ns[:1]) * 1e-9)
        return way_m(p) if self.unit == "m" else np.degrees(turning_rad(quat_wxyz))


def way_m(p: Array) -> Array:
    """Return how far along the path each position (N, 3) is (N,) [m]."""
    return _summed(np.linalg.norm(np.diff(p, axis=0), axis=1), len(p))


def turning_rad(quat_wxyz: Array) -> Array:
    """Return by how much has been turned, whichever way, up to each orientation (N, 4) (N,) [rad]."""
    q = components(quat_wxyz)
    before, after = select(q, slice(None, -1)), select(q, slice(1, None))
    return _summed(angles_rad(product(conjugate(before), after)), len(quat_wxyz))


def consecutive_pairs(progress: Array, delta: float) -> Pairs:
    """Return the pairs of rows (M,), (M,) that follow one another, each at least ``delta`` of progress (N,) long."""
    following = np.searchsorted(progress, progress + delta).tolist()
    rows = [0] if len(progress) else []
    while rows and (row := following[rows[-1]]) < len(progress):
        rows.append(row)
    chain = np.array(rows, dtype=np.int64)
    return chain[:-1], chain[1:]


def pairs_after_frames(n: int, delta: int) -> Pairs:
    """Return the pairs of rows (M,), (M,) of N that lie ``delta`` rows apart."""
    first = np.arange(max(n - delta, 0))
    return first, first + delta


def pairs_after_time(t_ns: Times, delta_s: float, tolerance_s: float | None = None) -> Pairs:
    """Return the pairs of rows (M,), (M,) that lie ``delta_s`` apart in time.

    They depend on time stamps only, never on what an estimator says, so that all are scored on the same ones. Every row
    starts at most one pair, and a gap in the stamps loses pairs but never shifts them.

    Args:
        t_ns: (N,) Time stamps [ns], increasing.
        delta_s: How far apart [s].
        tolerance_s: How much the time between the two may differ from it [s]; None for 3 %, or half of the usual
            interval between stamps if that is more: the nearest of regular stamps is no farther.
    """
    if len(t_ns) < 2:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    wanted = t_ns + round(delta_s * 1e9)
    second = nearest_rows(t_ns, wanted)
    if tolerance_s is None:
        tolerance_ns = max(_SHARE_OF_TIME * delta_s * 1e9, 0.5 * float(np.median(np.diff(t_ns))))
    else:
        tolerance_ns = tolerance_s * 1e9
    first = np.flatnonzero((np.abs(t_ns[second] - wanted) <= tolerance_ns) & (second > np.arange(len(t_ns))))
    return first, second[first]


def pairs_after_distance(p: Array, delta_m: float, tolerance_m: float | None = None) -> Pairs:
    """Return the pairs of rows (M,), (M,) that lie ``delta_m`` apart on a path.

    Args:
        p: (N, 3) Positions, the true ones by rights [m].
        delta_m: How far apart along the path [m].
        tolerance_m: How much the way between the two may differ from it [m]; None for 10 %.
    """
    if len(p) == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    way = way_m(p)
    wanted = way + delta_m
    after = np.clip(np.searchsorted(way, wanted), 0, len(way) - 1)
    before = np.searchsorted(way, way[np.maximum(after - 1, 0)])  # the first of those where it stood still
    second = np.where(wanted - way[before] <= np.abs(way[after] - wanted), before, after)
    tolerance_m = _SHARE * delta_m if tolerance_m is None else tolerance_m
    first = np.flatnonzero((np.abs(way[second] - wanted) <= tolerance_m) & (second > np.arange(len(way))))
    return first, second[first]


def pairs_after_turning(quat_wxyz: Array, delta_rad: float, tolerance_rad: float | None = None) -> Pairs:
    """Return all pairs of rows (M,), (M,), first before second, whose orientations (N, 4) differ by an angle.

    Every orientation is compared with every later one, in blocks: the time grows with N², the memory with N and M.

    Args:
        quat_wxyz: (N, 4) Orientations.
        delta_rad: By how much they differ [rad], π at most.
        tolerance_rad: How much the angle between the two may miss it [rad]; None for 10 %.
    """
    n = len(quat_wxyz)
    tolerance_rad = _SHARE * delta_rad if tolerance_rad is None else tolerance_rad
    q = components(quat_wxyz)
    rows = max(1, _BLOCK // max(n, 1))
    found = [(np.zeros(0, np.int64), np.zeros(0, np.int64))]
    for start in range(0, n, rows):
        block = np.arange(start, min(start + rows, n))
        turn = product(select(conjugate(q), (block, None)), select(q, (None, slice(start, None))))
        near = np.abs(angles_rad(turn) - delta_rad) <= tolerance_rad
        first, second = np.nonzero(near & (np.arange(n - start) > (block - start)[:, None]))
        found.append((first + start, second + start))
    return np.concatenate([pair[0] for pair in found]), np.concatenate([pair[1] for pair in found])


def _summed(steps: Array, n: int) -> Array:
    """Return the running sum (n,) of n − 1 steps, from zero on."""
    total = np.zeros(n)
    np.cumsum(steps, out=total[1:])
    return total
