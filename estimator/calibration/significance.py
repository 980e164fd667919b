"""Which part of a correction is significant, independent of the axes in which its parameters are expressed."""

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


def significant_length(difference: Array, covariance: Array, sigmas: float) -> float:
    """Return the length of the significant part of a correction, in the unit of its parameters.

    The correction is decomposed along the principal axes of its covariance. A component counts if it is larger than
    some standard deviations. The rotation between two cameras, for example, is often known to a tenth of the
    uncertainty of their common rotation, which no single parameter shows.

    Args:
        difference: (n,) Estimate minus the value in use.
        covariance: (n, n) Covariance of the estimate.
        sigmas: Number of standard deviations beyond which a component is significant.
    """
    variances, axes = np.linalg.eigh(covariance)
    components = axes.T @ difference
    significant = np.abs(components) > sigmas * np.sqrt(np.maximum(variances, 0.0))
    return float(np.linalg.norm(components[significant]))
