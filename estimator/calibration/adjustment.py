"""A bundle adjustment of one window of keyframes with their IMU, in which the calibration is unknown too.

All at once, by Gauss-Newton: the keyframes' poses and velocities, the IMU's biases, the landmarks, and what is asked of
the calibration. Landmarks are eliminated (Triggs et al., "Bundle adjustment: a modern synthesis", 1999), and what the
window alone says of the rest is known with all that it leaves open: where the motion does not show a part of the
calibration, that part keeps what was known of it before.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
import numpy.typing as npt
from scipy.linalg import cho_factor, cho_solve

from dronevio.estimator.backend.triangulation import MIN_DEPTH_M, triangulate
from dronevio.estimator.calibration.corrections import PER_CAMERA, Corrections
from dronevio.estimator.calibration.imu_factor import CalibrationImuFactor
from dronevio.models.rotation import exp_so3, log_so3, skew
from dronevio.models.state import NavState

Array = npt.NDArray[np.float64]
Rows = npt.NDArray[np.int64]

GAUGE_SIGMA_M = 1e-3  # of the first keyframe's place, which nothing tells [m]
ROBUST_SIGMAS = 2.4  # residuals beyond lose weight (Cauchy's loss at 95 % efficiency, Huber 1981)
_STATE = 9  # δθ, δp, δv of a keyframe


@dataclass(frozen=True, eq=False)
class WindowKeyframe:
    """A keyframe of a window."""

    state: NavState
    """Where the IMU is believed to be."""
    rate_rad_s: Array
    """(3,) How fast it turns, bias taken out [rad/s]."""
    time_offset_s: float
    """By how much its sightings were believed to be late, and moved [s]."""
    preintegrated: gtsam.PreintegratedCombinedMeasurements | None
    """The IMU since the keyframe before; None for the first."""
    ids: Rows
    """(N,) Landmarks that it sees."""
    camera: Rows
    """(N,) By which camera."""
    xy: Array
    """(N, 2) Where, normalized, by the rig's calibration without corrections."""


@dataclass(frozen=True)
class AdjustmentConfig:
    """Settings of the adjustment."""

    pixel_sigma: float = 0.8
    """Standard deviation of a sighting [px]."""
    min_views: int = 4
    """Keyframes that must have seen a landmark."""
    min_parallax_deg: float = 0.5
    """Angle under which it must have been seen [°]."""
    max_reprojection_px: float = 15.0
    """A landmark whose sightings are further off than this at first is left out [px]."""
    max_landmarks: int = 150
    """Those that were seen most often."""
    rounds: int = 3
    """Steps of Gauss-Newton."""
    tilt_sigma_rad: float = 0.1
    """What is known beforehand of the first keyframe's orientation [rad] ..."""
    velocity_sigma_m_s: float = 0.5
    """... of its velocity [m/s] ..."""
    gyro_bias_sigma_rad_s: float = 0.01
    """... and of the biases [rad/s] ..."""
    accel_bias_sigma_m_s2: float = 0.2
    """... [m/s²]: little, so that a window says the same whatever was believed before."""


@dataclass(frozen=True, eq=False)
class AdjustmentResult:
    """What a window says of the calibration, together with what was known before."""

    mean: Array
    """(D,) Corrections."""
    information: Array
    """(D, D) Inverse of their covariance."""
    rms_px: float
    """Root mean square reprojection error [px], outliers hardly counted."""


@dataclass(frozen=True, eq=False)
class _Sightings:
    """Flat sightings of a window, those of one landmark side by side."""

    keyframe: Rows
    camera: Rows
    landmark: Rows
    xy: Array


