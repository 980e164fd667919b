"""The interface between the odometry and a map that is built around it: keyframes as they come, leave and are lost."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from dronevio.estimator.backend.keyframe_estimate import KeyframeEstimate
from dronevio.estimator.backend.smoother import Keyframe, KeyframeSmoother
from dronevio.estimator.types import Calibration, Observations
from dronevio.models.arrays import Array, Integers
from dronevio.models.state import CameraFrame, NavState


@dataclass(frozen=True, eq=False)
class OdometryKeyframe:
    """The newest keyframe of the odometry."""

    t_ns: int
    """Time of the keyframe by the IMU's clock [ns]."""
    state: NavState
    """Its causal estimate, with covariance."""
    observations: Observations
    """The features of the keyframe in all cameras."""
    calibration: Calibration
    """The calibration in use."""
    is_of_newest_frame: bool
    """Whether the keyframe is the newest frame. Where a motion begins, it is an earlier one."""
    is_connected: bool
    """Whether features connect the keyframe with the one before; see `image_connection`."""
    window_times_ns: tuple[int, ...]
    """Times of the keyframes in the window, this one included [ns]. A keyframe that is no longer among them and has not
    been marginalized was dropped."""
    landmark_ids: Integers
    """(L,) Identities of the triangulated landmarks that the keyframe observes, in increasing order."""
    landmarks_odom: Array
    """(L, 3) Their positions in the odometry frame [m], as the window knows them now."""
    frame: CameraFrame | None = None
    """The frame of the keyframe; None if that is an earlier one."""


class KeyframeObserver(Protocol):
    """Receives the keyframes of the odometry, which does not depend on what the observer does with them."""

    def added(self, keyframe: OdometryKeyframe, /) -> None:
        """Receive a new keyframe, after the window has been optimized."""

    def marginalized(self, estimate: KeyframeEstimate, /) -> None:
        """Receive the final estimate of a keyframe that leaves the window."""

    def lost(self) -> None:
        """Notice that the estimate is lost: later keyframes are in another odometry frame."""


def odometry_keyframe(
    smoother: KeyframeSmoother,
    keyframe: Keyframe,
    calibration: Calibration,
    is_connected: bool,
    frame: CameraFrame | None,
) -> OdometryKeyframe:
    """Return the newest keyframe of a smoother for an observer.

    Args:
        smoother: The smoother.
        keyframe: The keyframe, without outliers.
        calibration: The calibration in use.
        is_connected: Whether features connect it with the keyframe before.
        frame: Its frame; None if that is not the newest.
    """
    landmarks = smoother.triangulated_landmarks
    ids, rows, _ = np.intersect1d(landmarks.ids, keyframe.observations.ids, return_indices=True)
    return OdometryKeyframe(
        keyframe.t_ns,
        smoother.state,
        keyframe.observations,
        calibration,
        frame is not None,
        is_connected,
        smoother.keyframe_times_ns,
        ids,
        landmarks.points[rows],
        frame,
    )
