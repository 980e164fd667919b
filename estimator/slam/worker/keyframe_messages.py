"""Keyframes of the odometry, as messages to the map.

A keyframe waits with its images, features and IMU samples until it leaves the window of the odometry; then its estimate
is final, and it joins the map. While the pose in the map is unknown, the map receives new keyframes at once, too.
"""

from collections import deque

from dronevio.estimator.backend.keyframe_estimate import KeyframeEstimate
from dronevio.estimator.imu.preintegration import PreintegrationParams
from dronevio.estimator.keyframe_observer import OdometryKeyframe
from dronevio.estimator.slam.adjustment.flight_measurements import KeyframeMeasurements
from dronevio.estimator.slam.worker.map_builder import (
    ImagedKeyframe,
    MapMessage,
    MarginalizedKeyframe,
    TrackLost,
    WindowKeyframe,
)
from dronevio.models.imu import ImuSamples
from dronevio.models.state import CameraFrame


class KeyframeMessages:
    """Turns keyframes of the odometry into messages to the map; implements `KeyframeObserver`."""

    def __init__(self, window_s: float) -> None:
        """Begin without keyframes.

        Args:
            window_s: Longest time by which the first keyframe of a track is earlier than the frame that begins it [s].
        """
        self._window_ns = round(window_s * 1e9)
        self._frame: CameraFrame | None = None
        self._imu: deque[ImuSamples] | None = None  # since those of the last keyframe; None before the first samples
        self._has_track = False  # whether there has been a keyframe since the last loss
        self._imu_noise: PreintegrationParams | None = None
        self._has_map_pose = True
        self._waiting: dict[int, tuple[OdometryKeyframe, ImagedKeyframe, int]] = {}  # and its stamp
        self._messages: list[MapMessage] = []

    def add_imu(self, samples: ImuSamples) -> None:
        """Keep IMU samples for the next keyframe that leaves the window."""
        self._imu = deque() if self._imu is None else self._imu
        if len(samples):
            self._imu.append(samples)

    def begin_frame(self, frame: CameraFrame, imu_noise: PreintegrationParams, *, has_map_pose: bool) -> None:
        """Keep the images of the newest frame, which may become a keyframe.

        Args:
            frame: The frame.
            imu_noise: The noise of the IMU as it is known.
            has_map_pose: Whether the pose of the odometry frame in the map frame is known.
        """
        self._frame, self._imu_noise, self._has_map_pose = frame, imu_noise, has_map_pose
        while not self._has_track and self._imu and self._imu[0].t_ns[-1] < frame.t_ns - self._window_ns:
            self._imu.popleft()

    def take(self) -> list[MapMessage]:
        """Return the messages since the last call."""
        messages, self._messages = self._messages, []
        return messages

    def added(self, keyframe: OdometryKeyframe) -> None:
        """Let a keyframe of the odometry wait until it leaves the window, unless its images are those of an earlier
        frame. If no image connects it with the one before, another track begins.
        """
        self._has_track = True
        self._waiting = {t: known for t, known in self._waiting.items() if t in keyframe.window_times_ns}
        frame = keyframe.frame or self._frame
        if frame is None or not keyframe.is_of_newest_frame:
            return
        if not keyframe.is_connected:
            self.lost()
            self._has_track = True
        images, R_odom_imu = tuple(frame.images), keyframe.state.T_world_imu[:3, :3]
        imaged = ImagedKeyframe(images, keyframe.calibration.rig, R_odom_imu, keyframe.observations, frame.t_ns)
        self._waiting[keyframe.t_ns] = keyframe, imaged, frame.t_ns
        if not self._has_map_pose:
            estimate = KeyframeEstimate.of_state(keyframe.state, keyframe.landmark_ids, keyframe.landmarks_odom)
            self._messages.append(WindowKeyframe(imaged, estimate))

    def marginalized(self, estimate: KeyframeEstimate) -> None:
        """Let a keyframe of the odometry join the map, if its images are known."""
        waiting = self._waiting.pop(estimate.t_ns, None)
        if waiting is None:
            return
        known, imaged, stamp_ns = waiting
        measured = None
        if self._imu is not None and self._imu_noise is not None:
            # Several keyframes may leave the window at one frame, of which the later ones have no further samples.
            imu, self._imu = ImuSamples.concatenated(self._imu or [ImuSamples.empty()]), deque()
            measured = KeyframeMeasurements(
                known.state, known.observations, known.calibration, imu, self._imu_noise, stamp_ns
            )
        self._messages.append(MarginalizedKeyframe(imaged, estimate, measured))

    def lost(self) -> None:
        """Begin another track: later keyframes are in another odometry frame."""
        self._waiting, self._has_map_pose, self._has_track = {}, False, False
        self._messages.append(TrackLost(0 if self._frame is None else self._frame.t_ns))
