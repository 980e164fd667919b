"""The intake: a frame, and the IMU before it, become what they tell at one instant of one clock.

Between two frames the gyroscope knows how the cameras turned, so the front end looks for features where they must be.
What it finds was exposed row by row, by a clock of its own, through lenses that may not be quite what they were taken
for; all of that is taken out here, so that behind the intake a frame is one instant of a rig that is calibrated.
"""

import numpy as np
import numpy.typing as npt

from dronevio.estimator.calibration.online import OnlineCalibration
from dronevio.estimator.frontend.protocol import FrontEnd
from dronevio.estimator.frontend.rolling_shutter import FrameTimes
from dronevio.estimator.imu.buffer import ImuBuffer, Increments
from dronevio.estimator.types import FramePacket, Observations
from dronevio.models.errors import ConfigError
from dronevio.models.imu import ImuSamples
from dronevio.models.rig import Rig
from dronevio.models.state import CameraFrame, Estimate

Array = npt.NDArray[np.float64]


class Intake:
    """Takes measurements in time order, and gives sightings."""

    def __init__(self, rig: Rig, front_end: FrontEnd, calibration: OnlineCalibration) -> None:
        """Prepare for a rig.

        Args:
            rig: The calibration.
            front_end: Where features come from.
            calibration: What is wrong with the rig's, as far as is known.
        """
        self._front_end, self._calibration = front_end, calibration
        self._buffer, self._times = ImuBuffer(rig.imu), FrameTimes(rig)
        self._R_imu_cam = rig.cameras[0].T_imu_cam[:3, :3]
        self._last_frame_ns: int | None = None

    def add_imu(self, samples: ImuSamples) -> None:
        """Take the IMU samples since the last call."""
        self._buffer.add(samples)

    def take(self, frame: CameraFrame, gyro_bias_rad_s: Array, gyro_bias_sigma_rad_s: float) -> FramePacket:
        """Take a frame, and follow the features into it.

        Args:
            frame: The frame.
            gyro_bias_rad_s: (3,) What is known of the gyroscope's bias [rad/s] ...
            gyro_bias_sigma_rad_s: ... and how well [rad/s].

        Raises:
            ConfigError: The frame is not later than the last one, or its image is not one of the rig's camera.
        """
        if self._last_frame_ns is not None and frame.t_ns <= self._last_frame_ns:
            raise ConfigError(f"frame at {frame.t_ns} ns after one at {self._last_frame_ns} ns; expected a later one")
        self._last_frame_ns = frame.t_ns
        t_ns = self._times.imu_time_ns(frame.t_ns)
        increments = self._buffer.take_until(t_ns)
        self._times.begin(increments, self._buffer.ahead(self._times.reach_s), gyro_bias_rad_s)
        rotation_sigma = float(gyro_bias_sigma_rad_s * increments.dt_s.sum()) + increments.rotation_excess_sigma_rad
        seen = self._front_end.track(frame, self._camera_rotation(increments, gyro_bias_rad_s), rotation_sigma)
        return FramePacket(t_ns, increments, self._at_frame(seen))

    def replenished(self, packet: FramePacket) -> FramePacket:
        """Return the newest packet with new features, and with what further cameras see."""
        return FramePacket(packet.t_ns, packet.increments, self._at_frame(self._front_end.replenish()))

    def discard(self, ids: npt.NDArray[np.int64]) -> None:
        """Follow some features no further."""
        self._front_end.discard(ids)

    def recalibrate(self) -> None:
        """Take over what the calibration has been corrected by."""
        rig = self._calibration.rig
        self._R_imu_cam = rig.cameras[0].T_imu_cam[:3, :3]
        self._times.late_s = self._calibration.applied.time_offset_s
        self._front_end.recalibrate(rig)

    @property
    def rate_rad_s(self) -> Array:
        """(3,) How fast the IMU turns at the newest frame [rad/s]."""
        return self._times.rate_rad_s

    def stamped(self, estimate: Estimate, frame: CameraFrame) -> Estimate:
        """Return what is told of the newest frame, by its own clock."""
        return self._times.stamped(estimate, frame.t_ns)

    def _at_frame(self, seen: Observations) -> Observations:
        """Return what a frame shows by the best calibration, at the frame's time."""
        return self._times.moved(self._calibration.corrected(seen))

    def _camera_rotation(self, increments: Increments, gyro_bias_rad_s: Array) -> Array:
        """Return R_cur_prev (3, 3) of the first camera over some increments."""
        return np.asarray(self._R_imu_cam.T @ increments.rotation(gyro_bias_rad_s).T @ self._R_imu_cam)
