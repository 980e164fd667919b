"""Refinement of an initial state by Gauss-Newton on reprojection errors, with the gyroscope bias and the landmarks.

It is a bundle adjustment in which the motion between the views is that of the IMU. Its normal equations yield the
covariance by which the initialization is accepted or not.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dronevio.estimator.initialization.closed_form import (
    MIN_START_DEPTH_M,
    LinearSystem,
    NoiseModel,
    ViewGeometry,
    WindowState,
    mean_depth_m,
)
from dronevio.estimator.initialization.gauge import BiasPrior
from dronevio.estimator.initialization.robust import INLIER_WEIGHT, robust_scale
from dronevio.estimator.initialization.views import IntegratedImu, WindowMeasurements
from dronevio.estimator.optimization.gauss_newton import gauss_newton
from dronevio.estimator.optimization.linalg import LUFactor
from dronevio.estimator.optimization.robust import geman_mcclure_loss, geman_mcclure_weight
from dronevio.models.arrays import Array
from dronevio.models.rotation import skew

STEPS = 4
"""Number of Gauss-Newton steps."""
KNOWN_SIGMA_S = 1e-9
"""Standard deviation of a time offset that is known [s]."""
_STATE = 12  # velocity, gravity on the sphere, accelerometer bias, gyroscope bias, time offset
_ACCEL_BIAS, _GYRO_BIAS, _TIME_OFFSET = slice(5, 8), slice(8, 11), 11
_DIFFERENCE_S = 0.0025  # least step of the numeric derivatives by the time offset


@dataclass(frozen=True, eq=False)
class RefinedState:
    """A state, and the measures of its quality."""

    state: WindowState
    """State at the first frame of the window."""
    weights: Array
    """(F,) Weights of the landmarks, 0 to 1."""
    squares: Array
    """(F,) Mean squared residuals of the landmarks, in units of the variance of an observation."""
    depth_m: Array
    """(F,) Mean depths of the landmarks [m]."""
    velocity_covariance: Array
    """(3, 3) Covariance of the velocity [m²/s²]."""
    time_offset_sigma_s: float
    """Standard deviation of the time offset [s]."""

    @property
    def inliers(self) -> npt.NDArray[np.bool_]:
        """(F,) Whether a landmark agrees with the state: its weight is a quarter or more."""
        return np.asarray(self.weights >= INLIER_WEIGHT)


def refine(
    measured: WindowMeasurements,
    state: WindowState,
    gyro_bias: BiasPrior,
    noise: NoiseModel,
    time_offset_sigma_s: float = KNOWN_SIGMA_S,
) -> RefinedState:
    """Return the state that minimizes the reprojection errors.

    Args:
        measured: Measurements of a window.
        state: Initial value.
        gyro_bias: What is known of the gyroscope bias from elsewhere [rad/s].
        noise: Assumptions on the measurements.
        time_offset_sigma_s: Standard deviation of the time offset of camera and IMU, which is expected to be the one in
            use [s].
    """
    objective = RefinementObjective(measured, gyro_bias, noise, time_offset_sigma_s)
    x = gauss_newton(objective, objective.initial(state), LUFactor, STEPS).x
    equations = objective.linearize(x)
    freedom = equations.weights * measured.tracks.degrees_of_freedom
    variance_factor = max(float(equations.squares @ freedom) / float(freedom.sum()), 1.0)
    covariance = variance_factor * np.asarray(np.linalg.inv(equations.H))
    offset_sigma_s = float(np.sqrt(covariance[_TIME_OFFSET, _TIME_OFFSET]))
    return RefinedState(
        x.state, equations.weights, equations.squares, equations.depth_m, covariance[:3, :3], offset_sigma_s
    )


@dataclass(frozen=True, eq=False)
class RefinementEstimate:
    """The variables: the state at the first frame and the landmarks."""

    state: WindowState
    """State at the first frame of the window."""
    landmarks: Array
    """(F, 3) Positions of the landmarks in the IMU frame of the first frame [m]."""


@dataclass(frozen=True, eq=False)
class RefinementEquations:
    """Normal equations of the state, with the landmarks eliminated, and the residuals that they are made of."""

    H: Array
    """(12, 12) Information matrix of the state."""
    b: Array
    """(12,) Right-hand side, the negative gradient."""
    x: RefinementEstimate
    """The variables at which they are linearized."""
    scales: float
    """Scale of the robust loss, a mean squared residual."""
    landmark_steps: Array
    """(F, 3, 13) Matrices by which minus the step of the landmarks follows from that of the state and 1."""
    weights: Array
    """(F,) Weights of the landmarks."""
    squares: Array
    """(F,) Mean squared residuals of the landmarks."""
    depth_m: Array
    """(F,) Mean depths of the landmarks [m]."""

    def retract(self, delta: Array) -> RefinementEstimate:
        """Return the variables after a step (12,), with the step of the landmarks that belongs to it."""
        landmarks = self.x.landmarks - self.landmark_steps @ np.append(delta, 1.0)
        return RefinementEstimate(_changed(self.x.state, delta), landmarks)


@dataclass(frozen=True, eq=False)
class RefinementObjective:
    """Reprojection errors in a window, and what is known of biases and time offset from elsewhere; see `refine`."""

    measured: WindowMeasurements
    """Measurements of a window."""
    gyro_bias: BiasPrior
    """What is known of the gyroscope bias [rad/s]."""
    noise: NoiseModel
    """Assumptions on the measurements."""
    time_offset_sigma_s: float
    """Standard deviation of the time offset [s]."""

    def initial(self, state: WindowState) -> RefinementEstimate:
        """Return the variables for a state, with the landmarks that agree best with it."""
        geometry = ViewGeometry.of(self.measured.imu.integrated(state.gyro_bias).motion(), self.measured.Ts_imu_cam)
        return RefinementEstimate(state, LinearSystem.of(self.measured, geometry).B @ state.y)

    def linearize(self, x: RefinementEstimate) -> RefinementEquations:
        """Return the normal equations at some variables."""
        measured, tracks, state, landmarks = self.measured, self.measured.tracks, x.state, x.landmarks
        # Residuals and their Jacobians, one block of 2V rows per landmark
        imu = measured.imu.integrated(state.gyro_bias)
        geometry = ViewGeometry.of(imu.motion(), measured.Ts_imu_cam)
        by_offset = _by_time_offset(imu, measured, state, landmarks)
        in_cameras = geometry.in_cameras(landmarks, state.y) + state.time_offset_s * by_offset
        residuals, z, xy = self._residuals(in_cameras)
        projection = np.zeros((*tracks.observed.shape, 2, 3))
        projection[..., 0, 0] = projection[..., 1, 1] = 1.0
        projection[..., 2] = -xy
        projection *= (tracks.observed[..., None] / self.noise.xy_sigma / z)[..., None]
        J_landmark = projection @ np.swapaxes(geometry.R_first_cam, 1, 2)[:, None]
        J_linear = J_landmark @ (geometry.Q[..., :9] @ _tangents(state))[:, None]
        by_bias = by_gyro_bias(imu, geometry, measured.Ts_imu_cam, landmarks, state.y)
        J_others = projection @ np.concatenate([by_bias, by_offset[..., None]], axis=-1)
        J = np.concatenate([J_landmark, J_linear, J_others, residuals[..., None]], axis=-1)
        J = np.moveaxis(J, 1, 0).reshape(len(tracks), -1, J.shape[-1])
        # Elimination of the landmarks
        products = np.swapaxes(J, 1, 2) @ J
        eliminated = np.linalg.solve(products[:, :3, :3] + 1e-9 * np.eye(3), products[:, :3, 3:])
        reduced = products[:, 3:, 3:] - np.swapaxes(products[:, :3, 3:], 1, 2) @ eliminated
        # Robust weights; the errors of a track are correlated in time, so that all its observations count as one
        squares = self._squares(residuals)
        scale = robust_scale(squares, self.noise.outlier_sigmas)
        weights = geman_mcclure_weight(squares, scale)
        total = np.einsum("f,fij->ij", weights / tracks.observed.sum(axis=0), reduced)
        error, variance = self._prior_error(state)
        H, b = total[:_STATE, :_STATE] + np.diag(1.0 / variance), -(total[:_STATE, _STATE] + error / variance)
        return RefinementEquations(H, b, x, scale, eliminated, weights, squares, mean_depth_m(measured, in_cameras))

    def cost(self, x: RefinementEstimate, scale: float) -> float:
        """Return the negative logarithm of the posterior density at a given scale, up to a constant."""
        state, tracks = x.state, self.measured.tracks
        imu = self.measured.imu.integrated(state.gyro_bias)
        in_cameras = ViewGeometry.of(imu.motion(), self.measured.Ts_imu_cam).in_cameras(x.landmarks, state.y)
        in_cameras = in_cameras + state.time_offset_s * _by_time_offset(imu, self.measured, state, x.landmarks)
        losses = geman_mcclure_loss(self._squares(self._residuals(in_cameras)[0]), scale)
        error, variance = self._prior_error(state)
        counts = tracks.degrees_of_freedom / tracks.observed.sum(axis=0)
        return 0.5 * float(counts @ losses + (error**2 / variance).sum())

    def _residuals(self, in_cameras: Array) -> tuple[Array, Array, Array]:
        """Return the residuals (V, F, 2) in standard deviations, the depths [m] and the projections (V, F, 2)."""
        tracks, z = self.measured.tracks, np.maximum(np.abs(in_cameras[..., 2:]), MIN_START_DEPTH_M)
        xy = in_cameras[..., :2] / z
        return (xy - tracks.xy) * (tracks.observed[..., None] / self.noise.xy_sigma), z, xy

    def _squares(self, residuals: Array) -> Array:
        """Return the mean squared residuals (F,) of the landmarks."""
        return np.asarray((residuals**2).sum(axis=(0, 2)) / self.measured.tracks.degrees_of_freedom)

    def _prior_error(self, state: WindowState) -> tuple[Array, Array]:
        """Return the deviation (12,) of a state from the priors' means, and their variances (12,), infinite without."""
        error, variance = np.zeros(_STATE), np.full(_STATE, np.inf)
        for rows, bias, prior in (
            (_ACCEL_BIAS, state.accel_bias, self.noise.accel_bias),
            (_GYRO_BIAS, state.gyro_bias, self.gyro_bias),
        ):
            error[rows], variance[rows] = bias - prior.mean, prior.sigma**2
        error[_TIME_OFFSET], variance[_TIME_OFFSET] = state.time_offset_s, self.time_offset_sigma_s**2
        return error, variance


