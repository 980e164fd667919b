"""Depth images of the frames of a rig: from a stereo pair where it has one, else from the motion of one camera."""

from dataclasses import replace
from typing import Protocol

import numpy as np

from dronevio.estimator.mapping.camera_pose import at_exposure, delay_s, displaced
from dronevio.estimator.mapping.rectification import Rectification, rectified_pair
from dronevio.estimator.mapping.stereo_depth import StereoDepth
from dronevio.estimator.mapping.sweep_depth import SweepDepth
from dronevio.models.depth import DepthImage
from dronevio.models.errors import ConfigError
from dronevio.models.rig import Rig
from dronevio.models.state import CameraFrame, Estimate, NavState

MAX_SHIFT_PX = 0.1
"""Largest shift of a point at a distance of 1 m between the exposures of a pair that counts as none [px]."""


class DepthSource(Protocol):
    """Computes depth images of the frames of a rig."""

    def depth(self, frame: CameraFrame, estimate: Estimate) -> DepthImage | None:
        """Return the depth image that is known with a frame; None if there is none.

        Frames with their estimates are given in the order of time; some may be left out. The depth image has the time
        stamp and the pose of the frame whose depth it is, which may be an earlier one. With a rolling shutter, the pose
        is that of the middle row.

        Args:
            frame: The frame.
            estimate: Its estimate.
        """


class CalibratedDepth:
    """Depth images at the exposures of their frames, by the calibration as it is estimated; a `DepthSource`.

    The sources that it chooses from are given estimates whose state is that in the middle of the exposure, so that they
    add the delays of their cameras alone. When the poses of the cameras are corrected, depth begins anew with them. If
    the cameras of a pair were exposed one after another, the pair is rectified from where they were.
    """

    def __init__(self, rig: Rig) -> None:
        """Take the given calibration of a rig with at least one camera."""
        self._begin(rig)

    def _begin(self, rig: Rig) -> None:
        """Begin with a calibration."""
        self._rig, self._pair = rig, rectified_pair(rig)
        self._source = SweepDepth(rig) if self._pair is None else StereoDepth(rig, self._pair)

    def depth(self, frame: CameraFrame, estimate: Estimate) -> DepthImage | None:
        """Return the depth image that is known with a frame; None if there is none."""
        rig = estimate.rig or self._rig
        if not _have_same_poses(rig, self._rig):
            self._begin(rig)
        state, pair = at_exposure(estimate, rig), self._pair
        estimate = replace(estimate, state=state)
        if state is None or pair is None or _shift_px(frame, state, rig, pair) <= MAX_SHIFT_PX:
            return self._source.depth(frame, estimate)
        used = (pair.left, pair.right)
        moved = replace(rig, cameras=tuple(displaced(rig, frame, camera, state) for camera in used))
        moved_pair = rectified_pair(moved)
        if moved_pair is None:
            return None
        images = tuple(frame.images[camera] for camera in used)
        return StereoDepth(moved, moved_pair).depth(CameraFrame(frame.t_ns, images), estimate)


def depth_source(rig: Rig) -> DepthSource:
    """Return the source of depth images of a rig: its best stereo pair, else the motion of its first camera.

    Raises:
        ConfigError: The rig has no camera.
    """
    if not rig.cameras:
        raise ConfigError("rig without a camera; expected one or more, from whose images depth is computed")
    return CalibratedDepth(rig)


def _have_same_poses(a: Rig, b: Rig) -> bool:
    """Return whether two calibrations of a rig have the same poses of their cameras."""
    return a is b or all(np.array_equal(x.T_imu_cam, y.T_imu_cam) for x, y in zip(a.cameras, b.cameras, strict=True))


def _shift_px(frame: CameraFrame, state: NavState, rig: Rig, pair: Rectification) -> float:
    """Return how far a point at 1 m moves in the images between the exposures of a pair at most [px]."""
    between_s = delay_s(rig, frame, pair.right) - delay_s(rig, frame, pair.left)
    rate = 0.0 if state.angular_velocity_rad_s is None else float(np.linalg.norm(state.angular_velocity_rad_s))
    return abs(between_s) * (rate + float(np.linalg.norm(state.velocity_m_s))) * float(pair.camera.K[0, 0])
