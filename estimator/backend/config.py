"""Settings of the fixed-lag smoother."""

from dataclasses import dataclass
from typing import Annotated

from dronevio.models.ranges import Range, Settings


@dataclass(frozen=True)
class SmootherConfig(Settings):
    """Settings of the fixed-lag smoother."""

    max_keyframes: Annotated[int, Range(3, 40)] = 9
    """Number of keyframes in the window."""
    min_parallax_px: Annotated[float, Range(low=0.0)] = 5.0
    """Smallest median displacement of the features since the previous keyframe, compensated for rotation [px]. Below
    it, the second-newest keyframe is dropped instead of marginalizing the oldest."""
    max_persistent: Annotated[int, Range(0, 100)] = 20
    """Largest number of landmarks that persist as variables of the marginal prior."""
    iterations: Annotated[int, Range(1, 20)] = 2
    """Largest number of Gauss-Newton steps per keyframe."""
    max_decrement: Annotated[float, Range(low=0.0)] = 20.0
    """Squared length of a step in standard deviations (Newton decrement) below which it is the last one: the next step
    would be shorter than one standard deviation."""
    pixel_sigma: Annotated[float, Range(0.01, 100.0)] = 0.145
    """Standard deviation of an image observation of the best quality, with one camera [px]."""
    stereo_pixel_sigma: Annotated[float, Range(0.01, 100.0)] = 0.1
    """Standard deviation of an image observation of the best quality, with several cameras [px]. It is smaller, because
    `drift_rad` accounts for the errors that tracks have in common."""
    drift_rad: Annotated[float, Range(0.0, 1.0)] = 3e-4
    """Random walk of the window's orientation relative to what has left it, with several cameras [rad/√s]. With one
    camera, the variances of observations grow instead."""
    robust_sigmas: Annotated[float, Range(0.1, 1e3)] = 1.0
    """Scale of the Cauchy loss of the observations, in standard deviations or medians, whichever is larger."""

    def image_sigma_px(self, cameras: int) -> float:
        """Return the standard deviation of an image observation of the best quality [px] with some cameras."""
        return self.pixel_sigma if cameras == 1 else self.stereo_pixel_sigma
