"""What the adjustment of a calibration minimizes: priors, IMU factors and reprojection errors of a window.

The variables are the poses and velocities of the keyframes, the IMU biases, the landmarks and the calibration.
Landmarks are eliminated by the Schur complement (Triggs et al., "Bundle adjustment: a modern synthesis", 2000).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import numpy.typing as npt

from dronevio.estimator.calibration.corrections import GRAVITY, GYRO_SCALE, Corrections
from dronevio.estimator.calibration.imu_factor import CalibrationImuFactors
from dronevio.estimator.calibration.projection import CalibrationObservations, CalibrationState, project
from dronevio.estimator.calibration.window import (
    AdjustmentConfig,
    WindowKeyframe,
    select_landmarks,
    window_observations,
    window_state,
)
from dronevio.estimator.optimization.robust import cauchy_inflation, cauchy_loss
from dronevio.estimator.types import GAUGE_SIGMA, Calibration
from dronevio.models.arrays import Array, Integers
from dronevio.models.rotation import exp_so3, log_so3
from dronevio.models.state import NavState

GAUGE_SIGMA_M = 1e-3
"""Standard deviation of the first keyframe's position, which is unobservable [m]."""
ROBUST_SIGMAS = 2.4
"""Threshold of Cauchy's loss in standard deviations, for an efficiency of 95 % (Huber, "Robust statistics", 1981)."""
STATE_DIM = 9
"""Degrees of freedom of a keyframe: δθ (right), δp and δv (world frame)."""
BIAS_DIM = 6
"""Degrees of freedom of the biases, gyroscope first."""


@dataclass(frozen=True, eq=False)
class CalibrationEstimate:
    """The variables of the adjustment."""

    state: CalibrationState
    """States of the K keyframes, and the corrections of the calibration."""
    bias: Array
    """(6,) Biases of gyroscope [rad/s] and accelerometer [m/s²]."""
    corrections: Array
    """(D,) The same corrections as a vector."""
    points: Array
    """(L, 3) Positions of the landmarks in the world frame [m]."""


@dataclass(frozen=True, eq=False)
class EliminatedLandmarks:
    """The normal equations of L landmarks, and what they have in common with n of the other unknowns."""

    columns: Integers
    """(n,) These unknowns among all."""
    L_inverse: Array
    """(L, 3, 3) Inverses of the Cholesky factors of the landmarks' information."""
    half: Array
    """(L, 3, n + 1) These times the blocks between landmarks and unknowns, and times the right-hand sides."""

    def back_substitute(self, delta: Array) -> Array:
        """Return the step (L, 3) of the landmarks that belongs to a step of the other unknowns."""
        right = self.half[..., -1] - self.half[..., :-1] @ delta[self.columns]
        return np.asarray((np.swapaxes(self.L_inverse, 1, 2) @ right[..., None])[..., 0])


@dataclass(frozen=True, eq=False)
class CalibrationEquations:
    """Normal equations of K keyframes, the biases and E corrections, n = 9 K + 6 + E; landmarks are eliminated."""

    H: Array
    """(n, n) Information matrix, without the landmarks."""
    b: Array
    """(n,) Right-hand side, the negative gradient."""
    x: CalibrationEstimate
    """The variables at which they are linearized."""
    estimated: Integers
    """(E,) Indices of the estimated corrections."""
    landmarks: EliminatedLandmarks | None
    """The landmarks; None without any."""
    rms_px: float
    """Root mean square reprojection error, weighted by the robust loss [px]; infinite without landmarks."""
    agreement: float
    """Mean weight of the observations in the robust loss, of the camera where it is smallest; 0 without landmarks."""
    scales: None = None
    """The scales of the robust loss do not depend on the variables."""

    def retract(self, delta: Array) -> CalibrationEstimate:
        """Return the variables after a step (n,), with the step of the landmarks that belongs to it."""
        s, corrections = self.x.state, self.x.corrections.copy()
        K, n = len(s.R_world_imu), len(delta) - len(self.estimated)
        keyframes = delta[: STATE_DIM * K].reshape(K, STATE_DIM)
        corrections[self.estimated] += delta[n:]
        state = replace(
            s,
            R_world_imu=s.R_world_imu @ exp_so3(keyframes[:, :3]),
            p_world_imu=s.p_world_imu + keyframes[:, 3:6],
            v_world_imu=s.v_world_imu + keyframes[:, 6:],
            corrections=Corrections.from_vector(corrections),
        )
        moved = self.landmarks.back_substitute(delta) if self.landmarks else np.zeros((0, 3))
        return CalibrationEstimate(state, self.x.bias + delta[n - BIAS_DIM : n], corrections, self.x.points + moved)


