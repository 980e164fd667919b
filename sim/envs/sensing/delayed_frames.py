"""Frames of one vehicle that reach its estimator with latency, as in a live system."""

from collections import deque

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.rig import Rig
from dronevio.models.rotation import pose_matrix, quat_wxyz_from_matrix
from dronevio.models.state import CameraFrame, Trajectory
from dronevio.sim.envs.sensing.estimation import EpisodeCameras, Estimation
from dronevio.sim.physics.vehicle_states import VehicleStates

_MOTION_S = 0.2  # of true motion before the latency that frames may need: exposure and readout


class DelayedFrames:
    """The frames of one vehicle, from its reset on.

    A frame is available ``latency_s`` after the middle of its exposure, but at least when it has been exposed and read
    out.
    """

    def __init__(self, rig: Rig, estimation: Estimation, source: EpisodeCameras) -> None:
        """Begin before the first frame, whose time stamp is the first one at which the IMU is on.

        Args:
            rig: Frame rate, time offset of the cameras, mounting and rate of the IMU.
            estimation: Latency and darkness.
            source: The cameras.
        """
        self._rig, self._estimation, self._source = rig, estimation, source
        self._poses: deque[tuple[int, Array]] = deque(
            maxlen=round((estimation.latency_s + _MOTION_S) * rig.imu.rate_hz) + 2
        )
        self._offset_ns = round(rig.time_offset_s * 1e9)
        self._period_ns = round(1e9 / rig.cameras[0].rate_hz)
        self._stamp_ns = max(-(self._offset_ns // self._period_ns), 0) * self._period_ns
        self._start_ns: int | None = None

    def start(self, t_ns: int) -> None:
        """Start the episode at a time [ns], from which the darkness counts."""
        self._start_ns = t_ns

    def add_motion(self, t_ns: int, truth: VehicleStates) -> None:
        """Add the true state of the vehicle at a time [ns]."""
        T = pose_matrix(truth.R_world_vehicle[0], truth.position_m[0]) @ self._rig.T_vehicle_imu
        self._poses.append((t_ns, T))

    def next_frame(self, t_ns: int) -> CameraFrame | None:
        """Return the next frame that is available at a time [ns], or None."""
        exposed_ns = self._stamp_ns + self._offset_ns
        latest_ns = max(exposed_ns + round(self._estimation.latency_s * 1e9), self._source.ready_ns(exposed_ns))
        if t_ns < latest_ns:
            return None
        frame = self._source.frame(self._stamp_ns, exposed_ns, self._is_lit(exposed_ns), self._motion())
        self._stamp_ns += self._period_ns
        return frame

    def close(self) -> None:
        """Release the resources of rendering."""
        self._source.close()

    def _is_lit(self, exposed_ns: int) -> bool:
        """Return whether light reaches the cameras at a time [ns]."""
        return self._start_ns is None or self._estimation.is_lit((exposed_ns - self._start_ns) * 1e-9)

    def _motion(self) -> Trajectory:
        """Return the last true poses of the IMU."""
        T = np.stack([pose for _, pose in self._poses])
        times = np.array([t_ns for t_ns, _ in self._poses], dtype=np.int64)
        return Trajectory(times, T[:, :3, 3], quat_wxyz_from_matrix(T[:, :3, :3]))
