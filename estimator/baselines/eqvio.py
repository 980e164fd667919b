"""GTSAM's equivariant filter EqVIO behind the feature tracker of this package, as a baseline estimator.

Source: van Goor, Mahony, "EqVIO: an equivariant filter for visual-inertial odometry", T-RO 2023.

GTSAM's interface of the filter returns its position and its velocity in the IMU frame, but neither orientation nor
covariance. The orientation of an estimate is therefore integrated from the gyroscope with the bias of the static
initialization. It is accurate enough to rotate the velocity into the world frame, and is not meant to be scored.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated

import gtsam
import numpy as np
import numpy.typing as npt
from gtsam_unstable import eqvio

from dronevio.estimator.frontend.corners import CornerConfig
from dronevio.estimator.frontend.patches import EVERY_FRAME
from dronevio.estimator.frontend.protocol import FrontEnd
from dronevio.estimator.frontend.tracker import FeatureTracker, TrackerConfig
from dronevio.estimator.imu.buffer import ImuBuffer, Increments
from dronevio.estimator.imu.forward_propagation import ImuRatePropagator
from dronevio.estimator.initialization.static import initialize_static
from dronevio.estimator.initialization.zero_velocity import ZeroVelocityConfig, ZeroVelocityDetector
from dronevio.estimator.types import Observations
from dronevio.models.arrays import Array
from dronevio.models.imu import ImuSamples
from dronevio.models.measurement_checks import check_imu
from dronevio.models.ranges import Range, Settings
from dronevio.models.rig import Rig
from dronevio.models.rotation import exp_so3, nearest_rotations, pose_matrix
from dronevio.models.state import CameraFrame, Estimate, FeatureTracks, Health, HealthReport, NavState

MAX_SPEED_M_S = 60.0  # above the speed of racing drones, so the filter has diverged


@dataclass(frozen=True)
class FilterSettings(Settings):
    """Settings of the filter. The defaults come with GTSAM's example recording and are tuned for EuRoC."""

    initial_point_depth: Annotated[float, Range(0.01, 1e4)] = 5.0002821832024296
    """Initial depth of a new landmark [m]."""
    initial_point_variance: Annotated[float, Range(above=0.0, high=1e8)] = 129.90415638150924
    """Initial variance of the position of a new landmark."""
    outlier_threshold_abs_norm: Annotated[float, Range(above=0.0, high=10.0)] = 0.010594907286020272
    """Largest accepted innovation of a landmark, in normalized coordinates."""
    feature_retention: Annotated[float, Range(0.0, 1.0)] = 0.18594708334486176
    """Ratio of the landmarks that are kept regardless of their innovation."""
    process_var_bias_omega: Annotated[float, Range(0.0, 1e3)] = 0.0
    """Process noise of the gyroscope bias [rad²/s³]."""
    process_var_bias_accel: Annotated[float, Range(0.0, 1e3)] = 0.0
    """Process noise of the accelerometer bias [m²/s⁵]."""
    process_var_attitude: Annotated[float, Range(0.0, 1e3)] = 6.0258753208114069e-05
    """Process noise of the attitude [rad²/s]."""
    process_var_position: Annotated[float, Range(0.0, 1e3)] = 9.9814660959284832e-06
    """Process noise of the position [m²/s]."""
    process_var_velocity: Annotated[float, Range(0.0, 1e3)] = 0.025317333863551263
    """Process noise of the velocity [m²/s³]."""
    process_var_cam_attitude: Annotated[float, Range(0.0, 1e3)] = 5.0753821740452388e-06
    """Process noise of the camera's orientation in the IMU frame [rad²/s]."""
    process_var_cam_position: Annotated[float, Range(0.0, 1e3)] = 1.2188313140115635e-05
    """Process noise of the camera's position in the IMU frame [m²/s]."""
    process_var_point: Annotated[float, Range(0.0, 1e3)] = 0.00029845436136043135
    """Process noise of the landmark positions."""
    initial_var_bias_omega: Annotated[float, Range(above=0.0, high=1e8)] = 97162.79515771076
    """Initial variance of the gyroscope bias [rad²/s²]."""
    initial_var_bias_accel: Annotated[float, Range(above=0.0, high=1e8)] = 1.5813333765300104
    """Initial variance of the accelerometer bias [m²/s⁴]."""
    initial_var_attitude: Annotated[float, Range(above=0.0, high=1e8)] = 0.13565029126052572
    """Initial variance of the attitude [rad²]."""
    initial_var_position: Annotated[float, Range(above=0.0, high=1e8)] = 0.1
    """Initial variance of the position [m²]."""
    initial_var_velocity: Annotated[float, Range(above=0.0, high=1e8)] = 8.9748529957309997e-08
    """Initial variance of the velocity [m²/s²]."""
    initial_var_cam_attitude: Annotated[float, Range(above=0.0, high=1e8)] = 0.0010228558965517584
    """Initial variance of the camera's orientation in the IMU frame [rad²]."""
    initial_var_cam_position: Annotated[float, Range(above=0.0, high=1e8)] = 0.023501400846134893
    """Initial variance of the camera's position in the IMU frame [m²]."""
    input_var_gyr: Annotated[float, Range(above=0.0, high=1e3)] = 5.9123660022695769e-08
    """Noise of the gyroscope [rad²/s]."""
    input_var_acc: Annotated[float, Range(above=0.0, high=1e3)] = 0.0001547248218532208
    """Noise of the accelerometer [m²/s³]."""
    input_var_gyr_bias_walk: Annotated[float, Range(above=0.0, high=1e3)] = 1.7882919946320345e-08
    """Random walk of the gyroscope bias [rad²/s³]."""
    input_var_acc_bias_walk: Annotated[float, Range(above=0.0, high=1e3)] = 1.9912030843328381e-05
    """Random walk of the accelerometer bias [m²/s⁵]."""
    measurement_noise_variance_norm: Annotated[float, Range(above=0.0, high=1.0)] = 1.7755656006412381e-05
    """Variance of an image observation in normalized coordinates; 1.9 px with EuRoC's camera."""


