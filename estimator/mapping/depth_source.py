"""Depth images of the frames of a rig: from a stereo pair where it has one, else from the motion of one camera."""

from typing import Protocol

from dronevio.estimator.mapping.rectification import rectified_pair
from dronevio.estimator.mapping.stereo_depth import StereoDepth
from dronevio.estimator.mapping.sweep_depth import SweepDepth
from dronevio.models.depth import DepthImage
from dronevio.models.errors import ConfigError
from dronevio.models.rig import Rig
from dronevio.models.state import CameraFrame, Estimate


class DepthSource(Protocol):
    """Computes depth images of the frames of a rig."""

    def depth(self, frame: CameraFrame, estimate: Estimate) -> DepthImage | None:
        """Return the depth image that is known with a frame; None if there is none.

        Frames with their estimates are given in the order of time; some may be left out. The depth image has the time
        stamp and the pose of the frame whose depth it is, which may be an earlier one. With a rolling shutter, the pose
        is that of the middle row.

        Args:
            frame: The frame.
            estimate: Its estimate, whose state is at the middle of the exposure by the clock of the cameras.
        """


def depth_source(rig: Rig) -> DepthSource:
    """Return the source of depth images of a rig: its best stereo pair, else the motion of its first camera.

    Raises:
        ConfigError: The rig has no camera.
    """
    if not rig.cameras:
        raise ConfigError("rig without a camera; expected one or more, from whose images depth is computed")
    pair = rectified_pair(rig)
    return SweepDepth(rig) if pair is None else StereoDepth(rig, pair)
