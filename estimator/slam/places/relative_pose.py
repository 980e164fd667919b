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

from dronevio.estimator.slam.places.matching import Correspondences
from dronevio.models.ranges import Range, Settings
from dronevio.models.rotation import cross, exp_so3, skew

Array = npt.NDArray[np.float64]

DOWN = np.array([0.0, 0.0, -1.0])
MAX_ERROR = 1e3
"""Whitened error of a landmark behind the camera, which makes it an outlier."""
MIN_STEP = 1e-4
"""Size of a step, [rad] and [m], after which the next one would be negligible."""
MAX_DEPTH_SIGMAS = 3.0
"""Largest estimated error of a depth, in standard deviations."""
MIN_DEPTH_M = 0.05
"""Smallest depth at which a landmark is projected [m]."""


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
class _Linearized:
    """Whitened residuals of all correspondences and their Jacobians; those of the old landmarks come first."""

    residual: Array  # (N, 2)
    J: Array  # (N, 2, 6)
    scale: Array  # (N, 2) derivative with respect to the logarithm of the common scale of the landmarks
    error: Array  # (N,)
    depth: Array  # (N, 1) estimated relative errors of the depths


class _Problem:
    """The measurements of one relative pose."""

    def __init__(self, old: Correspondences, new: Correspondences, views: Views, config: RelativePoseConfig) -> None:
        self.count_old = len(old)
        self._config, self._views = config, views
        self._old, self._new = old.points, new.points
        self._rays_old = old.points - views.Ts_imu_cam[old.point_camera, :3, 3]
        self._rays_new = new.points - views.Ts_imu_cam[new.point_camera, :3, 3]
        self._xy = np.concatenate([old.xy, new.xy])
        camera = np.concatenate([old.camera, new.camera])
        self._R_cam_imu = np.swapaxes(views.Ts_imu_cam[camera, :3, :3], 1, 2)
        self._p_imu_cam = views.Ts_imu_cam[camera, :3, 3]
        self._sigma = (config.pixel_sigma / views.focal_px[camera])[:, None]

    def linearize(self, T: Array, depth: Array | None = None) -> _Linearized:
        """Return the residuals at a pose (4, 4) of the query's IMU in that of the match.

        Args:
            T: The pose.
            depth: (N, 1) Relative errors of the depths at which the projection is linearized; zero by default.
        """
        R, p, n = T[:3, :3], T[:3, 3], self.count_old
        depth = np.zeros((len(self._xy), 1)) if depth is None else depth
        # Old landmarks are Rᵀ(X − p) in the query's frame, and new ones R Y + p in the match's frame.
        new = self._new + depth[n:] * self._rays_new
        p_imu = np.concatenate([(self._old + depth[:n] * self._rays_old - p) @ R, new @ R.T + p])
        ray = np.concatenate([self._rays_old @ R, self._rays_new @ R.T])
        p_cam = (self._R_cam_imu @ (p_imu - self._p_imu_cam)[:, :, None])[:, :, 0]
        is_behind = p_cam[:, 2] < MIN_DEPTH_M
        z = np.where(is_behind, 1.0, p_cam[:, 2])[:, None]
        projected = p_cam[:, :2] / z
        # Derivative of the projection with respect to the landmark in the IMU frame.
        J_p = (self._R_cam_imu[:, :2] - projected[:, :, None] * self._R_cam_imu[:, 2:]) / z[:, :, None]
        J = np.empty((len(z), 2, 6))
        J[:n, :, :3], J[:n, :, 3:] = cross(J_p[:n], p_imu[:n, None]), -J_p[:n] @ R.T
        J[n:, :, :3], J[n:, :, 3:] = cross(new[:, None], J_p[n:] @ R), J_p[n:]
        scale = (J_p @ ray[:, :, None])[:, :, 0]
        # W = (σ² I + ρ² s sᵀ)^(−½) = (I − k s sᵀ) / σ.
        length2 = np.sum(scale * scale, axis=1, keepdims=True)
        gain = np.sqrt(1.0 + self._config.depth_sigma**2 * length2 / self._sigma**2)
        k = (1.0 - 1.0 / gain) / np.maximum(length2, 1e-300)
        weight = np.where(is_behind[:, None], 0.0, 1.0 / self._sigma)
        # Residuals at the depths that explain them best, whitened by W
        residual = projected - self._xy - depth * scale
        variance = self._config.depth_sigma**2
        depth = -variance * np.sum(scale * residual, axis=1, keepdims=True) / (self._sigma**2 + variance * length2)
        residual = weight * (residual - k * scale * np.sum(scale * residual, axis=1, keepdims=True))
        # Jacobian and errors, whitened by W
        along = (scale[:, None, :] @ J)[:, 0]
        J = weight[:, :, None] * (J - (k * scale)[:, :, None] * along[:, None, :])
        error = np.where(is_behind, MAX_ERROR, np.sqrt(0.5 * np.sum(residual * residual, axis=1)))
        limit = MAX_DEPTH_SIGMAS * self._config.depth_sigma  # that of outliers
        return _Linearized(residual, J, weight * scale * (1.0 - k * length2), error, np.clip(depth, -limit, limit))

    def normal_equations(self, T: Array, depth: Array | None = None) -> tuple[Array, Array, _Linearized, float]:
        """Return H (6, 6), g (6,), the residuals, and the deviation of gravity in standard deviations."""
        part, views, config = self.linearize(T, depth), self._views, self._config
        weighted = part.J * self.weights(part)[:, None, None]
        H = np.tensordot(weighted, part.J, ((0, 1), (0, 1)))
        g = np.tensordot(weighted, part.residual, ((0, 1), (0, 1)))
        down_query, down_predicted = views.R_query.T @ DOWN, T[:3, :3].T @ views.R_match.T @ DOWN
        sigma = np.sqrt(2.0) * np.radians(config.tilt_sigma_deg)
        # The component along gravity is zero to the first order; keeping it makes a basis unnecessary.
        residual, J_tilt = (down_predicted - down_query) / sigma, skew(down_predicted) / sigma
        H[:3, :3] += J_tilt.T @ J_tilt
        g[:3] += J_tilt.T @ residual
        return H, g, part, float(np.linalg.norm(residual))

    def weights(self, part: _Linearized) -> Array:
        """Return the weights (N,) of the Cauchy loss."""
        return np.asarray(1.0 / (1.0 + (part.error / self._config.robust_sigmas) ** 2))

    def scale_gradients(self, part: _Linearized) -> Array:
        """Return the gradients (6, 2) with respect to the scale of the old and of the new landmarks."""
        weighted = np.sum(part.J * part.scale[:, :, None], axis=1) * self.weights(part)[:, None]
        return np.stack([weighted[: self.count_old].sum(axis=0), weighted[self.count_old :].sum(axis=0)], axis=1)

    def variance_factor(self, part: _Linearized) -> float:
        """Return the factor, 1 or more, by which the variance of the residuals exceeds the assumed one."""
        weight = self.weights(part)
        freedom = 2.0 * weight.sum() - 6.0
        return max(1.0, float(2.0 * np.sum(weight * part.error**2) / freedom)) if freedom > 0.0 else 1.0


