"""Refinement of an initial state by Gauss-Newton on reprojection errors, with the gyroscope bias and the landmarks.

It is a bundle adjustment in which the motion between the views is that of the IMU. Its normal equations yield the
covariance by which the initialization is accepted or not.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dronevio.estimator.initialization.closed_form import (
    MIN_DEPTH_M,
    LinearSystem,
    NoiseModel,
    ViewGeometry,
    WindowState,
    mean_depth_m,
)
from dronevio.estimator.initialization.gauge import BiasPrior
from dronevio.estimator.initialization.robust import INLIER_WEIGHT, robust_weights
from dronevio.estimator.initialization.views import WindowMeasurements

Array = npt.NDArray[np.float64]

STEPS = 4
"""Number of Gauss-Newton steps."""
KNOWN_SIGMA_S = 1e-9
"""Standard deviation of a time offset that is known [s]."""
_STATE = 12  # velocity, gravity on the sphere, accelerometer bias, gyroscope bias, time offset
_ACCEL_BIAS, _GYRO_BIAS, _TIME_OFFSET = slice(5, 8), slice(8, 11), 11
_DIFFERENCE_RAD_S = 1e-4  # step of the numeric derivatives by the gyroscope bias
_DIFFERENCE_S = 0.0025  # least step of those by the time offset


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
    geometry = _geometry(measured, state.gyro_bias)
    landmarks = LinearSystem.of(measured, geometry).B @ state.y
    for _ in range(STEPS):
        equations = _Equations.at(measured, state, landmarks, noise)
        H, h = equations.with_priors(state, gyro_bias, noise, time_offset_sigma_s)
        change = np.asarray(np.linalg.solve(H, -h))
        landmarks = landmarks - equations.landmark_steps @ np.append(change, 1.0)
        state = _changed(state, change)
    equations = _Equations.at(measured, state, landmarks, noise)
    covariance = np.asarray(np.linalg.inv(equations.with_priors(state, gyro_bias, noise, time_offset_sigma_s)[0]))
    freedom = equations.weights * measured.tracks.degrees_of_freedom
    variance_factor = max(float(equations.squares @ freedom) / float(freedom.sum()), 1.0)
    covariance *= variance_factor
    offset_sigma_s = float(np.sqrt(covariance[_TIME_OFFSET, _TIME_OFFSET]))
    return RefinedState(
        state, equations.weights, equations.squares, equations.depth_m, covariance[:3, :3], offset_sigma_s
    )


@dataclass(frozen=True, eq=False)
class _Equations:
    """Normal equations of the state, with the landmarks eliminated."""

    H: Array  # (12, 12)
    h: Array  # (12,) the gradient
    landmark_steps: Array  # (F, 3, 13) the landmarks change by minus this times the change of the state and 1
    weights: Array
    squares: Array
    depth_m: Array

    @classmethod
    def at(cls, measured: WindowMeasurements, state: WindowState, landmarks: Array, noise: NoiseModel) -> "_Equations":
        tracks, geometry = measured.tracks, _geometry(measured, state.gyro_bias)
        at_frames, by_offset = geometry.in_cameras(landmarks, state.y), _by_time_offset(measured, state, landmarks)
        in_cameras = at_frames + state.time_offset_s * by_offset
        z = np.maximum(np.abs(in_cameras[..., 2:]), MIN_DEPTH_M)
        xy = in_cameras[..., :2] / z
        known = tracks.observed[..., None] / noise.xy_sigma
        residuals = (xy - tracks.xy) * known
        projection = np.zeros((*tracks.observed.shape, 2, 3))
        projection[..., 0, 0] = projection[..., 1, 1] = 1.0
        projection[..., 2] = -xy
        projection *= (known / z)[..., None]
        J_landmark = projection @ np.swapaxes(geometry.R_first_cam, 1, 2)[:, None]
        J_linear = J_landmark @ (geometry.Q[..., :9] @ _tangents(state))[:, None]
        by_bias = [
            (_geometry(measured, state.gyro_bias + step).in_cameras(landmarks, state.y) - at_frames) / _DIFFERENCE_RAD_S
            for step in _DIFFERENCE_RAD_S * np.eye(3)
        ]
        J_others = projection @ np.stack([*by_bias, by_offset], axis=-1)
        J = np.concatenate([J_landmark, J_linear, J_others, residuals[..., None]], axis=-1)
        J = np.moveaxis(J, 1, 0).reshape(len(tracks), -1, J.shape[-1])  # one block of 2V rows per landmark
        products = np.swapaxes(J, 1, 2) @ J
        eliminated = np.linalg.solve(products[:, :3, :3] + 1e-9 * np.eye(3), products[:, :3, 3:])
        reduced = products[:, 3:, 3:] - np.swapaxes(products[:, :3, 3:], 1, 2) @ eliminated
        squares = (residuals**2).sum(axis=(0, 2)) / tracks.degrees_of_freedom
        weights = robust_weights(squares, noise.outlier_sigmas)
        # The errors of a track are correlated in time, so that all its observations count as one.
        total = np.einsum("f,fij->ij", weights / tracks.observed.sum(axis=0), reduced)
        depth_m = mean_depth_m(measured, in_cameras)
        return cls(total[:_STATE, :_STATE], total[:_STATE, _STATE], eliminated, weights, squares, depth_m)

    def with_priors(
        self, state: WindowState, gyro_bias: BiasPrior, noise: NoiseModel, time_offset_sigma_s: float
    ) -> tuple[Array, Array]:
        """Return matrix and gradient with the priors of the biases and of the time offset."""
        H, h = self.H.copy(), self.h.copy()
        for rows, bias, prior in (
            (_ACCEL_BIAS, state.accel_bias, noise.accel_bias),
            (_GYRO_BIAS, state.gyro_bias, gyro_bias),
        ):
            H[rows, rows] += np.eye(3) / prior.sigma**2
            h[rows] += (bias - prior.mean) / prior.sigma**2
        H[_TIME_OFFSET, _TIME_OFFSET] += 1.0 / time_offset_sigma_s**2
        h[_TIME_OFFSET] += state.time_offset_s / time_offset_sigma_s**2
        return H, h


def _geometry(measured: WindowMeasurements, gyro_bias: Array) -> ViewGeometry:
    return ViewGeometry.of(measured.imu.integrated(gyro_bias), measured.Ts_imu_cam)


def _by_time_offset(measured: WindowMeasurements, state: WindowState, landmarks: Array) -> Array:
    """Return the derivatives (V, F, 3) of the positions in the cameras by the time of the exposures [m/s]."""
    earlier, later = (measured.imu.integrated(state.gyro_bias, shift) for shift in (-_DIFFERENCE_S, _DIFFERENCE_S))
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
