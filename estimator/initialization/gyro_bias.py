"""The gyroscope bias from the epipolar geometry of pairs of views.

The normals of the epipolar planes of two views, n = f₁ × R f₂ of the bearings f, are all perpendicular to the
translation between them, whatever the depths are, if the rotation R is right (Kneip and Lynen, "Direct optimization of
frame-to-frame rotation", ICCV 2013). One bias determines the rotations of all pairs; the directions of their
translations are eliminated (He et al., "A rotation-translation-decoupled solution for robust and efficient
visual-inertial initialization", CVPR 2023). Neither velocity nor gravity nor scale is needed, and the solution is found
from any plausible initial value.
"""

from dataclasses import dataclass

import numpy as np

from dronevio.estimator.initialization.gauge import BiasPrior
from dronevio.estimator.initialization.robust import robust_weights
from dronevio.estimator.initialization.views import WindowMeasurements
from dronevio.models.arrays import Array, Integers
from dronevio.models.rotation import cross

PAIR_S = 0.3
"""Time between the views of a pair [s]. It is long enough for a parallax, and most tracks are longer."""
MAX_ITERATIONS = 20
"""Largest number of Gauss-Newton steps."""
CONVERGED_RAD_S = 3e-4
"""Change of the bias below which the iteration ends [rad/s]; the refinement of the whole state continues from there."""
CONVERGED_WEIGHT = 0.01
"""Mean change of the weights below which the iteration ends."""


@dataclass(frozen=True, eq=False)
class EpipolarSolution:
    """The gyroscope bias by epipolar geometry."""

    bias_rad_s: Array
    """(3,) Gyroscope bias [rad/s]."""
    weights: Array
    """(F,) Weights of the landmarks, 0 to 1; those of outliers are small."""
    residual_sigmas: float
    """Median root mean square residual of the landmarks, in standard deviations. Where it is large, the gyroscope does
    not measure the rotation of the images."""
    bias_sigmas: float
    """Distance of the bias from its prior, in standard deviations of the prior."""


def epipolar_gyro_bias(
    measured: WindowMeasurements, prior: BiasPrior, sigma_rad: float, outlier_sigmas: float
) -> EpipolarSolution:
    """Return the gyroscope bias at which the epipolar planes of each pair of views intersect in one line.

    Args:
        measured: Measurements of a window.
        prior: What is known of the bias before [rad/s].
        sigma_rad: Standard deviation of a bearing [rad].
        outlier_sigmas: Root mean square residual from which a landmark is an outlier, in standard deviations.
    """
    tracks = measured.tracks
    bias, weights, information = prior.mean, np.ones(len(tracks)), np.eye(3) / prior.sigma**2
    first, second = _pairs(tracks.camera, measured.imu.integrated(bias).motion().t_s)
    both = tracks.observed[first] & tracks.observed[second]
    if not both.any():
        return EpipolarSolution(bias, weights, 0.0, 0.0)
    count = both.sum(axis=0)
    squares = np.zeros(len(tracks))
    bearings = measured.bearings / np.sqrt(np.sqrt(2.0) * sigma_rad)  # both bearings of a normal have errors
    for _ in range(MAX_ITERATIONS):
        # Normals of the epipolar planes (P, F, 3), in standard deviations
        imu = measured.imu.integrated(bias)
        R_first = np.swapaxes(imu.rotations[first], 1, 2)
        turned = bearings[second] @ np.swapaxes(R_first @ imu.rotations[second], 1, 2)
        normals = cross(bearings[first], turned)
        directions = _translations(normals, weights * both)
        residuals = np.einsum("pfi,pi->pf", normals, directions[:, :, 0])
        squares = (residuals**2 * both).sum(axis=0) / np.maximum(count, 1)
        previous, weights = weights, robust_weights(squares, outlier_sigmas, count > 0)
        # The second view turns by C δ: t · (f₁ × (C δ × R f₂)) = (R f₂ × (t × f₁)) · C δ
        C = R_first @ (imu.rotations_by_gyro_bias[second] - imu.rotations_by_gyro_bias[first])
        by_bias = cross(turned, cross(directions[:, None, :, 0], bearings[first])) @ C
        H, h = _reduced(normals @ directions[:, :, 1:], by_bias, residuals, weights * both)
        step = -np.linalg.solve(H + information, h + information @ (bias - prior.mean))
        bias = bias + step
        if np.linalg.norm(step) < CONVERGED_RAD_S and np.abs(weights - previous).mean() < CONVERGED_WEIGHT:
            break
    residual_sigmas, shift = float(np.sqrt(np.median(squares[count > 0]))), bias - prior.mean
    return EpipolarSolution(bias, weights, residual_sigmas, float(np.sqrt(shift @ information @ shift)))


def _pairs(camera: Integers, t_s: Array) -> tuple[Integers, Integers]:
    """Return the first and second views of all pairs of one camera, each with the first view that is late enough."""
    seconds = (t_s[None] - t_s[:, None] >= PAIR_S - 1e-3) & (camera[None] == camera[:, None])
    first = np.flatnonzero(seconds.any(axis=1))
    return first, seconds[first].argmax(axis=1)


def _translations(normals: Array, weights: Array) -> Array:
    """Return bases (P, 3, 3): the direction of each translation, and in the other two columns its tangents."""
    return np.asarray(np.linalg.eigh(np.swapaxes(weights[..., None] * normals, 1, 2) @ normals)[1])


def _reduced(J_direction: Array, J_bias: Array, residuals: Array, weights: Array) -> tuple[Array, Array]:
    """Return matrix (3, 3) and vector (3,) of the normal equations of the bias, the directions eliminated."""
    J = np.concatenate([J_direction, J_bias, residuals[..., None]], axis=-1)  # (P, F, 2 + 3 + 1)
    products = np.swapaxes(weights[..., None] * J, 1, 2) @ J
    eliminated = np.linalg.solve(products[:, :2, :2] + 1e-6 * np.eye(2), products[:, :2, 2:])
    reduced = (products[:, 2:, 2:] - np.swapaxes(products[:, :2, 2:], 1, 2) @ eliminated).sum(axis=0)
    return reduced[:3, :3], reduced[:3, 3]
