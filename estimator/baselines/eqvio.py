"""A baseline: GTSAM's equivariant filter EqVIO behind our front end, as an estimator like any other.

Source: van Goor, Mahony, "EqVIO: an equivariant filter for visual-inertial odometry", T-RO 2023.

What GTSAM hands out of the filter is its position and its velocity in the IMU frame, no orientation and no covariance.
The orientation of an estimate is therefore the gyroscope's alone, integrated from the start with the bias of the rest:
good enough to turn the velocity into the world, and not to be scored.
"""

from dataclasses import dataclass, field

import gtsam
import numpy as np
import numpy.typing as npt
from gtsam_unstable import eqvio

from dronevio.estimator.frontend.corners import CornerConfig
from dronevio.estimator.frontend.protocol import FrontEnd
from dronevio.estimator.frontend.tracker import FeatureTracker, TrackerConfig
from dronevio.estimator.imu.buffer import ImuBuffer, Increments
from dronevio.estimator.initialization.static import initialize_static
from dronevio.estimator.initialization.zero_velocity import ZeroVelocityConfig, ZeroVelocityDetector
from dronevio.estimator.types import Observations
from dronevio.models.imu import ImuSamples
from dronevio.models.rig import Rig
from dronevio.models.rotation import exp_so3, nearest_rotations, pose_matrix
from dronevio.models.state import CameraFrame, Estimate, FeatureTracks, Health, HealthReport, NavState

Array = npt.NDArray[np.float64]

MAX_SPEED_M_S = 60.0  # faster than a racing drone flies: the filter has diverged


@dataclass(frozen=True)
class FilterSettings:
    """The filter's settings; by default those that come with GTSAM's flight, which are tuned for EuRoC."""

    initial_point_depth: float = 5.0002821832024296
    """Depth at which a new landmark is believed to be [m]."""
    initial_point_variance: float = 129.90415638150924
    """How uncertain that is."""
    outlier_threshold_abs_norm: float = 0.010594907286020272
    """Largest innovation of a landmark, in normalized coordinates."""
    feature_retention: float = 0.18594708334486176
    """Share of the landmarks that is kept however far off they are."""
    process_var_bias_omega: float = 0.0
    """Process noise of the gyroscope's bias [rad²/s³]."""
    process_var_bias_accel: float = 0.0
    """Process noise of the accelerometer's bias [m²/s⁵]."""
    process_var_attitude: float = 6.0258753208114069e-05
    """Process noise of the attitude [rad²/s]."""
    process_var_position: float = 9.9814660959284832e-06
    """Process noise of the position [m²/s]."""
    process_var_velocity: float = 0.025317333863551263
    """Process noise of the velocity [m²/s³]."""
    process_var_cam_attitude: float = 5.0753821740452388e-06
    """Process noise of the camera's attitude on the rig [rad²/s]."""
    process_var_cam_position: float = 1.2188313140115635e-05
    """Process noise of the camera's position on the rig [m²/s]."""
    process_var_point: float = 0.00029845436136043135
    """Process noise of the landmarks."""
    initial_var_bias_omega: float = 97162.79515771076
    """Variance of the gyroscope's bias at the start [rad²/s²]."""
    initial_var_bias_accel: float = 1.5813333765300104
    """Variance of the accelerometer's bias at the start [m²/s⁴]."""
    initial_var_attitude: float = 0.13565029126052572
    """Variance of the attitude at the start [rad²]."""
    initial_var_position: float = 0.1
    """Variance of the position at the start [m²]."""
    initial_var_velocity: float = 8.9748529957309997e-08
    """Variance of the velocity at the start [m²/s²]."""
    initial_var_cam_attitude: float = 0.0010228558965517584
    """Variance of the camera's attitude on the rig [rad²]."""
    initial_var_cam_position: float = 0.023501400846134893
    """Variance of the camera's position on the rig [m²]."""
    input_var_gyr: float = 5.9123660022695769e-08
    """Noise of the gyroscope [rad²/s]."""
    input_var_acc: float = 0.0001547248218532208
    """Noise of the accelerometer [m²/s³]."""
    input_var_gyr_bias_walk: float = 1.7882919946320345e-08
    """Random walk of the gyroscope's bias."""
    input_var_acc_bias_walk: float = 1.9912030843328381e-05
    """Random walk of the accelerometer's bias."""
    measurement_noise_variance_norm: float = 1.7755656006412381e-05
    """Variance of an image measurement, in normalized coordinates: 1.9 px with EuRoC's lens."""


