"""Bundle adjustment of a window of keyframes with their IMU and with the calibration among the unknowns.

Gauss-Newton steps estimate the poses and velocities of the keyframes, the IMU biases, the landmarks and the calibration
together. Landmarks are eliminated by the Schur complement (Triggs et al., "Bundle adjustment: a modern synthesis",
2000). The marginal information on the calibration accounts for all other unknowns: what the motion does not make
observable keeps its prior.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.linalg import cho_factor, cho_solve

from dronevio.estimator.calibration.corrections import GRAVITY, Corrections
from dronevio.estimator.calibration.imu_factor import CalibrationImuFactors
from dronevio.estimator.calibration.projection import project
from dronevio.estimator.calibration.window import (
    AdjustmentConfig,
    WindowKeyframe,
    select_landmarks,
    window_observations,
    window_state,
)
from dronevio.models.rotation import exp_so3, log_so3, pose_matrix
from dronevio.models.state import NavState

Array = npt.NDArray[np.float64]

GAUGE_SIGMA_M = 1e-3
"""Standard deviation of the first keyframe's position, which is unobservable [m]."""
ROBUST_SIGMAS = 2.4
"""Threshold of Cauchy's loss in standard deviations, for an efficiency of 95 % (Huber, "Robust statistics", 1981)."""
_STATE_DIM = 9
"""Degrees of freedom of a keyframe: δθ (right), δp and δv (world frame)."""
_BIAS_DIM = 6
"""Degrees of freedom of the biases, gyroscope first."""


@dataclass(frozen=True, eq=False)
class AdjustmentResult:
    """The posterior of the corrections after a window."""

    mean: Array
    """(D,) Vector of the corrections."""
    information: Array
    """(D, D) Information matrix of the corrections."""
    rms_px: float
    """Root mean square reprojection error, weighted by the robust loss [px]."""
    newest: NavState
    """State of the newest keyframe by the corrected calibration, with its covariance relative to the first keyframe."""
    newest_gain: Array
    """(15, D) Change of that state, in the order of `NavState`, if a correction differs from its mean: P_xc P_cc⁻¹."""

    def newest_given(self, corrections: Array) -> NavState:
        """Return the state of the newest keyframe if the corrections (D,) are others than the mean.

        Its expectation is conditional on the corrections. The covariance is that of `newest`, because they are not
        known exactly.
        """
        x, delta = self.newest, self.newest_gain @ (corrections - self.mean)
        return replace(
            x,
            T_world_imu=pose_matrix(x.T_world_imu[:3, :3] @ exp_so3(delta[:3]), x.T_world_imu[:3, 3] + delta[3:6]),
            velocity_m_s=x.velocity_m_s + delta[6:9],
            gyro_bias_rad_s=x.gyro_bias_rad_s + delta[9:12],
            accel_bias_m_s2=x.accel_bias_m_s2 + delta[12:],
        )