def whitened_errors(
    T_match_query: Array, old: Correspondences, new: Correspondences, views: Views, config: RelativePoseConfig
) -> tuple[Array, Array]:
    """Return the whitened reprojection errors (N,) and (M,) of both directions by a pose, about 1 for inliers."""
    error = _Problem(old, new, views, config).linearize(T_match_query).error
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
    problem, T = _Problem(old, new, views, config), np.array(T_match_query, np.float64)
    depth: Array | None = None
    for _ in range(config.iterations):
        H, g, part, _ = problem.normal_equations(T, depth)
        depth = part.depth
        try:
            step = np.asarray(-np.linalg.solve(H, g), np.float64)
        except np.linalg.LinAlgError:
            return None
        T[:3, :3] = T[:3, :3] @ exp_so3(step[:3])
        T[:3, 3] += step[3:]
        if np.abs(step).max() < MIN_STEP:
            break
    H, _, part, tilt = problem.normal_equations(T, depth)
    if not np.all(np.isfinite(H)) or np.linalg.cond(H) > 1e14:
        return None
    covariance = np.linalg.inv(H)
    sensitivity = covariance @ problem.scale_gradients(part)  # (6, 2) of the pose, with respect to both scales
    covariance = covariance * problem.variance_factor(part) + config.scale_sigma**2 * sensitivity @ sensitivity.T
    return PoseFit(T, 0.5 * (covariance + covariance.T), tilt)
