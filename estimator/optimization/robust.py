"""Robust losses of squared residuals, and the weights by which they are minimized with repeated linear fits.

A loss ρ(s) of a squared residual s is minimized by weighted least squares with the weight dρ/ds (Triggs et al., "Bundle
adjustment: a modern synthesis", 2000, section 3.3; Holland and Welsch, "Robust regression using iteratively reweighted
least-squares", 1977). Both losses are s for small s, so that their weight is 1 there.
"""

import numpy as np

from dronevio.models.arrays import Array


def cauchy_loss(squared: Array | float, threshold2: Array | float) -> Array:
    """Return Cauchy's loss c² log(1 + s/c²) of squared residuals.

    Args:
        squared: (N,) or number, squared residuals s.
        threshold2: (N,) or number, squared residual c² at which the weight is a half.
    """
    return np.asarray(threshold2 * np.log1p(squared / threshold2))


def cauchy_inflation(squared: Array | float, threshold2: Array | float) -> Array:
    """Return the inverse weights 1 + s/c² of Cauchy's loss: factors on the variances of residuals.

    Args:
        squared: (N,) or number, squared residuals s.
        threshold2: (N,) or number, squared residual c² at which the weight is a half.
    """
    return np.asarray(1.0 + squared / threshold2)


def geman_mcclure_loss(squared: Array, scale: float) -> Array:
    """Return the loss c s / (c + s) of Geman and McClure of squared residuals s (N,), with c the scale."""
    return np.asarray(scale * squared / (scale + squared))


def geman_mcclure_weight(squared: Array, scale: float) -> Array:
    """Return the weights (c / (c + s))² of the loss of Geman and McClure for squared residuals s (N,)."""
    return np.asarray((scale / (squared + scale)) ** 2)
