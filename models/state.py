"""States and trajectories: where the IMU was, how fast, and how sure an estimate of that is."""

from collections.abc import Iterable
from dataclasses import dataclass
from enum import StrEnum
from typing import Self

import numpy as np
import numpy.typing as npt

from dronevio.models.errors import ConfigError
from dronevio.models.imu import Times
from dronevio.models.rotation import matrix_from_quat_wxyz, pose_matrix, quat_wxyz_from_matrix

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class CameraFrame:
    """What the rig's cameras saw at one instant."""

    t_ns: int
    """Middle of the exposure [ns]."""
    images: tuple[npt.NDArray[np.uint8], ...]
    """One grey (H, W) image for each camera of the rig."""
    depth_m: npt.NDArray[np.float32] | None = None
    """(H, W) planar depth of the main camera [m]; simulation only, never handed to an estimator that is scored."""


@dataclass(frozen=True, eq=False)
class NavState:
    """The navigation state of the IMU at one instant; world is gravity-aligned, z up."""

    t_ns: int
    """Time [ns]."""
    T_world_imu: Array
    """(4, 4) Pose of the IMU."""
    velocity_m_s: Array
    """(3,) Velocity of the IMU in the world [m/s]."""
    gyro_bias_rad_s: Array
    """(3,) What the gyroscope reads too much [rad/s]."""
    accel_bias_m_s2: Array
    """(3,) What the accelerometer reads too much [m/s²]."""
    covariance: Array | None = None
    """(15, 15) In the order δθ (right perturbation, IMU frame), δp, δv (world), δb_gyro, δb_accel; SI units."""
    angular_velocity_rad_s: Array | None = None
    """(3,) Angular velocity in the IMU frame [rad/s], its bias removed; a controller needs it."""


class Health(StrEnum):
    """What an estimate is worth."""

    INITIALIZING = "initializing"
    """No pose yet."""
    TRACKING = "tracking"
    """Camera and IMU agree."""
    INERTIAL_ONLY = "inertial-only"
    """Too few tracks: dead reckoning."""
    LOST = "lost"
    """The estimate means nothing."""


@dataclass(frozen=True, eq=False)
class FeatureTracks:
    """The image features that an estimator followed into one frame of the main camera."""

    ids: npt.NDArray[np.int64]
    """(N,) Identity of each feature, for as long as it is followed."""
    pixels: Array
    """(N, 2) Where it is seen [px]."""
    ages: npt.NDArray[np.int64]
    """(N,) In how many frames it has been seen."""


@dataclass(frozen=True)
class HealthReport:
    """Why an estimate is worth what it is: what the estimator holds on to, and how well it fits.

    A figure is None where there is nothing to compute it from, such as a parallax without landmarks.
    """

    state: Health
    """What the estimate is worth."""
    reason: str
    """Why, for people."""
    tracks: int = 0
    """Features followed into this frame."""
    landmarks: int = 0
    """Those of them that constrain the estimate: landmarks of known position, seen with parallax. A corner that is
    followed well may yet say nothing of the motion."""
    median_parallax_rad: float | None = None
    """Median angle under which those landmarks have been seen [rad]."""
    innovation_px: float | None = None
    """Median distance of those landmarks from where the prediction puts them, before the frame corrects it [px]."""
    innovation_nis: float | None = None
    """Median over them of the innovation squared and normalized by its predicted covariance, divided by the median of
    χ² with two degrees of freedom: 1 where prediction and measurement are as sure as they claim; robust to outliers."""
    bias_sigmas: float | None = None
    """Largest component of the two biases, in standard deviations of what the IMU's model lets them be."""
    position_sigma_m: float | None = None
    """Standard deviation of the position, along the worst axis [m]."""
    velocity_sigma_m_s: float | None = None
    """Standard deviation of the velocity, along the worst axis [m/s]."""
    inertial_only_s: float = 0.0
    """For how long nothing but the IMU has held the estimate [s]."""


