"""The camera model: from points in the world to pixels, and back."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dronevio.models.errors import ConfigError
from dronevio.models.lenses.lens import LENSES, LensName

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class CameraModel:
    """A lens (`dronevio.models.lenses`) before an image sensor.

    Pixel centres are integers: the image spans [−0.5, width − 0.5] × [−0.5, height − 0.5].
    """

    width: int
    """Columns [px]."""
    height: int
    """Rows [px]."""
    fx: float
    """Focal length along x [px]."""
    fy: float
    """Focal length along y [px]."""
    cx: float
    """Principal point, x [px]."""
    cy: float
    """Principal point, y [px]."""
    distortion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """The lens's coefficients: radial k1, k2 and tangential p1, p2 of ``radtan``; k1 to k4 of ``equidistant``."""
    lens: LensName = "radtan"
    """``radtan`` bends a pinhole's image; with four zeros it is one. ``equidistant`` is a fisheye."""

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ConfigError: A field makes no sense; the message names it and its value.
        """
        if self.lens not in LENSES:
            raise ConfigError(f"camera lens {self.lens!r}; expected one of {', '.join(LENSES)}")
        if min(self.width, self.height) < 1:
            raise ConfigError(f"camera image of {self.width} × {self.height} px; expected 1 px each way or more")
        for name in ("fx", "fy"):
            if not 0.0 < getattr(self, name) < np.inf:
                raise ConfigError(f"camera {name} = {getattr(self, name)}; expected a focal length above zero")
        for name in ("cx", "cy"):
            if not np.isfinite(getattr(self, name)):
                raise ConfigError(f"camera {name} = {getattr(self, name)}; expected a finite number")
        if len(self.distortion) != 4 or not np.all(np.isfinite(self.distortion)):
            raise ConfigError(f"camera distortion = {self.distortion}; expected four finite numbers")

    @property
    def K(self) -> Array:
        """(3, 3) intrinsic matrix."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def project(self, p_cam: Array) -> Array:
        """Return pixels (…, 2) of points (…, 3) in the camera frame [m].

        NaN where the lens does not see a point: beyond the angle up to which it is defined (there its formula may fold
        points from far outside back into the image), and for ``radtan`` not in front.
        """
        uv = LENSES[self.lens].project(np.asarray(p_cam, dtype=np.float64), self.distortion)
        return np.asarray(uv * [self.fx, self.fy] + [self.cx, self.cy])

    def unproject(self, pixels: Array) -> Array:
        """Return unit bearings (…, 3) in the camera frame of pixels (…, 2); NaN where the lens images nothing."""
        ray = self._rays(pixels)
        return np.asarray(ray / np.linalg.norm(ray, axis=-1, keepdims=True))

    def normalize(self, pixels: Array) -> Array:
        """Return ideal normalized coordinates (…, 2), at depth 1, of pixels (…, 2).

        NaN where the lens images nothing, or what is not in front: 90° off the axis or more.
        """
        return _at_depth_1(self._rays(pixels))

    def distort(self, xy: Array) -> Array:
        """Return distorted normalized coordinates (…, 2) of ideal ones (…, 2), NaN beyond what the lens sees."""
        xy = np.asarray(xy, dtype=np.float64)
        ray = np.concatenate([xy, np.ones_like(xy[..., :1])], axis=-1)
        return LENSES[self.lens].project(ray, self.distortion)

    def undistort(self, xy_distorted: Array) -> Array:
        """Return ideal normalized coordinates (…, 2) of distorted ones (…, 2); NaN as in `normalize`."""
        return _at_depth_1(LENSES[self.lens].rays(np.asarray(xy_distorted, dtype=np.float64), self.distortion))

    def _rays(self, pixels: Array) -> Array:
        """Return rays (…, 3) of any length in the camera frame of pixels (…, 2)."""
        uv = (np.asarray(pixels, dtype=np.float64) - [self.cx, self.cy]) / [self.fx, self.fy]
        return LENSES[self.lens].rays(uv, self.distortion)


def _at_depth_1(ray: Array) -> Array:
    """Return rays (…, 3) cut at depth 1 (…, 2), NaN where they do not point ahead."""
    return np.asarray(ray[..., :2] / np.where(ray[..., 2:] > 0.0, ray[..., 2:], np.nan))