class CalibrationProblem:
    """The bundle adjustment of a window, solved one Gauss-Newton step at a time."""

    def __init__(
        self,
        keyframes: Sequence[WindowKeyframe],
        Ts_imu_cam: Array,
        focal_px: float,
        config: AdjustmentConfig,
        mean: Array,
        information: Array,
        estimated: npt.NDArray[np.bool_],
        gravity_m_s2: float,
        *,
        initial: Array | None = None,
        begins_stationary: bool = False,
    ) -> None:
        """Select and triangulate the landmarks of a window.

        Args:
            keyframes: At least one keyframe, in the order of time.
            Ts_imu_cam: (C, 4, 4) Poses of the cameras without corrections.
            focal_px: Focal length [px].
            config: Settings.
            mean: (D,) Prior mean of the corrections, D = 2 + 10 C.
            information: (D, D) Prior information matrix of the corrections.
            estimated: (D,) Whether a correction is estimated. The prior of those that are not is independent of the
                others.
            gravity_m_s2: Magnitude of gravity without correction [m/s²].
            initial: (D,) Corrections at which the adjustment begins; the prior mean by default.
            begins_stationary: Whether the vehicle is stationary at the first keyframe. Its state then does not depend
                on the calibration, and its covariance is the prior of that state and of the biases.
        """
        self._config, self._gravity_m_s2 = config, gravity_m_s2
        self._focal_px, self._sigma = focal_px, config.pixel_sigma / focal_px
        self._prior_mean, self._prior_information = mean, information
        self._corrections, self._estimated = (mean if initial is None else initial).copy(), np.flatnonzero(estimated)
        self._state = window_state(keyframes, Ts_imu_cam, Corrections.from_vector(self._corrections))
        self._newest_ns = keyframes[-1].state.t_ns
        of_bias = keyframes[0 if begins_stationary else -1].state
        self._bias = np.concatenate([of_bias.gyro_bias_rad_s, of_bias.accel_bias_m_s2])
        self._first_information = _first_information(config, keyframes[0].state if begins_stationary else None)
        self._first = self._state.R_world_imu[0].copy(), self._state.v_world_imu[0].copy(), self._bias.copy()
        measured = [(k.preintegrated, k.gravity_m_s2) for k in keyframes[1:] if k.preintegrated is not None]
        self._factors = CalibrationImuFactors.from_preintegrated(
            [preintegrated for preintegrated, _ in measured], self._bias, [gravity for _, gravity in measured]
        )
        candidates = window_observations(keyframes)
        self._observations, self._points = select_landmarks(self._state, candidates, focal_px, config)
        self._rms_px, self._steps, self._decrement = float("inf"), 0, float("inf")
        self._is_done = False
        self._result: AdjustmentResult | None = None

    @property
    def landmark_count(self) -> int:
        """Number of landmarks in the adjustment."""
        return len(self._points)

    @property
    def is_done(self) -> bool:
        """Whether all steps are taken, or the problem turned out to have no solution."""
        return self._is_done

    @property
    def result(self) -> AdjustmentResult | None:
        """The result; None before all steps are taken, and where the problem has no solution."""
        return self._result

    def step(self) -> None:
        """Take one Gauss-Newton step."""
        self._steps += 1
        covariance = self._gauss_newton_step()
        converged = self._decrement < self._config.max_decrement
        self._is_done = covariance is None or converged or self._steps >= self._config.iterations
        if self._is_done and covariance is not None:
            information, n = self._prior_information.copy(), _STATE_DIM + _BIAS_DIM
            of_corrections = np.linalg.inv(covariance[n:, n:])
            information[np.ix_(self._estimated, self._estimated)] = of_corrections
            gain = np.zeros((n, len(information)))
            gain[:, self._estimated] = covariance[:n, n:] @ of_corrections
            newest = self._newest_state(covariance[:n, :n])
            self._result = AdjustmentResult(self._corrections, information, self._rms_px, newest, gain)

    def _newest_state(self, covariance: Array) -> NavState:
        """Return the state of the newest keyframe with its covariance (15, 15)."""
        s, gyro_bias, accel_bias = self._state, self._bias[:3], self._bias[3:]
        T = pose_matrix(s.R_world_imu[-1], s.p_world_imu[-1])
        return NavState(self._newest_ns, T, s.v_world_imu[-1], gyro_bias, accel_bias, covariance)

    def _gauss_newton_step(self) -> Array | None:
        """Apply a Gauss-Newton step.

        Returns:
            The covariance (15 + E, 15 + E) of the newest keyframe, the biases and the corrections; None if the system
            is singular.

        The linear system holds K keyframes, the biases and the E estimated corrections, n = 9 K + 6 + E.
        """
        s = self._state
        K, E = len(s.R_world_imu), len(self._estimated)
        n = _STATE_DIM * K + _BIAS_DIM
        H, b = np.zeros((n + E, n + E)), np.zeros(n + E)
        self._add_priors(H, b, n)
        self._add_imu_factors(H, b, n)
        back_substitute = self._add_observations(H, b, n)
        try:
            factor = cho_factor(H)
            delta = cho_solve(factor, b)
            newest = n - _BIAS_DIM - _STATE_DIM
            covariance = np.asarray(cho_solve(factor, np.eye(n + E)[:, newest:])[newest:])
        except np.linalg.LinAlgError:
            return None
        self._decrement = float(b @ delta)
        self._points = self._points + back_substitute(delta)
        keyframes = delta[: _STATE_DIM * K].reshape(K, _STATE_DIM)
        self._bias = self._bias + delta[n - _BIAS_DIM : n]
        self._corrections[self._estimated] += delta[n:]
        self._state = replace(
            s,
            R_world_imu=s.R_world_imu @ exp_so3(keyframes[:, :3]),
            p_world_imu=s.p_world_imu + keyframes[:, 3:6],
            v_world_imu=s.v_world_imu + keyframes[:, 6:],
            corrections=Corrections.from_vector(self._corrections),
        )
        return covariance

    def _add_priors(self, H: Array, b: Array, n: int) -> None:
        """Add the priors of the corrections, of the first keyframe and of the biases."""
        R, v, bias = self._first
        information = self._prior_information[np.ix_(self._estimated, self._estimated)]
        H[n:, n:] += information
        b[n:] += information @ (self._prior_mean - self._corrections)[self._estimated]
        s = self._state
        error = np.concatenate([log_so3(s.R_world_imu[0].T @ R), np.zeros(3), v - s.v_world_imu[0], bias - self._bias])
        columns = np.r_[0:_STATE_DIM, n - _BIAS_DIM : n]
        H[np.ix_(columns, columns)] += self._first_information
        b[columns] += self._first_information @ error

    def _add_imu_factors(self, H: Array, b: Array, n: int) -> None:
        """Add the IMU factors between consecutive keyframes."""
        s, of_gravity = self._state, np.flatnonzero(self._estimated == GRAVITY)
        common = np.concatenate([np.arange(n - _BIAS_DIM, n), n + of_gravity])
        bias, gravity_m_s2 = self._bias - self._first[2], self._gravity_m_s2 + s.corrections.gravity_m_s2
        r, J = self._factors.residuals(s.R_world_imu, s.p_world_imu, s.v_world_imu, bias, gravity_m_s2)
        states = 2 * _STATE_DIM
        J = J[:, :, : states + len(common)]  # without the column of gravity if it is not estimated
        weighted = np.swapaxes(J, 1, 2) @ self._factors.information
        H_factors, b_factors = weighted @ J, (weighted @ r[..., None])[..., 0]
        for i in range(len(self._factors)):
            pair = slice(_STATE_DIM * i, _STATE_DIM * i + states)
            H[pair, pair] += H_factors[i, :states, :states]
            H[pair, common] += H_factors[i, :states, states:]
            H[common, pair] += H_factors[i, states:, :states]
            b[pair] -= b_factors[i, :states]
        H[np.ix_(common, common)] += H_factors[:, states:, states:].sum(axis=0)
        b[common] -= b_factors[:, states:].sum(axis=0)

    def _weighted_jacobians(self) -> tuple[Array, Array, Array, Array]:
        """Return the Jacobians of the observations, and their residuals, in standard deviations of the robust loss.

        They are the Jacobians by the pose of the keyframe (N, 2, 6), by the estimated corrections (N, 2, E) and by the
        landmark (N, 2, 3), and the residuals (N, 2, 1).
        """
        projection = project(self._state, self._observations, self._points)
        error = np.linalg.norm(projection.residual, axis=1)
        robust = 1.0 / (1.0 + (error / (ROBUST_SIGMAS * self._sigma)) ** 2)
        self._rms_px = float(np.sqrt(np.average(error**2, weights=robust))) * self._focal_px
        root_weight = np.sqrt(robust)[:, None, None] / self._sigma
        J_c = projection.J_corrections[:, :, self._estimated]
        parts = projection.J_pose, J_c, projection.J_point, projection.residual[..., None]
        J_pose, J_c, J_point, r = (part * root_weight for part in parts)
        return J_pose, J_c, J_point, r

    def _add_observations(self, H: Array, b: Array, n: int) -> Callable[[Array], Array]:
        """Add the observations with the landmarks eliminated.

        Returns:
            The back-substitution: a function from a solution of the linear system to the step (L, 3) of the landmarks.
        """
        observations, L, E = self._observations, len(self._points), len(self._estimated)
        K = len(self._state.R_world_imu)
        if L == 0:
            return lambda delta: np.zeros((0, 3))
        J_pose, J_c, J_point, r = self._weighted_jacobians()

        # Poses and corrections: products of all observations of a keyframe at once
        of_pose = np.zeros((K, 6, 6 + E + 1))
        order = np.argsort(observations.keyframe, kind="stable")
        bounds = np.searchsorted(observations.keyframe[order], np.arange(K + 1))
        J_r = np.concatenate([J_pose, J_c, r], axis=2)[order]
        for k in range(K):
            J_r_k = J_r[bounds[k] : bounds[k + 1]].reshape(-1, 6 + E + 1)
            of_pose[k] = J_r_k[:, :6].T @ J_r_k
        H_pp, H_pc, b_p = of_pose[..., :6], of_pose[..., 6:-1], of_pose[..., -1]
        J_c_r = J_r[..., 6:].reshape(-1, E + 1)
        of_corrections = J_c_r[:, :-1].T @ J_c_r

        # Landmarks
        J_point_T = np.swapaxes(J_point, 1, 2)
        of_landmark = np.add.reduceat(J_point_T @ np.concatenate([J_point, J_c, r], axis=2), observations.starts)
        H_ll, H_lc, b_l = of_landmark[..., :3], of_landmark[..., 3:-1], of_landmark[..., -1]
        H_lp = np.zeros((L, K, 3, 6))
        for camera in range(len(self._state.Ts_imu_cam)):  # a camera observes a landmark once in a keyframe
            rows = np.flatnonzero(observations.camera == camera)
            H_lp[observations.landmark[rows], observations.keyframe[rows]] += J_point_T[rows] @ J_pose[rows]

        # Elimination of the landmarks by the Cholesky factors L_l of H_ll: subtract (L_l⁻¹ H_lx)ᵀ (L_l⁻¹ H_lx)
        poses = (_STATE_DIM * np.arange(K)[:, None] + np.arange(6)).ravel()
        columns = np.concatenate([poses, np.arange(n, n + E)])
        H_lx = np.concatenate([np.swapaxes(H_lp, 1, 2).reshape(L, 3, 6 * K), H_lc], axis=2)
        L_l = np.linalg.cholesky(H_ll + 1e-9 * np.trace(H_ll, axis1=1, axis2=2)[:, None, None] * np.eye(3))
        half = np.linalg.solve(L_l, np.concatenate([H_lx, b_l[..., None]], axis=2)).reshape(3 * L, -1)
        H[np.ix_(columns, columns)] -= half[:, :-1].T @ half[:, :-1]
        b[columns] -= half[:, :-1].T @ half[:, -1]
        for k in range(K):
            pose = slice(_STATE_DIM * k, _STATE_DIM * k + 6)
            H[pose, pose] += H_pp[k]
            H[pose, n:] += H_pc[k]
            H[n:, pose] += H_pc[k].T
            b[pose] += b_p[k]
        H[n:, n:] += of_corrections[:, :-1]
        b[n:] += of_corrections[:, -1]

        def back_substitute(delta: Array) -> Array:
            halves = half.reshape(L, 3, -1)
            right = halves[..., -1] - halves[..., :-1] @ delta[columns]
            return np.asarray(np.linalg.solve(np.swapaxes(L_l, 1, 2), right[..., None])[..., 0])

        return back_substitute


def _first_information(config: AdjustmentConfig, stationary: NavState | None) -> Array:
    """Return the information (15, 15) on the first keyframe and the biases, before the window.

    Args:
        config: Settings.
        stationary: State of the first keyframe if the vehicle is stationary there, otherwise None.
    """
    c = config
    if stationary is None or stationary.covariance is None:
        sigmas = [c.orientation_sigma_rad, GAUGE_SIGMA_M, c.velocity_sigma_m_s]
        sigmas += [c.gyro_bias_sigma_rad_s, c.accel_bias_sigma_m_s2]
        return np.diag(np.repeat(np.array(sigmas) ** -2.0, 3))
    P = stationary.covariance.copy()
    P[3:6, :] = P[:, 3:6] = 0.0
    P[3:6, 3:6] = GAUGE_SIGMA_M**2 * np.eye(3)
    return np.asarray(np.linalg.inv(P), dtype=np.float64)
