"""Velocity and gravity in closed form, for known biases.

With the rotation known, each observation of a landmark is linear in the landmark's position, the initial velocity and
gravity (Dong-Si and Mourikis, "Estimator initialization in vision-aided inertial navigation with unknown camera-IMU
calibration", IROS 2012). The landmarks are eliminated one by one, and the magnitude of gravity is a constraint.
Outliers lose their weight by iterative reweighting.

The bias of the accelerometer is linear, too, but it stays at its expected value here: as long as the depths are not
known, the equations are distances, which a bias of some m/s² makes small by moving the cameras and all landmarks to one
point. The refinement estimates it.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from dronevio.estimator.initialization.gauge import BiasPrior
from dronevio.estimator.initialization.robust import INLIER_WEIGHT, robust_weights
from dronevio.estimator.initialization.views import Motion, WindowMeasurements
from dronevio.models.arrays import Array

MIN_START_DEPTH_M = 0.1
"""Smallest mean depth of a landmark that counts as in front of the cameras [m]."""
ITERATIONS = 12
"""Number of solutions, each with the depths and the weights of the one before."""
NEWTON_STEPS = 50
"""Largest number of steps to the multiplier of the constraint; a few suffice."""


@dataclass(frozen=True)
class NoiseModel:
    """Assumptions on the measurements."""

    xy_sigma: float
    """Standard deviation of an observation in normalized image coordinates."""
    outlier_sigmas: float
    """Root mean square residual at which a landmark has a quarter of its weight, in standard deviations."""
    accel_bias: BiasPrior
    """What is known of the accelerometer bias [m/s²]."""
    gravity_m_s2: float
    """Magnitude of gravity [m/s²]."""


@dataclass(frozen=True, eq=False)
class WindowState:
    """The state at the first frame of a window, in its IMU frame."""

    velocity: Array
    """(3,) Velocity of the IMU [m/s]."""
    gravity: Array
    """(3,) Acceleration of gravity [m/s²]."""
    accel_bias: Array
    """(3,) Accelerometer bias [m/s²]."""
    gyro_bias: Array
    """(3,) Gyroscope bias [rad/s]."""
    time_offset_s: float = 0.0
    """Time offset of camera and IMU relative to the one in use [s]: how much later than assumed the frames were
    exposed."""

    @cached_property
    def y(self) -> Array:
        """(10,) The linear unknowns: velocity, gravity, accelerometer bias and −1."""
        return np.concatenate([self.velocity, self.gravity, self.accel_bias, [-1.0]])


@dataclass(frozen=True, eq=False)
class ViewGeometry:
    """Where the cameras of the views are, as a linear function of the state."""

    Q: Array
    """(V, 3, 10) Matrices by which −Q y is the position of each camera, with y of `WindowState`."""
    R_first_cam: Array
    """(V, 3, 3) Rotations of the cameras."""

    @classmethod
    def of(cls, motion: Motion, Ts_imu_cam: Array) -> "ViewGeometry":
        """Return the geometry for a motion and the poses (V, 4, 4) of the views' cameras in the IMU frame."""
        t, eye = motion.t_s[:, None, None], np.eye(3)
        lever = motion.dp[..., None] + motion.R @ Ts_imu_cam[:, :3, 3:]
        Q = np.concatenate([-t * eye, -0.5 * t**2 * eye, -motion.dp_by_accel_bias, lever], axis=-1)
        return cls(Q, motion.R @ Ts_imu_cam[:, :3, :3])

    def in_cameras(self, landmarks: Array, y: Array) -> Array:
        """Return the positions (V, F, 3) of landmarks (F, 3) in the frames of the cameras."""
        return np.asarray((landmarks[None] + (self.Q @ y)[:, None]) @ self.R_first_cam)


