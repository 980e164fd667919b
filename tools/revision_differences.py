"""How far the results of two revisions are apart: the largest difference of each quantity, and ratios of errors."""

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import stats

from dronevio.models.arrays import Array

Arrays = Mapping[str, npt.NDArray[Any]]

UNCOMPARED = frozenset({"events"})
"""Arrays that are kept for information: messages, whose words may change."""
ABSENT = "–"
"""Stands in place of the hash of a quantity that a revision does not have."""


@dataclass(frozen=True)
class Difference:
    """One quantity of one recording, of both revisions."""

    recording: str
    """Name of the recording."""
    quantity: str
    """Name of the quantity, with its unit."""
    base_hash: str
    """SHA-256 of the base revision's array, its type and shape included."""
    head_hash: str
    """SHA-256 of the other revision's array."""
    largest: float
    """Largest difference where both have a value: absolute in the unit of the quantity, relative for covariances, the
    number of entries that differ for whole numbers and words; infinite where the shapes differ."""
    unmatched: int
    """Number of rows in which one revision has a value where the other has none."""

    @property
    def identical(self) -> bool:
        """Whether all bits agree."""
        return self.base_hash == self.head_hash

    def within(self, tolerance: float) -> bool:
        """Return whether the arrays agree up to a tolerance, with values in the same rows; to the bit if it is 0."""
        return self.identical or (tolerance > 0.0 and self.largest <= tolerance and not self.unmatched)


def differences(recording: str, base: Arrays, head: Arrays) -> list[Difference]:
    """Compare all quantities that either revision has of a recording."""
    names = [name for name in dict.fromkeys((*base, *head)) if name not in UNCOMPARED]
    return [difference(recording, name, base.get(name), head.get(name)) for name in names]


def difference(recording: str, name: str, a: npt.NDArray[Any] | None, b: npt.NDArray[Any] | None) -> Difference:
    """Compare one quantity, whose array is None where a revision does not have it."""
    hashes = array_hash(a), array_hash(b)
    if a is None or b is None or a.shape != b.shape:
        return Difference(recording, name, *hashes, math.inf, 0)
    if a.dtype.kind != "f" or b.dtype.kind != "f":
        return Difference(recording, name, *hashes, float(np.count_nonzero(a != b)), 0)
    a, b = np.atleast_1d(a), np.atleast_1d(b)
    same = (np.isnan(a) == np.isnan(b)).all(axis=tuple(range(1, a.ndim)))
    distance = largest(name, np.nan_to_num(a[same], nan=0.0), np.nan_to_num(b[same], nan=0.0))
    return Difference(recording, name, *hashes, distance, int((~same).sum()))


def array_hash(values: npt.NDArray[Any] | None) -> str:
    """Return the SHA-256 of an array's type, shape and bytes; `ABSENT` of no array."""
    if values is None:
        return ABSENT
    return hashlib.sha256(f"{values.dtype.str} {values.shape}".encode() + values.tobytes()).hexdigest()


def largest(name: str, a: Array, b: Array) -> float:
    """Return the largest difference of a quantity's arrays (N, ...) without NaN; 0 without entries."""
    if not a.size:
        return 0.0
    if name.startswith("rotation"):
        return float(rotation_angles(a, b).max())
    if name.startswith("covariance"):
        return float(relative_differences(a, b).max())
    return float(np.abs(a - b).max())


def rotation_angles(a: Array, b: Array) -> Array:
    """Return the angles (N,) [rad] between rotation matrices (N, 3, 3), accurate for small angles as well.

    The Frobenius norm of R_a − R_b is 2 √2 sin(θ/2).
    """
    chord = np.linalg.norm(a - b, axis=(1, 2)) / (2.0 * math.sqrt(2.0))
    return np.asarray(2.0 * np.arcsin(np.minimum(chord, 1.0)))


def relative_differences(a: Array, b: Array) -> Array:
    """Return |a − b|ᵢⱼ / (σᵢ σⱼ) of covariances (N, M, M), with the standard deviations σ of a."""
    sigma = np.sqrt(np.diagonal(a, axis1=1, axis2=2))
    distance = np.abs(a - b)
    with np.errstate(divide="ignore", invalid="ignore"):  # a variance may be zero
        return np.where(distance > 0.0, distance / (sigma[:, :, None] * sigma[:, None, :]), 0.0)


MIN_POSES = 0.95
"""Smallest share of the base's poses that an estimate of a flight has; with fewer, the flight is lost."""


def paired_ratios(base: Arrays, head: Arrays) -> Array:
    """Return the ratios (N,) of the errors of N flights, new to base, from ``ATE [m]`` and ``poses``.

    A flight that only the new revision loses has the ratio infinity. One that the base loses has the ratio 1, since
    a flight that is won must not make up for larger errors elsewhere.
    """
    lost = np.isnan(head["ATE [m]"]) | (head["poses"] < MIN_POSES * base["poses"])
    never = np.isnan(base["ATE [m]"])
    ratios = np.where(lost, np.inf, head["ATE [m]"] / base["ATE [m]"])
    return np.asarray(np.where(never, 1.0, ratios))


def mean_ratio(ratios: Array) -> tuple[float, float]:
    """Return the geometric mean of ratios (N,), N > 1, and its upper 95 % bound by Student's t on the logarithms."""
    if np.isinf(ratios).any():
        return math.inf, math.inf
    logs = np.log(ratios)
    error = float(logs.std(ddof=1)) / math.sqrt(len(logs))
    mean = float(logs.mean())
    return math.exp(mean), math.exp(mean + float(stats.t.ppf(0.95, len(logs) - 1)) * error)