def by_gyro_bias(imu: IntegratedImu, geometry: ViewGeometry, Ts_imu_cam: Array, landmarks: Array, y: Array) -> Array:
    """Return the derivatives (V, F, 3, 3) of the positions in the cameras by the gyroscope bias.

    The rotation of a view changes by A δ, its position by the change of the integrated force and of the lever of the
    camera.
    """
    from_imu = landmarks + (geometry.Q @ y + (imu.rotations @ Ts_imu_cam[:, :3, 3:])[..., 0])[:, None]
    by_bias = skew(from_imu) @ imu.rotations_by_gyro_bias[:, None] - imu.dp_by_gyro_bias(y[6:9])[:, None]
    return np.asarray(np.swapaxes(geometry.R_first_cam, 1, 2)[:, None] @ by_bias)


def _by_time_offset(imu: IntegratedImu, measured: WindowMeasurements, state: WindowState, landmarks: Array) -> Array:
    """Return the derivatives (V, F, 3) of the positions in the cameras by the time of the exposures [m/s]."""
    earlier, later = (imu.motion(shift_s) for shift_s in (-_DIFFERENCE_S, _DIFFERENCE_S))
    before, after = (
        ViewGeometry.of(motion, measured.Ts_imu_cam).in_cameras(landmarks, state.y) for motion in (earlier, later)
    )
    return np.asarray((after - before) / (later.t_s - earlier.t_s)[:, None, None])


def _tangents(state: WindowState) -> Array:
    """Return the derivatives (9, 8) of velocity, gravity and accelerometer bias; gravity keeps its magnitude."""
    E = np.zeros((9, 8))
    E[:3, :3] = E[6:, 5:] = np.eye(3)
    E[3:6, 3:5] = np.linalg.svd(state.gravity[None])[2][1:].T
    return E


def _changed(state: WindowState, change: Array) -> WindowState:
    """Return a state after a change (12,)."""
    linear = _tangents(state) @ change[:8]
    gravity = state.gravity + linear[3:6]
    gravity *= np.linalg.norm(state.gravity) / np.linalg.norm(gravity)
    accel_bias, gyro_bias = state.accel_bias + linear[6:], state.gyro_bias + change[_GYRO_BIAS]
    time_offset_s = state.time_offset_s + float(change[_TIME_OFFSET])
    return WindowState(state.velocity + linear[:3], gravity, accel_bias, gyro_bias, time_offset_s)
