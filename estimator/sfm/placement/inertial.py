"""Gravity and scale of a reconstruction from an IMU.

Between two images, the IMU measures the rotation, and the changes of velocity and position apart from gravity. The
reconstruction gives the same rotations, and the positions up to scale. First the gyroscope bias is the one that brings
the rotations into agreement; then velocities, gravity and scale solve a linear problem, in which gravity has a known
magnitude (Qin, Li and Shen, "VINS-Mono: a robust and versatile monocular visual-inertial state estimator", T-RO 2018,
section V-B, eq. 14-20). Unlike there, the accelerometer bias is estimated, too, because a whole flight determines it,
and the solution has a covariance.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.optimize import least_squares
from scipy.sparse import block_diag, bsr_array, csr_array, diags_array, eye_array, vstack
from scipy.sparse.linalg import splu

from dronevio.estimator.imu.buffer import ImuBuffer, Increments
from dronevio.estimator.sfm.bearings import tangent_bases
from dronevio.estimator.sfm.config import InertialConfig
from dronevio.models.arrays import Array
from dronevio.models.image_sets import InertialData
from dronevio.models.imu import GRAVITY_M_S2, Times
from dronevio.models.rotation import integrated_rotations, log_so3

Indices = npt.NDArray[np.int64]

MAX_INTERVAL_S = 2.0
"""Longest time between two images over which the IMU is integrated [s]."""
MIN_INTERVALS = 4
"""Smallest number of intervals between images with IMU samples."""
ROTATION_SCALE_RAD = 0.01
"""Scale of the robust loss of the rotations that determine the gyroscope bias [rad]."""
GRAVITY_ITERATIONS = 5
"""Number of refinements of the direction of gravity."""
DAMPING = 1e-13
"""Addition to the normal equations, scaled to a unit diagonal, so that what is not determined stays small."""
REFINEMENTS = 3
"""Number of solutions of the normal equations, each for the residuals of those before."""
POSITION_SIGMA = 1e-3
"""Standard deviation of the reconstructed positions, relative to the median distance between successive images."""


@dataclass(frozen=True, eq=False)
class InertialAlignment:
    """Gravity and scale of a reconstruction, and how well they are determined."""

    scale: float
    """Length of a unit of the reconstruction [m]."""
    scale_sigma: float
    """Standard deviation of the scale, relative to it; 0 if the scale was known before."""
    gravity: Array
    """(3,) Gravity in the frame of the reconstruction [m/s²]."""
    tilt_sigma_rad: float
    """Standard deviation of the direction of gravity about the less certain axis [rad]."""
    gyro_bias_rad_s: Array
    """(3,) Gyroscope bias [rad/s]."""
    accel_bias_m_s2: Array
    """(3,) Accelerometer bias [m/s²]."""
    rms_position_m: float
    """RMS difference between the changes of position by the IMU and by the images [m]."""
    rms_rotation_rad: float
    """RMS angle between the rotations by the IMU and by the images [rad]."""
    intervals: int
    """Number of intervals between images that were used."""


@dataclass(frozen=True, eq=False)
class _Intervals:
    """N intervals between successive images: poses by the images, and IMU increments."""

    increments: tuple[Increments, ...]
    R_start: Array  # (N, 3, 3) orientation of the IMU at the start, in the frame of the reconstruction
    R_end: Array  # (N, 3, 3)
    moved: Array  # (N, 3) displacement of the camera, in units of the reconstruction
    lever_m: Array  # (N, 3) displacement of the IMU relative to that of the camera, due to rotation [m]
    start: Indices  # (N,) number of the velocity at the start
    end: Indices  # (N,)


@dataclass(frozen=True, eq=False)
class _Preintegrated:
    """Changes over an interval in the IMU frame at its start, without gravity and initial velocity."""

    t_s: float
    v: Array  # (3,) change of velocity [m/s]
    p: Array  # (3,) change of position [m]
    J_v: Array  # (3, 3) change of v by an accelerometer bias, negative [s]
    J_p: Array  # (3, 3)


def align_with_imu(
    t_ns: Times,
    Ts_world_cam: Array,
    Ts_imu_cam: Array,
    inertial: InertialData,
    config: InertialConfig,
    known_scale: bool = False,
) -> InertialAlignment | str:
    """Return gravity and scale of a reconstruction, or the reason why the IMU does not determine them.

    Args:
        t_ns: (N,) Increasing time stamps of the images by the clock of the cameras [ns].
        Ts_world_cam: (N, 4, 4) Their poses in the frame of the reconstruction.
        Ts_imu_cam: (N, 4, 4) Pose of the camera of each image in the IMU frame.
        inertial: Measurements of the IMU.
        config: Settings.
        known_scale: Whether the reconstruction is in metres.
    """
    intervals = _intervals(t_ns, Ts_world_cam, Ts_imu_cam, inertial)
    count = len(intervals.increments)
    if count < MIN_INTERVALS:
        return f"{count} intervals between images with IMU samples; {MIN_INTERVALS} are needed"

    def rotation_errors(gyro_bias: Array) -> Array:
        R = np.stack([part.rotation(gyro_bias) for part in intervals.increments])
        return np.asarray(log_so3(np.swapaxes(R, 1, 2) @ np.swapaxes(intervals.R_start, 1, 2) @ intervals.R_end))

    fit = least_squares(
        lambda bias: rotation_errors(bias).ravel(),
        np.zeros(3),
        loss="soft_l1",
        f_scale=ROTATION_SCALE_RAD,
        x_scale=0.01,
    )
    motions = [_preintegrate(part, fit.x) for part in intervals.increments]
    rms_rotation = float(np.sqrt(np.mean(np.sum(rotation_errors(fit.x) ** 2, axis=1))))
    return _solve(intervals, motions, fit.x, rms_rotation, inertial, config, known_scale)


def _intervals(t_ns: Times, Ts_world_cam: Array, Ts_imu_cam: Array, inertial: InertialData) -> _Intervals:
    """Return the intervals between successive images that have IMU samples and are not too long."""
    t_imu_ns = t_ns + round(inertial.time_offset_s * 1e9)
    buffer = ImuBuffer(inertial.model)
    buffer.add(inertial.samples)
    buffer.take_until(int(t_imu_ns[0]))
    increments = [buffer.take_until(int(t)) for t in t_imu_ns[1:]]
    first_ns, last_ns = int(inertial.samples.t_ns[0]), int(inertial.samples.t_ns[-1])
    kept = np.array(
        [
            k
            for k, part in enumerate(increments)
            if t_imu_ns[k] >= first_ns
            and t_imu_ns[k + 1] <= last_ns
            and 0.0 < part.duration_s <= MAX_INTERVAL_S
            and not part.is_degraded
        ],
        np.int64,
    )
    R_imu = Ts_world_cam[:, :3, :3] @ np.swapaxes(Ts_imu_cam[:, :3, :3], 1, 2)
    lever = -np.einsum("nij,nj->ni", R_imu, Ts_imu_cam[:, :3, 3])
    positions = Ts_world_cam[:, :3, 3]
    _, row = np.unique(np.concatenate([kept, kept + 1]), return_inverse=True)
    return _Intervals(
        tuple(increments[k] for k in kept),
        R_imu[kept],
        R_imu[kept + 1],
        positions[kept + 1] - positions[kept],
        lever[kept + 1] - lever[kept],
        row[: len(kept)].astype(np.int64),
        row[len(kept) :].astype(np.int64),
    )


def _preintegrate(increments: Increments, gyro_bias: Array) -> _Preintegrated:
    dt = increments.dt_s[:, None]
    R = integrated_rotations((increments.gyro_rad_s - gyro_bias) * dt)[:-1]
    columns = np.concatenate([np.einsum("nij,nj->ni", R, increments.accel_m_s2)[..., None], R], axis=2) * dt[..., None]
    after = np.cumsum(columns, axis=0)
    p = np.sum((after - 0.5 * columns) * dt[..., None], axis=0)
    return _Preintegrated(increments.duration_s, after[-1, :, 0], p[:, 0], after[-1, :, 1:], p[:, 1:])


def _solve(
    intervals: _Intervals,
    motions: list[_Preintegrated],
    gyro_bias: Array,
    rms_rotation: float,
    inertial: InertialData,
    config: InertialConfig,
    known_scale: bool,
) -> InertialAlignment:
    """Solve for velocities, scale, accelerometer bias and gravity, whose magnitude is known."""
    A, b = _equations(intervals, motions)
    density = config.noise_inflation * inertial.model.accel_noise_density
    step = float(np.median(np.linalg.norm(intervals.moved, axis=1)))
    guess = _least_squares(A, b, _whitening(motions, density, 0.0), config.accel_bias_m_s2, known_scale)
    # The noise of the reconstructed positions in metres follows from the scale.
    whitening = _whitening(motions, density, POSITION_SIGMA * step * abs(guess.scale))
    solution = _least_squares(A, b, whitening, config.accel_bias_m_s2, known_scale)
    residuals = solution.residuals.reshape(-1, 6)[:, :3]
    return InertialAlignment(
        scale=solution.scale,
        scale_sigma=float(np.sqrt(solution.scale_variance) / abs(solution.scale)),
        gravity=solution.gravity,
        tilt_sigma_rad=float(np.sqrt(np.linalg.eigvalsh(solution.gravity_covariance)[-1]) / GRAVITY_M_S2),
        gyro_bias_rad_s=gyro_bias,
        accel_bias_m_s2=solution.accel_bias,
        rms_position_m=float(np.sqrt(np.mean(np.sum(residuals**2, axis=1)))),
        rms_rotation_rad=rms_rotation,
        intervals=len(motions),
    )


@dataclass(frozen=True, eq=False)
class _Solution:
    scale: float
    accel_bias: Array  # (3,)
    gravity: Array  # (3,)
    residuals: Array  # (6N,) of positions [m] and velocities [m/s]
    scale_variance: float  # 0 for a known scale
    gravity_covariance: Array  # (2, 2) in the tangent plane [m²/s⁴]


def _equations(intervals: _Intervals, motions: list[_Preintegrated]) -> tuple[csr_array, Array]:
    """Return A (6N, 3V + 7) and b (6N,) of the linear problem A x = b.

    The unknowns are the velocities, the scale, the accelerometer bias, and gravity. The first three rows of each
    interval are its change of position, the others its change of velocity, both in the frame of the reconstruction.
    """
    count, velocities, eye = len(motions), 3 * (int(intervals.end.max()) + 1), np.eye(3)
    t = np.array([motion.t_s for motion in motions])[:, None, None]
    R = intervals.R_start
    # Columns of each interval: velocity at its start, at its end, scale, bias, gravity
    blocks = np.zeros((count, 6, 13))
    blocks[:, :3, :3], blocks[:, 3:, :3], blocks[:, 3:, 3:6] = -t * eye, -eye, eye
    blocks[:, :3, 6] = intervals.moved
    blocks[:, :3, 7:10] = R @ np.stack([motion.J_p for motion in motions])
    blocks[:, 3:, 7:10] = R @ np.stack([motion.J_v for motion in motions])
    blocks[:, :3, 10:], blocks[:, 3:, 10:] = -0.5 * t**2 * eye, -t * eye
    columns = np.empty((count, 13), np.int64)
    columns[:, :3], columns[:, 3:6] = (3 * ends[:, None] + np.arange(3) for ends in (intervals.start, intervals.end))
    columns[:, 6:] = velocities + np.arange(7)
    places = np.repeat(np.arange(6 * count), 13), np.repeat(columns, 6, axis=0).ravel()
    b = np.empty((count, 6))
    b[:, :3] = np.einsum("nij,nj->ni", R, np.stack([motion.p for motion in motions])) - intervals.lever_m
    b[:, 3:] = np.einsum("nij,nj->ni", R, np.stack([motion.v for motion in motions]))
    return csr_array((blocks.ravel(), places), shape=(6 * count, velocities + 7)), b.ravel()


def _whitening(motions: list[_Preintegrated], density: float, position_sigma_m: float) -> Array:
    """Return the factors (N, 2, 2) that make position and velocity of each interval uncorrelated with unit variance.

    Args:
        motions: The preintegrated measurements.
        density: White noise density of the accelerometer [m/s²/√Hz].
        position_sigma_m: Standard deviation of the position of each image [m].
    """
    t = np.array([motion.t_s for motion in motions])
    covariance = density**2 * np.stack([[t**3 / 3.0, t**2 / 2.0], [t**2 / 2.0, t]]).transpose(2, 0, 1)
    covariance[:, 0, 0] += 2.0 * position_sigma_m**2
    return np.linalg.inv(np.linalg.cholesky(covariance))


def _least_squares(A: csr_array, b: Array, whitening: Array, bias_sigma: float, known_scale: bool) -> _Solution:
    """Return the weighted least-squares solution in which gravity has its magnitude."""
    unknowns = A.shape[1]
    is_free = np.ones(unknowns, np.bool_)
    is_free[-7] = not known_scale
    # A block of six rows has three components of a position, then of a velocity.
    weights = bsr_array((np.kron(whitening, np.eye(3)), np.arange(len(whitening)), np.arange(len(whitening) + 1)))
    prior = csr_array((np.full(3, 1.0 / bias_sigma), (np.arange(3), unknowns - 6 + np.arange(3))), (3, unknowns))
    W, w = vstack([weights @ A, prior]).tocsr(), np.concatenate([weights @ b, np.zeros(3)])
    x = np.zeros(unknowns)
    x[-7] = 1.0
    x[is_free] = _NormalEquations(W[:, is_free]).solve(w - W[:, ~is_free] @ x[~is_free])
    for _ in range(GRAVITY_ITERATIONS):
        x[-3:] *= GRAVITY_M_S2 / np.linalg.norm(x[-3:])
        # The unknowns with gravity in its tangent plane: x = x0 + N y
        tangent = tangent_bases(x[-3:] / GRAVITY_M_S2)
        N = block_diag([eye_array(unknowns - 3, format="csr")[:, is_free[:-3]], tangent.T], format="csr")
        J = csr_array(W @ N)
        equations = _NormalEquations(J)
        x = x + N @ equations.solve(w - W @ x)
    residuals = w - W @ x
    variance = max(float(residuals @ residuals) / max(len(w) - J.shape[1], 1), 1.0)
    covariance = variance * equations.covariance(np.arange(J.shape[1] - 6, J.shape[1]))
    scale_variance = 0.0 if known_scale else float(covariance[0, 0])
    gravity = x[-3:] * GRAVITY_M_S2 / np.linalg.norm(x[-3:])
    return _Solution(float(x[-7]), x[-6:-3], gravity, A @ x - b, scale_variance, covariance[-2:, -2:])


class _NormalEquations:
    """A sparse linear least-squares problem, by its normal equations with iterative refinement."""

    def __init__(self, J: csr_array) -> None:
        diagonal = np.asarray(J.multiply(J).sum(axis=0))
        self._J, self._scale = J, 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
        scale = diags_array(self._scale)
        H = scale @ (J.T @ J) @ scale + DAMPING * eye_array(J.shape[1])
        symmetric = {"SymmetricMode": True}
        self._factor = splu(H.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=symmetric)

    def solve(self, r: Array) -> Array:
        """Return x (n,) of the smallest |J x − r|."""
        x = np.zeros(self._J.shape[1])
        for _ in range(REFINEMENTS):
            x += self._inverse(self._J.T @ (r - self._J @ x))
        return x

    def covariance(self, columns: Indices) -> Array:
        """Return the block of (JᵀJ)⁻¹ at some rows and columns (m,)."""
        unit = np.zeros((self._J.shape[1], len(columns)))
        unit[columns, np.arange(len(columns))] = 1.0
        return self._inverse(unit)[columns]

    def _inverse(self, b: Array) -> Array:
        scale = self._scale if b.ndim == 1 else self._scale[:, None]
        return np.asarray(scale * self._factor.solve(scale * b))
