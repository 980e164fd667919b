"""Robust weights of landmarks, by the Geman-McClure loss with a scale that follows the median residual.

While a solution is far from the right one, all residuals are large, and so is the scale: the loss is then convex over
most of them. The scale decreases with the median as the solution improves, as in graduated non-convexity (Black and
Rangarajan, "On the unification of line processes, outlier rejection, and robust statistics", IJCV 1996; Yang et al.,
"Graduated non-convexity for robust spatial perception", RA-L 2020). Where the noise is larger than assumed, it remains
in proportion to the noise.
"""

import numpy as np
import numpy.typing as npt

from dronevio.estimator.optimization.robust import geman_mcclure_weight
from dronevio.models.arrays import Array

INLIER_WEIGHT = 0.25
"""Weight at the threshold between inliers and outliers."""
MEDIAN_FACTOR = 2.0
"""Least squared threshold, relative to the median of the squares. A square is the mean over all coordinates of a track,
so that those of inliers differ little."""


def robust_weights(squares: Array, outlier_sigmas: float, reference: npt.NDArray[np.bool_] | None = None) -> Array:
    """Return the weights (N,), 0 to 1, of landmarks.

    Args:
        squares: (N,) Mean squared residuals of the landmarks, in units of the assumed variance.
        outlier_sigmas: Root mean square residual at which the weight is `INLIER_WEIGHT`, in standard deviations.
        reference: (N,) Landmarks whose median counts; all by default.
    """
    return geman_mcclure_weight(squares, robust_scale(squares, outlier_sigmas, reference))


def robust_scale(squares: Array, outlier_sigmas: float, reference: npt.NDArray[np.bool_] | None = None) -> float:
    """Return the square at which the weight is `INLIER_WEIGHT`; for the arguments, see `robust_weights`."""
    values = squares if reference is None else squares[reference]
    median = float(np.median(values)) if len(values) else 0.0
    return max(MEDIAN_FACTOR * median, outlier_sigmas**2)
