"""When things were seen: moves sightings from the instant of their exposure to the time of their frame.

A rolling shutter exposes each row at a time of its own, and the clocks of camera and IMU may differ. A sighting that is
late by τ is moved back along the feature's path in the image (Qin and Shen, "Online temporal calibration for monocular
visual-inertial systems", IROS 2018): by the turn of the camera within τ, which the gyroscope knows, and by what the
camera's translation adds, at the velocity that the feature's last two sightings show. The error is of second order in
τ, and of the translation alone: ½ a/z τ (τ + Δt) for an acceleration a at the depth z and a time Δt between frames.
"""

from dataclasses import dataclass, fields, replace
from itertools import accumulate

import numpy as np
import numpy.typing as npt

from dronevio.estimator.imu.buffer import Increments
from dronevio.estimator.types import Matches, Observations
from dronevio.models.imu import GRAVITY_M_S2
from dronevio.models.rig import Rig
from dronevio.models.rotation import exp_so3, log_so3, pose_matrix
from dronevio.models.state import Estimate

Array = npt.NDArray[np.float64]
Rows = npt.NDArray[np.int64]

EXTRAPOLATED_S = 0.1  # how far beyond the known motion the rate of turn is held [s]; no readout is longer
SMOOTHED = 4  # samples on each side whose mean is the acceleration at a frame: rotors shake it
RATE_OVER_S = 0.005  # before and after a frame, about one interval of the IMU [s]
MIN_AGE_S = 1e-3  # two sightings nearer in time than this tell no velocity [s]


@dataclass(frozen=True, eq=False)
class NearbyTurn:
    """How the IMU turned just before and after a frame."""

    t_s: Array
    """(K,) Instants relative to the frame's [s], increasing, 0 among them."""
    turn_rad: Array
    """(K, 3) Rotation vectors of R_frame_then [rad]: from the IMU's axes then to those at the frame."""

    @classmethod
    def of(cls, before: Increments, after: Increments, gyro_bias_rad_s: Array) -> "NearbyTurn":
        """Sum up the gyroscope's increments on both sides of a frame; beyond them, the rate is held.

        Args:
            before: Increments that end at the frame.
            after: Increments that begin there; none if there are none yet.
            gyro_bias_rad_s: (3,) What the gyroscope reads too much [rad/s].
        """
        rates_before, rates_after = before.gyro_rad_s - gyro_bias_rad_s, after.gyro_rad_s - gyro_bias_rad_s
        first = rates_before[:1] if len(rates_before) else rates_after[:1]
        last = rates_after[-1:] if len(rates_after) else rates_before[-1:]
        held = np.full(min(len(first), 1), EXTRAPOLATED_S)
        past_s, past = np.append(before.dt_s[::-1], held), np.vstack([rates_before[::-1], first])
        future_s, future = np.append(after.dt_s, held), np.vstack([rates_after, last])
        t_s = np.concatenate([-np.cumsum(past_s)[::-1], [0.0], np.cumsum(future_s)])
        turns = np.vstack(
            [_summed(-past * past_s[:, None])[::-1], np.zeros((1, 3)), _summed(future * future_s[:, None])]
        )
        return cls(t_s, turns)

    def at(self, t_s: Array) -> Array:
        """Return the rotation vectors (N, 3) of R_frame_then [rad] at instants (N,) relative to the frame's [s]."""
        return np.stack([np.interp(t_s, self.t_s, axis) for axis in self.turn_rad.T], axis=-1)


@dataclass(frozen=True, eq=False)
class _Seen:
    """The sightings of a frame, in increasing order of their identities."""

    ids: Rows  # (N,)
    late_s: Array  # (N,) how much later than the frame each was exposed
    rays: Array  # (N, 3) to depth 1, in the camera's axes at the frame


