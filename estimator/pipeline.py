"""The measurement pipeline: a frame and the IMU samples before it become one packet at one instant of the IMU's clock.

Irregular time stamps are corrected, and repeated images left out. The gyroscope predicts the rotation of the cameras
between two frames, and the front end tracks features from there. Its observations are then corrected for the exposure
times of the rows, the clock offset and the intrinsics, so that what follows the pipeline sees calibrated, instantaneous
measurements.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from dronevio.estimator.config import VioConfig
from dronevio.estimator.frontend.protocol import FrontEnd, PredictingFrontEnd
from dronevio.estimator.frontend.repetition import RepetitionFilter
from dronevio.estimator.frontend.rig import measures_depth
from dronevio.estimator.frontend.rolling_shutter import ExposureCompensation
from dronevio.estimator.image_selection import ImageSelection
from dronevio.estimator.imu.buffer import ImuBuffer, Increments
from dronevio.estimator.imu.preintegration import PreintegrationParams
from dronevio.estimator.initialization.gauge import BiasPrior
from dronevio.estimator.initialization.zero_velocity import ZeroVelocityDetector
from dronevio.estimator.monitoring.image_connection import ImageConnection
from dronevio.estimator.monitoring.innovation import Innovation
from dronevio.estimator.monitoring.stamp_error import StampCorrection
from dronevio.estimator.propagator import propagated
from dronevio.estimator.types import Calibration, ExpectedFeatures, FramePacket, Observations
from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError
from dronevio.models.imu import ImuSamples
from dronevio.models.rig import Rig
from dronevio.models.state import NO_IMAGE, CameraFrame, Estimate, NavState

MAX_DELAY_S = 0.001
"""Longest time between an exposure and the time of its frame for the image before a keyframe to be left out [s]: the
flow between tracked images corrects for it, with an error that is proportional to the time between them."""
CONTRADICTED_SIGMA_RAD = 0.02
"""Standard deviation of the rotation between frames by a gyroscope that the images contradict [rad]."""
MAX_EXTRAPOLATION_S = 0.01
"""Longest time over which a state is extrapolated without its covariance [s]: the error of third order is .01 mm."""


class MeasurementPipeline:
    """Takes measurements in time order and returns frame packets."""

    def __init__(self, rig: Rig, config: VioConfig, front_end: FrontEnd) -> None:
        """Begin before the first measurement.

        Args:
            rig: The given calibration.
            config: Settings.
            front_end: Detects and tracks the features.
        """
        self._front_end, self._imu, self._buffer = front_end, rig.imu, ImuBuffer(rig.imu)
        self._stamps = StampCorrection(rig.cameras[0].rate_hz, config.stamps)
        self._exposure, self._repetition = ExposureCompensation(config.gravity_m_s2), RepetitionFilter()
        self._selection = ImageSelection(config.keyframe)
        self._zero_velocity = ZeroVelocityDetector(config.zero_velocity, config.gravity_m_s2)
        self._last_frame_ns: int | None = None
        self._outliers = 0  # of the IMU, up to the newest frame
        self._connection, self._is_left_out = ImageConnection(), False
        has_depth = measures_depth(rig)  # otherwise no image is left out; see `image_selection`
        self._predicting = front_end if isinstance(front_end, PredictingFrontEnd) and has_depth else None

    def add_imu(self, samples: ImuSamples) -> ImuSamples:
        """Add the IMU samples since the last call, and return those that are used now; see `ImuBuffer.add`."""
        return self._buffer.add(samples)

    def process(
        self,
        frame: CameraFrame,
        calibration: Calibration,
        gyro_bias: BiasPrior,
        *,
        moves: bool = False,
        contradicted: bool = False,
        since_keyframe_s: float | None = None,
        expected: Callable[[int, Increments], ExpectedFeatures] | None = None,
    ) -> FramePacket:
        """Track the features into a frame and return its packet.

        Args:
            frame: The frame.
            calibration: The calibration in use.
            gyro_bias: What is known of the gyroscope bias [rad/s].
            moves: Whether the vehicle is known to move.
            contradicted: Whether the images contradict the gyroscope, so that it must not decide which features are
                outliers.
            since_keyframe_s: Time from the newest keyframe to the last frame [s]; None if every image is needed.
            expected: Returns where features are expected at a time [ns], after increments since the last frame; None
                if every image is needed.

        Raises:
            ConfigError: The frame is not later than the last one, or an image does not fit its camera.
        """
        if self._last_frame_ns is not None and frame.t_ns <= self._last_frame_ns:
            raise ConfigError(
                f"frame at {frame.t_ns} ns after one at {self._last_frame_ns} ns; expected a later one,"
                " or a new estimator where the clock steps"
            )
        self._last_frame_ns = frame.t_ns

        # Time of exposure by the clock of the IMU, and the samples up to it
        delay_s = self._stamps.add_stamp(frame.t_ns)
        t_ns = self._exposure.imu_time_ns(frame.t_ns, calibration) + round(delay_s * 1e9)
        increments = self._buffer.take_until(t_ns)
        image_delays_s = 1e-9 * np.array(frame.image_delays_ns or (0,))
        ahead = self._buffer.ahead(max(self._exposure.lookahead_s(calibration, image_delays_s), -delay_s))
        self._exposure.begin_frame(increments, ahead, gyro_bias.mean, image_delays_s)

        # Rotation by the gyroscope, from which features are tracked
        R_cur_prev = _camera_rotation(calibration, increments, gyro_bias.mean)
        rotation_sigma = float(gyro_bias.sigma * increments.dt_s.sum()) + increments.rotation_excess_sigma_rad
        frame = self._repetition.filtered(frame, R_cur_prev, rotation_sigma, moves=moves)
        tracking_sigma = max(rotation_sigma, CONTRADICTED_SIGMA_RAD) if contradicted else rotation_sigma
        may_leave_out = self._may_leave_out(increments, R_cur_prev, since_keyframe_s, calibration)
        features = None
        if self._predicting is not None and expected is not None and (may_leave_out or self._is_left_out):
            features = expected(t_ns, increments)
        found = self._found(frame, features, R_cur_prev, tracking_sigma, calibration, may_leave_out=may_leave_out)
        # Cameras that have no tracker of their own observe no features in a frame that the others lack.
        has_image = not self._is_left_out and (len(found) > 0 or all(image.size for image in frame.images))

        # Observations at the time of the frame
        observations = found if self._is_left_out else self._at_frame_time(found, calibration)
        self._zero_velocity.update(t_ns, observations if has_image else None, increments)
        outliers, self._outliers = self._buffer.outliers - self._outliers, self._buffer.outliers
        if has_image:
            self._connection.add_frame(observations)
            self._selection.add(found)
        return FramePacket(
            t_ns,
            increments,
            observations,
            has_image,
            self._is_left_out,
            self._repetition.repeats,
            outliers,
            self._zero_velocity.stationary_s,
        )

    def _may_leave_out(
        self, increments: Increments, R_cur_prev: Array, since_keyframe_s: float | None, calibration: Calibration
    ) -> bool:
        """Return whether the images of a frame may be left out; see `ImageSelection`."""
        if self._stamps.is_irregular or increments.is_degraded or calibration.without_depth:
            since_keyframe_s = None
        needs_flow = self._exposure.longest_delay_s(calibration) > MAX_DELAY_S
        return self._selection.may_leave_out(increments.duration_s, R_cur_prev, since_keyframe_s, needs_flow=needs_flow)

    def _found(
        self,
        frame: CameraFrame,
        expected: ExpectedFeatures | None,
        R_cur_prev: Array,
        rotation_sigma_rad: float,
        calibration: Calibration,
        *,
        may_leave_out: bool,
    ) -> Observations:
        """Return the features that are tracked into a frame, or those that it shows where they are expected.

        In the second case, its images are left out: the next ones are tracked from those before.

        Args:
            frame: The frame.
            expected: Where features are expected, if images may be or have been left out.
            R_cur_prev: (3, 3) Rotation of the first camera from the previous frame.
            rotation_sigma_rad: Standard deviation of that rotation [rad].
            calibration: The calibration in use.
            may_leave_out: Whether the images may be left out.
        """
        front_end = self._front_end
        was_left_out, self._is_left_out = self._is_left_out, False
        if expected is None or self._predicting is None:
            return front_end.track(frame, R_cur_prev, rotation_sigma_rad, calibration)
        verified = self._predicting.verified(frame, expected, R_cur_prev, calibration) if may_leave_out else None
        if verified is None:
            return self._predicting.track(
                frame, R_cur_prev, rotation_sigma_rad, calibration, expected if was_left_out else None
            )
        self._is_left_out = True
        unseen = replace(frame, images=(NO_IMAGE,) * len(frame.images))
        self._at_frame_time(front_end.track(unseen, R_cur_prev, rotation_sigma_rad, calibration), calibration)
        return verified

    def compare_stamps(self, innovation: Callable[[], Innovation], predicted: NavState) -> None:
        """Compare irregular time stamps with the image of the newest frame; see `StampCorrection.compare`.

        Args:
            innovation: Returns the innovation of the frame.
            predicted: The state that the IMU predicts for it.
        """
        if self._stamps.is_irregular:
            self._stamps.compare(innovation(), predicted, self.angular_velocity_rad_s)

    def replenish(self, packet: FramePacket, calibration: Calibration) -> FramePacket:
        """Return the newest packet with newly detected features and the matches in further cameras."""

        def at_exposure_of(camera: int, features: Observations) -> Array:
            return self._exposure.at_exposure_of(camera, calibration.normalized(features), calibration)

        observations = calibration.usable(self._front_end.replenish(calibration, at_exposure_of))
        return replace(packet, observations=self._at_frame_time(observations, calibration))

    def is_connected(self, packet: FramePacket) -> bool:
        """Make the newest packet a keyframe, and return whether features connect it with the keyframe before."""
        return self._connection.add_keyframe(packet.observations)

    def discard(self, ids: npt.NDArray[np.int64]) -> None:
        """Stop tracking the given features."""
        self._front_end.discard(ids)

    @property
    def angular_velocity_rad_s(self) -> Array:
        """(3,) Angular velocity of the IMU at the newest frame, bias removed [rad/s]."""
        return self._exposure.angular_velocity_rad_s

    def published(
        self, estimate: Estimate, frame: CameraFrame, calibration: Calibration, params: PreintegrationParams
    ) -> Estimate:
        """Return the estimate of the newest frame at the time stamp of a frame, with the state at its exposure.

        Args:
            estimate: The estimate of the newest frame, at its time by the clock of the IMU.
            frame: That frame, or a later one that waits for its IMU samples.
            calibration: The calibration in use.
            params: The noise of the IMU.
        """
        is_newest = frame.t_ns == self._last_frame_ns
        t_ns = estimate.t_ns if is_newest else self._exposure.imu_time_ns(frame.t_ns, calibration)
        exposed_ns = t_ns + round(calibration.time_offset_correction_s * 1e9)
        exposed = self._at(estimate, exposed_ns, params).state
        if exposed is not None:
            exposed = replace(exposed, angular_velocity_rad_s=self.angular_velocity_rad_s)
        return replace(self._at(estimate, frame.t_ns, params), exposed=exposed, rig=calibration.timed_rig)

    def _at(self, estimate: Estimate, t_ns: int, params: PreintegrationParams) -> Estimate:
        """Return the estimate of the newest frame at a time by the clock of the IMU."""
        state, later_s = estimate.state, (t_ns - estimate.t_ns) * 1e-9
        if state is None or later_s <= MAX_EXTRAPOLATION_S:
            return self._exposure.at_time(estimate, t_ns)
        state = propagated(state, self._buffer.ahead(later_s, held=True), params, self._imu)
        return replace(estimate, t_ns=t_ns, state=replace(state, t_ns=t_ns))

    def _at_frame_time(self, observations: Observations, calibration: Calibration) -> Observations:
        return self._exposure.at_frame_time(calibration.normalized(observations), calibration)


def _camera_rotation(calibration: Calibration, increments: Increments, gyro_bias_rad_s: Array) -> Array:
    """Return R_cur_prev (3, 3) of the first camera over the increments."""
    R_imu_cam = calibration.Ts_imu_cam[0, :3, :3]
    return np.asarray(R_imu_cam.T @ increments.rotation(gyro_bias_rad_s).T @ R_imu_cam)
