"""Camera model: projection of points in the camera frame to pixels, and its inverse."""

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError
from dronevio.models.lenses.lens import LENSES, LensName, check_coefficients
from dronevio.models.ranges import Range, Settings

_BORDER_SAMPLES = 65  # on the central row and column, whose undistorted positions bound an undistorted image


@dataclass(frozen=True)
class CameraModel(Settings):
    """Intrinsics of a camera: a lens model (`dronevio.models.lenses`) and the geometry of the image sensor.

    Pixel centres have integer coordinates: the image spans [−0.5, width − 0.5] × [−0.5, height − 0.5].
    """

    width: Annotated[int, Range(1, 32_000)]
    """Number of columns [px]."""
    height: Annotated[int, Range(1, 32_000)]
    """Number of rows [px]."""
    fx: Annotated[float, Range(1e-3, 1e6)]
    """Focal length along x [px]."""
    fy: Annotated[float, Range(1e-3, 1e6)]
    """Focal length along y [px]."""
    cx: Annotated[float, Range(-1e6, 1e6)]
    """Principal point along x [px]."""
    cy: Annotated[float, Range(-1e6, 1e6)]
    """Principal point along y [px]."""
    distortion: Annotated[tuple[float, ...], Range(-1e3, 1e3)] = (0.0, 0.0, 0.0, 0.0)
    """Coefficients of the lens: k1, k2, p1, p2 of ``radtan``, which may be followed by k3 or by k3 to k6; k1 to k4 of
    ``equidistant``; w of ``fov``; xi, alpha of ``ds``; alpha, beta of ``eucm``; xi, k1, k2, p1, p2 of ``omni``."""
    lens: LensName = "radtan"
    """Lens model: ``radtan``, a pinhole with radial-tangential or rational distortion, or one of the fisheyes
    ``equidistant``, ``fov``, ``ds`` (double sphere), ``eucm`` (extended unified) and ``omni`` (unified, distorted)."""

    def __post_init__(self) -> None:
        """Check the values of the fields.

        Raises:
            ConfigError: A field has an invalid value; the message names both.
        """
        super().__post_init__()
        if self.lens not in LENSES:
            raise ConfigError(f"camera lens {self.lens!r}; expected one of {', '.join(LENSES)}")
        check_coefficients(self.lens, self.distortion)

    def resized(self, width: int, height: int) -> "CameraModel":
        """Return a camera with the same field of view and an image of another size [px].

        Pixels are no longer square if the ratio of the sides differs.

        Raises:
            ConfigError: A side is less than one pixel.
        """
        x, y = width / self.width, height / self.height
        return replace(
            self,
            width=width,
            height=height,
            fx=self.fx * x,
            fy=self.fy * y,
            cx=(self.cx + 0.5) * x - 0.5,  # pixel centres are at integers, so the image starts at −0.5
            cy=(self.cy + 0.5) * y - 0.5,
        )

    def fitted(self, width: int, height: int) -> "CameraModel":
        """Return a camera with an image of another size [px] and pixels of the same shape.

        It sees the largest centred part of the image whose sides have the ratio of the new ones.

        Raises:
            ConfigError: A side is less than one pixel.
        """
        sized = replace(self, width=width, height=height)
        scale = max(width / self.width, height / self.height)
        left, top = 0.5 * (self.width - width / scale), 0.5 * (self.height - height / scale)
        return replace(
            sized,
            fx=self.fx * scale,
            fy=self.fy * scale,
            cx=(self.cx + 0.5 - left) * scale - 0.5,
            cy=(self.cy + 0.5 - top) * scale - 0.5,
        )

    @property
    def central_focal_px(self) -> tuple[float, float]:
        """Focal lengths x, y of the pinhole that equals the lens near the axis: pixels per radian there [px].

        They differ from `fx` and `fy` for the lenses ``fov``, ``ds`` and ``omni``.
        """
        scale = LENSES[self.lens].central_scale(self.distortion)
        return scale * self.fx, scale * self.fy

    @property
    def K(self) -> Array:
        """(3, 3) Intrinsic matrix of the pinhole that equals the lens near the axis."""
        fx, fy = self.central_focal_px
        return np.array([[fx, 0.0, self.cx], [0.0, fy, self.cy], [0.0, 0.0, 1.0]])

    def project(self, p_cam: Array) -> Array:
        """Return pixels (…, 2) of points (…, 3) in the camera frame [m].

        The result is NaN where the lens model is not valid: beyond its largest angle, where its polynomial may map
        points outside the field of view into the image, and for ``radtan`` and ``fov`` behind the camera.
        """
        uv = LENSES[self.lens].project(np.asarray(p_cam, dtype=np.float64), self.distortion)
        return np.asarray(uv * [self.fx, self.fy] + [self.cx, self.cy])

    def unproject(self, pixels: Array) -> Array:
        """Return unit bearing vectors (…, 3) in the camera frame of pixels (…, 2); NaN where there is none."""
        ray = self._rays(pixels)
        return np.asarray(ray / np.linalg.norm(ray, axis=-1, keepdims=True))

    def normalize(self, pixels: Array) -> Array:
        """Return undistorted normalized coordinates (…, 2), at depth 1, of pixels (…, 2).

        The result is NaN where the lens model has no bearing, or one at 90° or more from the optical axis.
        """
        return _at_depth_1(self._rays(pixels))

    def distort(self, xy: Array) -> Array:
        """Return distorted normalized coordinates (…, 2) of undistorted ones (…, 2); NaN where it is not valid."""
        xy = np.asarray(xy, dtype=np.float64)
        ray = np.concatenate([xy, np.ones_like(xy[..., :1])], axis=-1)
        return LENSES[self.lens].project(ray, self.distortion)

    def undistort(self, xy_distorted: Array) -> Array:
        """Return undistorted normalized coordinates (…, 2) of distorted ones (…, 2); NaN as in `normalize`."""
        return _at_depth_1(LENSES[self.lens].unproject(np.asarray(xy_distorted, dtype=np.float64), self.distortion))

    def normalized_bounds(self, limit: float) -> tuple[Array, Array]:
        """Return the smallest and the largest normalized coordinates (2,), (2,) on the central row and column.

        They bound an undistorted image that extends to the middle of each side.

        Args:
            limit: Upper limit of their magnitude, the tangent of the largest angle from the optical axis.
        """
        right, bottom = self.width - 0.5, self.height - 0.5
        u, v = np.linspace(-0.5, right, _BORDER_SAMPLES), np.linspace(-0.5, bottom, _BORDER_SAMPLES)
        row, column = np.stack([u, np.full_like(u, self.cy)], 1), np.stack([np.full_like(v, self.cx), v], 1)
        xy = self.normalize(np.concatenate([row, column]))
        xy = np.clip(xy[np.isfinite(xy).all(axis=1)], -limit, limit)
        return xy.min(axis=0), xy.max(axis=0)

    def _rays(self, pixels: Array) -> Array:
        """Return rays (…, 3) in the camera frame of pixels (…, 2), of arbitrary length."""
        uv = (np.asarray(pixels, dtype=np.float64) - [self.cx, self.cy]) / [self.fx, self.fy]
        return LENSES[self.lens].unproject(uv, self.distortion)


def _at_depth_1(ray: Array) -> Array:
    """Return the x and y (…, 2) of rays (…, 3) scaled to depth 1; NaN where a ray does not point forward."""
    return np.asarray(ray[..., :2] / np.where(ray[..., 2:] > 0.0, ray[..., 2:], np.nan))
