"""Bundle adjustment by the method of Levenberg and Marquardt.

Each inlier observation has a reprojection error, by the pose of its image, its point and, if the camera is not
calibrated, its focal length and distortion: two radial coefficients of a pinhole, four of a fisheye. Poses have further
factors (`pose_factors`), and points that are measured have priors. The points are eliminated (`schur`).

References:
    Triggs, McLauchlan, Hartley, Fitzgibbon, "Bundle adjustment: a modern synthesis", 2000.
    Nielsen, "Damping parameter in Marquardt's method", 1999, for the damping.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated

import numpy as np
import numpy.typing as npt

from dronevio.estimator.optimization.linalg import SingularError
from dronevio.estimator.optimization.robust import cauchy_inflation, cauchy_loss
from dronevio.estimator.sfm.adjustment.pose_factors import PoseFactors, RelativePose, pose_factors
from dronevio.estimator.sfm.adjustment.reprojection import (
    BLOCK,
    Observations,
    Variables,
    derivatives,
    intrinsics_of,
    residuals,
)
from dronevio.estimator.sfm.adjustment.schur import Blocks, Groups, NormalEquations, joined
from dronevio.estimator.sfm.intrinsics import IntrinsicsPrior
from dronevio.estimator.sfm.model import KnownPoses, PositionPriors, Scene, SfmState
from dronevio.models.arrays import Array, Mask
from dronevio.models.ranges import Range, Settings

Indices = npt.NDArray[np.int64]

PIXEL_SIGMA = 1.0
"""Standard deviation of the observation of a small feature [px]."""
FISHEYE_SIGMAS = (0.5, 0.1, 0.1, 0.1, 0.1)
"""Standard deviations of the priors of a fisheye: focal length, relative to it, and distortion coefficients."""
MAX_ANGLE_COSINE = 0.1
"""Smallest cosine of the angle from the optical axis of the observations by which an estimated fisheye is adjusted."""
INITIAL_DAMPING = 1e-4
"""Damping of the first step, relative to the diagonal of the information matrix."""
MAX_DAMPING = 1e8
"""Damping above which no step decreases the cost."""
HIDDEN_FOCAL_LENGTHS = 2.0
"""Residual of a point that its camera does not see, such as one behind it, in focal lengths."""


@dataclass(frozen=True)
class BundleAdjustmentConfig(Settings):
    """Bundle adjustment."""

    max_iterations: Annotated[int, Range(1, 1000)] = 50
    """Largest number of iterations."""
    relative_tolerance: Annotated[float, Range(0.0, 1.0)] = 1e-6
    """Relative decrease of the error at which the optimizer stops."""
    cauchy_px: Annotated[float | None, Range(above=0.0)] = None
    """Scale of the Cauchy loss [px] for small features; None for a squared loss."""
    noise_px: Annotated[float, Range(above=0.0)] = PIXEL_SIGMA
    """Standard deviation of the observation of a small feature [px]."""


def adjust(
    scene: Scene,
    state: SfmState,
    selected: Mask,
    config: BundleAdjustmentConfig,
    rig: Sequence[RelativePose] = (),
    priors: KnownPoses | None = None,
    positions: PositionPriors | None = None,
) -> SfmState:
    """Adjust poses, points and cameras; the images of `Scene.is_fixed` keep their poses.

    Args:
        scene: The measurements.
        state: The initial values.
        selected: (M,) Observations that are used, a subset of `SfmState.used`.
        config: Settings of the optimizer.
        rig: Known relative poses of images.
        priors: Measured poses of at least two images, which then determine the world frame.
        positions: Measured positions, which then determine the world frame, and near which the state is.
    """
    problem, x = _problem(scene, state, selected, config, rig, priors, positions)
    x = _minimized(problem, x, config)
    Ts_world_cam, points, cameras = state.Ts_world_cam.copy(), state.points.copy(), list(state.cameras)
    moves = ~scene.is_fixed[problem.images]
    Ts_world_cam[problem.images[moves]] = x.Ts_world_cam[moves]
    points[problem.tracks] = x.points
    for row in np.flatnonzero(problem.estimated).tolist():
        cameras[problem.cameras[row]] = x.cameras[row]
    return replace(state, cameras=tuple(cameras), Ts_world_cam=Ts_world_cam, points=points)


def intrinsics_covariances(
    scene: Scene, state: SfmState, selected: Mask, config: BundleAdjustmentConfig
) -> dict[int, Array]:
    """Return the covariance of the intrinsics of each estimated camera, by its index, at the optimum of `adjust`.

    The parameters are focal length [px], k1 and k2 of a pinhole, and also k3 and k4 of a fisheye. The covariance of
    parameters that are held is zero; it is infinite where the observations do not determine the scene.
    """
    problem, x = _problem(scene, state, selected, config)
    rows = np.flatnonzero(problem.estimated)
    sizes = [5 if x.cameras[row].lens == "equidistant" else 3 for row in rows.tolist()]
    try:
        found = problem.linearized(x).covariance(len(problem.images) + rows)
    except SingularError:
        found = np.full((len(rows), BLOCK, BLOCK), np.nan)
    result = {}
    for row, size, covariance in zip(rows.tolist(), sizes, found, strict=True):
        count = int(problem.estimated[row])
        covariance[count:], covariance[:, count:] = 0.0, 0.0
        is_valid = np.isfinite(covariance).all() and (np.diag(covariance)[:count] > 0.0).all()
        result[int(problem.cameras[row])] = covariance[:size, :size] if is_valid else np.diag(np.full(size, np.inf))
    return result


def _minimized(problem: "_Problem", x: Variables, config: BundleAdjustmentConfig) -> Variables:
    """Return the variables after damped steps that decrease the cost."""
    cost, damping, growth = problem.cost(x), INITIAL_DAMPING, 2.0
    for _ in range(config.max_iterations):
        equations = problem.linearized(x)
        while True:
            try:
                blocks, points, predicted = equations.step(damping)
            except SingularError:
                decrease = -np.inf
            else:
                images = len(problem.images)
                candidate = x.moved(blocks[:images], points, blocks[images:])
                decrease = cost - problem.cost(candidate)
            if decrease > 0.0:
                break
            damping, growth = damping * growth, 2.0 * growth
            if damping > MAX_DAMPING:
                return x
        damping *= max(1.0 / 3.0, 1.0 - (2.0 * decrease / max(predicted, 1e-300) - 1.0) ** 3)
        x, cost, before, growth = candidate, cost - decrease, cost, 2.0
        if decrease <= config.relative_tolerance * before:
            break
    return x


@dataclass(frozen=True, eq=False)
class _Problem:
    """A bundle adjustment of I images, T points and K cameras, whose rows are those of the variables."""

    images: Indices
    """(I,) Indices of the images."""
    tracks: Indices
    """(T,) Indices of the tracks."""
    cameras: Indices
    """(K,) Indices of the cameras."""
    estimated: Indices
    """(K,) Number of intrinsics of each camera that are estimated."""
    observations: Observations
    """The observations."""
    cauchy: float | None
    """Scale of the Cauchy loss of the observations, in standard deviations; None for a squared loss."""
    intrinsics: Array
    """(K, 6) Expected intrinsics, padded."""
    intrinsics_sigmas: Array
    """(K, 6) Their standard deviations; infinite without a prior."""
    pose_factors: PoseFactors
    """Factors on the poses."""
    point_rows: Indices
    """(G,) Rows of the points that are measured."""
    point_targets: Array
    """(G, 3) Their measured positions."""
    point_sigmas: Array
    """(G, 3) Standard deviations of these."""
    point_cauchy: float
    """Scale of their Cauchy loss, in standard deviations."""

    def cost(self, x: Variables) -> float:
        """Return half the sum of all losses."""
        squared = self._squared(residuals(self.observations, x))
        losses = squared if self.cauchy is None else cauchy_loss(squared, self.cauchy**2)
        result = float(losses.sum()) + float(np.sum((self._deviations(x) / self.intrinsics_sigmas) ** 2))
        result += float(cauchy_loss(np.sum(self._apart(x) ** 2, axis=1), self.point_cauchy**2).sum())
        return 0.5 * result + self.pose_factors.cost(x.Ts_world_cam)

    def linearized(self, x: Variables) -> NormalEquations:
        """Return the normal equations, with the weights of the robust loss."""
        o, images, cameras = self.observations, len(self.images), len(self.cameras)
        r, A, B, C = self._whitened(x)
        At, Bt, Ct = (np.swapaxes(J, 1, 2) for J in (A, B, C))
        r = r[..., None]
        # Poses and points
        image, camera = np.arange(images), images + np.arange(cameras)
        U = [Blocks(image, image, self._by_image.sums(At @ A))]
        W = [Blocks(o.image, o.point, At @ B)]
        V, b_points = self._by_point.sums(Bt @ B), -self._by_point.sums(Bt @ r)[..., 0]
        b = np.zeros((images + cameras, BLOCK))
        b[:images] = -self._by_image.sums(At @ r)[..., 0]
        # Intrinsics and their coupling; rows of those that are not estimated are the identity
        information = self.intrinsics_sigmas**-2.0
        diagonal = np.where(np.arange(BLOCK) < self.estimated[:, None], information, 1.0)
        U.append(Blocks(camera, camera, diagonal[:, :, None] * np.eye(BLOCK)))
        b[images:] -= information * self._deviations(x)
        if self.estimated.any():
            between, camera_of_image = self._by_image.sums(At @ C), images + self._camera_of_image
            U.append(Blocks(camera, camera, self._by_camera.sums(Ct @ C)))
            U.append(Blocks(image, camera_of_image, between))
            U.append(Blocks(camera_of_image, image, np.swapaxes(between, 1, 2)))
            W.append(Blocks(images + o.camera, o.point, Ct @ B))
            b[images:] -= self._by_camera.sums(Ct @ r)[..., 0]
        # Factors on poses, and priors of points
        of_poses, b_poses = self.pose_factors.linearized(x.Ts_world_cam)
        U.append(of_poses)
        b[:images] += b_poses
        apart = self._apart(x)
        weight = 1.0 / cauchy_inflation(np.sum(apart**2, axis=1), self.point_cauchy**2)[:, None]
        V[self.point_rows] += (weight / self.point_sigmas**2)[:, :, None] * np.eye(3)
        b_points[self.point_rows] -= weight * apart / self.point_sigmas
        rows = images + cameras
        U_matrix, W_matrix = joined(U).matrix(rows, rows), joined(W).matrix(rows, len(self.tracks))
        return NormalEquations(U_matrix, W_matrix, V, b.ravel(), b_points)

    def _whitened(self, x: Variables) -> tuple[Array, Array, Array, Array]:
        """Return the residuals (M, 2) and their derivatives (M, 2, …) by pose, point and intrinsics, with weights.

        All are zero where a camera does not see its point.
        """
        r, d = residuals(self.observations, x), derivatives(self.observations, x, self.estimated)
        weight = np.ones(len(r)) if self.cauchy is None else 1.0 / cauchy_inflation(self._squared(r), self.cauchy**2)
        every = np.concatenate([r[..., None], d.pose, d.point, d.intrinsics], axis=2)
        every *= np.sqrt(weight)[:, None, None]
        every[~np.isfinite(every).all(axis=(1, 2))] = 0.0
        r, A, B, C = np.split(every, [1, 1 + BLOCK, 4 + BLOCK], axis=2)
        return r[..., 0], A, B, C

    def _squared(self, r: Array) -> Array:
        """Return the squares (M,) of residuals (M, 2), large ones for points that are not seen."""
        squared = np.einsum("ni,ni->n", r, r)
        hidden = (HIDDEN_FOCAL_LENGTHS * self._focal_px[self.observations.camera] / self.observations.sigma_px) ** 2
        return np.where(np.isfinite(squared), squared, hidden)

    def _deviations(self, x: Variables) -> Array:
        """Return the deviations (K, 6) of the intrinsics from what is expected; 0 for those without a prior."""
        values = np.zeros_like(self.intrinsics)
        for row, camera in enumerate(x.cameras):
            own = intrinsics_of(camera)[:BLOCK]
            values[row, : len(own)] = own
        return np.where(np.isfinite(self.intrinsics_sigmas), values - self.intrinsics, 0.0)

    def _apart(self, x: Variables) -> Array:
        """Return the deviations (G, 3) of the measured points in standard deviations."""
        return np.asarray((x.points[self.point_rows] - self.point_targets) / self.point_sigmas)

    @cached_property
    def _focal_px(self) -> Array:
        return np.maximum(self.intrinsics[:, 0], 1.0)

    @cached_property
    def _by_image(self) -> Groups:
        return Groups(self.observations.image, len(self.images))

    @cached_property
    def _by_point(self) -> Groups:
        return Groups(self.observations.point, len(self.tracks))

    @cached_property
    def _by_camera(self) -> Groups:
        return Groups(self.observations.camera, len(self.cameras))

    @cached_property
    def _camera_of_image(self) -> Indices:
        camera = np.zeros(len(self.images), np.int64)
        camera[self.observations.image] = self.observations.camera
        return camera


def _problem(
    scene: Scene,
    state: SfmState,
    selected: Mask,
    config: BundleAdjustmentConfig,
    rig: Sequence[RelativePose] = (),
    priors: KnownPoses | None = None,
    positions: PositionPriors | None = None,
) -> tuple[_Problem, Variables]:
    """Return the problem of `adjust`, and its variables at the beginning."""
    index = _seen(scene, state, np.flatnonzero(selected))
    images, image = np.unique(scene.tracks.image[index], return_inverse=True)
    tracks, point = np.unique(scene.tracks.track[index], return_inverse=True)
    cameras, camera_of_image = np.unique(scene.image_camera[images], return_inverse=True)
    # Intrinsics that are estimated, with what is known of them
    estimated, models = np.zeros(len(cameras), np.int64), [state.cameras[k] for k in cameras.tolist()]
    expected, sigmas = np.zeros((len(cameras), BLOCK)), np.full((len(cameras), BLOCK), np.inf)
    for row, k in enumerate(cameras.tolist()):
        prior = scene.priors[k] if scene.priors else IntrinsicsPrior(state.cameras[k])
        expected[row, 0] = models[row].fx
        if not _is_estimated(scene, state, k):
            continue
        own = prior.sigmas if prior.is_pinhole else np.array(FISHEYE_SIGMAS) * [prior.camera.fx, 1.0, 1.0, 1.0, 1.0]
        estimated[row] = count = prior.estimated if prior.is_pinhole else len(own)
        if count:
            models[row] = prior.held(models[row])
        sigmas[row, :count] = own[:count]
        expected[row, :count] = intrinsics_of(prior.camera)[:count]
    # Measurements of poses and points
    first = len(state.points) - (0 if positions is None else len(positions.points))
    measured = tracks[tracks >= first]
    Ts = state.Ts_world_cam[images]
    of_images = None if priors is None else replace(priors, Ts_world_cam=priors.Ts_world_cam[images])
    cauchy_px = config.cauchy_px
    factors = pose_factors(Ts, scene.is_fixed[images], _rows(rig, images), of_images, _of_rows(positions, images))
    problem = _Problem(
        images=images,
        tracks=tracks,
        cameras=cameras,
        estimated=estimated,
        observations=Observations(
            image, point, camera_of_image[image], scene.pixels[index], config.noise_px * scene.sigmas[index]
        ),
        cauchy=None if cauchy_px is None else cauchy_px / config.noise_px,
        intrinsics=expected,
        intrinsics_sigmas=sigmas,
        pose_factors=factors,
        point_rows=np.searchsorted(tracks, measured),
        point_targets=np.empty((0, 3)) if positions is None else positions.points[measured - first],
        point_sigmas=np.empty((0, 3)) if positions is None else positions.point_sigmas[measured - first],
        point_cauchy=1.0 if positions is None else positions.cauchy_sigmas,
    )
    return problem, Variables(Ts, state.points[tracks], tuple(models))


def _is_estimated(scene: Scene, state: SfmState, k: int) -> bool:
    """Return whether intrinsics of a camera can be estimated, and are not known."""
    camera = state.cameras[k]
    has_model = camera.lens == "equidistant" or (camera.lens == "radtan" and len(camera.distortion) == 4)
    return has_model and not bool(scene.is_calibrated[k])


def _seen(scene: Scene, state: SfmState, index: Indices) -> Indices:
    """Return the observations of points that project into their images, at least two of each point.

    Those of an estimated fisheye end before 90°, where its coefficients are not determined.
    """
    is_fisheye = np.array(
        [_is_estimated(scene, state, k) and c.lens == "equidistant" for k, c in enumerate(state.cameras)]
    )
    image, track = scene.tracks.image[index], scene.tracks.track[index]
    is_seen = np.isfinite(state.errors_px(scene, index))
    if is_fisheye.any():
        relative = state.points[track] - state.Ts_world_cam[image, :3, 3]
        cosine = np.sum(relative * state.Ts_world_cam[image, :3, 2], axis=1) / np.linalg.norm(relative, axis=1)
        is_seen &= ~is_fisheye[scene.image_camera[image]] | (cosine > MAX_ANGLE_COSINE)
    index = index[is_seen]
    counts = np.bincount(scene.tracks.track[index], minlength=scene.tracks.count)
    return np.asarray(index[counts[scene.tracks.track[index]] >= 2])


def _rows(rig: Sequence[RelativePose], images: Indices) -> list[RelativePose]:
    """Return known relative poses by the rows of their images; those of images without observations are left out."""
    row = {image: n for n, image in enumerate(images.tolist())}
    return [
        RelativePose(row[pair.first], row[pair.second], pair.T_first_second)
        for pair in rig
        if pair.first in row and pair.second in row
    ]


def _of_rows(positions: PositionPriors | None, images: Indices) -> PositionPriors | None:
    """Return measured positions by the rows of their images."""
    if positions is None:
        return None
    return replace(positions, cameras=positions.cameras[images], camera_sigmas=positions.camera_sigmas[images])
