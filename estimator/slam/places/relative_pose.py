"""Relative pose of two keyframes by robust least squares on the reprojection errors in both directions.

The old landmarks are projected into the new images and the new landmarks into the old ones. The directions of gravity
in both frames, which the odometry knows, are two more measurements. All six components are estimated, because the level
frames are not exact.

Landmarks are not exact either, mainly in their depth. Each depth has an error of its own, which is an unknown with a
prior and is eliminated from each step: the residual is that at zero error, with the covariance σ² I + ρ² s sᵀ, where s
is the derivative of the projection by the error and ρ its standard deviation. The linearization is at the estimated
error, since at zero error the derivatives would be correlated with the residuals, and the estimate biased. In addition,
all depths of a keyframe share an error, as that of the scale of a single camera, whose effect on the pose is added to
its covariance.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np
import numpy.typing as npt

from dronevio.estimator.backend.triangulation import MIN_DEPTH_M
from dronevio.estimator.optimization.gauss_newton import gauss_newton
from dronevio.estimator.optimization.linalg import LUFactor, SingularError
from dronevio.estimator.optimization.robust import cauchy_inflation, cauchy_loss
from dronevio.estimator.slam.places.matching import Correspondences
from dronevio.models.arrays import Array
from dronevio.models.ranges import Range, Settings
from dronevio.models.rotation import cross, exp_so3, pose_matrix, skew

DOWN = np.array([0.0, 0.0, -1.0])
MAX_ERROR = 1e3
"""Whitened error of a landmark behind the camera, which makes it an outlier."""
MIN_STEP = 1e-4
"""Size of a step, [rad] and [m], after which the next one would be negligible."""
MAX_DEPTH_SIGMAS = 3.0
"""Largest estimated error of a depth, in standard deviations."""


@dataclass(frozen=True)
class RelativePoseConfig(Settings):
    """Assumed errors of the measurements of a relative pose."""

    pixel_sigma: Annotated[float, Range(0.01, 100.0)] = 1.0
    """Standard deviation of the position of a corner [px]."""
    depth_sigma: Annotated[float, Range(0.0, 1.0)] = 0.03
    """Standard deviation of the depth of each landmark, relative to the depth."""
    scale_sigma: Annotated[float, Range(0.0, 1.0)] = 0.01
    """Standard deviation of the common error of the depths of a keyframe, relative to the depth."""
    tilt_sigma_deg: Annotated[float, Range(0.001, 45.0)] = 0.3
    """Standard deviation of the direction of gravity in the IMU frame of each keyframe [°]."""
    robust_sigmas: Annotated[float, Range(0.1, 1e3)] = 2.0
    """Scale of the Cauchy loss, in standard deviations."""
    iterations: Annotated[int, Range(1, 100)] = 10
    """Largest number of Gauss-Newton steps."""


@dataclass(frozen=True, eq=False)
class Views:
    """What is known of the two keyframes beside the correspondences."""

    Ts_imu_cam: Array
    """(C, 4, 4) Poses of the cameras in the IMU frame."""
    focal_px: Array
    """(C,) Focal lengths [px]."""
    R_match: Array
    """(3, 3) Orientation of the match's IMU in a frame with z up."""
    R_query: Array
    """(3, 3) Orientation of the query's IMU in a frame with z up."""


@dataclass(frozen=True, eq=False)
class PoseFit:
    """The estimated relative pose of two keyframes."""

    T_match_query: Array
    """(4, 4) Pose of the query's IMU in the IMU frame of the match."""
    covariance: Array
    """(6, 6) Covariance of δθ (right perturbation, frame of the query) and δp (frame of the match)."""
    tilt_sigmas: float
    """Deviation from the directions of gravity, in standard deviations."""

    def is_certain(self, max_sigma_m: float, max_sigma_rad: float) -> bool:
        """Return whether no standard deviation of position [m] and rotation [rad] exceeds a limit, in any direction."""
        rotation, position = (float(np.linalg.eigvalsh(self.covariance[i : i + 3, i : i + 3])[-1]) for i in (0, 3))
        return rotation <= max_sigma_rad**2 and position <= max_sigma_m**2


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """The variables: the relative pose, and the errors of the depths at which the projections are linearized."""

    T_match_query: Array
    """(4, 4) Pose of the query's IMU in that of the match."""
    depth: Array
    """(N, 1) Relative errors of the depths of all landmarks, those of the match first."""


@dataclass(frozen=True, eq=False)
class DepthScales:
    """Covariances σ² I + ρ² s sᵀ of N residuals about a linearization.

    Their inverse roots are (I − k s sᵀ) / σ.
    """

    depth: Array
    """(N, 1) Relative errors of the depths at which it is."""
    s: Array
    """(N, 2) Derivatives of the projections by these errors."""
    k: Array
    """(N, 1) Share of the error along s that is removed, divided by its squared length."""
    weight: Array
    """(N, 1) 1/σ; zero for landmarks behind the camera."""

    def whitened(self, residual: Array) -> Array:
        """Return residuals (N, 2) of the projections in standard deviations."""
        return np.asarray(self.weight * (residual - self.k * self.s * np.sum(self.s * residual, axis=1, keepdims=True)))


