"""Whether a lens model agrees with the motion of features, given the rotation by the gyroscope.

A calibrated lens maps pixels to bearings; a wrong focal length or distortion moves them along the radius, by
θ' = s θ (1 + k θ²) of the angle θ from the optical axis. Where features of a static scene move by a known rotation and
an unknown translation, s and k have one value at which all features of a pair of images lie on the epipolar planes.
For a calibrated lens, that is s = 1 and k = 0. The two also say what is wrong: s a focal length, k a distortion.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from dronevio.inspection.flow import Flow
from dronevio.models.arrays import Array
from dronevio.models.rotation import cross, exp_so3

MAX_FLOWS = 80
"""Number of pairs of images that are used: those with the largest rotations."""
MIN_FLOWS = 10
"""Smallest number of pairs for a result."""
GRID_SCALES, GRID_CUBICS = np.linspace(0.6, 1.6, 11), (-0.3, -0.15, 0.0, 0.15, 0.3)
"""Scales s and cubic changes k [1/rad²] at which the search begins."""
STEPS = 24
"""Number of steps of the search, of which each halves the interval."""


@dataclass(frozen=True)
class LensCheck:
    """The change of a lens model that agrees best with the motion."""

    scale: float
    """Factor s of all angles from the optical axis."""
    cubic: float
    """Change k of the factor with the squared angle [1/rad²]."""
    change_px: float
    """Root mean square displacement of features between the lens and the changed one [px]."""
    cost_ratio: float
    """Cost of the lens as it is calibrated, relative to that of the changed one."""
    pairs: int
    """Number of pairs of images."""


def check_lens(flows: Sequence[Flow], rotations: Array, pixel_rad: float) -> LensCheck | None:
    """Return the change of the lens that agrees best with the motion; None for fewer than `MIN_FLOWS` pairs.

    Args:
        flows: Matches between pairs of images.
        rotations: (P, 3) Rotation vectors of the camera between the images, by the gyroscope [rad]; NaN if unknown.
        pixel_rad: Angle of a pixel near the optical axis [rad].
    """
    angle = np.linalg.norm(rotations, axis=1)
    usable = [k for k in np.argsort(-np.nan_to_num(angle)) if np.isfinite(angle[k]) and len(flows[k].pixels[0]) > 20]
    if len(usable) < MIN_FLOWS:
        return None
    pairs = _Pairs.of([flows[k] for k in usable[:MAX_FLOWS]], rotations[usable[:MAX_FLOWS]])

    def cost(scale: float, cubic: float) -> float:
        return pairs.cost(scale, cubic, pixel_rad)

    scale, cubic = min(itertools.product(GRID_SCALES, GRID_CUBICS), key=lambda change: cost(*change))
    steps = np.array([0.05, 0.07])
    best = cost(scale, cubic)
    for _ in range(STEPS):  # pattern search: the cost is smooth, and has one minimum near the start
        for ds, dk in ((1, 0), (-1, 0), (0, 1), (0, -1), (1, -1), (-1, 1), (1, 1), (-1, -1)):
            tried = cost(scale + ds * steps[0], cubic + dk * steps[1])
            if tried < best:
                scale, cubic, best = scale + ds * steps[0], cubic + dk * steps[1], tried
                break
        else:
            steps = 0.5 * steps
    theta = np.arccos(np.clip(pairs.f0[:, 2], -1.0, 1.0))
    change = theta * (scale * (1.0 + cubic * theta**2) - 1.0) / pixel_rad
    ratio = cost(1.0, 0.0) / max(best, 1e-12)
    return LensCheck(float(scale), float(cubic), float(np.sqrt(np.mean(change**2))), ratio, len(pairs.start))


def changed_flow(flow: Flow, lens: LensCheck) -> Flow:
    """Return matches with the bearings of a changed lens."""
    f0, f1 = (_changed(f, lens.scale, lens.cubic) for f in flow.bearings)
    return replace(flow, bearings=(f0, f1))


@dataclass(frozen=True, eq=False)
class _Pairs:
    """The matches of all pairs one after another."""

    f0: Array  # (N, 3)
    f1: Array  # (N, 3)
    R_second_first: Array  # (P, 3, 3)
    pair: npt.NDArray[np.int64]  # (N,) index of the pair of each match
    start: npt.NDArray[np.int64]  # (P,) index of the first match of each pair

    @classmethod
    def of(cls, flows: Sequence[Flow], rotations: Array) -> "_Pairs":
        counts = np.array([len(flow.pixels[0]) for flow in flows])
        return cls(
            np.concatenate([flow.bearings[0] for flow in flows]),
            np.concatenate([flow.bearings[1] for flow in flows]),
            np.swapaxes(exp_so3(rotations), 1, 2),
            np.repeat(np.arange(len(flows)), counts),
            np.concatenate([[0], np.cumsum(counts)[:-1]]),
        )

    def errors(self, scale: float, cubic: float, pixel_rad: float) -> Array:
        """Return the epipolar errors (N,) with a changed lens [rad]."""
        f0, f1 = _changed(self.f0, scale, cubic), _changed(self.f1, scale, cubic)
        normals = cross(np.einsum("nij,nj->ni", self.R_second_first[self.pair], f0), f1)
        products = normals[:, :, None] * normals[:, None]
        weights, errors = np.ones(len(normals)), np.zeros(len(normals))
        for _ in range(3):
            sums = np.add.reduceat(weights[:, None, None] * products, self.start, axis=0)
            t = np.linalg.eigh(sums)[1][:, :, 0]
            errors = np.abs(np.einsum("ni,ni->n", normals, t[self.pair]))
            weights = 1.0 / (1.0 + (errors / pixel_rad) ** 2)
        return np.asarray(errors)

    def cost(self, scale: float, cubic: float, pixel_rad: float) -> float:
        """Return the mean of Cauchy's loss of the errors, relative to the angle of a pixel."""
        return float(np.mean(np.log1p((self.errors(scale, cubic, pixel_rad) / pixel_rad / scale) ** 2)))


def _changed(f: Array, scale: float, cubic: float) -> Array:
    """Return bearings (N, 3) whose angle from the optical axis is changed."""
    cosine = np.clip(f[:, 2], -1.0, 1.0)
    theta, sine = np.arccos(cosine), np.sqrt(np.maximum(1.0 - cosine**2, 1e-18))
    changed = np.clip(scale * theta * (1.0 + cubic * theta**2), 0.0, np.pi)
    return np.column_stack([f[:, :2] * (np.sin(changed) / sine)[:, None], np.cos(changed)])