@dataclass(frozen=True, eq=False)
class Estimate:
    """What an estimator says after one camera frame: causal, never revised."""

    t_ns: int
    """Time stamp of the frame [ns]."""
    health: Health
    """What the estimate is worth."""
    state: NavState | None
    """The state at the frame, in a smooth odometry frame; None while there is none."""
    tracks: FeatureTracks | None = None
    """The features followed into this frame."""
    landmarks_world: Array | None = None
    """(M, 3) Map points triangulated at this frame [m]; None on frames where none are computed."""
    events: tuple[str, ...] = ()
    """What happened, for people: ``initialized``, ``keyframe``, ``solver restored`` …"""
    health_report: HealthReport | None = None
    """Why it is worth that; None from an estimator that does not say."""
    T_map_odom: Array | None = None
    """(4, 4) Correction of the odometry frame by closed loops: it may jump, `state` never does. None from an estimator
    that closes no loops: it has odometry only."""

    @property
    def T_map_imu(self) -> Array | None:
        """(4, 4) Pose of the IMU, corrected by closed loops; None without a pose or without a map."""
        if self.state is None or self.T_map_odom is None:
            return None
        return np.asarray(self.T_map_odom @ self.state.T_world_imu)


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Poses of the IMU over time, and what else is known of its motion."""

    t_ns: Times
    """(N,) Time stamps [ns], strictly increasing."""
    p_world_imu: Array
    """(N, 3) Positions [m]."""
    quat_wxyz: Array
    """(N, 4) Orientations, IMU to world."""
    velocity_m_s: Array | None = None
    """(N, 3) Velocities in the world [m/s]."""
    gyro_bias_rad_s: Array | None = None
    """(N, 3) Gyroscope biases [rad/s]."""
    accel_bias_m_s2: Array | None = None
    """(N, 3) Accelerometer biases [m/s²]."""
    covariance: Array | None = None
    """(N, 15, 15) Covariances, in the order of `NavState`."""

    def __post_init__(self) -> None:
        """Check the shapes.

        Raises:
            ConfigError: The arrays do not belong together, or time does not increase.
        """
        n = len(self.t_ns)
        if self.t_ns.shape != (n,) or self.p_world_imu.shape != (n, 3) or self.quat_wxyz.shape != (n, 4):
            raise ConfigError(
                f"trajectory with shapes {self.t_ns.shape}, {self.p_world_imu.shape}, {self.quat_wxyz.shape};"
                " expected (N,), (N, 3), (N, 4)"
            )
        if n > 1 and not np.all(np.diff(self.t_ns) > 0):
            raise ConfigError("trajectory whose time stamps do not increase")

    def __len__(self) -> int:
        return len(self.t_ns)

    def __getitem__(self, rows: slice | npt.NDArray[np.bool_] | npt.NDArray[np.int64]) -> Self:
        """Return the trajectory of the given rows."""

        def pick(values: Array | None) -> Array | None:
            return None if values is None else values[rows]

        return type(self)(
            self.t_ns[rows],
            self.p_world_imu[rows],
            self.quat_wxyz[rows],
            pick(self.velocity_m_s),
            pick(self.gyro_bias_rad_s),
            pick(self.accel_bias_m_s2),
            pick(self.covariance),
        )

    @property
    def rotations(self) -> Array:
        """(N, 3, 3) Orientations as matrices."""
        return matrix_from_quat_wxyz(self.quat_wxyz)

    @property
    def Ts_world_imu(self) -> Array:
        """(N, 4, 4) Poses as matrices."""
        return pose_matrix(self.rotations, self.p_world_imu)

    @property
    def t_s(self) -> Array:
        """(N,) Seconds since the first pose."""
        return np.asarray((self.t_ns - self.t_ns[0]) * 1e-9)

    @property
    def length_m(self) -> float:
        """Length of the path [m]."""
        return float(np.linalg.norm(np.diff(self.p_world_imu, axis=0), axis=1).sum())

    @classmethod
    def from_states(cls, states: Iterable[NavState]) -> Self:
        """Join states in time order into a trajectory; it has covariances if every state has one."""
        kept = list(states)
        if not kept:
            return cls(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 4)))
        T = np.stack([s.T_world_imu for s in kept])
        covariances = [s.covariance for s in kept if s.covariance is not None]
        return cls(
            np.array([s.t_ns for s in kept], dtype=np.int64),
            T[:, :3, 3],
            quat_wxyz_from_matrix(T[:, :3, :3]),
            np.stack([s.velocity_m_s for s in kept]),
            np.stack([s.gyro_bias_rad_s for s in kept]),
            np.stack([s.accel_bias_m_s2 for s in kept]),
            np.stack(covariances) if len(covariances) == len(kept) else None,
        )
