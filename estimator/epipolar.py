"""Two-point RANSAC: outliers among feature matches, when the rotation between the frames is known from the gyroscope.

With the rotation taken out, a static point moves along the epipolar line through the direction of translation:
tᵀ (R f₀ × f₁) = 0. Two matches give t, so few hypotheses suffice (Troiani et al., "2-point-based outlier rejection for
camera-IMU systems", ICRA 2014).
"""

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

HYPOTHESES = 96  # 99.9 % to draw one clean pair with 70 % outliers
MIN_MATCHES = 8  # with fewer, consensus says little


def epipolar_inliers(
    xy0: Array, xy1: Array, R_1_0: Array, threshold: float, rng: np.random.Generator
) -> npt.NDArray[np.bool_]:
    """Say which matches agree with one translation between two frames.

    Args:
        xy0: (N, 2) Normalised coordinates in the first frame.
        xy1: (N, 2) Normalised coordinates in the second frame.
        R_1_0: (3, 3) Rotation of the first camera frame into the second.
        threshold: Largest distance of an inlier from its epipolar line, in normalised coordinates.
        rng: Draws the hypotheses.

    Returns:
        (N,) True for inliers; all of them where there are too few matches to tell.
    """
    n = len(xy0)
    if n < MIN_MATCHES:
        return np.ones(n, dtype=np.bool_)
    f0 = np.column_stack([xy0, np.ones(n)]) @ R_1_0.T
    f0 = f0 / f0[:, 2:]
    f1 = np.column_stack([xy1, np.ones(n)])
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

    agree = (_line_distance(t, normals, f0) < threshold) & told
    best = int(np.argmax(agree.sum(axis=1)))
    # Refit on the consensus: the direction that is most nearly normal to all normals.
    support = normals[agree[best]]
    refined = np.linalg.svd(support, full_matrices=False)[2][-1] if len(support) >= MIN_MATCHES else t[best]
    refit = _line_distance(refined[None], normals, f0)[0] < threshold
    return np.asarray(refit if refit.sum() >= agree[best].sum() else agree[best])


def _line_distance(t: Array, normals: Array, f0: Array) -> Array:
    """Return the distances (H, N) of the second points from the epipolar lines [t]× f0, for H translations."""
    lines_x = np.outer(t[:, 1], f0[:, 2]) - np.outer(t[:, 2], f0[:, 1])
    lines_y = np.outer(t[:, 2], f0[:, 0]) - np.outer(t[:, 0], f0[:, 2])
    return np.asarray(np.abs(t @ normals.T) / np.maximum(np.hypot(lines_x, lines_y), 1e-9))
