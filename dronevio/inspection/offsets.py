"""The time offset of camera and IMU over the recording: whether it stays, drifts or steps."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dronevio.inspection.relation import COARSE_STEP_S, Gyroscope, Relation, Rotations
from dronevio.models.arrays import Array

SECTION_PAIRS = 18
"""Smallest number of rotations of a section, a second of video."""
MAX_SECTIONS = 12
"""Largest number of sections."""
MIN_EXPLAINED = 0.8
"""Smallest share of the variance that the gyroscope explains in a section whose offset is used."""
MAX_SIGMA_S = 0.005
"""Largest standard deviation of such an offset [s]."""
MIN_SIDE = 2
"""Smallest number of sections before and after a step; one could err."""
SIGNIFICANT = 4.0
"""Number of standard deviations of a significant drift or step."""
MAX_RELATIVE_COST = 0.3
"""Largest cost at the offset of a section, relative to the median over all offsets; more is no clear minimum."""
FLOOR_S = 0.0007
"""What an offset errs by beyond its standard deviation: exposure times change, and interpolation is not exact [s]."""


@dataclass(frozen=True, eq=False)
class OffsetCourse:
    """The offset in sections of the recording."""

    t_s: Array
    """(S,) Middle of each section since the first rotation [s]."""
    offset_s: Array
    """(S,) Offset of each section [s]."""
    sigma_s: Array
    """(S,) Its standard deviation [s]."""
    drift: float
    """Slope of the offset [s/s]."""
    drift_sigma: float
    """Standard deviation of the slope [s/s]."""
    step_s: float
    """Change of the offset at the best time of a step [s]."""
    step_at_s: float
    """Time of that step since the first rotation [s]."""
    step_sigma_s: float
    """Standard deviation of the step [s]."""
    misfits: tuple[float, float, float]
    """Sum of the squared normalized residuals of a constant offset, of a drift and of a step."""

    @property
    def drift_is_significant(self) -> bool:
        """Whether a drift explains the sections clearly better than a constant."""
        constant, drift, _ = self.misfits
        return abs(self.drift) > SIGNIFICANT * self.drift_sigma and constant > 4.0 * drift + 10.0

    @property
    def step_is_significant(self) -> bool:
        """Whether a step explains the sections clearly better than a constant, and better than a drift."""
        constant, drift, step = self.misfits
        return abs(self.step_s) > SIGNIFICANT * self.step_sigma_s and constant > 4.0 * step + 10.0 and step < drift


def offset_course(rotations: Rotations, gyroscope: Gyroscope, relation: Relation) -> OffsetCourse | None:
    """Return the offset in sections; None for fewer than four sections that determine it.

    Args:
        rotations: Rotations of the camera, finite.
        gyroscope: The gyroscope.
        relation: The relation over the whole recording, of which only the offset is determined anew.
    """
    count = int(np.clip(len(rotations) // SECTION_PAIRS, 1, MAX_SECTIONS))
    offsets = [
        _section(rotations[rows], gyroscope, relation) for rows in np.array_split(np.arange(len(rotations)), count)
    ]
    middle_s = rotations.middle_s
    parts = [middle_s[rows].mean() for rows in np.array_split(np.arange(len(rotations)), count)]
    sections = [(float(t), *each) for t, each in zip(parts, offsets, strict=True) if each is not None]
    if len(sections) < 2 * MIN_SIDE:
        return None
    t_s, offset_s, sigma_s = np.array(sections).T
    sigma_s = np.hypot(sigma_s, FLOOR_S)
    w = sigma_s**-2
    constant = float(w @ (offset_s - w @ offset_s / w.sum()) ** 2)
    drift, drift_sigma, of_drift = _line(t_s, offset_s, w)
    steps = [_step(k, t_s, offset_s, w) for k in range(MIN_SIDE, len(t_s) - MIN_SIDE + 1)]
    step_s, step_at_s, step_sigma_s, of_step = min(steps, key=lambda each: each[3])
    misfits = constant, of_drift, of_step
    return OffsetCourse(t_s, offset_s, sigma_s, drift, drift_sigma, step_s, step_at_s, step_sigma_s, misfits)


def _section(rotations: Rotations, gyroscope: Gyroscope, relation: Relation) -> tuple[float, float] | None:
    """Return the offset of a section and its standard deviation [s]; None if it is not determined."""
    measured = rotations.rate_rad_s

    def misfits(offsets_s: Array) -> Array:
        residuals = ((measured - relation.predicted(gyroscope.rates_at(rotations, offsets_s))) ** 2).sum(axis=2)
        scale = (3.0 * relation.noise_rad_s) ** 2
        values = scale * np.log1p(residuals / scale)
        inside = np.isfinite(values)
        means = np.where(inside, values, 0.0).sum(axis=1) / np.maximum(inside.sum(axis=1), 1)
        return np.where(inside.mean(axis=1) > 0.7, means, np.inf)

    costs = misfits(relation.offsets_s)
    finite = costs[np.isfinite(costs)]
    if not len(finite) or finite.min() > MAX_RELATIVE_COST * np.median(finite):
        return None
    offset_s = float(relation.offsets_s[np.argmin(costs)])
    for step in (COARSE_STEP_S, 0.2 * COARSE_STEP_S):
        low, mid, high = misfits(offset_s + step * np.array([-1.0, 0.0, 1.0])).tolist()
        curvature = low - 2.0 * mid + high
        if np.isfinite(curvature) and curvature > 0.0:
            offset_s += step * float(np.clip(0.5 * (low - high) / curvature, -1.0, 1.0))
    near = relation.predicted(gyroscope.rates_at(rotations, offset_s + COARSE_STEP_S * np.array([-1.0, 0.0, 1.0])))
    earlier, predicted, later = near
    residual = measured - predicted
    acceleration = np.nan_to_num((later - earlier) / (2.0 * COARSE_STEP_S))
    variance = np.nanmedian((residual**2).sum(axis=1)) / 2.37  # median of χ² with three degrees of freedom
    total = float((acceleration**2).sum())
    spread = float(np.nanmedian((measured - measured.mean(axis=0)) ** 2 @ np.ones(3))) / 2.37
    sigma_s = float(np.sqrt(variance / total)) if total > 0.0 else np.inf
    if sigma_s > MAX_SIGMA_S or variance > (1.0 - MIN_EXPLAINED) * spread:
        return None
    return offset_s, sigma_s


def _line(t_s: Array, offset_s: Array, w: Array) -> tuple[float, float, float]:
    """Return slope, standard deviation of the slope, and misfit of a line through offsets with weights (S,)."""
    A = np.column_stack([np.ones_like(t_s), t_s - w @ t_s / w.sum()])
    H = (A * w[:, None]).T @ A
    x = np.linalg.solve(H, A.T @ (w * offset_s))
    return float(x[1]), float(H[1, 1] ** -0.5), float(w @ (offset_s - A @ x) ** 2)


def _step(k: int, t_s: Array, offset_s: Array, w: Array) -> tuple[float, float, float, float]:
    """Return size, time, standard deviation and misfit of a step before section k."""
    parts: Sequence[slice] = (slice(None, k), slice(k, None))
    means = [float(w[part] @ offset_s[part] / w[part].sum()) for part in parts]
    misfit = sum(float(w[part] @ (offset_s[part] - mean) ** 2) for part, mean in zip(parts, means, strict=True))
    sigma_s = float(np.sqrt(sum(1.0 / w[part].sum() for part in parts)))
    return means[1] - means[0], float(0.5 * (t_s[k - 1] + t_s[k])), sigma_s, misfit
