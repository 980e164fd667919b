"""Two-point RANSAC: outliers among feature matches, when the rotation between the frames is known from the gyroscope.

With the rotation taken out, a static point moves along the epipolar line through the direction of translation:
tᵀ (R f₀ × f₁) = 0. Two matches give t, so few hypotheses suffice (Troiani et al., "2-point-based outlier rejection for
camera-IMU systems", ICRA 2014).
"""

import cv2
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

HYPOTHESES = 96  # 99.9 % to draw one clean pair with 70 % outliers
CERTAINTY = 0.999  # of five clean matches being among those that are drawn
MIN_MATCHES = 8  # with fewer, consensus says little


def epipolar_inliers(
    xy0: Array, xy1: Array, R_1_0: Array, threshold: float, rng: np.random.Generator
) -> npt.NDArray[np.bool_]:
    """Say which matches agree with one translation between two frames.

    Args:
        xy0: (N, 2) Normalized coordinates in the first frame.
        xy1: (N, 2) Normalized coordinates in the second frame.
        R_1_0: (3, 3) Rotation of the first camera frame into the second.
        threshold: Largest angle between an inlier and its epipolar plane [rad].
        rng: Draws the hypotheses.

    Returns:
        (N,) True for inliers; all of them where there are too few matches to tell.
    """
    n = len(xy0)
    if n < MIN_MATCHES:
        return np.ones(n, dtype=np.bool_)
    f0, f1 = _bearings(xy0) @ R_1_0.T, _bearings(xy1)
    normals = np.cross(f0, f1)

    # A match that the rotation alone explains fits every translation, and would make a hypothesis out of noise.
    flow = np.linalg.norm(f1 - f0, axis=1)
    moving = np.flatnonzero(flow > 2.0 * threshold)
    if len(moving) < MIN_MATCHES:
        return np.asarray(flow < 4.0 * threshold)
    first = rng.integers(0, len(moving), HYPOTHESES)
    second = (first + rng.integers(1, len(moving), HYPOTHESES)) % len(moving)  # another one
    t = np.cross(normals[moving[first]], normals[moving[second]])
    length = np.linalg.norm(t, axis=1, keepdims=True)
    told = length > 1e-15  # parallel normals tell no direction, and all would agree with none
    t = t / np.where(told, length, 1.0)

    agree = (_off_plane(t, normals, f0) < threshold) & told
    best = int(np.argmax(agree.sum(axis=1)))
    # Refit on the consensus: the direction that is most nearly normal to all normals.
    support = normals[agree[best]]
    refined = np.linalg.svd(support, full_matrices=False)[2][-1] if len(support) >= MIN_MATCHES else t[best]
    refit = _off_plane(refined[None], normals, f0)[0] < threshold
    return np.asarray(refit if refit.sum() >= agree[best].sum() else agree[best])


def essential_inliers(xy0: Array, xy1: Array, threshold: float) -> npt.NDArray[np.bool_]:
    """Say which matches agree with one motion between two frames, of which not even the rotation is known.

    By the essential matrix of five matches (Nistér, "An efficient solution to the five-point relative pose problem",
    PAMI 2004). Dearer than with a known rotation, and more easily deceived.

    Args:
        xy0: (N, 2) Normalized coordinates in the first frame.
        xy1: (N, 2) Normalized coordinates in the second frame.
        threshold: Largest distance of an inlier from its epipolar line, in normalized coordinates.

    Returns:
        (N,) True for inliers; none where there are too few matches to tell.
    """
    if len(xy0) < MIN_MATCHES:
        return np.zeros(len(xy0), dtype=np.bool_)
    _, inliers = cv2.findEssentialMat(xy0, xy1, np.eye(3), cv2.RANSAC, prob=CERTAINTY, threshold=threshold)
    return np.zeros(len(xy0), dtype=np.bool_) if inliers is None else np.asarray(inliers[:, 0] == 1)


def _bearings(xy: Array) -> Array:
    """Return unit vectors (N, 3) towards normalized coordinates (N, 2)."""
    rays = np.column_stack([xy, np.ones(len(xy))])
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def _off_plane(t: Array, normals: Array, f0: Array) -> Array:
    """Return the angles (H, N) [rad] between the second bearings and the epipolar planes of H translations (H, 3)."""
    sines = np.sqrt(np.maximum(1.0 - (t @ f0.T) ** 2, 1e-12))
    return np.asarray(np.abs(t @ normals.T) / sines)
