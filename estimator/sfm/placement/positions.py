"""Similarity transformation that brings a reconstruction to measured positions, robustly, with its covariance.

Positions have standard deviations, and some of them may be wrong by any amount. The start is the least median of
squares (Rousseeuw, "Least median of squares regression", JASA 1984) of similarity transformations through three
positions, or through two with a measured orientation. It is refined by iteratively reweighted least squares with the
Cauchy loss. If the residuals exceed the stated standard deviations, these are multiplied by the ratio.

Measured orientations have errors that their images have in common, so that all of them together count like one.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array, Mask
from dronevio.models.rotation import exp_so3, log_so3, skew

Indices = npt.NDArray[np.int64]

HYPOTHESES = 500
"""Number of transformations that are tried."""
MOST_COMPARED = 200
"""Largest number of positions, and of orientations, to which each of them is compared."""
ITERATIONS = 50
"""Largest number of refinements."""
CAUCHY_SIGMAS = 2.4
"""Scale of the Cauchy loss of the positions, relative to their standard deviations: 95 % efficient without outliers."""
OUTLIER_SIGMAS = 5.0
"""Length of a residual, relative to its standard deviations, beyond which a position is called an outlier."""
CHI3_MEDIAN = 1.538
"""Median of the length of a vector of three normally distributed coordinates of standard deviation 1."""
TILT_SIGMA_RAD, YAW_SIGMA_RAD = np.radians(1.0), np.radians(10.0)
"""Standard deviations of the tilt and of the yaw that measured orientations have in common [rad]. Yaw is that of a
compass, which steel and the declination turn."""
ORIENTATION_SCALE_RAD = np.radians(5.0)
"""Scale of the Cauchy loss of an orientation [rad]."""
LARGEST_SIGMA_RAD, LARGEST_SCALE_SIGMA = np.pi, 1.0
"""Standard deviations where nothing is measured: rotation [rad], and scale, relative to it."""


@dataclass(frozen=True, eq=False)
class MeasuredPositions:
    """N points of a reconstruction whose positions in the world frame are measured."""

    points: Array
    """(N, 3) Points in the frame of the reconstruction."""
    positions_m: Array
    """(N, 3) Their measured positions in the world frame [m]."""
    sigmas_m: Array
    """(N, 3) Standard deviations of the positions along the axes of the world frame [m]."""
    Rs: Array
    """(L, 3, 3) Measured rotations from the frame of the reconstruction to the world frame, with z up."""


@dataclass(frozen=True, eq=False)
class PositionAlignment:
    """Similarity transformation of a reconstruction to a world frame, and how well it is determined."""

    scale: float
    """Length of a unit of the reconstruction [m]."""
    R: Array
    """(3, 3) Rotation from the frame of the reconstruction to the world frame."""
    t: Array
    """(3,) Origin of the frame of the reconstruction in the world frame [m]."""
    residuals_m: Array
    """(N, 3) Measured positions minus those of the reconstruction, in the world frame [m]."""
    noise_factor: float
    """Ratio of the residuals to the stated standard deviations, by the median; at least 1."""
    is_outlier: Mask
    """(N,) Whether a residual is larger than the noise explains."""
    covariance: Array
    """(7, 7) Covariance of the position of the centre of the positions [m], the rotation vector in the world frame
    [rad], and the logarithm of the scale."""

    @property
    def scale_sigma(self) -> float:
        """Standard deviation of the scale, relative to it; 0 if it was known before."""
        return float(np.sqrt(self.covariance[6, 6]))

    @property
    def yaw_sigma_rad(self) -> float:
        """Standard deviation of the rotation about the vertical [rad]."""
        return float(np.sqrt(self.covariance[5, 5]))

    @property
    def tilt_sigma_rad(self) -> float:
        """Standard deviation of the vertical about the less certain horizontal axis [rad]."""
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance[3:5, 3:5])[-1]))


def align_with_positions(measured: MeasuredPositions, known_scale: bool = False) -> PositionAlignment | str:
    """Return the similarity transformation to measured positions, or the reason why there is none.

    Args:
        measured: The positions.
        known_scale: Whether the reconstruction is in metres; its scale stays.
    """
    count = len(measured.points)
    needed = 2 if len(measured.Rs) else 3
    if count < needed:
        return f"{count} measured positions; at least {needed} are needed"
    scales, Rs, ts = _hypotheses(measured, known_scale)
    if not len(scales):
        return "all measured positions, or all reconstructed ones, are the same"
    compared = np.unique(np.linspace(0, count - 1, MOST_COMPARED).astype(np.int64))
    predicted = scales[:, None, None] * np.einsum("hij,nj->hni", Rs, measured.points[compared]) + ts[:, None]
    lengths = np.linalg.norm((measured.positions_m[compared] - predicted) / measured.sigmas_m[compared], axis=2)
    factor = max(float(np.median(lengths, axis=1).min()) / CHI3_MEDIAN, 1.0)
    cost = np.log1p((lengths / (CAUCHY_SIGMAS * factor)) ** 2).sum(axis=1)
    if len(measured.Rs):
        some = measured.Rs[np.unique(np.linspace(0, len(measured.Rs) - 1, MOST_COMPARED).astype(np.int64))]
        angles = np.linalg.norm(log_so3(some[None] @ np.swapaxes(Rs, 1, 2)[:, None]), axis=2)
        cost += np.log1p((np.median(angles, axis=1) / ORIENTATION_SCALE_RAD) ** 2)
    best = int(np.argmin(cost))
    return _refined(measured, float(scales[best]), Rs[best], ts[best], known_scale)


def _hypotheses(measured: MeasuredPositions, known_scale: bool) -> tuple[Array, Array, Array]:
    """Return scales (H,), rotations (H, 3, 3) and translations (H, 3) by a few positions and orientations each."""
    rng = np.random.default_rng(0)
    a, b = measured.points, measured.positions_m
    count = len(a)
    parts: list[tuple[Array, Array, Array]] = []
    if count >= 3:
        rows = rng.random((HYPOTHESES, count)).argsort(axis=1)[:, :3]
        x, y = a[rows], b[rows]
        dx, dy = x - x.mean(axis=1, keepdims=True), y - y.mean(axis=1, keepdims=True)
        U, singular, Vt = np.linalg.svd(np.einsum("hni,hnj->hij", dy, dx))
        signs = np.ones((HYPOTHESES, 3))
        signs[:, 2] = np.sign(np.linalg.det(U @ Vt))
        R = (U * signs[:, None]) @ Vt
        spread = np.sum(dx**2, axis=(1, 2))
        scale = np.sum(singular * signs, axis=1) / np.where(spread > 0.0, spread, np.inf)
        parts.append((scale, R, np.stack([x.mean(axis=1), y.mean(axis=1)])))
    if len(measured.Rs):
        rows = rng.random((HYPOTHESES, count)).argsort(axis=1)[:, :2]
        R = measured.Rs[rng.integers(len(measured.Rs), size=HYPOTHESES)]
        length = np.linalg.norm(a[rows[:, 1]] - a[rows[:, 0]], axis=1)
        scale = np.linalg.norm(b[rows[:, 1]] - b[rows[:, 0]], axis=1) / np.where(length > 0.0, length, np.inf)
        parts.append((scale, R, np.stack([a[rows].mean(axis=1), b[rows].mean(axis=1)])))
    scales, Rs = np.concatenate([part[0] for part in parts]), np.concatenate([part[1] for part in parts])
    centres = np.concatenate([part[2] for part in parts], axis=1)
    usable = np.isfinite(scales) & (scales > 0.0)
    scales, Rs, centres = scales[usable], Rs[usable], centres[:, usable]
    if known_scale:
        scales = np.ones_like(scales)
    return scales, Rs, centres[1] - scales[:, None] * np.einsum("hij,hj->hi", Rs, centres[0])


def _refined(measured: MeasuredPositions, scale: float, R: Array, t: Array, known_scale: bool) -> PositionAlignment:
    """Return the optimum near a transformation, by iteratively reweighted least squares."""
    free = np.arange(6 if known_scale else 7)
    for _ in range(ITERATIONS):
        H, g, centre, _ = _normal_equations(measured, scale, R, t)
        step = np.zeros(7)
        step[free] = np.linalg.solve(H[np.ix_(free, free)], g[free])
        growth, turn = float(np.exp(np.clip(step[6], -0.5, 0.5))), exp_so3(step[3:6])
        scale, R = scale * growth, turn @ R
        t = centre + growth * turn @ (t - centre) + step[:3]
        if np.all(np.abs(step[:3]) < 1e-6) and np.all(np.abs(step[3:]) < 1e-9):
            break
    H, _, _, factor = _normal_equations(measured, scale, R, t)
    covariance = np.zeros((7, 7))
    covariance[np.ix_(free, free)] = np.linalg.inv(H[np.ix_(free, free)])
    residuals = measured.positions_m - (scale * measured.points @ R.T + t)
    is_outlier = np.linalg.norm(residuals / measured.sigmas_m, axis=1) > OUTLIER_SIGMAS * factor
    return PositionAlignment(scale, R, t, residuals, factor, is_outlier, covariance)


def _normal_equations(
    measured: MeasuredPositions, scale: float, R: Array, t: Array
) -> tuple[Array, Array, Array, float]:
    """Return H (7, 7) and g (7,) of the step H x = g, the centre of the rotation, and the factor of the noise.

    The step is a translation, a rotation vector in the world frame, and the change of the logarithm of the scale, both
    about the centre of the positions.
    """
    predicted = scale * measured.points @ R.T + t
    residuals = measured.positions_m - predicted
    lengths = np.linalg.norm(residuals / measured.sigmas_m, axis=1)
    factor = max(float(np.median(lengths)) / CHI3_MEDIAN, 1.0)
    robust = 1.0 / (1.0 + (lengths / (CAUCHY_SIGMAS * factor)) ** 2)
    weights = robust[:, None] / (factor * measured.sigmas_m) ** 2
    centre = np.average(predicted, axis=0, weights=weights.min(axis=1))
    relative = predicted - centre
    J = np.zeros((len(relative), 3, 7))
    J[:, :, :3], J[:, :, 3:6], J[:, :, 6] = np.eye(3), -skew(relative), relative
    H = np.einsum("nij,ni,nik->jk", J, weights, J)
    g = np.einsum("nij,ni,ni->j", J, weights, residuals)
    # What nothing measures keeps its value, with a large standard deviation
    H[[3, 4, 5], [3, 4, 5]] += 1.0 / LARGEST_SIGMA_RAD**2
    H[6, 6] += 1.0 / LARGEST_SCALE_SIGMA**2
    if len(measured.Rs):
        turns = log_so3(measured.Rs @ R.T)
        agreement = 1.0 / (1.0 + np.sum(turns**2, axis=1) / ORIENTATION_SCALE_RAD**2)
        information = 1.0 / np.array([TILT_SIGMA_RAD, TILT_SIGMA_RAD, YAW_SIGMA_RAD]) ** 2
        H[[3, 4, 5], [3, 4, 5]] += agreement.mean() * information
        g[3:6] += information * (agreement[:, None] * turns).mean(axis=0)
    return H, g, centre, factor
