"""The measurement pipeline: a frame and the IMU samples before it become one packet at one instant of the IMU's clock.

The gyroscope predicts the rotation of the cameras between two frames, and the front end tracks features from there. Its
observations are then corrected for the exposure times of the rows, the clock offset and the intrinsics, so that what
follows the pipeline sees calibrated, instantaneous measurements.
"""

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from dronevio.estimator.frontend.protocol import FrontEnd
from dronevio.estimator.frontend.repetition import RepetitionFilter
from dronevio.estimator.frontend.rolling_shutter import ExposureCompensation
from dronevio.estimator.imu.buffer import ImuBuffer, Increments
from dronevio.estimator.types import Calibration, FramePacket, Observations
from dronevio.models.errors import ConfigError
from dronevio.models.imu import GRAVITY_M_S2, ImuModel, ImuSamples
from dronevio.models.state import CameraFrame, Estimate

Array = npt.NDArray[np.float64]


CONTRADICTED_SIGMA_RAD = 0.02
"""Standard deviation of the rotation between frames by a gyroscope that the images contradict [rad]."""


class MeasurementPipeline:
    """Takes measurements in time order and returns frame packets."""

    def __init__(self, imu: ImuModel, front_end: FrontEnd, gravity_m_s2: float = GRAVITY_M_S2) -> None:
        """Begin before the first measurement.

        Args:
            imu: The sensor model.
            front_end: Detects and tracks the features.
            gravity_m_s2: Magnitude of gravity [m/s²].
        """
        self._front_end = front_end
        self._buffer, self._exposure = ImuBuffer(imu), ExposureCompensation(gravity_m_s2)
        self._repetition = RepetitionFilter()
        self._last_frame_ns: int | None = None
        self._outliers = 0  # of the IMU, up to the newest frame

    def add_imu(self, samples: ImuSamples) -> ImuSamples:
        """Add the IMU samples since the last call, and return those that are used now; see `ImuBuffer.add`."""
        return self._buffer.add(samples)

    def process(
        self,
        frame: CameraFrame,
        calibration: Calibration,
        gyro_bias_rad_s: Array,
        gyro_bias_sigma_rad_s: float,
        delay_s: float = 0.0,
        *,
        moves: bool = False,
        contradicted: bool = False,
    ) -> FramePacket:
        """Track the features into a frame and return its packet.

        Args:
            frame: The frame.
            calibration: The calibration in use.
            gyro_bias_rad_s: (3,) Estimate of the gyroscope bias [rad/s].
            gyro_bias_sigma_rad_s: Its standard deviation [rad/s].
            delay_s: How much later than its time stamp the frame was exposed [s].
            moves: Whether the vehicle is known to move.
            contradicted: Whether the images contradict the gyroscope, so that it must not decide which features are
                outliers.

        Raises:
            ConfigError: The frame is not later than the last one, or an image does not fit its camera.
        """
        if self._last_frame_ns is not None and frame.t_ns <= self._last_frame_ns:
            raise ConfigError(
                f"frame at {frame.t_ns} ns after one at {self._last_frame_ns} ns; expected a later one,"
                " or a new estimator where the clock steps"
            )
        self._last_frame_ns = frame.t_ns
        t_ns = self._exposure.imu_time_ns(frame.t_ns, calibration) + round(delay_s * 1e9)
        increments = self._buffer.take_until(t_ns)
        image_delays_s = 1e-9 * np.array(frame.image_delays_ns or (0,))
        ahead = self._buffer.ahead(max(self._exposure.lookahead_s(calibration, image_delays_s), -delay_s))
        self._exposure.begin_frame(increments, ahead, gyro_bias_rad_s, image_delays_s)
        rotation_sigma = float(gyro_bias_sigma_rad_s * increments.dt_s.sum()) + increments.rotation_excess_sigma_rad
        R_cur_prev = _camera_rotation(calibration, increments, gyro_bias_rad_s)
        frame = self._repetition.filtered(frame, R_cur_prev, rotation_sigma, moves=moves)
        tracking_sigma = max(rotation_sigma, CONTRADICTED_SIGMA_RAD) if contradicted else rotation_sigma
        observations = self._front_end.track(frame, R_cur_prev, tracking_sigma, calibration.rig)
        # Cameras that have no tracker of their own observe no features in a frame that the others lack.
        has_image = len(observations) > 0 or all(image.size for image in frame.images)
        at_frame = self._at_frame_time(observations, calibration)
        outliers, self._outliers = self._buffer.outliers - self._outliers, self._buffer.outliers
        return FramePacket(t_ns, increments, at_frame, has_image, self._repetition.repeats, outliers)

    def replenish(self, packet: FramePacket, calibration: Calibration) -> FramePacket:
        """Return the newest packet with newly detected features and the matches in further cameras."""

        def at_exposure_of(camera: int, features: Observations) -> Array:
            xy = self._exposure.at_exposure_of(camera, calibration.normalized(features), calibration)
            return calibration.given_xy(xy, features.camera)

        observations = self._front_end.replenish(calibration.rig, at_exposure_of)
        return replace(packet, observations=self._at_frame_time(observations, calibration))

    def discard(self, ids: npt.NDArray[np.int64]) -> None:
        """Stop tracking the given features."""
        self._front_end.discard(ids)

    @property
    def angular_velocity_rad_s(self) -> Array:
        """(3,) Angular velocity of the IMU at the newest frame, bias removed [rad/s]."""
        return self._exposure.angular_velocity_rad_s

    def since_frame(self, span_s: float) -> Increments:
        """Return the IMU increments of a time after the newest frame [s]; where samples are missing, one is held."""
        return self._buffer.ahead(span_s, held=True)

    def at_stamp(self, estimate: Estimate, frame: CameraFrame) -> Estimate:
        """Return the estimate of the newest frame at the frame's time stamp, by the clock of the cameras."""
        return self._exposure.at_stamp(estimate, frame.t_ns)

    def _at_frame_time(self, observations: Observations, calibration: Calibration) -> Observations:
        return self._exposure.at_frame_time(calibration.normalized(observations), calibration)


def _camera_rotation(calibration: Calibration, increments: Increments, gyro_bias_rad_s: Array) -> Array:
    """Return R_cur_prev (3, 3) of the first camera over the increments."""
    R_imu_cam = calibration.Ts_imu_cam[0, :3, :3]
    return np.asarray(R_imu_cam.T @ increments.rotation(gyro_bias_rad_s).T @ R_imu_cam)