@dataclass(frozen=True, eq=False)
class CalibrationObjective:
    """The measurements of a window, and what is known of its variables before."""

    initial: CalibrationEstimate
    """Variables at which the adjustment begins, and at which the IMU factors are linearized by the biases."""
    prior_mean: Array
    """(D,) Prior mean of the corrections."""
    prior_information: Array
    """(D, D) Prior information matrix of the corrections."""
    estimated: Integers
    """(E,) Indices of the corrections that are estimated."""
    first_information: Array
    """(15, 15) Prior information on the first keyframe and the biases."""
    factors: CalibrationImuFactors
    """IMU factors between the keyframes."""
    observations: CalibrationObservations
    """Observations of the landmarks."""
    gravity_m_s2: float
    """Magnitude of gravity without correction [m/s²]."""
    focal_px: float
    """Focal length [px]."""
    sigma: float
    """Standard deviation of an observation, in the image, in focal lengths."""

    @classmethod
    def of(
        cls,
        keyframes: Sequence[WindowKeyframe],
        given: Calibration,
        config: AdjustmentConfig,
        mean: Array,
        information: Array,
        estimated: npt.NDArray[np.bool_],
        gravity_m_s2: float,
        *,
        initial: Array | None = None,
        begins_stationary: bool = False,
    ) -> "CalibrationObjective":
        """Select and triangulate the landmarks of a window.

        Args:
            keyframes: At least one keyframe, in the order of time.
            given: The calibration without corrections.
            config: Settings.
            mean: (D,) Prior mean of the corrections, D = 3 + 10 C.
            information: (D, D) Prior information matrix of the corrections.
            estimated: (D,) Whether a correction is estimated. The prior of those that are not is independent of the
                others.
            gravity_m_s2: Magnitude of gravity without correction [m/s²].
            initial: (D,) Corrections at which the adjustment begins; the prior mean by default.
            begins_stationary: Whether the vehicle is stationary at the first keyframe. Its state then does not depend
                on the calibration, and its covariance is the prior of that state and of the biases.
        """
        initial, focal_px = mean if initial is None else initial, float(given.focal_px[0])
        state = window_state(keyframes, given, Corrections.from_vector(initial))
        of_bias = keyframes[0 if begins_stationary else -1].state
        bias = np.concatenate([of_bias.gyro_bias_rad_s, of_bias.accel_bias_m_s2])
        measured = [(k.preintegrated, k.gravity_m_s2) for k in keyframes[1:] if k.preintegrated is not None]
        factors = CalibrationImuFactors.from_preintegrated(
            [preintegrated for preintegrated, _ in measured], bias, [gravity for _, gravity in measured]
        )
        observations, points = select_landmarks(state, window_observations(keyframes), focal_px, config)
        return cls(
            CalibrationEstimate(state, bias, initial.copy(), points),
            mean,
            information,
            np.flatnonzero(estimated),
            _first_information(config, keyframes[0].state, is_stationary=begins_stationary),
            factors,
            observations,
            gravity_m_s2,
            focal_px,
            config.pixel_sigma / focal_px,
        )

    def linearize(self, x: CalibrationEstimate) -> CalibrationEquations:
        """Return the normal equations at some variables, with the landmarks eliminated."""
        n = STATE_DIM * len(x.state.R_world_imu) + BIAS_DIM
        H, b = np.zeros((n + len(self.estimated), n + len(self.estimated))), np.zeros(n + len(self.estimated))
        self._add_priors(H, b, x, n)
        self._add_imu_factors(H, b, x, n)
        landmarks, rms_px, agreement = self._add_observations(H, b, x, n) if len(x.points) else (None, np.inf, 0.0)
        return CalibrationEquations(H, b, x, self.estimated, landmarks, rms_px, agreement)

    def cost(self, x: CalibrationEstimate, scales: None = None) -> float:
        """Return the negative logarithm of the posterior density of some variables, up to a constant."""
        of_corrections, of_first = self._prior_errors(x)
        r = self._imu_residuals(x)[0]
        squares = self._squares(project(x.state, self.observations, x.points).residual)
        losses = ROBUST_SIGMAS**2 * cauchy_loss(squares, 1.0)
        return float(
            0.5 * of_corrections @ self._information @ of_corrections
            + 0.5 * of_first @ self.first_information @ of_first
            + 0.5 * np.einsum("ni,nij,nj->", r, self.factors.information, r)
            + 0.5 * losses.sum()
        )

    @cached_property
    def _information(self) -> Array:
        """(E, E) Prior information on the estimated corrections."""
        return np.asarray(self.prior_information[np.ix_(self.estimated, self.estimated)])

    def _squares(self, residual: Array) -> Array:
        """Return the squares (N,) of residuals (2, N), relative to the squared threshold of the robust loss."""
        return np.asarray((residual[0] ** 2 + residual[1] ** 2) / (ROBUST_SIGMAS * self.sigma) ** 2)

    def _prior_errors(self, x: CalibrationEstimate) -> tuple[Array, Array]:
        """Return the priors' means minus the estimated corrections (E,), and minus first keyframe and biases (15,)."""
        s, first = x.state, self.initial.state
        rotation, velocity = log_so3(s.R_world_imu[0].T @ first.R_world_imu[0]), first.v_world_imu[0] - s.v_world_imu[0]
        of_first = np.concatenate([rotation, np.zeros(3), velocity, self.initial.bias - x.bias])
        return (self.prior_mean - x.corrections)[self.estimated], of_first

    def _add_priors(self, H: Array, b: Array, x: CalibrationEstimate, n: int) -> None:
        """Add the priors of the corrections, of the first keyframe and of the biases."""
        of_corrections, of_first = self._prior_errors(x)
        H[n:, n:] += self._information
        b[n:] += self._information @ of_corrections
        columns = np.r_[0:STATE_DIM, n - BIAS_DIM : n]
        H[np.ix_(columns, columns)] += self.first_information
        b[columns] += self.first_information @ of_first

    def _imu_residuals(self, x: CalibrationEstimate) -> tuple[Array, Array]:
        """Return the residuals (F, 9) of the IMU factors and their Jacobians; see `CalibrationImuFactors`."""
        s, bias = x.state, x.bias - self.initial.bias
        gravity_m_s2, scale = self.gravity_m_s2 + s.corrections.gravity_m_s2, s.corrections.gyro_scale
        return self.factors.residuals(s.R_world_imu, s.p_world_imu, s.v_world_imu, bias, gravity_m_s2, scale)

    def _add_imu_factors(self, H: Array, b: Array, x: CalibrationEstimate, n: int) -> None:
        """Add the IMU factors between consecutive keyframes."""
        of_imu = np.flatnonzero(np.isin(self.estimated, (GRAVITY, GYRO_SCALE)))  # successive columns of J, too
        common = np.concatenate([np.arange(n - BIAS_DIM, n), n + of_imu])
        (r, J), states = self._imu_residuals(x), 2 * STATE_DIM
        J = J[:, :, np.r_[: states + BIAS_DIM, states + BIAS_DIM - GRAVITY + self.estimated[of_imu]]]
        weighted = np.swapaxes(J, 1, 2) @ self.factors.information
        H_factors, b_factors = weighted @ J, (weighted @ r[..., None])[..., 0]
        for i in range(len(self.factors)):
            pair = slice(STATE_DIM * i, STATE_DIM * i + states)
            H[pair, pair] += H_factors[i, :states, :states]
            H[pair, common] += H_factors[i, :states, states:]
            H[common, pair] += H_factors[i, states:, :states]
            b[pair] -= b_factors[i, :states]
        H[np.ix_(common, common)] += H_factors[:, states:, states:].sum(axis=0)
        b[common] -= b_factors[:, states:].sum(axis=0)

    def _add_observations(
        self, H: Array, b: Array, x: CalibrationEstimate, n: int
    ) -> tuple[EliminatedLandmarks, float, float]:
        """Add the observations with the landmarks eliminated; return these, reprojection error [px] and agreement."""
        observations, L, E, K = self.observations, len(x.points), len(self.estimated), len(x.state.R_world_imu)
        # Jacobians by landmark, pose and corrections, and residuals, in standard deviations of the robust loss
        projection = project(x.state, observations, x.points)
        robust = 1.0 / cauchy_inflation(self._squares(projection.residual), 1.0)
        J_c, r = projection.J_corrections[:, self.estimated], projection.residual[:, None]
        J_r = np.concatenate([projection.J_point, projection.J_pose, J_c, r], axis=1)
        J_r *= np.sqrt(robust) / self.sigma

        # Poses and corrections: products of all observations of a keyframe at once
        of_pose, of_corrections = np.zeros((K, 6, 6 + E + 1)), np.zeros((E, E + 1))
        order = np.argsort(observations.keyframe, kind="stable")
        bounds = np.searchsorted(observations.keyframe[order], np.arange(K + 1)).tolist()
        by_keyframe = J_r[:, 3:].take(order, axis=2).swapaxes(0, 1)
        for k in range(K):
            J_r_k = by_keyframe[..., bounds[k] : bounds[k + 1]].reshape(6 + E + 1, -1)
            of_pose[k] = J_r_k[:6] @ J_r_k.T
            of_corrections += J_r_k[6:-1] @ J_r_k[6:].T
        H_pp, H_pc, b_p = of_pose[..., :6], of_pose[..., 6:-1], of_pose[..., -1]

        # Landmarks: products of all observations of each, and of every observation with its pose
        of_landmark, by_landmark = np.empty((L, 3, 9 + E + 1)), J_r.swapaxes(0, 1)
        starts = [*observations.starts.tolist(), len(observations.landmark)]
        for row in range(L):
            J_r_l = by_landmark[..., starts[row] : starts[row + 1]].reshape(9 + E + 1, -1)
            of_landmark[row] = J_r_l[:3] @ J_r_l.T
        H_ll, H_lc, b_l = of_landmark[..., :3], of_landmark[..., 9:-1], of_landmark[..., -1]
        H_lp, of_observation = np.zeros((L, K, 3, 6)), np.einsum("rin,rjn->nij", J_r[:, :3], J_r[:, 3:9])
        for camera in range(len(x.state.Ts_imu_cam)):  # a camera observes a landmark once in a keyframe
            rows = np.flatnonzero(observations.camera == camera)
            H_lp[observations.landmark[rows], observations.keyframe[rows]] += of_observation[rows]

        # Elimination of the landmarks by the Cholesky factors L_l of H_ll: subtract (L_l⁻¹ H_lx)ᵀ (L_l⁻¹ H_lx)
        poses = (STATE_DIM * np.arange(K)[:, None] + np.arange(6)).ravel()
        columns = np.concatenate([poses, np.arange(n, n + E)])
        H_lx = np.concatenate([np.swapaxes(H_lp, 1, 2).reshape(L, 3, 6 * K), H_lc], axis=2)
        damping = 1e-9 * np.trace(H_ll, axis1=1, axis2=2)[:, None, None] * np.eye(3)
        L_inverse = np.linalg.inv(np.linalg.cholesky(H_ll + damping))
        half = (L_inverse @ np.concatenate([H_lx, b_l[..., None]], axis=2)).reshape(3 * L, -1)
        H[np.ix_(columns, columns)] -= half[:, :-1].T @ half[:, :-1]
        b[columns] -= half[:, :-1].T @ half[:, -1]
        for k in range(K):
            pose = slice(STATE_DIM * k, STATE_DIM * k + 6)
            H[pose, pose] += H_pp[k]
            H[pose, n:] += H_pc[k]
            H[n:, pose] += H_pc[k].T
            b[pose] += b_p[k]
        H[n:, n:] += of_corrections[:, :-1]
        b[n:] += of_corrections[:, -1]
        rms = float(np.sqrt((robust * (projection.residual**2).sum(axis=0)).sum() / robust.sum()))
        agreement = min(
            float(robust[observations.camera == camera].mean()) for camera in np.unique(observations.camera)
        )
        return EliminatedLandmarks(columns, L_inverse, half.reshape(L, 3, -1)), rms * self.focal_px, agreement