@dataclass(frozen=True)
class EquivariantConfig(Settings):
    """Settings of the EqVIO baseline."""

    filter: FilterSettings = field(default_factory=FilterSettings)
    """Settings of GTSAM's filter."""
    tracker: TrackerConfig = field(
        default_factory=lambda: TrackerConfig(corners=CornerConfig(cell_px=120), patches=EVERY_FRAME)
    )
    """Settings of the feature tracker: patches aligned at every frame, because each updates the filter, and 24 grid
    cells at 752×480, because the cost of the filter grows with the cube of the number of landmarks."""
    zero_velocity: ZeroVelocityConfig = field(default_factory=lambda: ZeroVelocityConfig(max_flow_px=0.6))
    """Settings of the zero-velocity detection."""
    min_stationary_s: Annotated[float, Range(0.05, 60.0)] = 0.8
    """Time for which the drone has to be stationary before the initialization [s]."""
    replenish_interval_s: Annotated[float, Range(0.01, 5.0)] = 0.2
    """Interval between the detections of new features [s]."""


class EquivariantFilter:
    """Interface of GTSAM's filter in numpy arrays: IMU increments and features in, position and velocity out."""

    def __init__(self, T_imu_cam: Array, settings: FilterSettings, up_imu: Array) -> None:
        """Initialize the filter at the origin, with the attitude of `shortest_rotation_to_z`.

        Args:
            T_imu_cam: (4, 4) Pose of the camera in the IMU frame.
            settings: Settings of the filter.
            up_imu: (3,) Specific force of the stationary IMU, in the IMU frame [m/s²].
        """
        s = settings
        params = eqvio.EqVIOFilterParams()
        params.initialPointDepth = s.initial_point_depth
        params.initialPointVariance = s.initial_point_variance
        params.outlierThresholdAbs = s.outlier_threshold_abs_norm
        params.featureRetention = s.feature_retention
        params.biasOmegaProcessVariance = s.process_var_bias_omega
        params.biasAccelProcessVariance = s.process_var_bias_accel
        params.attitudeProcessVariance = s.process_var_attitude
        params.positionProcessVariance = s.process_var_position
        params.velocityProcessVariance = s.process_var_velocity
        params.cameraAttitudeProcessVariance = s.process_var_cam_attitude
        params.cameraPositionProcessVariance = s.process_var_cam_position
        params.pointProcessVariance = s.process_var_point
        inputs = [s.input_var_gyr, s.input_var_acc, s.input_var_gyr_bias_walk, s.input_var_acc_bias_walk]
        params.inputNoise = np.diag(np.repeat(inputs, 3))
        state = eqvio.State()
        state.cameraOffset = gtsam.Pose3(T_imu_cam)
        blocks = [s.initial_var_bias_omega, s.initial_var_bias_accel, s.initial_var_attitude, s.initial_var_position]
        blocks += [s.initial_var_velocity, s.initial_var_cam_attitude, s.initial_var_cam_position]
        self._filter = eqvio.EqVIOFilter(state, np.diag(np.repeat(blocks, 3)), [], params)
        self._filter.initializeFromIMU(_input(0.0, np.zeros(3), up_imu))
        self._camera = gtsam.PinholeCameraCal3_S2(gtsam.Pose3(), gtsam.Cal3_S2())  # coordinates are normalized
        self._noise = s.measurement_noise_variance_norm
        self._t_s = 0.0

    def predict(self, increments: Increments) -> None:
        """Propagate the filter by the IMU increments since the last call."""
        for dt, gyro, accel in zip(increments.dt_s.tolist(), increments.gyro_rad_s, increments.accel_m_s2, strict=True):
            self._filter.predict(_input(self._t_s, gyro, accel), dt)
            self._t_s += dt

    def update(self, ids: npt.NDArray[np.int64], xy: Array) -> None:
        """Update the filter with the features of a frame.

        Args:
            ids: (N,) Identities of the features.
            xy: (N, 2) Normalized coordinates.

        Raises:
            RuntimeError: The linear system of the update is singular.
        """
        if len(ids):
            observations = dict(zip(ids.tolist(), xy, strict=True))
            self._filter.update(observations, self._camera, self._noise * np.eye(2 * len(ids)))

    @property
    def position_m(self) -> Array:
        """(3,) Position in the world frame [m]."""
        return np.asarray(self._filter.position())

    @property
    def velocity_imu_m_s(self) -> Array:
        """(3,) Velocity in the IMU frame [m/s]."""
        return np.asarray(self._filter.velocity())


