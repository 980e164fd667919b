"""Compensation of exposure times: moves observations from the instant of their exposure to the time of their frame.

A rolling shutter exposes each row at a time of its own, the clocks of camera and IMU may be offset, and the cameras of
a rig may be exposed one after another. An observation with a delay τ is moved back along the path of the feature in the
image (Qin and Shen, "Online temporal calibration for monocular visual-inertial systems", IROS 2018): by the rotation of
the camera within τ, which the gyroscope measures, and by the flow due to the camera's translation, from the feature's
last two observations. The error is of second order in τ and due to the translation alone: ½ a/z τ (τ + Δt) for an
acceleration a, a depth z and a time Δt between frames.
"""

from dataclasses import dataclass, fields, replace

import numpy as np

from dronevio.estimator.imu.buffer import NO_INCREMENTS, Increments
from dronevio.estimator.types import Calibration, Matches, Observations, common_rows
from dronevio.models.arrays import Array, Integers
from dronevio.models.imu import GRAVITY_M_S2
from dronevio.models.rotation import cumulative_rotations, exp_so3, log_so3, pose_matrix
from dronevio.models.state import Estimate

EXTRAPOLATION_S = 0.1  # beyond the measured motion, the angular velocity is held for this time [s]
ACCEL_SAMPLES = 4  # increments on each side of a frame whose mean is its specific force, to average out vibration
ANGULAR_VELOCITY_SPAN_S = 0.005  # on each side of a frame, in which the gyroscope is averaged; one interval of it [s]
MIN_FLOW_INTERVAL_S = 1e-3  # shortest time between two observations that a flow is computed from [s]
MAX_GAP_S = 0.5  # longest time without an image across which a flow is computed [s]
NO_DELAYS_S = np.zeros(1)  # of images that all have the time stamp of their frame


@dataclass(frozen=True, eq=False)
class LocalRotation:
    """The rotation of the IMU shortly before and after a frame."""

    t_s: Array
    """(K,) Times relative to that of the frame [s], increasing; one of them is 0."""
    rotation_rad: Array
    """(K, 3) Rotation vectors of R_frame_t [rad]: from the IMU frame at each time to that at the frame."""

    @classmethod
    def of(cls, before: Increments, after: Increments, gyro_bias_rad_s: Array) -> "LocalRotation":
        """Integrate the gyroscope on both sides of a frame and hold its rate beyond.

        Args:
            before: Increments that end at the frame.
            after: Increments that begin at the frame, as far as they are available.
            gyro_bias_rad_s: (3,) Gyroscope bias [rad/s].
        """
        rates_before, rates_after = before.gyro_rad_s - gyro_bias_rad_s, after.gyro_rad_s - gyro_bias_rad_s
        first = rates_before[:1] if len(rates_before) else rates_after[:1]
        last = rates_after[-1:] if len(rates_after) else rates_before[-1:]
        held = np.full(min(len(first), 1), EXTRAPOLATION_S)
        past_s, past = np.concatenate([before.dt_s[::-1], held]), np.concatenate([rates_before[::-1], first])
        future_s, future = np.concatenate([after.dt_s, held]), np.concatenate([rates_after, last])
        t_s = np.concatenate([-np.cumsum(past_s)[::-1], [0.0], np.cumsum(future_s)])
        steps = exp_so3(np.concatenate([-past * past_s[:, None], future * future_s[:, None]]))
        Rs_past, Rs_future = cumulative_rotations(steps[: len(past)]), cumulative_rotations(steps[len(past) :])
        return cls(t_s, log_so3(np.concatenate([Rs_past[::-1], np.eye(3)[None], Rs_future])))

    def at(self, t_s: Array) -> Array:
        """Return the rotation vectors (N, 3) of R_frame_t [rad] at times (N,) relative to the frame's [s]."""
        return np.stack([np.interp(t_s, self.t_s, axis) for axis in self.rotation_rad.T], axis=-1)


@dataclass(frozen=True, eq=False)
class _Exposed:
    """The observations of a frame, in increasing order of their identities."""

    ids: Integers  # (N,)
    camera: Integers  # (N,) index of the camera of each
    delay_s: Array  # (N,) exposure time of each relative to the frame's
    rays: Array  # (N, 3) at depth 1, in the camera frame at the time of the frame


