"""Data types that pass between the parts of the estimator: observations, frame packets and the calibration in use."""

from dataclasses import dataclass, field, fields, replace
from functools import cached_property

import numpy as np

from dronevio.estimator.imu.buffer import Increments
from dronevio.estimator.intrinsics import IntrinsicCorrections
from dronevio.models.arrays import Array, Integers, Mask
from dronevio.models.camera import CameraModel
from dronevio.models.rig import Rig
from dronevio.models.rotation import skew

GAUGE_SIGMA = 1e-4
"""Standard deviation of the gauge, yaw [rad] and position [m], at initialization. The gauge is known by definition;
the value only keeps the linear system well conditioned."""


@dataclass(frozen=True, eq=False)
class Matches:
    """Observations by further cameras of landmarks that one camera tracks, all at the same instant."""

    ids: Integers
    """(M,) Feature identities, a subset of those of the observations that the matches belong to."""
    camera: Integers
    """(M,) Index of the camera that makes each observation."""
    xy: Array
    """(M, 2) Normalized, undistorted image coordinates in that camera."""

    def __len__(self) -> int:
        return len(self.ids)

    def without(self, ids: Integers) -> "Matches":
        """Return the matches without those of the given features."""
        return self.chosen(~np.isin(self.ids, ids))

    def chosen(self, rows: Mask) -> "Matches":
        """Return the matches of some rows."""
        return Matches(self.ids[rows], self.camera[rows], self.xy[rows])

    def joined(self, others: "Matches") -> "Matches":
        """Return these matches followed by others."""
        pairs = ((getattr(self, name), getattr(others, name)) for name in ("ids", "camera", "xy"))
        return Matches(*(np.concatenate(pair) for pair in pairs))


NO_MATCHES = Matches(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 2)))
"""The matches of a single camera, and of frames that are not keyframes."""


@dataclass(frozen=True, eq=False)
class Observations:
    """The tracked features of one frame."""

    ids: Integers
    """(N,) Feature identities in increasing order."""
    pixels: Array
    """(N, 2) Image coordinates [px]."""
    xy: Array
    """(N, 2) Normalized, undistorted image coordinates."""
    ages: Integers
    """(N,) Number of frames in which each feature has been observed."""
    camera: Integers = field(default_factory=lambda: np.zeros(0, np.int64))
    """(N,) Index of the camera that tracks each feature; the first camera by default."""
    matches: Matches = NO_MATCHES
    """Observations of the same landmarks by further cameras; only on keyframes."""
    miscalibrated: Matches = NO_MATCHES
    """Matches in cameras whose extrinsic calibration they contradict. Only online calibration uses them."""
    zncc: Array = field(default_factory=lambda: np.zeros(0))
    """(N,) Zero-normalized cross-correlation of each patch with its template; 1 by default."""
    scale: Array = field(default_factory=lambda: np.zeros(0))
    """(N,) Scale of each patch relative to its template; 1 by default."""

    def __post_init__(self) -> None:
        """Fill in the defaults of the fields that are not given."""
        if len(self.camera) != len(self.ids):
            object.__setattr__(self, "camera", np.zeros(len(self.ids), np.int64))
        for name in ("zncc", "scale"):
            if len(getattr(self, name)) != len(self.ids):
                object.__setattr__(self, name, np.ones(len(self.ids)))

    def __len__(self) -> int:
        return len(self.ids)

    def without(self, ids: Integers) -> "Observations":
        """Return the observations without those of the given features."""
        kept = ~np.isin(self.ids, ids)
        left = {f.name: getattr(self, f.name)[kept] for f in fields(self) if f.name not in ("matches", "miscalibrated")}
        return Observations(**left, matches=self.matches.without(ids), miscalibrated=self.miscalibrated.without(ids))


NO_FEATURES = Observations(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, np.int64))
"""The observations of a frame without features."""


@dataclass(frozen=True, eq=False)
class ExpectedFeatures:
    """Where a prediction expects N features in the images of the C cameras of a rig."""

    ids: Integers
    """(N,) Identities of the features, in increasing order."""
    rays: Array
    """(C, N, 3) Rays in each camera frame, by the given intrinsics."""


@dataclass(frozen=True, eq=False)
class FramePacket:
    """The features of a frame and the IMU measurements since the previous frame."""

    t_ns: int
    """Time of the frame by the IMU's clock [ns]."""
    increments: Increments
    """The IMU increments since the previous frame."""
    observations: Observations
    """The observed features at that time."""
    has_image: bool = True
    """Whether a camera that tracks features has an image; without one, the IMU alone propagates the estimate."""
    is_left_out: bool = False
    """Whether the images are not tracked, since no keyframe is due and they show the features where they are expected.
    The observations are then these features, and no measurement."""
    repeats_image: bool = False
    """Whether an image was left out because it repeats the one before."""
    imu_outliers: int = 0
    """Number of IMU samples that were left out as outliers since the previous frame."""
    stationary_s: float = 0.0
    """Time for which no motion has been detected [s]."""