def _input(t_s: float, gyro_rad_s: Array, accel_m_s2: Array) -> eqvio.IMUInput:
    sample = eqvio.IMUInput()
    sample.stamp, sample.gyr, sample.acc = t_s, gyro_rad_s, accel_m_s2
    return sample


def shortest_rotation_to_z(up_imu: Array) -> Array:
    """Return the initial R_world_imu (3, 3) of the filter: the shortest rotation that maps ``up_imu`` (3,) to z."""
    up = up_imu / np.linalg.norm(up_imu)
    axis = np.array([up[1], -up[0], 0.0])  # up × z
    sine = float(np.linalg.norm(axis))
    if sine < 1e-9:  # up is parallel to z, so the axis of rotation is arbitrary
        return np.diag([1.0, np.sign(up[2]), np.sign(up[2])])
    return exp_so3(axis / sine * np.arctan2(sine, up[2]))


@dataclass(frozen=True, eq=False)
class _Initializing:
    """The drone has not been stationary for long enough."""

    stationary: tuple[Increments, ...] = ()
    """Increments since the drone became stationary."""
    gyro_bias_rad_s: Array = field(default_factory=lambda: np.zeros(3))
    """(3,) Gyroscope bias [rad/s], unknown and therefore zero."""


@dataclass(frozen=True, eq=False)
class _Filtering:
    """The filter is running."""

    filter: EquivariantFilter
    """The filter in its newest state."""
    R_world_imu: Array
    """(3, 3) Orientation, integrated from the gyroscope."""
    gyro_bias_rad_s: Array
    """(3,) Gyroscope bias of the initialization [rad/s]."""


@dataclass(frozen=True, eq=False)
class _Lost:
    """The filter has failed and is not restarted."""

    reason: str
    """Description of the failure."""
    gyro_bias_rad_s: Array
    """(3,) Gyroscope bias of the initialization [rad/s]."""


