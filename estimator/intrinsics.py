"""Corrections of the intrinsics of cameras: focal length, principal point and a radial term of the third order.

They act on undistorted coordinates of the given calibration, and need no derivatives of lenses: a wrong first
coefficient of any lens leaves such a radial term. The coordinates are those in which a focal length is a scale. For
pinholes with a radial-tangential distortion these are the normalized ones, at depth 1; for fisheyes, their length is
the angle from the axis.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array, Integers, Mask

NEWTON_STEPS = 4
"""Number of Newton steps in which the radial correction is inverted, to the precision of the numbers."""
MIN_SLOPE = 0.1
"""Smallest slope of the radial correction in these steps."""
TINY = 1e-12
"""Smallest coefficient that bounds the radius, and smallest squared radius that is not that of the axis."""
LARGEST_RAD = np.radians(89.0)
"""Largest angle from the axis that normalized coordinates have."""


def lens_xy(xy: Array, is_fisheye: Mask) -> Array:
    """Return coordinates (N, 2) in which a focal length is a scale, of normalized ones (N, 2)."""
    return np.asarray(_scales(xy, is_fisheye)[0][:, None] * xy)


def lens_jacobian(xy: Array, is_fisheye: Mask) -> Array:
    """Return the Jacobian (N, 2, 2) of `lens_xy`."""
    scale, slope = _scales(xy, is_fisheye)
    J = slope[:, None, None] * xy[:, :, None] * xy[:, None]
    J[:, [0, 1], [0, 1]] += scale[:, None]
    return np.asarray(J)


def normalized_xy(lens: Array, is_fisheye: Mask) -> Array:
    """Return the normalized coordinates (N, 2) of those by `lens_xy`."""
    angle = np.hypot(*lens.T)
    tangent = np.tan(np.minimum(angle, LARGEST_RAD)) / np.maximum(angle, np.sqrt(TINY))
    return np.asarray(np.where(is_fisheye & (angle > np.sqrt(TINY)), tangent, 1.0)[:, None] * lens)


def _scales(xy: Array, is_fisheye: Mask) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return the ratios s (N,) of `lens_xy` to normalized coordinates of radius r, and s'(r) / r (N,)."""
    r2 = np.maximum((xy * xy).sum(axis=1), TINY)
    r = np.sqrt(r2)
    scale = np.arctan(r) / r
    slope = np.where(r2 > 1e-6, (1.0 / (1.0 + r2) - scale) / r2, -2.0 / 3.0)
    return np.where(is_fisheye, scale, 1.0), np.where(is_fisheye, slope, 0.0)


@dataclass(frozen=True, eq=False)
class IntrinsicCorrections:
    """Corrections of the intrinsics of C cameras.

    In the coordinates of `lens_xy`, given = (1 + focal) (1 + radial r²) corrected + principal.
    """

    focal: Array
    """(C,) Relative corrections of fx and fy alike: their ratio is that of the sides of a pixel, which is known."""
    principal: Array
    """(C, 2) Corrections of the principal points, in units of fx and fy."""
    radial: Array
    """(C,) Corrections of the first radial coefficient of the distortion."""
    is_fisheye: Mask
    """(C,) Whether the lens of a camera is a fisheye."""

    def corrected_xy(self, xy: Array, camera: Integers) -> Array:
        """Return normalized coordinates (N, 2) by the corrected intrinsics, from those by the given intrinsics."""
        is_fisheye = self.is_fisheye[camera]
        distorted = (lens_xy(xy, is_fisheye) - self.principal[camera]) / (1.0 + self.focal[camera, None])
        k, target = self.radial[camera], np.hypot(*distorted.T)
        largest = np.sqrt(1.0 / (3.0 * np.maximum(-k, TINY)))  # where the slope is 0
        r = np.minimum(target, largest)
        for _ in range(NEWTON_STEPS if self.radial.any() else 0):  # r (1 + k r²) = target
            r = np.clip(r - (r + k * r**3 - target) / np.maximum(1.0 + 3.0 * k * r * r, MIN_SLOPE), 0.0, largest)
        return normalized_xy(distorted / (1.0 + k * r * r)[:, None], is_fisheye)

    def given_xy(self, xy: Array, camera: Integers) -> Array:
        """Return normalized coordinates (N, 2) by the given intrinsics, the inverse of `corrected_xy`."""
        is_fisheye = self.is_fisheye[camera]
        lens = lens_xy(xy, is_fisheye)
        scale = (1.0 + self.focal[camera]) * (1.0 + self.radial[camera] * (lens * lens).sum(axis=1))
        return normalized_xy(scale[:, None] * lens + self.principal[camera], is_fisheye)