class ExposureCompensation:
    """Moves the observations of each frame to the time of the frame by the IMU's clock.

    All estimates are on the IMU's clock. Internally the time of a frame is the exposure of its middle row by its stamp
    and the rig's given time offset. The published estimate is the state at which the IMU's clock shows the frame's time
    stamp.
    """

    def __init__(self, gravity_m_s2: float = GRAVITY_M_S2) -> None:
        """Begin before the first frame, with the magnitude of gravity [m/s²]."""
        self._gravity_m_s2 = gravity_m_s2
        self._increments = NO_INCREMENTS, NO_INCREMENTS  # before and after the frame
        self._gyro_bias_rad_s = np.zeros(3)
        self._local_rotation: LocalRotation | None = None  # computed when it is used, which is not in every frame
        self._angular_velocity_rad_s: Array | None = None  # the same
        self._accel_m_s2 = np.zeros(3)
        self._frame_interval_s = 0.0
        self._image_delays_s = NO_DELAYS_S
        none = np.zeros(0, np.int64)
        self._now = self._last = _Exposed(none, none, np.zeros(0), np.zeros((0, 3)))

    @staticmethod
    def imu_time_ns(stamp_ns: int, calibration: Calibration) -> int:
        """Return the time of a frame by the IMU's clock [ns]."""
        return stamp_ns + round(calibration.rig.time_offset_s * 1e9)

    @staticmethod
    def lookahead_s(calibration: Calibration, image_delays_s: Array = NO_DELAYS_S) -> float:
        """Return the time after a frame for which IMU data are needed, by the delays of its images [s]."""
        middle_s = image_delays_s + calibration.camera_offsets_s
        last_row_s = float((middle_s + 0.5 * calibration.readouts_s).max()) + calibration.time_offset_correction_s
        return float(max(last_row_s, -calibration.rig.time_offset_s, 0.0))

    def longest_delay_s(self, calibration: Calibration) -> float:
        """Return the longest time between an exposure and the time of the frame, before or after it [s]."""
        middle_s = np.abs(self._camera_delays_s(calibration) + calibration.time_offset_correction_s)
        return float((middle_s + 0.5 * calibration.readouts_s).max())

    def begin_frame(
        self, before: Increments, after: Increments, gyro_bias_rad_s: Array, image_delays_s: Array = NO_DELAYS_S
    ) -> None:
        """Begin a frame.

        Args:
            before: The IMU increments since the previous frame.
            after: The increments after the frame, `lookahead_s` long or as far as they are available.
            gyro_bias_rad_s: (3,) Gyroscope bias [rad/s].
            image_delays_s: (C,) How much later than the frame the image of each camera is stamped [s]; none by default.
        """
        self._image_delays_s = image_delays_s
        self._last, self._frame_interval_s = self._now, float(before.dt_s.sum())
        self._increments, self._gyro_bias_rad_s = (before, after), gyro_bias_rad_s
        self._local_rotation = self._angular_velocity_rad_s = None
        near = np.concatenate([before.accel_m_s2[-ACCEL_SAMPLES:], after.accel_m_s2[:ACCEL_SAMPLES]])
        self._accel_m_s2 = near.mean(axis=0) if len(near) else np.zeros(3)

    @property
    def _rotation(self) -> LocalRotation:
        """The rotation shortly before and after the frame."""
        if self._local_rotation is None:
            self._local_rotation = LocalRotation.of(*self._increments, self._gyro_bias_rad_s)
        return self._local_rotation

    @property
    def angular_velocity_rad_s(self) -> Array:
        """(3,) Angular velocity of the IMU at the frame, bias removed [rad/s]."""
        if self._angular_velocity_rad_s is None:
            self._angular_velocity_rad_s = _angular_velocity(*self._increments, self._gyro_bias_rad_s)
        return self._angular_velocity_rad_s

    def at_frame_time(self, observations: Observations, calibration: Calibration) -> Observations:
        """Return the observations of a frame as they are at the time of the frame.

        A feature that is observed for the first time has no flow, and is left out if its delay is not zero, as are its
        matches: a flow that is interpolated from neighbouring features causes scale errors of 1 %.

        The method may be called again for the same frame, with new features or with matches in further cameras.
        """
        is_delayed = calibration.readouts_s.any() or self._camera_delays_s(calibration).any()
        if not is_delayed and calibration.time_offset_correction_s == 0.0:
            rays = np.column_stack([observations.xy, np.ones(len(observations))])
            self._now = _Exposed(observations.ids, observations.camera, np.zeros(len(observations)), rays)
            return observations
        delay_s, rays, flow = self._moving(calibration, observations)
        self._now = self._with_unseen(_Exposed(observations.ids, observations.camera, delay_s, rays), calibration)
        kept = np.isfinite(flow[:, 0]) | (delay_s == 0.0)
        xy = rays[:, :2] - _displacement(delay_s, flow)
        names = {f.name for f in fields(observations)} - {"xy", "matches", "miscalibrated"}
        others = {name: getattr(observations, name)[kept] for name in names}
        matches, miscalibrated = (
            self._matches_at_frame_time(calibration, matches, observations, rays, flow)
            for matches in (observations.matches, observations.miscalibrated)
        )
        return Observations(**others, xy=xy[kept], matches=matches, miscalibrated=miscalibrated)

    def at_exposure_of(self, camera: int, observations: Observations, calibration: Calibration) -> Array:
        """Return the coordinates (N, 2) that features have when another camera of the rig is exposed.

        They are those of the middle rows: cameras with rolling shutters expose equal rows one after another. A feature
        that is observed for the first time is moved by the rotation alone.

        Args:
            camera: Index of the other camera.
            observations: The features of the frame, with N rows.
            calibration: The calibration in use.
        """
        delays_s = self._camera_delays_s(calibration)
        later_s = delays_s[camera] - delays_s[observations.camera]
        if not later_s.any():
            return observations.xy
        delay_s, rays, flow = self._moving(calibration, observations)
        xy = rays[:, :2] + later_s[:, None] * np.nan_to_num(flow)
        return self._rotated(calibration, observations.camera, xy, delay_s + later_s, inverse=True)[:, :2]

    def at_time(self, estimate: Estimate, t_ns: int) -> Estimate:
        """Return the estimate of a frame at another time by the IMU's clock, such as that which its time stamp states.

        The times differ by the rig's time offset and by the error of the stamp. The rotation is exact; position and
        velocity are of third order in the difference.
        """
        state, by_s = estimate.state, (t_ns - estimate.t_ns) * 1e-9
        if by_s == 0.0:
            return estimate
        if state is None:
            return replace(estimate, t_ns=t_ns)
        R = state.T_world_imu[:3, :3]
        accel = R @ (self._accel_m_s2 - state.accel_bias_m_s2) - [0.0, 0.0, self._gravity_m_s2]
        p = state.T_world_imu[:3, 3] + by_s * state.velocity_m_s + 0.5 * by_s**2 * accel
        R_then = R @ exp_so3(self._rotation.at(np.array([by_s])))[0]
        state = replace(
            state,
            t_ns=t_ns,
            T_world_imu=pose_matrix(R_then, p),
            velocity_m_s=state.velocity_m_s + by_s * accel,
        )
        return replace(estimate, t_ns=t_ns, state=state)

    def _camera_delays_s(self, calibration: Calibration) -> Array:
        """Return the delays (C,) of the cameras' middle rows relative to the frame, if the clock is right [s]."""
        return self._image_delays_s + calibration.camera_offsets_s

    def _delays_s(self, calibration: Calibration, camera: Integers, row_px: Array) -> Array:
        """Return the exposure times (N,) of image rows (N,) relative to the time of the frame [s]."""
        last_row = np.array([c.model.height - 1 for c in calibration.rig.cameras])[camera]
        of_row = (row_px / last_row - 0.5) * calibration.readouts_s[camera]
        of_camera = self._camera_delays_s(calibration)[camera]
        return np.asarray(of_row + of_camera + calibration.time_offset_correction_s)

    def _moving(self, calibration: Calibration, observations: Observations) -> tuple[Array, Array, Array]:
        """Return the delays (N,), the rays (N, 3) corrected for rotation, and the flows (N, 2) of observations."""
        delay_s = self._delays_s(calibration, observations.camera, observations.pixels[:, 1])
        rays = self._rotated(calibration, observations.camera, observations.xy, delay_s)
        return delay_s, rays, self._flows(calibration, observations, delay_s, rays)

    def _rotated(
        self, calibration: Calibration, camera: Integers, xy: Array, delay_s: Array, inverse: bool = False
    ) -> Array:
        """Return rays (N, 3) at depth 1 in the camera frames at the time of the frame, corrected for rotation.

        The inverse returns the rays at the exposures from those at the time of the frame.
        """
        R_imu_cam = calibration.Ts_imu_cam[camera, :3, :3] * (-1.0 if inverse else 1.0)
        rotation_cam = np.einsum("nij,ni->nj", R_imu_cam, self._rotation.at(delay_s))
        rays = np.column_stack([xy, np.ones(len(xy))])
        rays = np.einsum("nij,nj->ni", exp_so3(rotation_cam), rays)
        return np.asarray(rays / rays[:, 2:])

    def _flows(self, calibration: Calibration, observations: Observations, delay_s: Array, rays: Array) -> Array:
        """Return the flows (N, 2) due to translation [1/s]; NaN for features that are observed for the first time."""
        flow, last = np.full((len(observations), 2), np.nan), self._last
        i, j = common_rows(observations.ids, last.ids)
        if not len(i):
            return flow
        before = np.einsum("nij,nj->ni", self._Rs_now_last(calibration)[observations.camera[i]], last.rays[j])
        elapsed_s = np.maximum(self._frame_interval_s + delay_s[i] - last.delay_s[j], MIN_FLOW_INTERVAL_S)
        flow[i] = (rays[i, :2] - before[:, :2] / before[:, 2:]) / elapsed_s[:, None]
        return flow

    def _Rs_now_last(self, calibration: Calibration) -> Array:
        """Return the rotations (C, 3, 3) of the cameras from the time of the last frame to that of the frame."""
        rotation_imu = self._rotation.at(np.array([-self._frame_interval_s]))[0]
        return exp_so3(rotation_imu @ calibration.Ts_imu_cam[:, :3, :3])

    def _with_unseen(self, now: _Exposed, calibration: Calibration) -> _Exposed:
        """Return observations of the frame with the last ones of the cameras that have none in it, at its time."""
        last = self._last
        delay_s = last.delay_s - self._frame_interval_s
        kept = ~np.isin(last.camera, now.camera) & (delay_s > -MAX_GAP_S)
        if not kept.any():
            return now
        camera = last.camera[kept]
        rays = np.einsum("nij,nj->ni", self._Rs_now_last(calibration)[camera], last.rays[kept])
        ids = np.concatenate([now.ids, last.ids[kept]])
        order = np.argsort(ids)
        return _Exposed(
            ids[order],
            np.concatenate([now.camera, camera])[order],
            np.concatenate([now.delay_s, delay_s[kept]])[order],
            np.concatenate([now.rays, rays / rays[:, 2:]])[order],
        )

    def _matches_at_frame_time(
        self, calibration: Calibration, matches: Matches, observations: Observations, rays: Array, flow: Array
    ) -> Matches:
        """Return the matches at the time of the frame; the landmark's flow is that of the camera that tracks it."""
        if not len(matches):
            return matches
        row = np.searchsorted(observations.ids, matches.ids)
        xy1 = np.column_stack([matches.xy, np.ones(len(matches))])
        row_px = np.empty(len(matches))
        for index, camera in enumerate(calibration.rig.cameras):
            mine = matches.camera == index
            row_px[mine] = camera.model.project(xy1[mine])[:, 1]
        delay_s = self._delays_s(calibration, matches.camera, row_px)
        here = self._rotated(calibration, matches.camera, matches.xy, delay_s)
        R_imu_cam = calibration.Ts_imu_cam[:, :3, :3]
        R_there = np.swapaxes(R_imu_cam[matches.camera], 1, 2) @ R_imu_cam[observations.camera[row]]
        drift = np.einsum("nij,nj->ni", R_there[..., :2], flow[row])
        depth = np.einsum("nj,nj->n", R_there[:, 2], rays[row])
        xy = here[:, :2] - _displacement(delay_s, (drift[:, :2] - here[:, :2] * drift[:, 2:]) / depth[:, None])
        kept = np.isfinite(xy[:, 0])
        return replace(matches, ids=matches.ids[kept], camera=matches.camera[kept], xy=xy[kept])


