"""Whether images connect the successive keyframes of an odometry.

Where all features of a frame are suddenly replaced by others, the images were exchanged or the vehicle was carried away
between two frames. After darkness, where nothing was tracked, the IMU connects the keyframes.
"""

import numpy as np

from dronevio.estimator.types import Observations, common_rows
from dronevio.models.arrays import Integers

MIN_FEATURES = 8
"""Smallest number of common features that connect two keyframes; fewer may be tracked by mistake."""
MIN_SHARE = 0.15
"""Smallest share of them among the features of the keyframe that has fewer. Between images of two places, a twentieth
was tracked by mistake; successive keyframes of eight flights share 0.39 or more (`docs/tuning.md`)."""


class ImageConnection:
    """Compares the features of each keyframe with those of the one before."""

    def __init__(self) -> None:
        """Begin without keyframes."""
        self._keyframe_ids = np.zeros(0, np.int64)
        self._tracked = 0, 0  # numbers of features that were tracked into the frame before, and into the newest

    def add_frame(self, tracked: Observations) -> None:
        """Add the features that were tracked into the next frame with an image."""
        self._tracked = self._tracked[1], len(tracked)

    def add_keyframe(self, observations: Observations) -> bool:
        """Make the newest frame a keyframe, and return whether features connect it with the one before."""
        before, self._keyframe_ids = self._keyframe_ids, observations.ids
        return are_connected(before, observations.ids, self._tracked[0])


def are_connected(before: Integers, ids: Integers, tracked: int) -> bool:
    """Return whether images connect two successive keyframes.

    Args:
        before: (N,) Identities of the features of the first keyframe.
        ids: (M,) Identities of the features of the second keyframe.
        tracked: Number of features that were tracked into the frame before the second keyframe.
    """
    fewer = min(len(before), len(ids))
    if min(fewer, tracked) < MIN_FEATURES:
        return True
    return len(common_rows(before, ids)[0]) >= max(MIN_FEATURES, MIN_SHARE * fewer)
