"""The relation of two measurements of one rotation: time offset, rotation between frames, scale, and belonging.

A camera measures its rotation between two images, a gyroscope the rate of its own. If both are on one drone, then

    Ω_camera(t) = Q Ω_gyro(t + τ) + b

with the same τ, the same orthogonal matrix Q times a scale, and the same b all the time. None of them is assumed: τ is
searched, and the rest follows by linear least squares. A wrong unit is a scale, swapped axes are a reflection, a wrong
mounting is a rotation, and measurements that do not belong together fit at no τ.
"""

from dataclasses import dataclass
from typing import cast

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array
from dronevio.models.imu import ImuSamples, Times

SEARCH_S = 1.0
"""Largest offset that is searched [s]; more is another recording rather than an offset."""
COARSE_STEP_S = 0.005
"""Step of the search [s], below the time in which a drone changes its rate of rotation."""
ITERATIONS = 8
"""Number of reweighted least-squares steps."""
MIN_PAIRS = 20
"""Smallest number of measured rotations for a relation."""


@dataclass(frozen=True, eq=False)
class Rotations:
    """Mean angular velocities over intervals of time."""

    start_ns: Times
    """(P,) Beginning of each interval [ns]."""
    end_ns: Times
    """(P,) End of each interval [ns]."""
    rate_rad_s: Array
    """(P, 3) Mean angular velocity in the sensor's frame [rad/s]."""

    def __getitem__(self, rows: npt.NDArray[np.bool_] | npt.NDArray[np.int64] | slice) -> "Rotations":
        """Return some of the intervals."""
        return Rotations(self.start_ns[rows], self.end_ns[rows], self.rate_rad_s[rows])

    def __len__(self) -> int:
        return len(self.start_ns)

    @property
    def middle_s(self) -> Array:
        """(P,) Middle of each interval since the first [s]."""
        return np.asarray((self.start_ns - self.start_ns[0] + self.end_ns - self.start_ns[0]) * 0.5e-9)


class Gyroscope:
    """Mean rates of a gyroscope over any intervals, by its integral."""

    def __init__(self, imu: ImuSamples) -> None:
        """Integrate the samples, two or more."""
        self._origin_ns = int(imu.t_ns[0])
        self._t_s = (imu.t_ns - self._origin_ns) * 1e-9
        steps = np.diff(self._t_s)[:, None]
        later, earlier = imu.gyro_rad_s[1:], imu.gyro_rad_s[:-1]
        means = later if imu.sampling == "increment" else 0.5 * (later + earlier)
        self._angle = np.concatenate([np.zeros((1, 3)), np.cumsum(means * steps, axis=0)])

    @property
    def resting_rate_rad_s(self) -> Array:
        """(3,) Median rate of all intervals between samples, about the bias of a gyroscope that turns to both sides."""
        return np.asarray(np.median(np.diff(self._angle, axis=0) / np.diff(self._t_s)[:, None], axis=0))

    def rates(self, intervals: Rotations, offset_s: float) -> Array:
        """Return the mean rates (P, 3) over intervals that are shifted by an offset [rad/s]; NaN outside."""
        return cast(Array, self.rates_at(intervals, np.array([offset_s]))[0])

    def rates_at(self, intervals: Rotations, offsets_s: Array) -> Array:
        """Return the mean rates (D, P, 3) over intervals that are shifted by offsets (D,) [rad/s]; NaN outside."""
        ends = []
        for t_ns in (intervals.start_ns, intervals.end_ns):
            t = (t_ns - self._origin_ns) * 1e-9 + offsets_s[:, None]
            ends.append(np.stack([np.interp(t, self._t_s, each, np.nan, np.nan) for each in self._angle.T], axis=-1))
        duration_s = (intervals.end_ns - intervals.start_ns)[:, None] * 1e-9
        return np.asarray((ends[1] - ends[0]) / duration_s)


