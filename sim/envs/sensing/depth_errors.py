"""Errors of depth images, as a stereo depth camera has them.

The error of a disparity is that of a depth in proportion to its square (Nguyen, Izadi and Lovell, "Modeling Kinect
sensor noise for improved 3D reconstruction and tracking", 3DIMPVT 2012); near surfaces, pixels at the edges of objects
and some others have no measurement.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
import numpy.typing as npt
from scipy.ndimage import maximum_filter, minimum_filter

from dronevio.models.ranges import Range, Settings

_EDGE = 0.1  # relative difference of depths within the window of a pixel at an edge


@dataclass(frozen=True)
class DepthErrors(Settings):
    """Errors of the observation ``depth``; none by default. Pixels without a measurement have the largest depth."""

    disparity_sigma_px: Annotated[float, Range(0.0, 100.0)] = 0.0
    """Standard deviation of a disparity, in pixels of the observed image."""
    baseline_m: Annotated[float, Range(above=0.0, high=10.0)] = 0.05
    """Distance between the two cameras of the sensor [m]."""
    nearest_m: Annotated[float, Range(0.0, 100.0)] = 0.0
    """Smallest depth that is measured [m]."""
    lost: Annotated[float, Range(0.0, 1.0)] = 0.0
    """Probability that a pixel has no measurement."""
    edge_px: Annotated[int, Range(0, 100)] = 0
    """Distance from an edge of an object, a step of 10 %, within which pixels have no measurement [px]."""

    def applied(
        self, depth_m: npt.NDArray[np.float32], focal_px: float, farthest_m: float, rng: np.random.Generator
    ) -> npt.NDArray[np.float32]:
        """Return measured depths.

        Args:
            depth_m: (k, H, W, 1) True depths [m].
            focal_px: Focal length of the images [px].
            farthest_m: Largest depth [m].
            rng: Generator of the errors.
        """
        if self == EXACT:
            return depth_m
        is_lost = (depth_m < self.nearest_m) | (rng.random(depth_m.shape, np.float32) < self.lost)
        if self.edge_px:
            window = (1, 2 * self.edge_px + 1, 2 * self.edge_px + 1, 1)
            nearest, farthest = minimum_filter(depth_m, window), maximum_filter(depth_m, window)
            is_lost |= farthest > (1.0 + _EDGE) * nearest
        # A disparity is focal length × baseline / depth
        noise = rng.standard_normal(depth_m.shape, np.float32) * (
            self.disparity_sigma_px / (focal_px * self.baseline_m)
        )
        inverse = 1.0 / np.maximum(depth_m, 1e-3) + noise
        measured = np.where(inverse > 1.0 / farthest_m, 1.0 / np.maximum(inverse, 1.0 / farthest_m), farthest_m)
        return np.where(is_lost | (depth_m >= farthest_m), farthest_m, measured).astype(np.float32)


EXACT = DepthErrors()
"""No errors."""
STEREO_DEPTH = DepthErrors(disparity_sigma_px=0.03, nearest_m=0.3, lost=0.02, edge_px=1)
"""Errors of 2 % at 2 m in images of the default size, the largest that the data sheet of the RealSense D435 states."""
