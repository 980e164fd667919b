"""Features that are followed from one image to another of the same camera, and the rotation between the two images."""

from dataclasses import dataclass

import numpy as np

from dronevio.estimator.calibration.image_rotation import relative_rotations
from dronevio.estimator.frontend import klt
from dronevio.estimator.frontend.corners import CornerConfig, detect_corners
from dronevio.models.arrays import Array, Image
from dronevio.models.camera import CameraModel

FEATURES = 180
"""Largest number of features of an image, as many as the odometry follows."""
WINDOW_PX, LEVELS = 15, 4
"""Side of the patch that is compared, and number of pyramid levels: a feature may move by 100 px."""
MAX_BACKWARD_PX = 0.5
"""Largest distance between a feature and its match that is followed backwards [px]."""
BORDER_PX = 10
"""Smallest distance of a feature from the border of the image [px]."""
MIN_FORWARD = 0.17
"""Smallest cosine of the angle between a bearing and the optical axis: fisheyes see beyond 80°, and blur there."""
MIN_MATCHES = 15
"""Smallest number of matches that determine a rotation; five do without noise."""


@dataclass(frozen=True, eq=False)
class Flow:
    """Matches between two images of a camera."""

    t_ns: tuple[int, int]
    """Time stamps of the two images [ns]."""
    corners: int
    """Number of features that were searched."""
    pixels: tuple[Array, Array]
    """(N, 2) Positions in the two images [px]."""
    bearings: tuple[Array, Array]
    """(N, 3) Unit vectors in the camera frame at the two times."""

    @property
    def duration_s(self) -> float:
        """Time between the images [s]."""
        return (self.t_ns[1] - self.t_ns[0]) * 1e-9

    @property
    def median_px(self) -> float:
        """Median displacement of the matches [px]; NaN without any."""
        moved = np.linalg.norm(self.pixels[1] - self.pixels[0], axis=1)
        return float(np.median(moved)) if len(moved) else float("nan")


def flow_between(
    first: Image, second: Image, t_ns: tuple[int, int], model: CameraModel, other: CameraModel | None = None
) -> Flow:
    """Return the matches between two images (H, W).

    Args:
        first: Image in which corners are detected.
        second: Image in which they are searched.
        t_ns: Times of the two images [ns].
        model: Camera of the first image.
        other: Camera of the second image, if it is another one.
    """
    cell = max(44, round((first.size / FEATURES) ** 0.5))
    corners = detect_corners(first, 1.0, np.zeros((0, 2)), BORDER_PX, CornerConfig(cell_px=min(cell, 500)))
    if first.shape != second.shape:  # OpenCV tracks between images of one size
        return Flow(t_ns, len(corners), (np.zeros((0, 2)),) * 2, (np.zeros((0, 3)),) * 2)
    source = klt.match_brightness(first, second)
    matched, is_tracked = klt.track(source, second, corners, corners, WINDOW_PX, LEVELS)
    back, returned = klt.track(second, source, matched, corners, WINDOW_PX, 0)
    is_tracked &= returned & (np.linalg.norm(back - corners, axis=1) < MAX_BACKWARD_PX)
    f0, f1 = model.unproject(corners), (other or model).unproject(matched)
    is_tracked &= (f0[:, 2] > MIN_FORWARD) & (f1[:, 2] > MIN_FORWARD)
    return Flow(t_ns, len(corners), (corners[is_tracked], matched[is_tracked]), (f0[is_tracked], f1[is_tracked]))


def rotation_of(flow: Flow) -> Array:
    """Return the rotation vector (3,) of the camera from the first image to the second [rad]; NaN if undetermined."""
    if len(flow.pixels[0]) < MIN_MATCHES:
        return np.full(3, np.nan)
    first, second = (f[:, :2] / f[:, 2:] for f in flow.bearings)
    return np.asarray(relative_rotations([(first, second)])[0][0])