@dataclass(frozen=True, eq=False)
class PoseEquations:
    """Normal equations of a relative pose, and the residuals that they are made of; depths are eliminated."""

    H: Array
    """(6, 6) Information matrix of δθ (right) and δp."""
    b: Array
    """(6,) Right-hand side, the negative gradient."""
    x: PoseEstimate
    """The variables at which they are linearized."""
    scales: DepthScales
    """Covariances of the residuals."""
    J: Array
    """(N, 2, 6) Whitened Jacobians by δθ and δp."""
    by_scale: Array
    """(N, 2) Whitened derivatives by the logarithm of the common scale of the landmarks."""
    error: Array
    """(N,) Whitened errors, about 1 for inliers."""
    weights: Array
    """(N,) Weights of the Cauchy loss."""
    depth: Array
    """(N, 1) Estimated relative errors of the depths."""
    tilt_sigmas: float
    """Deviation from the directions of gravity, in standard deviations."""

    def retract(self, delta: Array) -> PoseEstimate:
        """Return the variables after a step (6,), with the estimated depths."""
        T = self.x.T_match_query
        return PoseEstimate(pose_matrix(T[:3, :3] @ exp_so3(delta[:3]), T[:3, 3] + delta[3:]), self.depth)

    def scale_gradients(self, count_old: int) -> Array:
        """Return the gradients (6, 2) with respect to the scale of the old and of the new landmarks."""
        weighted = np.sum(self.J * self.by_scale[:, :, None], axis=1) * self.weights[:, None]
        return np.stack([weighted[:count_old].sum(axis=0), weighted[count_old:].sum(axis=0)], axis=1)

    @property
    def variance_factor(self) -> float:
        """Factor, 1 or more, by which the variance of the residuals exceeds the assumed one."""
        freedom = 2.0 * self.weights.sum() - 6.0
        return max(1.0, float(2.0 * np.sum(self.weights * self.error**2) / freedom)) if freedom > 0.0 else 1.0


