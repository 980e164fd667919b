"""Unified camera model with radial-tangential distortion (``omni``): catadioptric cameras and wide fisheyes.

    u = d((x, y) / (z + ξ |p|)),   d as in `radtan`

C. Mei, P. Rives, "Single view point omnidirectional camera calibration from planar grids", ICRA 2007 (section II-B);
Kalibr's ``omni``, OpenCV's ``omnidir``, camodocal's ``MEI``. The field of view may exceed 90° from the axis.
"""

from collections.abc import Mapping

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.lenses import radtan
from dronevio.models.lenses.ds import from_sphere
from dronevio.models.ranges import FINITE, Range

COEFFICIENTS: Mapping[str, Range] = {"xi": Range(0.0, 1e3), **dict.fromkeys(("k1", "k2", "p1", "p2"), FINITE)}
"""Names and ranges of the coefficients: ξ, and those of `radtan`."""
COUNTS: tuple[int, ...] = (5,)
"""Allowed numbers of coefficients."""


def central_scale(coefficients: tuple[float, ...]) -> float:
    """Return the radius in the image, in focal lengths, per radian from the optical axis, near the axis."""
    return 1.0 / (1.0 + coefficients[0])


def project(p_cam: Array, coefficients: tuple[float, ...]) -> Array:
    """Return image coordinates (…, 2), in focal lengths, of points (…, 3) in the camera frame.

    The result is NaN from the largest radius before distortion on, or from the angle at which that is infinite, and
    beyond `radtan.valid_limit`.
    """
    xi, *distortion = coefficients
    d, z = np.linalg.norm(p_cam, axis=-1, keepdims=True), p_cam[..., 2:]
    visible = z > -min(xi, 1.0 / max(xi, 1.0)) * d
    return radtan.project(
        np.concatenate([p_cam[..., :2], np.where(visible, z + xi * d, np.nan)], axis=-1), tuple(distortion)
    )


def unproject(uv: Array, coefficients: tuple[float, ...]) -> Array:
    """Return the unit rays (…, 3) of image coordinates (…, 2), in focal lengths; NaN where there is none."""
    xi, *distortion = coefficients
    return from_sphere(radtan.unproject(uv, tuple(distortion)), xi)
