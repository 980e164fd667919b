"""Outlier rejection among feature matches of two frames, by RANSAC.

If the gyroscope provides the rotation between the frames, two matches suffice for a hypothesis: with the rotation
removed, a static point moves along the epipolar line through the direction of translation, tᵀ (R f₀ × f₁) = 0
(Troiani et al., "2-point-based outlier rejection for camera-IMU systems", ICRA 2014). Otherwise five matches determine
the essential matrix.
"""

import cv2
import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array
from dronevio.models.rotation import cross

HYPOTHESES = 96  # a pair without outliers is drawn with a probability of 99.9 % if 70 % are outliers
CONFIDENCE = 0.999  # probability that one sample of five matches is free of outliers
MIN_RATIO = 0.37  # of inliers, for which a thousand samples suffice; no more are drawn
MIN_MATCHES = 8  # with fewer matches, a consensus is not significant


def epipolar_inliers(
    xy0: Array, xy1: Array, R_1_0: Array, threshold: float, rng: np.random.Generator
) -> npt.NDArray[np.bool_]:
    """Return which matches are consistent with one translation, given the rotation between two frames.

    Args:
        xy0: (N, 2) Normalized coordinates in the first frame.
        xy1: (N, 2) Normalized coordinates in the second frame.
        R_1_0: (3, 3) Rotation of the first camera frame into the second.
        threshold: Largest angle between an inlier and its epipolar plane [rad].
        rng: Random generator that draws the hypotheses.

    Returns:
        (N,) True for inliers; true for all matches if there are fewer than `MIN_MATCHES`.
    """
    n = len(xy0)
    if n < MIN_MATCHES:
        return np.ones(n, dtype=np.bool_)
    # Epipolar planes of the matches, with the rotation removed
    f0, f1 = _bearings(xy0) @ R_1_0.T, _bearings(xy1)
    normals = cross(f0, f1)

    # A match that rotation alone explains is consistent with every translation, so a hypothesis from it is noise.
    flow = np.linalg.norm(f1 - f0, axis=1)
    moving = np.flatnonzero(flow > 2.0 * threshold)
    if len(moving) < MIN_MATCHES:
        return np.asarray(flow < 4.0 * threshold)
    # Hypotheses of the direction of translation by two matches each
    first = rng.integers(0, len(moving), HYPOTHESES)
    second = (first + rng.integers(1, len(moving), HYPOTHESES)) % len(moving)  # differs from the first
    t = cross(normals[moving[first]], normals[moving[second]])
    length = np.linalg.norm(t, axis=1, keepdims=True)
    is_defined = length > 1e-15  # parallel normals do not determine the direction of translation
    t = t / np.where(is_defined, length, 1.0)

    # Largest consensus
    is_inlier = _agree(t, normals, f0, threshold) & is_defined
    best = int(np.argmax(is_inlier.sum(axis=1)))
    # Refinement on the consensus set: the direction most nearly orthogonal to all its normals.
    consensus = normals[is_inlier[best]]
    is_refined = len(consensus) >= MIN_MATCHES
    refined_t = np.linalg.eigh(consensus.T @ consensus)[1][:, 0] if is_refined else t[best]  # least eigenvalue
    refined = _agree(refined_t[None], normals, f0, threshold)[0]
    return np.asarray(refined if refined.sum() >= is_inlier[best].sum() else is_inlier[best])


def essential_inliers(xy0: Array, xy1: Array, threshold: float, min_ratio: float) -> npt.NDArray[np.bool_]:
    """Return which matches are consistent with one motion between two frames, rotation unknown.

    The motion is the essential matrix of five matches (Nistér, "An efficient solution to the five-point relative pose
    problem", PAMI 2004). The method is slower and less robust than `epipolar_inliers`.

    Args:
        xy0: (N, 2) Normalized coordinates in the first frame.
        xy1: (N, 2) Normalized coordinates in the second frame.
        threshold: Largest distance of an inlier from its epipolar line, in normalized coordinates.
        min_ratio: Smallest ratio of inliers that is of use; it determines the number of samples.

    Returns:
        (N,) True for inliers; false for all matches if there are fewer than `MIN_MATCHES`.
    """
    if len(xy0) < MIN_MATCHES:
        return np.zeros(len(xy0), dtype=np.bool_)
    _, inliers = cv2.findEssentialMat(
        xy0, xy1, np.eye(3), cv2.RANSAC, prob=CONFIDENCE, threshold=threshold, maxIters=samples_of_five(min_ratio)
    )
    return np.zeros(len(xy0), dtype=np.bool_) if inliers is None else np.asarray(inliers[:, 0] == 1)


def samples_of_five(inlier_ratio: float) -> int:
    """Return the number of samples of five matches, one of which is free of outliers with `CONFIDENCE`.

    Args:
        inlier_ratio: Ratio of inliers; smaller ones than `MIN_RATIO` count as that.
    """
    ratio = np.clip(inlier_ratio, MIN_RATIO, 0.99)
    return int(np.ceil(np.log1p(-CONFIDENCE) / np.log1p(-(ratio**5))))


def _bearings(xy: Array) -> Array:
    """Return the unit bearing vectors (N, 3) of normalized coordinates (N, 2)."""
    rays = np.column_stack([xy, np.ones(len(xy))])
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def _agree(t: Array, normals: Array, f0: Array, threshold: float) -> npt.NDArray[np.bool_]:
    """Return whether second bearings lie within an angle [rad] of the epipolar planes (H, N) of translations (H, 3).

    The angle is |t · n| / √(1 − (t · f₀)²) with the unit direction t of translation, the normal n of both bearings and
    the first bearing f₀.
    """
    squared_sines = np.maximum(1.0 - (t @ f0.T) ** 2, 1e-12)
    return np.asarray((t @ normals.T) ** 2 < threshold**2 * squared_sines)