@dataclass(frozen=True, eq=False)
class Relation:
    """How one measurement of a rotation follows from another."""

    offset_s: float
    """τ: time to add to the stamps of the first to be on the clock of the second [s]."""
    offset_sigma_s: float
    """Standard deviation of the offset [s]."""
    Q: Array
    """(3, 3) Orthogonal matrix from the second sensor's frame to the first's; a reflection if its determinant is −1."""
    scale: float
    """Ratio of the first to the second rate."""
    bias_rad_s: Array
    """(3,) Mean difference in the frame of the second sensor: its bias [rad/s]."""
    agreement: float
    """Share of the variance of the first rate that the second explains, at most 1."""
    proper_ratio: float
    """Residual of the best reflection relative to that of the best rotation: below 1 if axes are reflected."""
    rotation_sigma_rad: float
    """Standard deviation of Q about its least certain axis [rad]; infinite where all rotations have one axis."""
    excitation_rad_s: float
    """Root mean square of the second rate about its mean [rad/s]."""
    noise_rad_s: float
    """Root mean square of the residuals, robust [rad/s]."""
    offsets_s: Array
    """(S,) Offsets of the search [s]."""
    curve: Array
    """(S,) Share of the variance that is explained at each offset."""
    weights: Array
    """(P,) Weight of each interval, near 0 for outliers."""

    def predicted(self, rates_rad_s: Array) -> Array:
        """Return the rates (…, 3) of the first sensor for those of the gyroscope (…, 3) [rad/s]."""
        return np.asarray(self.scale * (rates_rad_s - self.bias_rad_s) @ self.Q.T)

    @property
    def is_reflected(self) -> bool:
        """Whether axes are reflected."""
        return bool(np.linalg.det(self.Q) < 0.0)


def relate(first: Rotations, gyroscope: Gyroscope, search_s: float = SEARCH_S) -> Relation | None:
    """Return the relation of measured rotations to a gyroscope; None for fewer than `MIN_PAIRS`.

    Args:
        first: Measured rotations, for example those of a camera.
        gyroscope: The gyroscope.
        search_s: Largest offset [s].
    """
    first = first[np.asarray(np.isfinite(first.rate_rad_s).all(axis=1), np.bool_)]
    if len(first) < MIN_PAIRS:
        return None
    offsets = np.linspace(-search_s, search_s, 2 * round(search_s / COARSE_STEP_S) + 1)
    # Outliers among the first are measured by the second, at the offset that fits best; these two depend on each other.
    weights, table = np.ones(len(first)), gyroscope.rates_at(first, offsets)
    for _ in range(3):
        curve = _explained(first.rate_rad_s, table, weights)
        if not np.isfinite(curve).any():
            return None
        offset = _refined(first, gyroscope, float(offsets[np.nanargmax(curve)]), weights)
        weights = _weights(first.rate_rad_s, gyroscope.rates(first, offset))
    return _relation(first, gyroscope, offset, weights, offsets, curve)


def _relation(
    first: Rotations, gyroscope: Gyroscope, offset: float, weights: Array, offsets: Array, curve: Array
) -> Relation:
    """Return the relation at the best offset."""
    second = gyroscope.rates(first, offset)
    inside = np.asarray(np.isfinite(second).all(axis=1), np.bool_)
    a, b, w = first.rate_rad_s[inside], second[inside], weights[inside]
    mean_a, mean_b = w @ a / w.sum(), w @ b / w.sum()
    a, b = a - mean_a, b - mean_b
    Q, scale, residual = _procrustes(a, b, w, None)
    _, _, proper = _procrustes(a, b, w, 1.0)
    _, _, improper = _procrustes(a, b, w, -1.0)
    noise = float(np.sqrt(residual / max(3.0 * w.sum() - 7.0, 1.0)))
    c = scale * b @ Q.T
    information = np.einsum("n,nij->ij", w, (c * c).sum(axis=1)[:, None, None] * np.eye(3) - c[:, :, None] * c[:, None])
    least = float(np.linalg.eigvalsh(information)[0])
    return Relation(
        offset_s=offset,
        offset_sigma_s=_offset_sigma_s(first, gyroscope, offset, weights, noise),
        Q=Q,
        scale=scale,
        bias_rad_s=mean_b - Q.T @ mean_a / scale,
        agreement=1.0 - residual / max(float(w @ (a * a).sum(axis=1)), 1e-300),
        proper_ratio=improper / max(proper, 1e-300),
        rotation_sigma_rad=noise / np.sqrt(least) if least > 0.0 else float("inf"),
        excitation_rad_s=float(np.sqrt(w @ (b * b).sum(axis=1) / w.sum())),
        noise_rad_s=noise,
        offsets_s=offsets,
        curve=curve,
        weights=weights,
    )