def _first_information(config: AdjustmentConfig, first: NavState, *, is_stationary: bool) -> Array:
    """Return the information (15, 15) on the first keyframe and the biases, before the window.

    In motion, its state depends on the wrong calibration, all but the heading, which no measurement of the window
    shows.

    Args:
        config: Settings.
        first: State of the first keyframe.
        is_stationary: Whether the vehicle is stationary there.
    """
    c = config
    if is_stationary and first.covariance is not None:
        P = first.covariance.copy()
        P[3:6, :] = P[:, 3:6] = 0.0
        P[3:6, 3:6] = GAUGE_SIGMA_M**2 * np.eye(3)
        return np.asarray(np.linalg.inv(P), dtype=np.float64)
    sigmas = [c.orientation_sigma_rad, GAUGE_SIGMA_M, c.velocity_sigma_m_s]
    sigmas += [c.gyro_bias_sigma_rad_s, c.accel_bias_sigma_m_s2]
    information = np.diag(np.repeat(np.array(sigmas) ** -2.0, 3))
    if first.covariance is not None:
        vertical = first.T_world_imu[2, :3]  # in the IMU frame
        variance = max(float(vertical @ first.covariance[:3, :3] @ vertical), GAUGE_SIGMA**2)
        known = 1.0 / variance - c.orientation_sigma_rad**-2.0
        information[:3, :3] += max(known, 0.0) * np.outer(vertical, vertical)
    return information