def _angular_velocity(before: Increments, after: Increments, gyro_bias_rad_s: Array) -> Array:
    """Return the mean angular velocity (3,) around a frame [rad/s]; where nothing is measured, the nearest is held.

    Args:
        before: Increments that end at the frame.
        after: Increments that begin at the frame, as far as they are available.
        gyro_bias_rad_s: (3,) Gyroscope bias [rad/s].
    """
    sides = (before.dt_s[::-1], before.gyro_rad_s[::-1]), (after.dt_s, after.gyro_rad_s)  # from the frame outwards
    nearest = [gyro[0] for _, gyro in sides if len(gyro)]
    if not nearest:
        return np.zeros(3)
    angle_rad = np.zeros(3)
    for (dt_s, gyro), held in zip(sides, (nearest[0], nearest[-1]), strict=True):
        within_s = np.diff(np.minimum(np.cumsum(dt_s), ANGULAR_VELOCITY_SPAN_S), prepend=0.0)
        farthest = gyro[-1] if len(gyro) else held
        angle_rad += within_s @ gyro + (ANGULAR_VELOCITY_SPAN_S - within_s.sum()) * farthest
    return angle_rad / (2.0 * ANGULAR_VELOCITY_SPAN_S) - gyro_bias_rad_s


def _displacement(delay_s: Array, flow: Array) -> Array:
    """Return the displacements (N, 2) by flows (N, 2) [1/s] within delays (N,) [s]; zero without a delay."""
    return np.where(delay_s[:, None] == 0.0, 0.0, delay_s[:, None] * flow)
