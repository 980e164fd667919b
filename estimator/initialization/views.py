"""The measurements of a window: image observations by view, and the motion between the views that the IMU measures.

A view is one camera in one frame of the window. Positions and rotations are in the IMU frame of the first frame.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from dronevio.estimator.imu.buffer import Increments, joined
from dronevio.estimator.types import FramePacket
from dronevio.models.arrays import Array, Integers
from dronevio.models.rotation import cross, integrated_rotations, skew


@dataclass(frozen=True, eq=False)
class Tracks:
    """The F landmarks of a window that are observed often enough, in V views."""

    xy: Array
    """(V, F, 2) Normalized image coordinates, 0 where not observed."""
    observed: npt.NDArray[np.bool_]
    """(V, F) Whether a view observes a landmark."""
    frame: Integers
    """(V,) Index of the frame of each view in the window."""
    camera: Integers
    """(V,) Index of the camera of each view in the rig."""
    ids: Integers
    """(F,) Identities of the features."""

    def __len__(self) -> int:
        return len(self.ids)

    @property
    def degrees_of_freedom(self) -> Array:
        """(F,) Number of coordinates of each landmark's observations beyond the three of its position, at least 1."""
        return np.asarray(np.maximum(2.0 * self.observed.sum(axis=0) - 3.0, 1.0))


@dataclass(frozen=True, eq=False)
class Motion:
    """The IMU integrated from the first frame of a window to each view, without gravity and initial velocity."""

    t_s: Array
    """(V,) Times since the first frame [s]."""
    R: Array
    """(V, 3, 3) Rotations R_first_view of the IMU."""
    dp: Array
    """(V, 3) Double integrals of the specific force [m]."""
    dp_by_accel_bias: Array
    """(V, 3, 3) Derivatives of `dp` by the accelerometer bias [s²]."""


@dataclass(frozen=True, eq=False)
class IntegratedImu:
    """The N increments of a window integrated with a gyroscope bias, and zero accelerometer bias.

    Views are at the nearest samples.
    """

    increments: Increments
    """The N increments, biases included."""
    t_s: Array
    """(N + 1,) Times since the first frame [s]."""
    R: Array
    """(N + 1, 3, 3) Rotations R_first_sample of the IMU."""
    rows: Integers
    """(V,) Samples of the views."""

    @property
    def rotations(self) -> Array:
        """(V, 3, 3) Rotations R_first_view of the IMU."""
        return np.asarray(self.R[self.rows])

    def motion(self, shift_s: float = 0.0) -> Motion:
        """Return the motion from the first frame to each view.

        Args:
            shift_s: How much later than the views the motion is wanted at least, or earlier where it is negative [s];
                it ends with the window.
        """
        rows = self._shifted(shift_s)
        return Motion(self.t_s[rows], self.R[rows], self._dp[rows], self._dp_by_accel_bias[rows])

    @cached_property
    def rotations_by_gyro_bias(self) -> Array:
        """(V, 3, 3) Derivatives A of the rotations by the gyroscope bias [s]: R(b + δ) ≈ Exp(A δ) R(b)."""
        return np.asarray(self._R_by_gyro_bias[self.rows])

    def dp_by_gyro_bias(self, accel_bias_m_s2: Array) -> Array:
        """Return the derivatives (V, 3, 3) by the gyroscope bias of the double integrals of the specific force [m s].

        Args:
            accel_bias_m_s2: (3,) Accelerometer bias, which is not in `Motion.dp` [m/s²].
        """
        dt_s = self.increments.dt_s
        dv = self._dv - (self.R[:-1] @ accel_bias_m_s2) * dt_s[:, None]
        return np.asarray(_summed_twice(-skew(dv) @ self._R_by_gyro_bias[:-1], dt_s)[self.rows])

    @cached_property
    def _R_by_gyro_bias(self) -> Array:
        steps = -0.5 * (self.R[:-1] + self.R[1:]) * self.increments.dt_s[:, None, None]
        return np.concatenate([np.zeros((1, 3, 3)), np.cumsum(steps, axis=0)])

    @cached_property
    def _dv(self) -> Array:
        return np.asarray((self.R[:-1] @ self.increments.accel_m_s2[..., None])[..., 0] * self.increments.dt_s[:, None])

    @cached_property
    def _dp(self) -> Array:
        return _summed_twice(self._dv, self.increments.dt_s)

    @cached_property
    def _dp_by_accel_bias(self) -> Array:
        dt_s = self.increments.dt_s
        return _summed_twice(-self.R[:-1] * dt_s[:, None, None], dt_s)

    def _shifted(self, shift_s: float) -> Integers:
        if not shift_s:
            return self.rows
        wanted_s = self.t_s[self.rows] + shift_s
        after, before = np.searchsorted(self.t_s, wanted_s), np.searchsorted(self.t_s, wanted_s, "right") - 1
        return np.asarray(np.clip(after if shift_s > 0.0 else before, 0, len(self.t_s) - 1))


