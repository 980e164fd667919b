"""Graduated non-convexity: robust weights that find the inliers without an initial value.

The Geman-McClure loss rejects outliers and has many local minima. Its scale is therefore large at first, where the loss
is convex, and decreases from iteration to iteration (Black and Rangarajan, "On the unification of line processes,
outlier rejection, and robust statistics", IJCV 1996; Yang et al., "Graduated non-convexity for robust spatial
perception", RA-L 2020, section III).
"""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

SHRINKAGE = 2.0
"""Factor by which the squared scale decreases from one iteration to the next."""


@dataclass(frozen=True)
class GraduatedLoss:
    """A Geman-McClure loss whose scale decreases to that of the outliers."""

    outlier_sigmas: float
    """Residual at which the weight of the final loss is 1/4, in standard deviations."""
    control: float = np.inf
    """Squared scale of the loss, relative to the final one; infinite for least squares."""

    @property
    def is_final(self) -> bool:
        """Whether the scale is the final one."""
        return self.control == 1.0

    def tightened(self, squares: Array) -> "GraduatedLoss":
        """Return the loss of the next iteration.

        Args:
            squares: (N,) Squared residuals in units of their variance, whose median determines the first scale.
        """
        first = 2.0 * float(np.median(squares)) / self.outlier_sigmas**2
        return replace(self, control=max(min(self.control / SHRINKAGE, first), 1.0))

    def weights(self, squares: Array) -> Array:
        """Return the weights (…), 0 to 1, of squared residuals (…) in units of their variance."""
        if np.isinf(self.control):
            return np.ones_like(squares)
        scale = self.control * self.outlier_sigmas**2
        return np.asarray((scale / (squares + scale)) ** 2)