@dataclass(frozen=True, eq=False)
class LinearSystem:
    """The observations as linear equations, with the landmarks eliminated.

    A landmark at p that is observed at (u, w) satisfies M R_first_camᵀ (p + Q y) = 0 with M = [1 0 −u; 0 1 −w]. The
    rows are distances; divided by the landmark's depth they are distances in normalized image coordinates.
    """

    H: Array
    """(F, 10, 10) Matrices by which yᵀ H y is the sum of the squared distances of each landmark."""
    B: Array
    """(F, 3, 10) Matrices by which B y is the position of the landmark that minimizes them."""

    @classmethod
    def of(cls, measured: WindowMeasurements, geometry: ViewGeometry) -> "LinearSystem":
        """Arrange the equations."""
        tracks, Q = measured.tracks, geometry.Q
        M = np.zeros((*tracks.observed.shape, 2, 3))
        M[..., 0, 0] = M[..., 1, 1] = 1.0
        M[..., 2] = -tracks.xy
        M = (M * tracks.observed[..., None, None]) @ np.swapaxes(geometry.R_first_cam, 1, 2)[:, None]
        N = np.swapaxes(M, -1, -2) @ M  # (V, F, 3, 3)
        NQ = N @ Q[:, None]
        sum_NQ = NQ.sum(axis=0)
        B = -np.linalg.solve(N.sum(axis=0) + 1e-9 * np.eye(3), sum_NQ)
        return cls(np.einsum("vij,vfik->fjk", Q, NQ, optimize=True) + np.swapaxes(sum_NQ, 1, 2) @ B, B)

    def squares(self, y: Array) -> Array:
        """Return the sums of squared distances (F,)."""
        return np.asarray(np.maximum(np.einsum("i,fij,j->f", y, self.H, y), 0.0))


def solve_closed_form(measured: WindowMeasurements, gyro_bias: Array, weights: Array, noise: NoiseModel) -> WindowState:
    """Return the state for a given gyroscope bias.

    Args:
        measured: Measurements of a window.
        gyro_bias: (3,) Gyroscope bias [rad/s].
        weights: (F,) Weights of the landmarks by earlier tests, 0 to 1.
        noise: Assumptions on the measurements.
    """
    geometry = ViewGeometry.of(measured.imu.integrated(gyro_bias).motion(), measured.Ts_imu_cam)
    system, freedom = LinearSystem.of(measured, geometry), measured.tracks.degrees_of_freedom
    reliable = weights >= min(INLIER_WEIGHT, float(weights.max()))
    robust, depth_m, y = weights, np.ones(len(weights)), np.zeros(10)
    for iteration in range(ITERATIONS):
        information = robust / (noise.xy_sigma * depth_m) ** 2
        y = _minimum(np.einsum("f,fij->ij", information, system.H), noise)
        depth_m = np.maximum(np.abs(mean_depth_m(measured, geometry.in_cameras(system.B @ y, y))), MIN_START_DEPTH_M)
        if iteration > 0:  # before, the depths were not known, so that the solution minimized distances
            squares = system.squares(y) / (noise.xy_sigma * depth_m) ** 2 / freedom
            robust = weights * robust_weights(squares, noise.outlier_sigmas, reliable)
    return WindowState(y[:3], y[3:6], y[6:9], gyro_bias)


def mean_depth_m(measured: WindowMeasurements, in_cameras: Array) -> Array:
    """Return the mean depths (F,) of landmarks at positions (V, F, 3) in the cameras that observe them [m]."""
    observed = measured.tracks.observed
    return np.asarray((in_cameras[..., 2] * observed).sum(axis=0) / observed.sum(axis=0))


def _minimum(H: Array, noise: NoiseModel) -> Array:
    """Return y (10,) with the velocity and the gravity, of its magnitude, that minimize yᵀ H y."""
    bias = noise.accel_bias.mean
    h = H[:6, 9] - H[:6, 6:9] @ bias
    eliminated = np.linalg.solve(H[:3, :3], np.column_stack([H[:3, 3:6], h[:3]]))
    D, d = H[3:6, 3:6] - H[3:6, :3] @ eliminated[:, :3], h[3:] - H[3:6, :3] @ eliminated[:, 3]
    gravity = on_sphere(D, d, noise.gravity_m_s2)
    velocity = eliminated[:, 3] - eliminated[:, :3] @ gravity
    return np.concatenate([velocity, gravity, bias, [-1.0]])


def on_sphere(D: Array, d: Array, radius: float) -> Array:
    """Return the vector x (3,) of a given norm that minimizes xᵀDx − 2dᵀx.

    It is (D + λI)⁻¹ d. Its norm decreases with λ, from infinity at minus the smallest eigenvalue of D to zero. Newton's
    method finds λ as the root of 1/norm − 1/radius, which is nearly linear and concave, so that the steps from below
    never pass it (Moré and Sorensen, "Computing a trust region step", SIAM J. Sci. Stat. Comput. 1983).
    """
    eigenvalues, U = np.linalg.eigh(D)
    c, above = U.T @ d, eigenvalues - eigenvalues[0]
    shift = 1e-9 * float(eigenvalues[-1])
    for _ in range(NEWTON_STEPS):
        x = c / (above + shift)
        norm2 = float(x @ x)
        if norm2 <= radius**2 * (1.0 + 1e-12):
            break
        shift += norm2 / float(x @ (x / (above + shift))) * (np.sqrt(norm2) / radius - 1.0)
    return np.asarray(U @ (c / (above + shift)))