class ImuWindow:
    """The IMU measurements of a window, which can be integrated with any gyroscope bias."""

    def __init__(self, window: Sequence[FramePacket], frames: Integers) -> None:
        """Arrange the measurements.

        Args:
            window: Consecutive frame packets.
            frames: (V,) Index of the frame of each view.
        """
        self.increments: Increments = joined([packet.increments for packet in window[1:]])
        """The IMU increments between the first and the last frame, biases included."""
        ends = np.concatenate([[0], np.cumsum([len(packet.increments.dt_s) for packet in window[1:]])])
        self._t_s = np.concatenate([[0.0], np.cumsum(self.increments.dt_s)])
        self._rows = ends[frames]

    def integrated(self, gyro_bias_rad_s: Array) -> IntegratedImu:
        """Return the integral for a gyroscope bias (3,) [rad/s]."""
        i = self.increments
        R = integrated_rotations((i.gyro_rad_s - gyro_bias_rad_s) * i.dt_s[:, None])
        return IntegratedImu(i, self._t_s, R, self._rows)


@dataclass(frozen=True, eq=False)
class WindowMeasurements:
    """All that an initialization uses of a window."""

    tracks: Tracks
    """Observations of landmarks."""
    imu: ImuWindow
    """IMU measurements from the first frame to each view."""
    Ts_imu_cam: Array
    """(V, 4, 4) Poses of the views' cameras in the IMU frame."""

    @classmethod
    def of(
        cls, window: Sequence[FramePacket], Ts_imu_cam: Array, max_frames: int, min_observations: int
    ) -> "WindowMeasurements":
        """Arrange the measurements of consecutive frame packets.

        Args:
            window: Consecutive frame packets.
            Ts_imu_cam: (C, 4, 4) Poses of the rig's cameras in the IMU frame.
            max_frames: Largest number of frames that are used, spread evenly over the window; those with matches are
                used in any case.
            min_observations: Smallest number of used frames in which a landmark must be observed; half of them suffice,
                but not one.
        """
        tracks = collect_tracks(window, max_frames, min_observations)
        return cls(tracks, ImuWindow(window, tracks.frame), Ts_imu_cam[tracks.camera])

    @property
    def bearings(self) -> Array:
        """(V, F, 3) Directions of the observations in the IMU frames of their views, of unit length."""
        rays = np.concatenate([self.tracks.xy, np.ones((*self.tracks.observed.shape, 1))], axis=-1)
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        return np.asarray(rays @ np.swapaxes(self.Ts_imu_cam[:, :3, :3], 1, 2))

    def median_parallax_rad(self, gyro_bias_rad_s: Array) -> float:
        """Return the median angle between the first and last views of the landmarks, compensated for rotation [rad].

        Args:
            gyro_bias_rad_s: (3,) Gyroscope bias by which the rotation is known [rad/s].
        """
        observed = self.tracks.observed
        rays = self.bearings @ np.swapaxes(self.imu.integrated(gyro_bias_rad_s).rotations, 1, 2)
        first, last = observed.argmax(axis=0), len(observed) - 1 - observed[::-1].argmax(axis=0)
        columns = np.arange(len(self.tracks))
        sines = np.linalg.norm(cross(rays[first, columns], rays[last, columns]), axis=1)
        return float(np.median(np.arcsin(np.minimum(sines, 1.0))))


def collect_tracks(window: Sequence[FramePacket], max_frames: int, min_observations: int) -> Tracks:
    """Arrange the observations of all landmarks that enough of the frames observe; see `WindowMeasurements.of`."""
    spread = np.rint(np.linspace(0, len(window) - 1, min(max_frames, len(window)))).astype(np.int64)
    used = [k for k, packet in enumerate(window) if k in spread or len(packet.observations.matches)]
    observations = [window[k].observations for k in used]
    ids, counts = np.unique(np.concatenate([frame.ids for frame in observations]), return_counts=True)
    ids = ids[counts >= max(min(min_observations, len(used) // 2), 2)]  # one observation determines nothing
    views: list[tuple[int, int, Array, npt.NDArray[np.bool_]]] = []
    for k, frame in zip(used, observations, strict=True):
        by_camera = [(frame.ids, frame.camera, frame.xy), (frame.matches.ids, frame.matches.camera, frame.matches.xy)]
        for some_ids, cameras, some_xy in by_camera:
            for camera in np.unique(cameras).tolist():
                mine = np.flatnonzero(cameras == camera)
                _, column, row = np.intersect1d(ids, some_ids[mine], return_indices=True)
                xy, visible = np.zeros((len(ids), 2)), np.zeros(len(ids), dtype=np.bool_)
                xy[column], visible[column] = some_xy[mine[row]], True
                views.append((k, camera, xy, visible))
    frame_of, camera_of = (np.array([view[i] for view in views], dtype=np.int64) for i in (0, 1))
    xy_of = np.array([view[2] for view in views]).reshape(len(views), len(ids), 2)
    observed = np.array([view[3] for view in views], dtype=np.bool_).reshape(len(views), len(ids))
    return Tracks(xy_of, observed, frame_of, camera_of, ids)


def _summed_twice(steps: Array, dt_s: Array) -> Array:
    """Return the double sums (N + 1, …) of changes (N, …) of velocity that are constant over intervals (N,) [s]."""
    dt = dt_s.reshape(-1, *[1] * (steps.ndim - 1))
    zero = np.zeros((1, *steps.shape[1:]))
    velocity = np.concatenate([zero, np.cumsum(steps, axis=0)])
    return np.concatenate([zero, np.cumsum((velocity[:-1] + 0.5 * steps) * dt, axis=0)])