def _explained(a: Array, b: Array, weights: Array) -> Array:
    """Return the shares (D,) of the variance of a (P, 3) that scaled orthogonal matrices times b (D, P, 3) explain.

    A share is NaN where b is NaN for half of the intervals or more.
    """
    inside = np.asarray(np.isfinite(b).all(axis=2), np.bool_)
    w = weights * inside
    total = np.maximum(w.sum(axis=1), 1e-300)[:, None]
    b = np.where(inside[:, :, None], b, 0.0)
    a = a - (w @ a / total)[:, None]  # (D, P, 3)
    b = b - (np.einsum("dp,dpi->di", w, b) / total)[:, None]
    singular = np.linalg.svd(np.einsum("dp,dpi,dpj->dij", w, a, b), compute_uv=False)
    variances = np.einsum("dp,dpi->d", w, a * a) * np.einsum("dp,dpi->d", w, b * b)
    shares = singular.sum(axis=1) ** 2 / np.maximum(variances, 1e-300)
    return np.asarray(np.where(inside.mean(axis=1) < 0.5, np.nan, shares))


def _procrustes(a: Array, b: Array, w: Array, sign: float | None) -> tuple[Array, float, float]:
    """Return Q (3, 3), s and the weighted squared residual of a ≈ s Q b, with a given determinant of Q or any."""
    U, singular, Vt = np.linalg.svd((a * w[:, None]).T @ b)
    determinant = float(np.sign(np.linalg.det(U @ Vt)))
    last = 1.0 if sign is None else sign * determinant
    D = np.array([1.0, 1.0, last])
    variance_a, variance_b = float(w @ (a * a).sum(axis=1)), float(w @ (b * b).sum(axis=1))
    trace = float(singular @ D)
    return (U * D) @ Vt, trace / max(variance_b, 1e-300), variance_a - trace**2 / max(variance_b, 1e-300)


def _weights(a: Array, b: Array) -> Array:
    """Return weights (P,) of intervals by their residuals: Cauchy's, with a robust scale; 0 where b is NaN."""
    inside = np.asarray(np.isfinite(b).all(axis=1), np.bool_)
    weights = inside.astype(np.float64)
    for _ in range(ITERATIONS):
        w = weights / weights.sum()
        mean_a, mean_b = w @ a, w @ np.where(inside[:, None], b, 0.0)
        Q, scale, _ = _procrustes(a[inside] - mean_a, b[inside] - mean_b, w[inside], None)
        residuals = np.full(len(a), np.inf)
        residuals[inside] = np.linalg.norm(a[inside] - mean_a - scale * (b[inside] - mean_b) @ Q.T, axis=1)
        typical = 1.5 * float(np.median(residuals[inside])) + 1e-9
        weights = 1.0 / (1.0 + (residuals / typical) ** 2)
    return weights


def _refined(first: Rotations, gyroscope: Gyroscope, offset_s: float, weights: Array) -> float:
    """Return the offset at the top of the parabola through explained shares, to a fraction of a step."""
    for step in (COARSE_STEP_S, 0.2 * COARSE_STEP_S):
        tried = offset_s + step * np.array([-1.0, 0.0, 1.0])
        low, mid, high = _explained(first.rate_rad_s, gyroscope.rates_at(first, tried), weights).tolist()
        curvature = low - 2.0 * mid + high
        if np.isfinite(curvature) and curvature < 0.0:
            offset_s += step * float(np.clip(0.5 * (low - high) / curvature, -1.0, 1.0))
    return offset_s


def _offset_sigma_s(first: Rotations, gyroscope: Gyroscope, offset_s: float, weights: Array, noise: float) -> float:
    """Return the standard deviation of the offset: the noise over the root of the summed squared accelerations."""
    step = COARSE_STEP_S
    later, earlier = (gyroscope.rates(first, offset_s + k * step) for k in (1, -1))
    acceleration = np.nan_to_num((later - earlier) / (2.0 * step))
    acceleration = acceleration - weights @ acceleration / max(weights.sum(), 1e-300)
    total = float(weights @ (acceleration**2).sum(axis=1))
    return noise / np.sqrt(total) if total > 0.0 else float("inf")


def played_backwards(first: Rotations) -> Rotations:
    """Return the rotations of the same images in reverse order, at the time stamps of the frames."""
    ends = first.start_ns[0] + first.end_ns[-1]
    return Rotations(ends - first.end_ns[::-1], ends - first.start_ns[::-1], -first.rate_rad_s[::-1])
