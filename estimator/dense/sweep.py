"""Sweep of surfaces through the scene: correlation of an image with its neighbours at many depths of each pixel.

For a hypothesis of the inverse depth w(x) of each pixel x, a neighbouring image is warped into the reference image,

    x' ~ K' (R K⁻¹ x + w(x) t),

and compared in square windows by zero-mean normalized cross-correlation (ZNCC). With constant w, this is the plane
sweep of Collins, "A space-sweep approach to true multi-image matching", CVPR 1996. With w around an earlier estimate,
the windows follow the estimated surface, so that slanted surfaces are not biased.
"""

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt

from dronevio.estimator.dense.views import View
from dronevio.models.arrays import Floats

Costs = npt.NDArray[np.uint8]

SCALE = 250
"""Integer value of the cost 1."""
_OUTSIDE = -1e3  # grey value of warped images outside their content
VARIANCE_FLOOR = 4.0
"""Variance that is added to that of a window, of the order of the noise; windows without texture correlate with 0."""


class Warp:
    """Warp of a neighbouring image into a reference image for a given inverse depth of each pixel."""

    def __init__(self, reference: View, source: View) -> None:
        """Precompute the projection at infinite depth and the epipole."""
        T = np.linalg.inv(source.T_world_cam) @ reference.T_world_cam
        K = source.camera.K
        self._infinite_homography = K @ T[:3, :3] @ np.linalg.inv(reference.camera.K)
        self._epipole = K @ T[:3, 3]
        self._size = reference.camera.width, reference.camera.height
        self._grey = np.where(source.mask, source.grey, np.float32(_OUTSIDE))
        x, y = np.meshgrid(np.arange(self._size[0], dtype=np.float32), np.arange(self._size[1], dtype=np.float32))
        H = self._infinite_homography.astype(np.float32)
        self._at_infinity = [H[k, 0] * x + H[k, 1] * y + H[k, 2] for k in range(3)]

    def plane(self, inverse_depth: float) -> Floats:
        """Return the image (H, W) warped by a plane of constant depth, below 0 where it has no content."""
        homography = self._infinite_homography.copy()
        homography[:, 2] += inverse_depth * self._epipole
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        return np.asarray(cv2.warpPerspective(self._grey, homography, self._size, flags=flags, borderValue=_OUTSIDE))

    def surface(self, inverse_depth: Floats) -> Floats:
        """Return the image (H, W) warped by a surface (H, W), below 0 where it has no content."""
        u, v = self.pixels(inverse_depth)
        return np.asarray(cv2.remap(self._grey, u, v, cv2.INTER_LINEAR, borderValue=_OUTSIDE))

    def pixels(self, inverse_depth: Floats) -> tuple[Floats, Floats]:
        """Return columns and rows (H, W), (H, W) of the points of a surface in the source; far outside behind it."""
        e = self._epipole.astype(np.float32)
        z = np.maximum(self._at_infinity[2] + inverse_depth * e[2], np.float32(1e-6))
        return (self._at_infinity[0] + inverse_depth * e[0]) / z, (self._at_infinity[1] + inverse_depth * e[1]) / z

    def step(self, inverse_depth: float) -> float:
        """Return the change of inverse depth that moves a projection by one pixel, the median over the image."""
        x, y, z = (
            a[::8, ::8].astype(np.float64) + inverse_depth * e
            for a, e in zip(self._at_infinity, self._epipole, strict=True)
        )
        z = np.where(z > 0.0, z, np.nan)
        du, dv = ((self._epipole[k] * z - self._epipole[2] * a) / z**2 for k, a in ((0, x), (1, y)))
        moved = np.hypot(du, dv)
        moved = moved[np.isfinite(moved)]
        return 1.0 / float(np.median(moved)) if len(moved) and np.median(moved) > 0.0 else float("inf")


class Correlation:
    """Correlation of windows of a reference image with those of warped images."""

    def __init__(self, grey: Floats, window: int) -> None:
        """Precompute the moments of the windows of the reference image (H, W)."""
        self._size = (window, window)
        self._grey = grey
        self._mean = self._box(grey)
        self._deviation = self._deviation_of(grey, self._mean)

    def __call__(self, warped: Floats) -> Floats:
        """Return the ZNCC (H, W) of the windows around all pixels, −1 to 1."""
        mean = self._box(warped)
        deviation = self._deviation_of(warped, mean)
        deviation *= self._deviation
        covariance = self._box(self._grey * warped)
        mean *= self._mean
        covariance -= mean
        covariance /= deviation
        return covariance

    def _deviation_of(self, image: Floats, mean: Floats) -> Floats:
        variance = self._box(image * image)
        variance -= mean * mean
        np.maximum(variance, 0.0, out=variance)
        variance += np.float32(VARIANCE_FLOOR)
        return np.sqrt(variance, out=variance)

    def _box(self, image: Floats) -> Floats:
        return np.asarray(cv2.boxFilter(image, cv2.CV_32F, self._size, borderType=cv2.BORDER_REPLICATE))


def sweep(
    reference: View,
    warps: Sequence[Warp],
    base: Floats | None,
    slope: Floats | None,
    offsets: Floats,
    window: int,
    best: int,
) -> Costs:
    """Return the cost of each inverse depth base + slope · offset of each pixel.

    The cost is 1 − ZNCC within 0 and 1, the mean over the neighbours with the best correlation at this depth (Kang,
    Szeliski and Chai, "Handling occlusions in dense multi-view stereo", CVPR 2001). It is 1 where a neighbour does not
    see the point.

    Args:
        reference: The reference image.
        warps: Warps of the neighbours.
        base: (H, W) Inverse depth to which the offsets are added; None for 0.
        slope: (H, W) Factor of the offsets; None for 1.
        offsets: (D,) Offsets of the inverse depth.
        window: Side of the windows [px].
        best: Number of neighbours in the mean.

    Returns:
        (H, D, W) Costs in units of 1 / `SCALE`.
    """
    correlation = Correlation(reference.grey, window)
    height, width = reference.grey.shape
    costs = np.empty((height, len(offsets), width), np.uint8)
    best = min(best, len(warps))
    for k, offset in enumerate(offsets):
        lowest: list[Floats] = []
        surface = None if base is None and slope is None else _surface(base, slope, offset)
        for warp in warps:
            warped = warp.plane(float(offset)) if surface is None else warp.surface(surface)
            outside = warped < 0.0
            np.maximum(warped, 0.0, out=warped)
            cost = correlation(warped)
            np.subtract(1.0, cost, out=cost)
            np.clip(cost, 0.0, 1.0, out=cost)
            cost[outside] = 1.0
            _insert(lowest, cost, best)
        mean = sum(lowest[1:], start=lowest[0])
        mean *= np.float32(SCALE / best)
        costs[:, k] = np.rint(mean, out=mean)
    return costs


def _surface(base: Floats | None, slope: Floats | None, offset: np.float32) -> Floats:
    """Return the inverse depth (H, W) of a surface."""
    if slope is None:
        assert base is not None
        return base + offset
    return slope * offset if base is None else base + slope * offset


def _insert(lowest: list[Floats], cost: Floats, count: int) -> None:
    """Insert a cost into the sorted list of the lowest ones of each pixel."""
    for k in range(len(lowest)):
        lowest[k], cost = np.minimum(lowest[k], cost), np.maximum(lowest[k], cost)
    if len(lowest) < count:
        lowest.append(cost)
