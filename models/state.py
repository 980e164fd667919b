"""Camera frames, navigation states, estimates with their health, and trajectories."""

from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from enum import StrEnum
from numbers import Integral
from typing import Self

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array
from dronevio.models.defects import Defect
from dronevio.models.errors import ConfigError
from dronevio.models.imu import Times
from dronevio.models.map_correction import MapCorrection
from dronevio.models.rig import Rig
from dronevio.models.rotation import matrix_from_quat_wxyz, pose_matrix, quat_wxyz_from_matrix
from dronevio.models.summary import Summarized, duration_text, size_text

NO_IMAGE: npt.NDArray[np.uint8] = np.zeros((0, 0), np.uint8)
"""Image without pixels, in place of one that a camera lacks at the time of a frame."""


@dataclass(frozen=True, eq=False)
class CameraFrame:
    """Images of all cameras of a rig at one time."""

    t_ns: int
    """Time stamp, the middle of the exposure of the middle row [ns]."""
    images: tuple[npt.NDArray[np.uint8], ...]
    """Grey images (H, W), one for each camera of the rig; `NO_IMAGE` for a camera that has none at this time."""
    depth_m: npt.NDArray[np.float32] | None = None
    """(H, W) Depth along the optical axis of the main camera; only in simulation, and not given to estimators [m]."""
    defects: tuple[Defect, ...] = ()
    """Reasons of the images that cannot be read."""
    image_delays_ns: tuple[int, ...] = ()
    """How much later than `t_ns` each image was exposed, by the time stamps of the cameras [ns]; empty if all images
    have the time stamp of the frame."""

    def __post_init__(self) -> None:
        """Check the types of time stamp and images.

        Raises:
            ConfigError: The time stamp is not a whole number, the images are not a tuple or list, or their delays are
                not as many.
        """
        t_ns: object = self.t_ns
        images: object = self.images
        if not isinstance(t_ns, Integral):
            raise ConfigError(f"frame with the time stamp {t_ns!r}; expected whole nanoseconds, an int")
        if not isinstance(images, (tuple, list)):
            found = type(images).__name__
            raise ConfigError(f"frame at {self.t_ns} ns with images of type {found}; expected a tuple of arrays")
        if len(self.image_delays_ns) not in {0, len(images)}:
            raise ConfigError(
                f"frame at {self.t_ns} ns with {len(images)} images and {len(self.image_delays_ns)} delays;"
                " expected as many, or none"
            )


@dataclass(frozen=True, eq=False)
class NavState:
    """Navigation state of the IMU at one time.

    The world frame is the fixed frame of its source, such as that of the simulation, of an odometry or of a
    map; it is aligned with gravity, z up.
    """

    t_ns: int
    """Time of the state [ns]."""
    T_world_imu: Array
    """(4, 4) Pose of the IMU in the world frame."""
    velocity_m_s: Array
    """(3,) Velocity of the IMU in the world frame [m/s]."""
    gyro_bias_rad_s: Array
    """(3,) Gyroscope bias, which is added to the measurements [rad/s]."""
    accel_bias_m_s2: Array
    """(3,) Accelerometer bias, which is added to the measurements [m/s²]."""
    covariance: Array | None = None
    """(15, 15) Covariance in the order δθ (right perturbation, IMU frame), δp, δv (world frame), δb_gyro, δb_accel, in
    SI units."""
    angular_velocity_rad_s: Array | None = None
    """(3,) Angular velocity in the IMU frame without bias, for controllers [rad/s]."""


class Health(StrEnum):
    """Status of an estimator."""

    INITIALIZING = "initializing"
    """No pose has been estimated yet."""
    TRACKING = "tracking"
    """Landmarks and IMU constrain the estimate."""
    INERTIAL_ONLY = "inertial-only"
    """Images do not support the estimate: too few landmarks are visible, and the IMU alone is integrated; or images and
    IMU contradict each other, or the calibration. `HealthReport.cause` tells which."""
    LOST = "lost"
    """The estimate has failed and is not valid."""


@dataclass(frozen=True, eq=False)
class FeatureTracks:
    """Image features that an estimator finds in one frame of the main camera."""

    ids: npt.NDArray[np.int64]
    """(N,) Identity of each feature, constant while it is tracked."""
    pixels: Array
    """(N, 2) Position of each feature in the image [px]."""
    ages: npt.NDArray[np.int64]
    """(N,) Number of frames into which each feature has been tracked."""


