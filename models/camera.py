"""The camera model: from points in front of the camera to pixels, and back."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

_UNDISTORT_ITERATIONS = 20  # Newton on a smooth 2-D map: EuRoC's lens needs 4 to reach 1e-12


@dataclass(frozen=True)
class CameraModel:
    """A pinhole with radial-tangential distortion (Brown 1966; OpenCV's and Kalibr's ``radtan``).

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
    """Radial k1, k2 and tangential p1, p2."""

    @property
    def K(self) -> Array:
        """(3, 3) intrinsic matrix."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def distort(self, xy: Array) -> Array:
        """Return distorted normalised coordinates (…, 2) of ideal ones (…, 2)."""
        k1, k2, p1, p2 = self.distortion
        x, y = xy[..., 0], xy[..., 1]
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * k2)
        return np.stack(
            [
                x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
                y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
            ],
            axis=-1,
        )

    def undistort(self, xy_distorted: Array) -> Array:
        """Return ideal normalised coordinates (…, 2) of distorted ones (…, 2), by Newton's method."""
        target = np.asarray(xy_distorted, dtype=np.float64)
        if not any(self.distortion):
            return target.copy()
        xy = target.copy()
        for _ in range(_UNDISTORT_ITERATIONS):
            residual = self.distort(xy) - target
            if residual.size == 0 or np.max(np.abs(residual)) < 1e-13:
                break
            J = self._distortion_jacobian(xy)
            det = J[..., 0, 0] * J[..., 1, 1] - J[..., 0, 1] * J[..., 1, 0]
            dx = (J[..., 1, 1] * residual[..., 0] - J[..., 0, 1] * residual[..., 1]) / det
            dy = (J[..., 0, 0] * residual[..., 1] - J[..., 1, 0] * residual[..., 0]) / det
            xy = xy - np.stack([dx, dy], axis=-1)
        return xy

    def project(self, p_cam: Array) -> Array:
        """Return pixels (…, 2) of points (…, 3) in the camera frame [m]; NaN where a point is not in front."""
        p = np.asarray(p_cam, dtype=np.float64)
        z = np.where(p[..., 2:] > 0.0, p[..., 2:], np.nan)
        uv = self.distort(p[..., :2] / z)
        return np.asarray(uv * [self.fx, self.fy] + [self.cx, self.cy])

    def normalise(self, pixels: Array) -> Array:
        """Return ideal normalised coordinates (…, 2), at depth 1, of pixels (…, 2)."""
        uv = np.asarray(pixels, dtype=np.float64)
        return self.undistort((uv - [self.cx, self.cy]) / [self.fx, self.fy])

    def unproject(self, pixels: Array) -> Array:
        """Return unit bearings (…, 3) in the camera frame of pixels (…, 2)."""
        xy = self.normalise(pixels)
        ray = np.concatenate([xy, np.ones_like(xy[..., :1])], axis=-1)
        return np.asarray(ray / np.linalg.norm(ray, axis=-1, keepdims=True))

    def _distortion_jacobian(self, xy: Array) -> Array:
        """Return ∂distort/∂xy (…, 2, 2)."""
        k1, k2, p1, p2 = self.distortion
        x, y = xy[..., 0], xy[..., 1]
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * k2)
        d_radial = 2.0 * (k1 + 2.0 * k2 * r2)  # ∂radial/∂x = x · d_radial
        off = x * y * d_radial + 2.0 * p1 * x + 2.0 * p2 * y
        xx = radial + x * x * d_radial + 2.0 * p1 * y + 6.0 * p2 * x
        yy = radial + y * y * d_radial + 6.0 * p1 * y + 2.0 * p2 * x
        return np.stack([np.stack([xx, off], axis=-1), np.stack([off, yy], axis=-1)], axis=-2)