class FrameTimes:
    """Knows when the rows of a frame were exposed, and moves what they show to one time by the IMU's clock.

    All that is estimated is on the IMU's clock. Inside, a frame is at the exposure of its middle row, where the rig's
    known time offset puts it; what is told of it in the end is the state when the IMU's clock showed its time stamp.
    """

    def __init__(self, rig: Rig) -> None:
        """Prepare for a rig."""
        self._cameras, self._known_offset_s = rig.cameras, rig.time_offset_s
        self._Rs_imu_cam = np.stack([camera.T_imu_cam[:3, :3] for camera in rig.cameras])
        self._readouts_s = np.array([camera.readout_s for camera in rig.cameras])
        self.late_s = 0.0
        """How much later than that the middle row was exposed in truth [s]: what the known offset lacks."""
        self._turn = NearbyTurn(np.zeros(1), np.zeros((1, 3)))
        self._accel_m_s2 = np.zeros(3)
        self._since_last_s = 0.0
        self._now = self._last = _Seen(np.zeros(0, np.int64), np.zeros(0), np.zeros((0, 3)))

    def imu_time_ns(self, stamp_ns: int) -> int:
        """Return the time of a frame by the IMU's clock [ns]."""
        return stamp_ns + round(self._known_offset_s * 1e9)

    @property
    def reach_s(self) -> float:
        """How far after a frame's time it may have seen something, or be told of [s]."""
        return float(max(0.5 * self._readouts_s.max() + self.late_s, -self._known_offset_s, 0.0))

    def begin(self, before: Increments, after: Increments, gyro_bias_rad_s: Array) -> None:
        """Begin a frame.

        Args:
            before: The IMU since the frame before.
            after: The IMU after it, `reach_s` long or as long as it is known.
            gyro_bias_rad_s: (3,) What the gyroscope reads too much [rad/s].
        """
        self._last, self._since_last_s = self._now, float(before.dt_s.sum())
        self._turn = NearbyTurn.of(before, after, gyro_bias_rad_s)
        near = np.vstack([before.accel_m_s2[-SMOOTHED:], after.accel_m_s2[:SMOOTHED]])
        self._accel_m_s2 = near.mean(axis=0) if len(near) else np.zeros(3)

    @property
    def rate_rad_s(self) -> Array:
        """(3,) How fast the IMU turns at the frame [rad/s]."""
        step_s = np.array([-RATE_OVER_S, RATE_OVER_S])
        return np.asarray(np.diff(self._turn.at(step_s), axis=0)[0] / (2.0 * RATE_OVER_S))

    def moved(self, seen: Observations) -> Observations:
        """Return what a frame shows as it was at the frame's time.

        A feature that is seen for the first time shows no velocity, and is left out if it has to be moved: guessed from
        its neighbours, the velocity of a new corner makes the path 1 % too large or too small.

        It may be asked more than once for a frame: with new features, or with other cameras' sightings of them.
        """
        if not self._readouts_s.any() and self.late_s == 0.0:
            self._now = _Seen(seen.ids, np.zeros(len(seen)), np.column_stack([seen.xy, np.ones(len(seen))]))
            return seen
        cameras, late_s = seen.camera, self._late_s(seen.camera, seen.pixels[:, 1])
        rays = self._turned(cameras, seen.xy, late_s)
        velocity = self._velocities(seen, late_s, rays)
        self._now = _Seen(seen.ids, late_s, rays)
        kept = np.isfinite(velocity[:, 0])
        xy = rays[:, :2] - late_s[:, None] * velocity
        others = {
            f.name: getattr(seen, f.name)[kept]
            for f in fields(seen)
            if f.name not in ("xy", "matches", "miscalibrated")
        }
        matches, miscalibrated = (
            self._moved_matches(m, seen, rays, velocity) for m in (seen.matches, seen.miscalibrated)
        )
        return Observations(**others, xy=xy[kept], matches=matches, miscalibrated=miscalibrated)

    def stamped(self, estimate: Estimate, stamp_ns: int) -> Estimate:
        """Return what is told of a frame, with its time stamp, and its state carried there over the known offset.

        That is exact in the rotation, and of third order in the offset else.
        """
        state, by_s = estimate.state, -self._known_offset_s
        if by_s == 0.0:
            return estimate
        if state is None:
            return replace(estimate, t_ns=stamp_ns)
        R = state.T_world_imu[:3, :3]
        accel = R @ (self._accel_m_s2 - state.accel_bias_m_s2) - [0.0, 0.0, GRAVITY_M_S2]
        p = state.T_world_imu[:3, 3] + by_s * state.velocity_m_s + 0.5 * by_s**2 * accel
        turned = R @ exp_so3(self._turn.at(np.array([by_s])))[0]
        state = replace(
            state,
            t_ns=stamp_ns,
            T_world_imu=pose_matrix(turned, p),
            velocity_m_s=state.velocity_m_s + by_s * accel,
        )
        return replace(estimate, t_ns=stamp_ns, state=state)

    def _late_s(self, camera: Rows, row_px: Array) -> Array:
        """Return how much later than the frame's time rows (N,) of some cameras' images are exposed [s]."""
        last_row = np.array([c.model.height - 1 for c in self._cameras])[camera]
        return np.asarray((row_px / last_row - 0.5) * self._readouts_s[camera] + self.late_s)

    def _turned(self, camera: Rows, xy: Array, late_s: Array) -> Array:
        """Return rays (N, 3), cut at depth 1, as they are in the cameras' axes at the frame."""
        turn_cam = np.einsum("nij,ni->nj", self._Rs_imu_cam[camera], self._turn.at(late_s))
        rays = np.column_stack([xy, np.ones(len(xy))])
        rays = np.einsum("nij,nj->ni", exp_so3(turn_cam), rays)
        return np.asarray(rays / rays[:, 2:])

    def _velocities(self, seen: Observations, late_s: Array, rays: Array) -> Array:
        """Return (N, 2) how fast each feature moves by the camera's translation [1/s]; NaN where seen only once."""
        velocity, last = np.full((len(seen), 2), np.nan), self._last
        _, i, j = np.intersect1d(seen.ids, last.ids, assume_unique=True, return_indices=True)
        if not len(i):
            return velocity
        # R_now_last of the cameras is the turn back to the last frame's time
        turn_imu = np.broadcast_to(self._turn.at(np.array([-self._since_last_s])), (len(i), 3))
        turn_cam = np.einsum("nij,ni->nj", self._Rs_imu_cam[seen.camera[i]], turn_imu)
        before = np.einsum("nij,nj->ni", exp_so3(turn_cam), last.rays[j])
        elapsed_s = np.maximum(self._since_last_s + late_s[i] - last.late_s[j], MIN_AGE_S)
        velocity[i] = (rays[i, :2] - before[:, :2] / before[:, 2:]) / elapsed_s[:, None]
        return velocity

    def _moved_matches(self, matches: Matches, seen: Observations, rays: Array, velocity: Array) -> Matches:
        """Return the sightings by further cameras; the landmark moves there as it does where it is followed."""
        if not len(matches):
            return matches
        row = np.searchsorted(seen.ids, matches.ids)
        xy1 = np.column_stack([matches.xy, np.ones(len(matches))])
        row_px = np.empty(len(matches))
        for index, camera in enumerate(self._cameras):
            mine = matches.camera == index
            row_px[mine] = camera.model.project(xy1[mine])[:, 1]
        late_s = self._late_s(matches.camera, row_px)
        here = self._turned(matches.camera, matches.xy, late_s)
        R_there = np.swapaxes(self._Rs_imu_cam[matches.camera], 1, 2) @ self._Rs_imu_cam[seen.camera[row]]
        drift = np.einsum("nij,nj->ni", R_there[..., :2], velocity[row])
        depth = np.einsum("nj,nj->n", R_there[:, 2], rays[row])
        xy = here[:, :2] - late_s[:, None] * (drift[:, :2] - here[:, :2] * drift[:, 2:]) / depth[:, None]
        kept = np.isfinite(xy[:, 0])
        return replace(matches, ids=matches.ids[kept], camera=matches.camera[kept], xy=xy[kept])


def _summed(steps_rad: Array) -> Array:
    """Return the rotation vectors (K, 3) of products of the first 1 … K of some small turns (K, 3)."""
    turns = list(accumulate(exp_so3(steps_rad), np.matmul))
    return log_so3(np.array(turns)) if turns else np.zeros((0, 3))