@dataclass(frozen=True, kw_only=True)
class HealthQuantities:
    """The quantities that determine the health of an estimate at one frame.

    A quantity is None where it is undefined, such as the parallax without landmarks.
    """

    tracks: int = 0
    """Number of features tracked into this frame."""
    landmarks: int = 0
    """Number of tracked features that constrain the estimate: triangulated landmarks with parallax."""
    median_parallax_rad: float | None = None
    """Median parallax angle of these landmarks [rad]."""
    innovation_px: float | None = None
    """Median distance between the observations of these landmarks and their predictions before the update [px]."""
    innovation_nis: float | None = None
    """Median NIS (normalized innovation squared) of these landmarks, divided by the median of χ² with two degrees of
    freedom; 1 if prediction and measurement have the covariances that are assumed."""
    bias_sigmas: float | None = None
    """Largest component of the two biases, in standard deviations of the IMU model."""
    position_sigma_m: float | None = None
    """Standard deviation of the position along the least certain axis [m]."""
    velocity_sigma_m_s: float | None = None
    """Standard deviation of the velocity along the least certain axis [m/s]."""
    inertial_only_s: float = 0.0
    """Time for which the IMU alone has constrained the estimate [s]."""

    @property
    def quantities(self) -> "HealthQuantities":
        """These quantities alone."""
        return HealthQuantities(**{field.name: getattr(self, field.name) for field in fields(HealthQuantities)})


@dataclass(frozen=True)
class HealthReport(HealthQuantities):
    """Health of an estimator at one frame, with its reason and the quantities that determine it."""

    health: Health
    """Status of the estimator."""
    reason: str
    """Reason of the status, as a text for users."""
    cause: StrEnum | None = None
    """The same as a constant, for programs; None from estimators that give a text only. Those of the odometry are in
    `dronevio.estimator.monitoring.causes`."""


@dataclass(frozen=True, eq=False)
class Estimate:
    """Output of an estimator for one frame: causal, and not revised afterwards."""

    t_ns: int
    """Time stamp of the frame [ns]."""
    health: Health
    """Status of the estimator."""
    state: NavState | None
    """State at the frame, whose world frame is the odometry frame: continuous, with drift. None if there is none."""
    tracks: FeatureTracks | None = None
    """Features that are tracked into this frame."""
    landmarks_odom: Array | None = None
    """(M, 3) Positions of landmarks in the odometry frame, None on frames for which they are not computed [m]."""
    events: tuple[str, ...] = ()
    """Events at this frame, as texts for users, such as ``initialized`` or ``keyframe``."""
    health_report: HealthReport | None = None
    """Reason of the status, None if the estimator does not report it."""
    T_map_odom: Array | None = None
    """(4, 4) Pose of the odometry frame in the map frame, corrected by loop closures; it may be discontinuous, while
    `state` is continuous. None for pure odometry, and after a loss until a place of the map is recognized."""
    map_covariance: Array | None = None
    """(6, 6) Covariance of `T_map_imu`: δθ (right perturbation, IMU frame), δp (map frame), in SI units; None if it is
    not estimated."""
    closed_loops_ns: tuple[tuple[int, int], ...] = ()
    """Time stamps of the earlier and the later keyframe of each loop that corrects the estimate from this frame on
    [ns]."""
    track: int = 0
    """Number of the odometry frame: it increases whenever the estimate is lost, or images show another place, after
    which poses are in another odometry frame."""
    map_correction: MapCorrection | None = None
    """Poses of the odometry frames of all tracks in the map frame, at the time stamps of the keyframes of the map; they
    change when a loop is closed, together with `T_map_odom`. Estimates share it until it changes. None from estimators
    without a map, and in stored runs."""
    exposed: NavState | None = None
    """State in the middle of the exposure of the frame, in the odometry frame, by the time offset as it is estimated; a
    camera may be exposed later by a time of its own. None without a state, and from estimators that leave it out."""
    rig: Rig | None = None
    """The calibration with the time offset and the poses of the cameras as they are estimated, and the given lenses.
    Estimates share it until it changes. None from estimators that take the given one as true."""

    @property
    def T_odom_imu(self) -> Array | None:
        """(4, 4) Pose of the IMU in the odometry frame; None without a state."""
        return None if self.state is None else self.state.T_world_imu

    @property
    def T_map_imu(self) -> Array | None:
        """(4, 4) Pose of the IMU in the map frame, corrected by loop closures; None without a pose or a map."""
        T_map_odom, T_odom_imu = self.T_map_odom, self.T_odom_imu
        return None if T_map_odom is None or T_odom_imu is None else np.asarray(T_map_odom @ T_odom_imu)