class RelativePoseObjective:
    """The measurements of one relative pose."""

    def __init__(self, old: Correspondences, new: Correspondences, views: Views, config: RelativePoseConfig) -> None:
        """Take the correspondences in both directions; see `refine`."""
        self.count_old = len(old)
        """Number of old landmarks, which come first."""
        self._config, self._views = config, views
        self._old, self._new = old.points, new.points
        self._rays_old = old.points - views.Ts_imu_cam[old.point_camera, :3, 3]
        self._rays_new = new.points - views.Ts_imu_cam[new.point_camera, :3, 3]
        self._xy = np.concatenate([old.xy, new.xy])
        camera = np.concatenate([old.camera, new.camera])
        self._R_cam_imu = np.swapaxes(views.Ts_imu_cam[camera, :3, :3], 1, 2)
        self._p_imu_cam = views.Ts_imu_cam[camera, :3, 3]
        self._sigma = (config.pixel_sigma / views.focal_px[camera])[:, None]

    def initial(self, T_match_query: Array) -> PoseEstimate:
        """Return the variables for a pose (4, 4), with the depths as they are given."""
        return PoseEstimate(T_match_query, np.zeros((len(self._xy), 1)))

    def linearize(self, x: PoseEstimate) -> PoseEquations:
        """Return the normal equations at some variables."""
        R, n = x.T_match_query[:3, :3], self.count_old
        p_imu, p_cam, z, is_behind = self._in_cameras(x.T_match_query, x.depth)
        projected = p_cam[:, :2] / z
        # Derivatives of the projection by the landmark in the IMU frame, by the pose and by the depth
        J_p = (self._R_cam_imu[:, :2] - projected[:, :, None] * self._R_cam_imu[:, 2:]) / z[:, :, None]
        new = self._new + x.depth[n:] * self._rays_new
        J = np.empty((len(z), 2, 6))
        J[:n, :, :3], J[:n, :, 3:] = cross(J_p[:n], p_imu[:n, None]), -J_p[:n] @ R.T
        J[n:, :, :3], J[n:, :, 3:] = cross(new[:, None], J_p[n:] @ R), J_p[n:]
        ray = np.concatenate([self._rays_old @ R, self._rays_new @ R.T])
        s = (J_p @ ray[:, :, None])[:, :, 0]
        # The depths are eliminated: residuals at their priors' means, with their covariances
        variance, length2 = self._config.depth_sigma**2, np.sum(s * s, axis=1, keepdims=True)
        gain = np.sqrt(1.0 + variance * length2 / self._sigma**2)
        k = (1.0 - 1.0 / gain) / np.maximum(length2, 1e-300)
        scales = DepthScales(x.depth, s, k, np.where(is_behind[:, None], 0.0, 1.0 / self._sigma))
        residual = projected - self._xy - x.depth * s
        depth = -variance * np.sum(s * residual, axis=1, keepdims=True) / (self._sigma**2 + variance * length2)
        limit = MAX_DEPTH_SIGMAS * self._config.depth_sigma  # that of outliers
        residual, along = scales.whitened(residual), (s[:, None, :] @ J)[:, 0]
        J = scales.weight[:, :, None] * (J - (k * s)[:, :, None] * along[:, None, :])
        # Robust normal equations
        error = np.where(is_behind, MAX_ERROR, np.sqrt(0.5 * np.sum(residual * residual, axis=1)))
        weights = 1.0 / cauchy_inflation((error / self._config.robust_sigmas) ** 2, 1.0)
        weighted = J * weights[:, None, None]
        H, g = (np.tensordot(weighted, each, ((0, 1), (0, 1))) for each in (J, residual))
        tilt, J_tilt = self._tilt(R)
        H[:3, :3] += J_tilt.T @ J_tilt
        g[:3] += J_tilt.T @ tilt
        by_scale, depth = scales.weight * s * (1.0 - k * length2), np.clip(depth, -limit, limit)
        return PoseEquations(H, -g, x, scales, J, by_scale, error, weights, depth, float(np.linalg.norm(tilt)))

    def cost(self, x: PoseEstimate, scales: DepthScales) -> float:
        """Return the cost of a pose, with the depths eliminated as in a linearization."""
        _, p_cam, z, _ = self._in_cameras(x.T_match_query, scales.depth)
        residual = scales.whitened(p_cam[:, :2] / z - self._xy - scales.depth * scales.s)
        losses = cauchy_loss(np.sum(residual * residual, axis=1), 2.0 * self._config.robust_sigmas**2)
        tilt = self._tilt(x.T_match_query[:3, :3])[0]
        return 0.5 * float(losses.sum() + tilt @ tilt)

    def _in_cameras(self, T: Array, depth: Array) -> tuple[Array, Array, Array, npt.NDArray[np.bool_]]:
        """Return the landmarks (N, 3) in the frames of IMU and camera, their depths (N, 1), and which are behind."""
        # Old landmarks are Rᵀ(X − p) in the query's frame, and new ones R Y + p in the match's frame.
        R, p, n = T[:3, :3], T[:3, 3], self.count_old
        new = self._new + depth[n:] * self._rays_new
        p_imu = np.concatenate([(self._old + depth[:n] * self._rays_old - p) @ R, new @ R.T + p])
        p_cam = (self._R_cam_imu @ (p_imu - self._p_imu_cam)[:, :, None])[:, :, 0]
        is_behind = p_cam[:, 2] < MIN_DEPTH_M
        return p_imu, p_cam, np.where(is_behind, 1.0, p_cam[:, 2])[:, None], is_behind

    def _tilt(self, R: Array) -> tuple[Array, Array]:
        """Return the deviation (3,) of gravity in standard deviations, and its derivative (3, 3) by δθ."""
        views, sigma = self._views, np.sqrt(2.0) * np.radians(self._config.tilt_sigma_deg)
        down_query, down_predicted = views.R_query.T @ DOWN, R.T @ views.R_match.T @ DOWN
        # The component along gravity is zero to the first order; keeping it makes a basis unnecessary.
        return (down_predicted - down_query) / sigma, skew(down_predicted) / sigma


def whitened_errors(
    T_match_query: Array, old: Correspondences, new: Correspondences, views: Views, config: RelativePoseConfig
) -> tuple[Array, Array]:
    """Return the whitened reprojection errors (N,) and (M,) of both directions by a pose, about 1 for inliers."""
    objective = RelativePoseObjective(old, new, views, config)
    error = objective.linearize(objective.initial(T_match_query)).error
    return error[: len(old)], error[len(old) :]


def refine(
    T_match_query: Array, old: Correspondences, new: Correspondences, views: Views, config: RelativePoseConfig
) -> PoseFit | None:
    """Return the relative pose that minimizes the robust reprojection errors, None if it is not determined.

    Args:
        T_match_query: (4, 4) Initial pose.
        old: Landmarks of the match and corners of the query.
        new: Landmarks of the query and corners of the match.
        views: Cameras and directions of gravity.
        config: Assumed errors.
    """
    objective = RelativePoseObjective(old, new, views, config)
    initial = objective.initial(T_match_query)
    try:
        x = gauss_newton(objective, initial, LUFactor, config.iterations, lambda s: np.abs(s.delta).max() < MIN_STEP).x
    except SingularError:
        return None
    equations = objective.linearize(x)
    if not np.all(np.isfinite(equations.H)) or np.linalg.cond(equations.H) > 1e14:
        return None
    covariance = np.linalg.inv(equations.H)
    sensitivity = covariance @ equations.scale_gradients(objective.count_old)  # (6, 2) of the pose, to both scales
    covariance = covariance * equations.variance_factor + config.scale_sigma**2 * sensitivity @ sensitivity.T
    return PoseFit(x.T_match_query, 0.5 * (covariance + covariance.T), equations.tilt_sigmas)
