"""Submaps: parts of the map, each of which moves as one with the keyframe at which it begins.

Source of the idea: Bosse et al., "Simultaneous localization and map building in large-scale cyclic environments using
the Atlas framework", IJRR 2004; Millane et al., "C-blox", IROS 2018.
"""

import zlib
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dronevio.estimator.mapping.evidence import Evidence
from dronevio.estimator.mapping.log_odds import LogOdds
from dronevio.models.arrays import Array, Floats, Integers

LOG_ODDS_STEP = 0.1
"""Step of the log-odds of closed submaps, a quarter of the evidence of one depth image."""
_GROWTH = 16  # cells by whose multiples a box grows
Steps = npt.NDArray[np.int8]


@dataclass(frozen=True)
class Anchor:
    """What a submap moves with."""

    number: int
    """Number of the submap, in the order of time."""
    track: int
    """Number of the odometry frame."""
    t_ns: int
    """Time stamp at which the submap begins [ns]."""


@dataclass(eq=False)
class ActiveSubmap:
    """The submap that gathers the evidence of depth images, in the odometry frame."""

    anchor: Anchor
    """What it moves with."""
    position_m: Array
    """(3,) Position of the camera at the newest depth image [m]."""
    log_odds: LogOdds | None = None
    """Its cells so far; None before the first evidence."""
    path_m: float = 0.0
    """Length of the path of the camera [m]."""

    def add(self, evidence: Evidence, position_m: Array) -> None:
        """Add the evidence of a depth image, by a camera at a position (3,) [m]; the box grows to contain it."""
        self.path_m += float(np.linalg.norm(position_m - self.position_m))
        self.position_m = position_m
        if evidence.log_odds.any():
            self.log_odds = covering(self.log_odds, evidence)
            self.log_odds.add(evidence)

    def closed(self) -> "PackedSubmap":
        """Return the submap in its packed form."""
        return PackedSubmap.of(self.anchor, self.log_odds)


def covering(box: LogOdds | None, evidence: Evidence) -> LogOdds:
    """Return a box with the same cells that contains the evidence; the same one if it does already."""
    low, high = evidence.low, evidence.low + evidence.log_odds.shape
    if box is not None:
        if np.all(box.low <= low) and np.all(box.low + box.values.shape >= high):
            return box
        low, high = np.minimum(low, box.low), np.maximum(high, box.low + box.values.shape)
    low, high = _GROWTH * (low // _GROWTH), -_GROWTH * (-high // _GROWTH)
    values = np.zeros(high - low, np.float32)
    if box is not None:
        values[tuple(slice(a, a + n) for a, n in zip(box.low - low, box.values.shape, strict=True))] = box.values
    return LogOdds(low, values)


@dataclass(frozen=True, eq=False)
class PackedSubmap:
    """The known cells of a submap that has ended, compressed."""

    anchor: Anchor
    """What it moves with."""
    low: Integers
    """(3,) Index of the first cell in the lattice of the odometry frame."""
    shape: tuple[int, int, int]
    """Number of cells along each axis."""
    data: bytes
    """Log-odds in steps of `LOG_ODDS_STEP` as int8, by zlib."""

    @classmethod
    def of(cls, anchor: Anchor, box: LogOdds | None) -> "PackedSubmap":
        """Return the packed form of a box without its unknown sides."""
        steps = np.zeros((0, 0, 0), np.int8) if box is None else np.rint(box.values / LOG_ODDS_STEP).astype(np.int8)
        low = np.zeros(3, np.int64) if box is None else box.low
        if not steps.any():
            return cls(anchor, low, (0, 0, 0), zlib.compress(b""))
        for axis in range(3):
            known = np.flatnonzero(steps.any(axis=tuple(other for other in range(3) if other != axis)))
            steps = np.take(steps, np.arange(known[0], known[-1] + 1), axis)
            low = low + known[0] * (np.arange(3) == axis)
        a, b, c = steps.shape
        return cls(anchor, low, (a, b, c), zlib.compress(np.ascontiguousarray(steps).tobytes(), 1))

    @property
    def steps(self) -> Steps:
        """(X, Y, Z) Log-odds of the cells, in steps of `LOG_ODDS_STEP`."""
        return np.frombuffer(zlib.decompress(self.data), np.int8).reshape(self.shape)

    @property
    def log_odds(self) -> LogOdds:
        """The cells as a box of log-odds."""
        values: Floats = self.steps.astype(np.float32) * np.float32(LOG_ODDS_STEP)
        return LogOdds(self.low, values)