@dataclass(frozen=True, eq=False, repr=False)
class Trajectory(Summarized):
    """Poses of the IMU over time, optionally with velocities, biases and covariances.

    The world frame is the fixed frame of its source; see `NavState`.
    """

    t_ns: Times
    """(N,) Time stamps, strictly increasing [ns]."""
    p_world_imu: Array
    """(N, 3) Positions in the world frame [m]."""
    quat_wxyz: Array
    """(N, 4) Orientations as unit quaternions, from the IMU frame to the world frame."""
    velocity_m_s: Array | None = None
    """(N, 3) Velocities in the world frame [m/s]."""
    gyro_bias_rad_s: Array | None = None
    """(N, 3) Gyroscope biases [rad/s]."""
    accel_bias_m_s2: Array | None = None
    """(N, 3) Accelerometer biases [m/s²]."""
    covariance: Array | None = None
    """(N, 15, 15) Covariances of the states, in the order of `NavState`."""

    def __post_init__(self) -> None:
        """Check the shapes and the time stamps.

        Raises:
            ConfigError: The shapes do not match, or the time stamps do not increase.
        """
        n = len(self.t_ns)
        if self.t_ns.shape != (n,) or self.p_world_imu.shape != (n, 3) or self.quat_wxyz.shape != (n, 4):
            raise ConfigError(
                f"trajectory with shapes {self.t_ns.shape}, {self.p_world_imu.shape}, {self.quat_wxyz.shape};"
                " expected (N,), (N, 3), (N, 4)"
            )
        if n > 1 and not np.all(np.diff(self.t_ns) > 0):
            raise ConfigError("trajectory whose time stamps do not increase")

    def _summary(self) -> list[tuple[str, str]]:
        parts = {
            "velocities": self.velocity_m_s,
            "gyroscope biases": self.gyro_bias_rad_s,
            "accelerometer biases": self.accel_bias_m_s2,
            "covariances": self.covariance,
        }
        return [
            ("poses", f"{len(self)}"),
            ("duration", duration_text(self.t_ns)),
            ("length of the path", f"{self.length_m:.2f} m"),
            ("size in x, y, z", size_text(self.p_world_imu)),
            ("also has", ", ".join(name for name, values in parts.items() if values is not None) or "–"),
        ]

    def __len__(self) -> int:
        return len(self.t_ns)

    def __getitem__(self, rows: slice | npt.NDArray[np.bool_] | npt.NDArray[np.int64]) -> Self:
        """Return the trajectory of selected rows."""

        def select(values: Array | None) -> Array | None:
            return None if values is None else values[rows]

        return type(self)(
            self.t_ns[rows],
            self.p_world_imu[rows],
            self.quat_wxyz[rows],
            select(self.velocity_m_s),
            select(self.gyro_bias_rad_s),
            select(self.accel_bias_m_s2),
            select(self.covariance),
        )

    @property
    def rotations(self) -> Array:
        """(N, 3, 3) Orientations as rotation matrices."""
        return matrix_from_quat_wxyz(self.quat_wxyz)

    @property
    def Ts_world_imu(self) -> Array:
        """(N, 4, 4) Poses as homogeneous matrices."""
        return pose_matrix(self.rotations, self.p_world_imu)

    @property
    def t_s(self) -> Array:
        """(N,) Times since the first pose [s]."""
        return np.asarray((self.t_ns - self.t_ns[0]) * 1e-9)

    @property
    def length_m(self) -> float:
        """Length of the path [m]."""
        return float(np.linalg.norm(np.diff(self.p_world_imu, axis=0), axis=1).sum())

    def corrected(self, correction: MapCorrection) -> Self:
        """Return a trajectory of the odometry in the map frame.

        Velocities and covariances, which belong to the odometry frame, are left out, and so are the poses of tracks
        that are not joined with the map.
        """
        Ts_map_odom = correction.at(self.t_ns)
        is_known = ~np.isnan(Ts_map_odom[:, 0, 0])
        known = self[is_known]
        Ts = Ts_map_odom[is_known] @ known.Ts_world_imu
        quat_wxyz = quat_wxyz_from_matrix(Ts[:, :3, :3])
        return replace(known, p_world_imu=Ts[:, :3, 3], quat_wxyz=quat_wxyz, velocity_m_s=None, covariance=None)

    @classmethod
    def from_states(cls, states: Iterable[NavState]) -> Self:
        """Return the trajectory of states in time order, with covariances if all states have one."""
        states = list(states)
        if not states:
            return cls(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 4)))
        T = np.stack([s.T_world_imu for s in states])
        covariances = [s.covariance for s in states if s.covariance is not None]
        return cls(
            np.array([s.t_ns for s in states], dtype=np.int64),
            T[:, :3, 3],
            quat_wxyz_from_matrix(T[:, :3, :3]),
            np.stack([s.velocity_m_s for s in states]),
            np.stack([s.gyro_bias_rad_s for s in states]),
            np.stack([s.accel_bias_m_s2 for s in states]),
            np.stack(covariances) if len(covariances) == len(states) else None,
        )