@dataclass(frozen=True)
class EquivariantConfig:
    """Settings of the baseline."""

    filter: FilterSettings = field(default_factory=FilterSettings)
    """Those of the filter itself."""
    tracker: TrackerConfig = field(default_factory=lambda: TrackerConfig(corners=CornerConfig(cell_px=120)))
    """Those of the front end. The filter's cost grows with the cube of the landmarks: 24 cells at 752×480."""
    stillness: ZeroVelocityConfig = field(default_factory=lambda: ZeroVelocityConfig(max_flow_px=0.6))
    """What counts as standing still: few features tell it less sharply than many."""
    rest_s: float = 0.8
    """How long the drone must stand still for the start [s]."""
    replenish_s: float = 0.2
    """How often new features are looked for [s]."""


class EquivariantFilter:
    """GTSAM's filter: increments of the IMU and normalized features in, position and velocity out."""

    def __init__(self, T_imu_cam: Array, settings: FilterSettings, up_imu: Array) -> None:
        """Begin level, by the shortest turn that takes the specific force at rest upwards.

        Args:
            T_imu_cam: (4, 4) Pose of the camera in the IMU frame.
            settings: The filter's settings.
            up_imu: (3,) Specific force at rest, in the IMU frame [m/s²].
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
        self._camera = gtsam.PinholeCameraCal3_S2(gtsam.Pose3(), gtsam.Cal3_S2())  # the features are normalized
        self._noise = s.measurement_noise_variance_norm
        self._t_s = 0.0

    def predict(self, increments: Increments) -> None:
        """Take the IMU since the last call."""
        for dt, gyro, accel in zip(increments.dt_s.tolist(), increments.gyro_rad_s, increments.accel_m_s2, strict=True):
            self._filter.predict(_input(self._t_s, gyro, accel), dt)
            self._t_s += dt

    def update(self, ids: npt.NDArray[np.int64], xy: Array) -> None:
        """Take the features of a frame.

        Args:
            ids: (N,) Identities.
            xy: (N, 2) Normalized coordinates.

        Raises:
            RuntimeError: The filter finds no solution.
        """
        if len(ids):
            seen = dict(zip(ids.tolist(), xy, strict=True))
            self._filter.update(seen, self._camera, self._noise * np.eye(2 * len(ids)))

    @property
    def position_m(self) -> Array:
        """(3,) Position in the world [m]."""
        return np.asarray(self._filter.position())

    @property
    def velocity_imu_m_s(self) -> Array:
        """(3,) Velocity in the IMU frame [m/s]."""
        return np.asarray(self._filter.velocity())


def _input(t_s: float, gyro_rad_s: Array, accel_m_s2: Array) -> eqvio.IMUInput:
    sample = eqvio.IMUInput()
    sample.stamp, sample.gyr, sample.acc = t_s, gyro_rad_s, accel_m_s2
    return sample


def shortest_turn_up(up_imu: Array) -> Array:
    """Return R_world_imu (3, 3) as the filter begins with: the shortest turn that takes ``up_imu`` (3,) to z."""
    up = up_imu / np.linalg.norm(up_imu)
    axis = np.array([up[1], -up[0], 0.0])  # up × z
    sine = float(np.linalg.norm(axis))
    if sine < 1e-9:  # it hangs level or upside down, and then any axis will do
        return np.diag([1.0, np.sign(up[2]), np.sign(up[2])])
    return exp_so3(axis / sine * np.arctan2(sine, up[2]))


class EquivariantOdometry:
    """Follows features in the first camera's images, waits for a rest, and runs the filter from there on."""

    def __init__(self, rig: Rig, config: EquivariantConfig | None = None, front_end: FrontEnd | None = None) -> None:
        """Prepare for a rig, of which the first camera is used.

        Args:
            rig: The calibration.
            config: Settings.
            front_end: Where feature observations come from; by default the images.
        """
        self._config = config or EquivariantConfig()
        self._camera = rig.cameras[0]
        self._front_end = front_end or FeatureTracker(self._camera.model, self._config.tracker)
        self._buffer = ImuBuffer()
        self._stillness = ZeroVelocityDetector(self._config.stillness)
        self._rest: list[Increments] = []
        self._gyro_bias = np.zeros(3)
        self._R_world_imu = np.eye(3)
        self._filter: EquivariantFilter | None = None
        self._replenished_ns: int | None = None
        self._lost: str | None = None

    def add_imu(self, samples: ImuSamples) -> None:
        """Take the IMU samples since the last call."""
        self._buffer.add(samples)

    def add_frame(self, frame: CameraFrame) -> Estimate:
        """Take a frame and say where the IMU is; lost for good, with the reason, where the filter fails."""
        increments = self._buffer.take_until(frame.t_ns)
        turn = increments.rotation(self._gyro_bias)
        R_imu_cam = self._camera.T_imu_cam[:3, :3]
        observations = self._front_end.track(frame, R_imu_cam.T @ turn.T @ R_imu_cam)
        if self._replenished_ns is None or frame.t_ns - self._replenished_ns >= self._config.replenish_s * 1e9:
            self._replenished_ns = frame.t_ns
            observations = self._front_end.replenish()
        if self._filter is None:
            return self._start(frame.t_ns, increments, observations)
        self._R_world_imu = nearest_rotations(self._R_world_imu @ turn)
        return self._filtered(self._filter, frame.t_ns, increments, observations)

    def _start(self, t_ns: int, increments: Increments, observations: Observations) -> Estimate:
        """Start if the drone has stood still for long enough."""
        self._stillness.update(t_ns, observations, increments)
        stationary_s = self._stillness.stationary_s
        self._rest = [*self._rest, increments] if stationary_s > 0.0 else []
        if stationary_s < self._config.rest_s:
            reason = f"the drone has stood still for {stationary_s:.1f} s; {self._config.rest_s:g} s are needed"
            return self._answer(t_ns, Health.INITIALIZING, reason, observations, None)
        start = initialize_static(t_ns, self._rest)
        up_imu = start.T_world_imu[2, :3]
        self._gyro_bias, self._R_world_imu = start.gyro_bias_rad_s, shortest_turn_up(up_imu)
        self._filter = EquivariantFilter(self._camera.T_imu_cam, self._config.filter, up_imu)
        return self._filtered(self._filter, t_ns, None, observations)

    def _filtered(
        self, running: EquivariantFilter, t_ns: int, increments: Increments | None, observations: Observations
    ) -> Estimate:
        """Take one step of the filter, unless it has failed before."""
        if self._lost is None:
            try:
                if increments is not None:
                    running.predict(increments)
                running.update(observations.ids, observations.xy)
            except (RuntimeError, ValueError) as error:
                self._lost = str(error).strip().splitlines()[0]
        p_m, v_m_s = running.position_m, self._R_world_imu @ running.velocity_imu_m_s
        if self._lost is None and not (np.isfinite(p_m).all() and np.linalg.norm(v_m_s) < MAX_SPEED_M_S):
            self._lost = "the filter has diverged"
        if self._lost is not None:
            return self._answer(t_ns, Health.LOST, self._lost, observations, None)
        pose = pose_matrix(self._R_world_imu, p_m)
        state = NavState(t_ns, pose, v_m_s, self._gyro_bias, np.zeros(3))
        if len(observations):
            return self._answer(t_ns, Health.TRACKING, f"{len(observations)} features", observations, state)
        return self._answer(t_ns, Health.INERTIAL_ONLY, "nothing is seen", observations, state)

    @staticmethod
    def _answer(t_ns: int, health: Health, reason: str, observations: Observations, state: NavState | None) -> Estimate:
        tracks = FeatureTracks(observations.ids, observations.pixels, observations.ages)
        report = HealthReport(health, reason, tracks=len(observations), landmarks=len(observations))
        return Estimate(t_ns, health, state, tracks, health_report=report)