class EquivariantOdometry:
    """Tracks the features of the first camera, and runs the filter once the drone has been stationary."""

    def __init__(self, rig: Rig, config: EquivariantConfig | None = None, front_end: FrontEnd | None = None) -> None:
        """Create the estimator for a rig.

        Args:
            rig: The calibration, of which the first camera is used.
            config: Settings of the baseline.
            front_end: Source of the feature observations; by default a `FeatureTracker` of the first camera.
        """
        self._config = config or EquivariantConfig()
        self._camera = rig.cameras[0]
        self._front_end = front_end or FeatureTracker(self._camera.model, self._config.tracker)
        self._buffer = ImuBuffer()
        self._zero_velocity = ZeroVelocityDetector(self._config.zero_velocity)
        self._replenished_ns: int | None = None
        self._phase: _Initializing | _Filtering | _Lost = _Initializing()
        self._imu_rate = ImuRatePropagator(rig.imu)

    def add_imu(self, samples: ImuSamples) -> None:
        """Add the IMU samples since the last call.

        Raises:
            ConfigError: A sample is not finite, or not later than the last one.
        """
        check_imu(samples)
        self._buffer.add(samples)
        self._imu_rate.push(samples)

    def state_at(self, t_ns: int) -> NavState | None:
        """Return the newest state, propagated by the IMU to its last sample not after a time; see `Estimator`."""
        return self._imu_rate.state_at(t_ns)

    def add_frame(self, frame: CameraFrame) -> Estimate:
        """Return the estimate at a frame. If the filter fails, this and all later estimates are `Health.LOST`."""
        estimate = self._at_frame(frame)
        if estimate.state is not None:
            self._imu_rate.correct(estimate)
        return estimate

    def _at_frame(self, frame: CameraFrame) -> Estimate:
        """Return the estimate at a frame, after one step of the current phase."""
        increments = self._buffer.take_until(frame.t_ns)
        rotation = increments.rotation(self._phase.gyro_bias_rad_s)
        observations = self._observations(frame, rotation)
        match self._phase:
            case _Initializing(stationary):
                return self._initialize(frame.t_ns, stationary, increments, observations)
            case _Filtering(R_world_imu=R_world_imu):
                running = replace(self._phase, R_world_imu=nearest_rotations(R_world_imu @ rotation))
                return self._filtered(running, frame.t_ns, increments, observations)
            case _Lost(reason):
                return _estimate(frame.t_ns, Health.LOST, reason, observations)

    def _observations(self, frame: CameraFrame, R_prev_cur: Array) -> Observations:
        """Return the features of a frame, given the rotation of the IMU since the previous one."""
        R_imu_cam = self._camera.T_imu_cam[:3, :3]
        observations = self._front_end.track(frame, R_imu_cam.T @ R_prev_cur.T @ R_imu_cam)
        interval_ns = self._config.replenish_interval_s * 1e9
        if self._replenished_ns is not None and frame.t_ns - self._replenished_ns < interval_ns:
            return observations
        self._replenished_ns = frame.t_ns
        return self._front_end.replenish()

    def _initialize(
        self, t_ns: int, stationary: Sequence[Increments], increments: Increments, observations: Observations
    ) -> Estimate:
        """Start the filter if the drone has been stationary for long enough."""
        self._zero_velocity.update(t_ns, observations, increments)
        stationary_s, min_s = self._zero_velocity.stationary_s, self._config.min_stationary_s
        stationary = (*stationary, increments) if stationary_s > 0.0 else ()
        if stationary_s < min_s:
            self._phase = _Initializing(stationary)
            reason = f"it starts at rest only: stationary for {stationary_s:.1f} s, and {min_s:g} s are needed"
            return _estimate(t_ns, Health.INITIALIZING, reason, observations)
        initial = initialize_static(t_ns, stationary)
        up_imu = initial.T_world_imu[2, :3]
        running = EquivariantFilter(self._camera.T_imu_cam, self._config.filter, up_imu)
        phase = _Filtering(running, shortest_rotation_to_z(up_imu), initial.gyro_bias_rad_s)
        return self._filtered(phase, t_ns, None, observations)

    def _filtered(
        self, phase: _Filtering, t_ns: int, increments: Increments | None, observations: Observations
    ) -> Estimate:
        """Run one step of the filter, and return the estimate after it."""
        self._phase, bias = phase, phase.gyro_bias_rad_s
        try:
            if increments is not None:
                phase.filter.predict(increments)
            phase.filter.update(observations.ids, observations.xy)
        except (RuntimeError, ValueError) as error:
            return self._lose(_Lost(str(error).strip().splitlines()[0], bias), t_ns, observations)
        p_m, v_m_s = phase.filter.position_m, phase.R_world_imu @ phase.filter.velocity_imu_m_s
        if not (np.isfinite(p_m).all() and np.linalg.norm(v_m_s) < MAX_SPEED_M_S):
            return self._lose(_Lost("the filter has diverged", bias), t_ns, observations)
        state = NavState(t_ns, pose_matrix(phase.R_world_imu, p_m), v_m_s, bias, np.zeros(3))
        if len(observations):
            return _estimate(t_ns, Health.TRACKING, f"{len(observations)} features", observations, state)
        return _estimate(t_ns, Health.INERTIAL_ONLY, "no feature is visible", observations, state)

    def _lose(self, phase: _Lost, t_ns: int, observations: Observations) -> Estimate:
        self._phase = phase
        return _estimate(t_ns, Health.LOST, phase.reason, observations)


def _estimate(
    t_ns: int, health: Health, reason: str, observations: Observations, state: NavState | None = None
) -> Estimate:
    tracks = FeatureTracks(observations.ids, observations.pixels, observations.ages)
    report = HealthReport(health, reason, tracks=len(observations), landmarks=len(observations))
    return Estimate(t_ns, health, state, tracks, health_report=report)