class CalibrationProblem:
    """The unknowns of a window, moved by one Gauss-Newton step after another."""

    def __init__(
        self,
        keyframes: Sequence[WindowKeyframe],
        Ts_imu_cam: Array,
        focal_px: float,
        config: AdjustmentConfig,
        mean: Array,
        information: Array,
        estimated: npt.NDArray[np.bool_],
    ) -> None:
        """Arrange a window.

        Args:
            keyframes: In time order, two at least.
            Ts_imu_cam: (C, 4, 4) Poses of the cameras, without corrections.
            focal_px: Focal length [px].
            config: Settings.
            mean: (D,) What was known of the corrections before.
            information: (D, D) How well: the inverse covariance.
            estimated: (D,) Which of them are unknown, and independent of the others.
        """
        self._config, self._sigma = config, config.pixel_sigma / focal_px
        self._Ts_imu_cam = Ts_imu_cam
        self._prior_mean, self._prior_information = mean, information
        self._c, self._unknown = mean.copy(), np.flatnonzero(estimated)
        states = [keyframe.state for keyframe in keyframes]
        self._R = np.stack([state.T_world_imu[:3, :3] for state in states])
        self._p = np.stack([state.T_world_imu[:3, 3] for state in states])
        self._v = np.stack([state.velocity_m_s for state in states])
        self._rates = np.stack([keyframe.rate_rad_s for keyframe in keyframes])
        self._time_offsets_s = np.array([keyframe.time_offset_s for keyframe in keyframes])
        last = states[-1]
        self._bias = np.concatenate([last.gyro_bias_rad_s, last.accel_bias_m_s2])
        self._first = self._R[0].copy(), self._v[0].copy(), self._bias.copy()
        self._intervals = [
            CalibrationImuFactor.of(k.preintegrated, self._bias) for k in keyframes[1:] if k.preintegrated
        ]
        self._seen, self._points = self._select(keyframes, focal_px)
        self._focal_px, self._rms_px, self._steps = focal_px, float("inf"), 0
        self.is_done = False
        """Whether there is no further step to take."""
        self.result: AdjustmentResult | None = None
        """What came of it; None before the end, and where the problem has no solution."""

    @property
    def landmarks(self) -> int:
        """How many landmarks take part."""
        return len(self._points)

    def step(self) -> None:
        """Take a step, a third of the work or so."""
        self._steps += 1
        information = self._step()
        self.is_done = information is None or self._steps >= self._config.rounds
        if self.is_done and information is not None:
            self.result = AdjustmentResult(self._c, information, self._rms_px)

    def _select(self, keyframes: Sequence[WindowKeyframe], focal_px: float) -> tuple[_Sightings, Array]:
        """Take the landmarks that are worth it, and triangulate them."""
        c = self._config
        ids = np.concatenate([k.ids for k in keyframes])
        camera, xy = np.concatenate([k.camera for k in keyframes]), np.concatenate([k.xy for k in keyframes])
        index = np.repeat(np.arange(len(keyframes)), [len(k.ids) for k in keyframes])
        order = np.argsort(ids, kind="stable")
        ids, camera, xy, index = ids[order], camera[order], xy[order], index[order]
        _, landmark, counts = np.unique(ids, return_inverse=True, return_counts=True)
        if not len(ids):
            return _Sightings(index, camera, landmark, xy), np.zeros((0, 3))
        enough = counts >= c.min_views
        seen = _renumbered(_Sightings(index, camera, landmark, xy), enough)
        if not enough.any():
            return seen, np.zeros((0, 3))
        Rs, ps = self._camera_poses(seen)
        found = triangulate(_starts(seen.landmark), Rs, ps, self._uncorrected(seen))
        good = (
            found.in_front
            & (found.parallax_rad > np.radians(c.min_parallax_deg))
            & (found.rms < c.max_reprojection_px / focal_px)
        )
        counts = np.bincount(seen.landmark)
        by_count = np.sort(counts[good])[::-1]
        if len(by_count) > c.max_landmarks:
            good &= counts >= by_count[c.max_landmarks - 1]
        return _renumbered(seen, good), found.points[good]

    def _camera_poses(self, seen: _Sightings) -> tuple[Array, Array]:
        """Return the orientation and place of the camera at each sighting."""
        corrections, k = Corrections.from_vector(self._c), seen.keyframe
        delay_s = (corrections.time_offset_s - self._time_offsets_s)[k, None]
        R_imu = self._R[k] @ exp_so3(self._rates[k] * delay_s)
        p_imu = self._p[k] + self._v[k] * delay_s
        R_ic = (self._Ts_imu_cam[:, :3, :3] @ exp_so3(corrections.rotation_rad))[seen.camera]
        t_ic = (self._Ts_imu_cam[:, :3, 3] + corrections.translation_m)[seen.camera]
        return R_imu @ R_ic, p_imu + np.einsum("nij,nj->ni", R_imu, t_ic)

    def _uncorrected(self, seen: _Sightings) -> Array:
        corrections = Corrections.from_vector(self._c)
        return np.asarray((seen.xy - corrections.principal[seen.camera]) / (1.0 + corrections.focal[seen.camera]))

    def _step(self) -> Array | None:
        """Solve the linearized problem, move there, and return the information on the corrections."""
        K, D = len(self._R), len(self._unknown)
        n = _STATE * K + 6
        H, g = np.zeros((n + D, n + D)), np.zeros(n + D)
        self._add_prior(H, g, n)
        self._add_motion(H, g)
        pull = self._add_sightings(H, g, n)
        try:
            factor = cho_factor(H)
            x = cho_solve(factor, g)
            pulled = cho_solve(factor, np.eye(n + D)[:, n:])[n:]
        except np.linalg.LinAlgError:
            return None
        self._points = self._points + pull(x)
        states = x[: _STATE * K].reshape(K, _STATE)
        self._R = self._R @ exp_so3(states[:, :3])
        self._p, self._v = self._p + states[:, 3:6], self._v + states[:, 6:]
        self._bias = self._bias + x[n - 6 : n]
        self._c[self._unknown] += x[n:]
        information = self._prior_information.copy()
        information[np.ix_(self._unknown, self._unknown)] = np.linalg.inv(pulled)
        return information

    def _add_prior(self, H: Array, g: Array, n: int) -> None:
        """Add what is known beforehand: of the corrections, of the first keyframe and of the biases."""
        c, (R, v, bias) = self._config, self._first
        known = self._prior_information[np.ix_(self._unknown, self._unknown)]
        H[n:, n:] += known
        g[n:] += known @ (self._prior_mean - self._c)[self._unknown]
        sigmas = [c.tilt_sigma_rad, GAUGE_SIGMA_M, c.velocity_sigma_m_s]
        weights = np.repeat(np.array(sigmas) ** -2.0, 3)
        off = np.concatenate([log_so3(self._R[0].T @ R), np.zeros(3), v - self._v[0]])
        H[range(_STATE), range(_STATE)] += weights
        g[:_STATE] += weights * off
        weights = np.repeat(np.array([c.gyro_bias_sigma_rad_s, c.accel_bias_sigma_m_s2]) ** -2.0, 3)
        rows = range(n - 6, n)
        H[rows, rows] += weights
        g[n - 6 : n] += weights * (bias - self._bias)

    def _add_motion(self, H: Array, g: Array) -> None:
        """Add the IMU between the keyframes (Forster et al. 2017, eq. 45)."""
        n = _STATE * len(self._R) + 6
        bias_rows = np.arange(n - 6, n)
        for i, interval in enumerate(self._intervals):
            r, J = interval.residual(
                self._R[i : i + 2], self._p[i : i + 2], self._v[i : i + 2], self._bias - self._first[2]
            )
            rows = np.concatenate([np.arange(_STATE * i, _STATE * (i + 2)), bias_rows])
            weighted = J.T @ interval.information
            H[np.ix_(rows, rows)] += weighted @ J
            g[rows] -= weighted @ r

    def _add_sightings(self, H: Array, g: Array, n: int) -> Callable[[Array], Array]:
        """Add the sightings, landmarks eliminated; return what gives their displacements (L, 3) after the step."""
        seen, L, K, D = self._seen, len(self._points), len(self._R), len(self._unknown)
        if L == 0:
            return lambda x: np.zeros((0, 3))
        r, J_pose, J_landmark, J_c = self._linearized()
        error = np.linalg.norm(r, axis=1)
        trust = 1.0 / (1.0 + (error / (ROBUST_SIGMAS * self._sigma)) ** 2)
        self._rms_px = float(np.sqrt(np.average(error**2, weights=trust))) * self._focal_px
        weight = trust / self._sigma**2
        Jw_pose, Jw_landmark, Jw_c = (np.swapaxes(J, 1, 2) * weight[:, None, None] for J in (J_pose, J_landmark, J_c))
        starts = _starts(seen.landmark)
        H_ll = np.add.reduceat(Jw_landmark @ J_landmark, starts)
        g_l = np.add.reduceat((Jw_landmark @ r[..., None])[..., 0], starts)
        of_pose = np.zeros((K, 6, 6 + D + 1))
        order = np.argsort(seen.keyframe, kind="stable")
        first = np.flatnonzero(np.diff(seen.keyframe[order], prepend=-1))
        across = Jw_pose @ np.concatenate([J_pose, J_c, r[..., None]], axis=2)
        of_pose[seen.keyframe[order[first]]] = np.add.reduceat(across[order], first)
        H_pp, H_pc, g_p = of_pose[..., :6], of_pose[..., 6:-1], of_pose[..., -1]
        H_lp = np.zeros((L, K, 3, 6))
        for camera in range(len(self._Ts_imu_cam)):  # one camera of one keyframe sees a landmark once
            here = np.flatnonzero(seen.camera == camera)
            H_lp[seen.landmark[here], seen.keyframe[here]] += Jw_landmark[here] @ J_pose[here]
        H_lc = np.add.reduceat(Jw_landmark @ J_c, starts)
        poses = (_STATE * np.arange(K)[:, None] + np.arange(6)).ravel()
        rows = np.concatenate([poses, np.arange(n, n + D)])
        H_lx = np.concatenate([np.swapaxes(H_lp, 1, 2).reshape(L, 3, 6 * K), H_lc], axis=2)
        root = np.linalg.cholesky(H_ll + 1e-9 * np.trace(H_ll, axis1=1, axis2=2)[:, None, None] * np.eye(3))
        half = np.linalg.solve(root, np.concatenate([H_lx, g_l[..., None]], axis=2)).reshape(3 * L, -1)
        H[np.ix_(rows, rows)] -= half[:, :-1].T @ half[:, :-1]
        g[rows] -= half[:, :-1].T @ half[:, -1]
        for k in range(K):
            own = slice(_STATE * k, _STATE * k + 6)
            H[own, own] += H_pp[k]
            H[own, n:] += H_pc[k]
            H[n:, own] += H_pc[k].T
            g[own] += g_p[k]
        H[n:, n:] += np.tensordot(Jw_c, J_c, axes=([0, 2], [0, 1]))
        g[n:] += np.tensordot(Jw_c, r, axes=([0, 2], [0, 1]))

        def displacements(x: Array) -> Array:
            left = half.reshape(L, 3, -1)
            return np.linalg.solve(np.swapaxes(root, 1, 2), (left[..., -1] - left[..., :-1] @ x[rows])[..., None])[
                ..., 0
            ]

        return displacements

    def _linearized(self) -> tuple[Array, Array, Array, Array]:
        """Return residuals (N, 2) and what moves the projections: pose (N, 2, 6), landmark (N, 2, 3), unknowns."""
        seen, corrections = self._seen, Corrections.from_vector(self._c)
        k, camera = seen.keyframe, seen.camera
        delay_s = (corrections.time_offset_s - self._time_offsets_s)[k, None]
        turn_back = exp_so3(-self._rates[k] * delay_s)
        R_world_imu, v = self._R[k], self._v[k]
        q = np.einsum("nji,nj->ni", R_world_imu, self._points[seen.landmark] - self._p[k] - v * delay_s)
        p_imu = np.einsum("nij,nj->ni", turn_back, q)
        R_cam_imu = np.swapaxes(self._Ts_imu_cam[:, :3, :3] @ exp_so3(corrections.rotation_rad), 1, 2)[camera]
        p_cam = np.einsum(
            "nij,nj->ni", R_cam_imu, p_imu - (self._Ts_imu_cam[:, :3, 3] + corrections.translation_m)[camera]
        )
        depth = np.maximum(p_cam[:, 2], MIN_DEPTH_M)
        z, focal = p_cam[:, :2] / depth[:, None], 1.0 + corrections.focal[camera]
        r = seen.xy - focal * z - corrections.principal[camera]
        A = np.zeros((len(k), 2, 3))
        A[:, 0, 0] = A[:, 1, 1] = 1.0
        A[:, :, 2] = -z
        A *= (focal / depth[:, None])[:, :, None]
        AR = A @ R_cam_imu
        M = AR @ turn_back
        J_landmark = M @ np.swapaxes(R_world_imu, 1, 2)
        J_pose = np.concatenate([M @ skew(q), -J_landmark], axis=2)
        J_c = np.zeros((len(k), 2, len(self._c)))
        drift = np.cross(p_imu, self._rates[k]) - np.einsum("nji,nj->ni", R_world_imu, v)
        J_c[:, :, 0] = np.einsum("nij,nj->ni", AR, drift)
        own = np.zeros((len(k), 2, PER_CAMERA))
        own[:, :, 0:3], own[:, :, 3:6] = A @ skew(p_cam), -AR
        own[:, 0, 6], own[:, 1, 7] = z.T
        own[:, 0, 8] = own[:, 1, 9] = 1.0
        columns = 1 + PER_CAMERA * camera[:, None] + np.arange(PER_CAMERA)
        np.put_along_axis(J_c, columns[:, None, :].repeat(2, axis=1), own, axis=2)
        return r, J_pose, J_landmark, J_c[:, :, self._unknown]


def _starts(landmark: Rows) -> Rows:
    """Return where the sightings of each landmark begin."""
    return np.flatnonzero(np.diff(landmark, prepend=-1))


def _renumbered(seen: _Sightings, good: npt.NDArray[np.bool_]) -> _Sightings:
    """Return the sightings of some landmarks alone, these numbered anew."""
    kept = good[seen.landmark]
    number = np.cumsum(good) - 1
    return _Sightings(seen.keyframe[kept], seen.camera[kept], number[seen.landmark[kept]], seen.xy[kept])