@dataclass(frozen=True, eq=False)
class Calibration:
    """The calibration in use: the given rig with the corrections that online calibration has applied, also of gravity.

    It is the only source of calibration in the estimator and is immutable. A new correction makes a new object, which
    the odometry passes to its parts with each frame.
    """

    rig: Rig
    """The rig with the corrected extrinsics of its cameras. Lenses and time offset are those that were given."""
    time_offset_correction_s: float = 0.0
    """Correction of the cameras' time offset [s], to be added to that of the rig."""
    intrinsics: IntrinsicCorrections | None = None
    """Corrections of the intrinsics; none by default."""
    gravity_correction_m_s2: float = 0.0
    """Correction of the magnitude of gravity [m/s²], to be added to the given one."""
    without_depth: frozenset[int] = frozenset()
    """Indices of the cameras whose matches do not determine depths, since their calibration is known to be wrong."""

    @cached_property
    def timed_rig(self) -> Rig:
        """The rig with the corrected time offset; the given one without a correction of it."""
        by_s = self.time_offset_correction_s
        return replace(self.rig, time_offset_s=self.rig.time_offset_s + by_s) if by_s else self.rig

    @cached_property
    def Ts_imu_cam(self) -> Array:
        """(C, 4, 4) Poses of the cameras in the IMU frame."""
        return np.stack([camera.T_imu_cam for camera in self.rig.cameras])

    @cached_property
    def models(self) -> tuple[CameraModel, ...]:
        """The C cameras with the given intrinsics."""
        return tuple(camera.model for camera in self.rig.cameras)

    @cached_property
    def focal_px(self) -> Array:
        """(C,) Focal lengths of the cameras along x, near the axis [px]."""
        return np.array([model.central_focal_px[0] for model in self.models])

    @cached_property
    def readouts_s(self) -> Array:
        """(C,) Readout times of the cameras [s]; zero for global shutters."""
        return np.array([camera.readout_s for camera in self.rig.cameras])

    @cached_property
    def camera_offsets_s(self) -> Array:
        """(C,) Time offset of each camera beside that of the rig [s]."""
        return np.array([camera.time_offset_s for camera in self.rig.cameras])

    def rays(self, p_imu: Array) -> Array:
        """Return the rays (C, N, 3) in the camera frames to points (N, 3) in the IMU frame [m].

        They are by the given intrinsics, and NaN to points behind a camera.
        """
        Rs, t = self.Ts_imu_cam[:, :3, :3], self.Ts_imu_cam[:, None, :3, 3]
        rays = (p_imu - t) @ Rs
        rays[rays[..., 2] <= 0.0] = np.nan
        return rays if self.intrinsics is None else np.stack([self.given_rays(x, i) for i, x in enumerate(rays)])

    def given_rays(self, rays: Array, camera: int) -> Array:
        """Return rays (N, 3) of a camera by the given intrinsics, from those by the corrected intrinsics.

        After a correction, rays that point behind the camera are NaN.
        """
        if self.intrinsics is None:
            return rays
        xy = rays[:, :2] / np.where(rays[:, 2:] > 0.0, rays[:, 2:], np.nan)
        return np.column_stack([self.given_xy(xy, np.full(len(xy), camera)), np.ones(len(xy))])

    def corrected_xy(self, xy: Array, camera: Integers) -> Array:
        """Return normalized coordinates (N, 2) by the corrected intrinsics, from those by the given intrinsics."""
        return xy if self.intrinsics is None else self.intrinsics.corrected_xy(xy, camera)

    def given_xy(self, xy: Array, camera: Integers) -> Array:
        """Return normalized coordinates (N, 2) by the given intrinsics, the inverse of `corrected_xy`."""
        return xy if self.intrinsics is None else self.intrinsics.given_xy(xy, camera)

    def usable(self, observations: Observations) -> Observations:
        """Return observations in which matches that do not determine depths are flagged as miscalibrated."""
        if not self.without_depth:
            return observations
        bad = np.isin(observations.matches.camera, list(self.without_depth))
        used, left = (observations.matches.chosen(rows) for rows in (~bad, bad))
        return replace(observations, matches=used, miscalibrated=observations.miscalibrated.joined(left))

    def normalized(self, observations: Observations) -> Observations:
        """Return observations with normalized coordinates by the corrected intrinsics."""
        if self.intrinsics is None:
            return observations
        matches, miscalibrated = (
            replace(m, xy=self.corrected_xy(m.xy, m.camera)) for m in (observations.matches, observations.miscalibrated)
        )
        xy = self.corrected_xy(observations.xy, observations.camera)
        return replace(observations, xy=xy, matches=matches, miscalibrated=miscalibrated)


@dataclass(frozen=True)
class CalibrationSigmas:
    """Standard deviations of the calibration in use."""

    time_offset_s: float = 0.0
    """Time offset [s]."""
    rotation_rad: float = 0.0
    """Rotation of the camera about each axis [rad]."""
    focal: float = 0.0
    """Focal length, relative."""

    def jacobian(self, x: Array) -> Array:
        """Return the changes (3, 4) of a displacement or velocity (3,) by rotation and focal length.

        Each is that of one standard deviation: a rotation turns what the camera measures, and a focal length scales it.
        """
        return np.column_stack([self.rotation_rad * skew(x), self.focal * x])

    def of_displacement(self, x: Array) -> Array:
        """Return the covariance (3, 3) of a displacement or velocity (3,) by rotation and focal length."""
        J = self.jacobian(x)
        return np.asarray(J @ J.T)


def common_rows(ids: Integers, others: Integers) -> tuple[Integers, Integers]:
    """Return the rows of the common identities in each of two increasing arrays, faster than `numpy.intersect1d`."""
    columns = np.minimum(np.searchsorted(others, ids), len(others) - 1) if len(others) else np.zeros(0, np.int64)
    rows = np.flatnonzero(others[columns] == ids) if len(others) else columns
    return rows, columns[rows]
