"""Corrections of the intrinsics of cameras: focal length, principal point, and the first coefficient of the lens.

The odometry works with undistorted coordinates. To correct them, they are distorted by the given lens: in the image,
the focal length is a scale and the principal point a displacement. The result is undistorted by the corrected lens.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from dronevio.models.arrays import Array, Integers
from dronevio.models.camera import CameraModel
from dronevio.models.lenses.lens import LENSES

STEP = 1e-5
"""Step of the central differences by coordinates and by the coefficient."""


def image_coordinates(model: CameraModel, xy: Array, radial: float = 0.0) -> Array:
    """Return image coordinates (N, 2), relative to the principal point in focal lengths, of normalized ones (N, 2).

    Where the lens is not valid, they are the normalized ones.

    Args:
        model: The camera.
        xy: Normalized, undistorted coordinates.
        radial: Correction of the first coefficient of the lens.
    """
    found = LENSES[model.lens].project(np.column_stack([xy, np.ones(len(xy))]), _coefficients(model, radial))
    return np.where(np.isfinite(found), found, xy)


def image_jacobians(model: CameraModel, xy: Array, radial: float) -> tuple[Array, Array, Array]:
    """Return `image_coordinates` (N, 2), and derivatives by coordinates (N, 2, 2) and by the coefficient (N, 2)."""
    x, y = np.array([STEP, 0.0]), np.array([0.0, STEP])
    moved = np.concatenate([xy, xy + x, xy - x, xy + y, xy - y])
    image, *by_steps = image_coordinates(model, moved, radial).reshape(5, -1, 2)
    by_xy = np.stack([by_steps[0] - by_steps[1], by_steps[2] - by_steps[3]], axis=-1)
    by_radial = image_coordinates(model, xy, radial + STEP) - image_coordinates(model, xy, radial - STEP)
    return image, by_xy / (2.0 * STEP), by_radial / (2.0 * STEP)


def _normalized(model: CameraModel, image: Array, radial: float) -> Array:
    """Return the normalized coordinates (N, 2) of image coordinates (N, 2); NaN where there are none."""
    rays = LENSES[model.lens].unproject(image, _coefficients(model, radial))
    return np.asarray(rays[:, :2] / np.where(rays[:, 2:] > 0.0, rays[:, 2:], np.nan))


def _coefficients(model: CameraModel, radial: float) -> tuple[float, ...]:
    first, *others = model.distortion
    return (first + radial, *others)


@dataclass(frozen=True, eq=False)
class IntrinsicCorrections:
    """Corrections of the intrinsics of C cameras, with given = (1 + focal) corrected + principal in the image."""

    focal: Array
    """(C,) Relative corrections of fx and fy alike: their ratio is that of the sides of a pixel, which is known."""
    principal: Array
    """(C, 2) Corrections of the principal points, in units of fx and fy."""
    radial: Array
    """(C,) Corrections of the first coefficients of the lenses: k1 of ``radtan`` and ``equidistant``."""
    models: tuple[CameraModel, ...]
    """The C given cameras."""

    def corrected_xy(self, xy: Array, camera: Integers) -> Array:
        """Return normalized coordinates (N, 2) by the corrected intrinsics, from those by the given intrinsics.

        Where a lens is not valid, they are not corrected.
        """

        def corrected(c: int, given: Array) -> Array:
            image = (image_coordinates(self.models[c], given) - self.principal[c]) / (1.0 + self.focal[c])
            return _normalized(self.models[c], image, self.radial[c])

        return _by_camera(corrected, xy, camera)

    def given_xy(self, xy: Array, camera: Integers) -> Array:
        """Return normalized coordinates (N, 2) by the given intrinsics, the inverse of `corrected_xy`."""

        def given(c: int, corrected: Array) -> Array:
            image = image_coordinates(self.models[c], corrected, self.radial[c])
            return _normalized(self.models[c], (1.0 + self.focal[c]) * image + self.principal[c], 0.0)

        return _by_camera(given, xy, camera)


def _by_camera(function: Callable[[int, Array], Array], xy: Array, camera: Integers) -> Array:
    """Return coordinates (N, 2) changed by a function of the index and the coordinates of each camera."""
    changed = xy.copy()
    for c in np.unique(camera).tolist():
        rows = np.flatnonzero(camera == c)
        found = function(c, xy[rows])
        changed[rows] = np.where(np.isfinite(found).all(axis=1, keepdims=True), found, xy[rows])
    return changed
