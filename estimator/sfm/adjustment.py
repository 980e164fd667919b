"""Bundle adjustment by GTSAM's Levenberg-Marquardt optimizer.

Each inlier observation is a factor on the pose of its image, on its point and, if the camera is not calibrated, on the
focal length and the radial distortion of its camera: two coefficients of a pinhole, four of a fisheye. Other lenses are
calibrated, and their observations are those of a pinhole (`dronevio.estimator.sfm.normalized`). Known poses are held or
have priors; without them, a prior on one pose and on the distance to a second fixes the gauge.
"""

import ctypes
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, TypeAlias

import gtsam
import numpy as np
import numpy.typing as npt
from gtsam.symbol_shorthand import K, P, X

from dronevio.estimator.sfm.intrinsics import PARAMETERS, IntrinsicsPrior
from dronevio.estimator.sfm.model import KnownPoses, PositionPriors, Scene, SfmState
from dronevio.estimator.sfm.normalized import normalized
from dronevio.models.arrays import Array, Mask
from dronevio.models.camera import CameraModel
from dronevio.models.ranges import Range, Settings

Indices = npt.NDArray[np.int64]
Calibration: TypeAlias = gtsam.Cal3DS2 | gtsam.Cal3Fisheye | gtsam.Cal3_S2

UNIT = gtsam.Cal3_S2()
"""Pinhole with unit focal length, of observations in normalized coordinates."""
FIXED_SIGMA = 1e-7
"""Standard deviation of a pose that is held: rotation [rad], position relative to the scale of the scene."""
RANGE_SIGMA = 1e-5
"""Standard deviation of the prior that fixes the scale, relative to the distance."""
PIXEL_SIGMA = 1.0
"""Standard deviation of the observation of a small feature [px]."""
FISHEYE_SIGMAS = (0.1, 0.1, 0.1, 0.1)
"""Standard deviations of the priors of the distortion coefficients of a fisheye."""
HELD_SIGMA = 1e-4
"""Standard deviation of an intrinsic parameter that is held, relative to that of its prior."""
MIN_FISHEYE_COSINE = 0.1
"""Smallest cosine of the angle from the optical axis of the observations that an estimated fisheye is adjusted to."""
RIG_SIGMAS = (1e-5, 1e-5)
"""Standard deviations of a known relative pose: rotation [rad], translation in units of the scene."""

WEAK_ROTATION_SIGMA_RAD = 0.3
"""Standard deviation of the rotation of one image beside measured positions [rad]."""


@dataclass(frozen=True, eq=False)
class RelativePose:
    """A known pose of one camera in the frame of another, which determines the scale."""

    first: int
    """Index of the first image."""
    second: int
    """Index of the second image."""
    T_first_second: Array
    """(4, 4) Pose of the second camera in the frame of the first."""


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
    problem = _problem(scene, state, selected, config, rig, priors, positions)
    # Damping by the diagonal of the Hessian: focal lengths, distortion and rotations differ in scale by orders.
    parameters = gtsam.LevenbergMarquardtParams.CeresDefaults()
    parameters.setMaxIterations(config.max_iterations)
    parameters.setRelativeErrorTol(config.relative_tolerance)
    parameters.setAbsoluteErrorTol(1e-12)
    with _silenced():
        result = gtsam.LevenbergMarquardtOptimizer(problem.graph, problem.values, parameters).optimize()
    # State at the optimum
    Ts_world_cam, points = state.Ts_world_cam.copy(), state.points.copy()
    for i in problem.images[~scene.is_fixed[problem.images]]:
        Ts_world_cam[i] = result.atPose3(X(i)).matrix()
    for t in problem.tracks:
        points[t] = result.atPoint3(P(t))
    cameras = list(state.cameras)
    for k in problem.estimated:
        cameras[k] = _prior(scene, state, k).held(_estimated(cameras[k], result, k))
    return replace(state, cameras=tuple(cameras), Ts_world_cam=Ts_world_cam, points=points)


def intrinsics_covariances(
    scene: Scene, state: SfmState, selected: Mask, config: BundleAdjustmentConfig
) -> dict[int, Array]:
    """Return the covariance of the intrinsics of each estimated camera, by its index, at the optimum of `adjust`.

    The parameters of a pinhole are focal length [px], k1, k2; of a fisheye fx, fy, skew, cx, cy, k1, k2, k3, k4. Their
    covariance is infinite where the observations do not determine the scene.
    """
    problem = _problem(scene, state, selected, config)
    try:
        with _silenced():
            marginals = gtsam.Marginals(problem.graph, problem.values)
            found = {k: np.asarray(marginals.marginalCovariance(K(k))) for k in problem.estimated}
    except RuntimeError:  # an indeterminate linear system
        found = {}
    sizes = {k: 9 if state.cameras[k].lens == "equidistant" else 3 for k in problem.estimated if k not in found}
    return found | {k: np.diag(np.full(size, np.inf)) for k, size in sizes.items()}


@contextmanager
def _silenced() -> Iterator[None]:
    """Suppress standard output, to which GTSAM prints each point that moves behind a camera that is estimated."""
    sys.stdout.flush()
    try:
        saved = os.dup(1)
    except OSError:  # it is closed
        yield
        return
    with Path(os.devnull).open("wb") as nowhere:
        os.dup2(nowhere.fileno(), 1)
    try:
        yield
    finally:
        with suppress(OSError, TypeError, AttributeError):
            ctypes.CDLL(None).fflush(None)
        os.dup2(saved, 1)
        os.close(saved)


@dataclass(frozen=True, eq=False)
class _Problem:
    """A factor graph with initial values of its variables."""

    graph: gtsam.NonlinearFactorGraph
    values: gtsam.Values
    images: Indices
    tracks: Indices
    estimated: tuple[int, ...]


def _problem(
    scene: Scene,
    state: SfmState,
    selected: Mask,
    config: BundleAdjustmentConfig,
    rig: Sequence[RelativePose] = (),
    priors: KnownPoses | None = None,
    positions: PositionPriors | None = None,
) -> _Problem:
    """Return the problem of `adjust`."""
    # Observations that project with the current state
    is_held = [not _is_estimated(camera) for camera in state.cameras]
    scene = replace(scene, is_calibrated=scene.is_calibrated | is_held)
    index = _projected(scene, state, np.flatnonzero(selected))
    image, track = scene.tracks.image[index], scene.tracks.track[index]
    images, tracks = np.unique(image), np.unique(track)
    # Factor graph: reprojections, the rig, and the gauge or priors
    values, graph = gtsam.Values(), gtsam.NonlinearFactorGraph()
    for i in images:
        values.insert(X(i), gtsam.Pose3(state.Ts_world_cam[i]))
    for t in tracks:
        values.insert(P(t), state.points[t])
    calibrations = _insert_cameras(scene, state, np.unique(scene.image_camera[images]), values, graph)
    noises = {sigma: _noise(sigma, config) for sigma in np.unique(scene.sigmas[index]).tolist()}
    _add_projections(graph, scene, state, index, calibrations, noises, config)
    _add_rig(graph, rig)
    if positions is not None:
        _add_positions(graph, positions, state, images, tracks)
    elif priors is None:
        _fix_gauge(graph, state, images, scene.is_fixed[images], has_scale=bool(rig))
    else:
        _add_priors(graph, priors, images)
    estimated = tuple(k for k, calibration in calibrations.items() if calibration is None)
    return _Problem(graph, values, images, tracks, estimated)


def _projected(scene: Scene, state: SfmState, index: Indices) -> Indices:
    """Return the observations without those that GTSAM does not project: of points behind the camera.

    Those of an estimated fisheye, and of lenses that are replaced by a pinhole, end before 90°. Points that have fewer
    than two other observations are left out.
    """
    is_normalized = np.array([_calibration(camera) is UNIT for camera in state.cameras])
    is_fisheye = np.array([camera.lens == "equidistant" for camera in state.cameras]) & ~scene.is_calibrated
    is_fisheye |= is_normalized
    image, track = scene.tracks.image[index], scene.tracks.track[index]
    relative = state.points[track] - state.Ts_world_cam[image, :3, 3]
    cosine = np.sum(relative * state.Ts_world_cam[image, :3, 2], axis=1) / np.linalg.norm(relative, axis=1)
    is_ahead = cosine > np.where(is_fisheye[scene.image_camera[image]], MIN_FISHEYE_COSINE, 0.0)
    if is_normalized.any():  # their measured bearings have to be ahead, too
        is_ahead &= ~is_normalized[scene.image_camera[image]] | (
            state.bearings(scene, index)[:, 2] > MIN_FISHEYE_COSINE
        )
    index = index[is_ahead]
    counts = np.bincount(scene.tracks.track[index], minlength=scene.tracks.count)
    return np.asarray(index[counts[scene.tracks.track[index]] >= 2])


def _noise(sigma: float, config: BundleAdjustmentConfig) -> gtsam.noiseModel.Base:
    """Return the noise of an observation of a relative standard deviation."""
    return _robust(gtsam.noiseModel.Isotropic.Sigma(2, config.noise_px * sigma), config)


def _robust(gaussian: gtsam.noiseModel.Base, config: BundleAdjustmentConfig) -> gtsam.noiseModel.Base:
    """Return the noise of an observation with the loss of the configuration."""
    if config.cauchy_px is None:
        return gaussian
    loss = gtsam.noiseModel.mEstimator.Cauchy.Create(config.cauchy_px / config.noise_px)
    return gtsam.noiseModel.Robust.Create(loss, gaussian)


def _is_estimated(camera: CameraModel) -> bool:
    """Return whether the parameters of a camera can be estimated."""
    return camera.lens == "equidistant" or (camera.lens == "radtan" and len(camera.distortion) == 4)


def _calibration(camera: CameraModel) -> Calibration:
    """Return GTSAM's calibration of a camera, `UNIT` if it has none."""
    if not _is_estimated(camera):
        return UNIT
    if camera.lens == "equidistant":
        return _fisheye(camera)
    return gtsam.Cal3DS2(camera.fx, camera.fy, 0.0, camera.cx, camera.cy, *camera.distortion)


def _prior(scene: Scene, state: SfmState, k: int) -> IntrinsicsPrior:
    """Return what is known of a camera beforehand, by default its current model."""
    return scene.priors[k] if scene.priors else IntrinsicsPrior(state.cameras[k])


def _bundler(camera: CameraModel) -> gtsam.Cal3Bundler:
    """Return GTSAM's calibration of a pinhole with two radial coefficients."""
    return gtsam.Cal3Bundler(camera.fx, camera.distortion[0], camera.distortion[1], camera.cx, camera.cy)


def _fisheye(camera: CameraModel) -> gtsam.Cal3Fisheye:
    """Return GTSAM's calibration of a fisheye."""
    return gtsam.Cal3Fisheye(camera.fx, camera.fy, 0.0, camera.cx, camera.cy, *camera.distortion)


def _insert_cameras(
    scene: Scene, state: SfmState, used: Indices, values: gtsam.Values, graph: gtsam.NonlinearFactorGraph
) -> dict[int, Calibration | None]:
    """Insert the cameras (K,) that are estimated, with their priors, and return the others."""
    calibrations: dict[int, Calibration | None] = {}
    for k in used.tolist():
        camera = state.cameras[k]
        if scene.is_calibrated[k]:
            calibrations[k] = _calibration(camera)
            continue
        prior = _prior(scene, state, k)
        if prior.is_pinhole and prior.estimated == 0:
            calibrations[k] = _calibration(camera)
            continue
        calibrations[k] = None
        if camera.lens == "equidistant":
            noise = _fisheye_prior(prior.camera.fx)
            values.insert(K(k), _fisheye(camera))
            graph.push_back(gtsam.PriorFactorCal3Fisheye(K(k), _fisheye(prior.camera), noise))
            continue
        is_free = np.arange(PARAMETERS) < prior.estimated
        noise = gtsam.noiseModel.Diagonal.Sigmas(prior.sigmas * np.where(is_free, 1.0, HELD_SIGMA))
        values.insert(K(k), _bundler(prior.held(camera)))
        graph.push_back(gtsam.PriorFactorCal3Bundler(K(k), _bundler(prior.camera), noise))
    return calibrations


def _add_projections(
    graph: gtsam.NonlinearFactorGraph,
    scene: Scene,
    state: SfmState,
    index: Indices,
    calibrations: dict[int, Calibration | None],
    noises: dict[float, gtsam.noiseModel.Base],
    config: BundleAdjustmentConfig,
) -> None:
    """Add a factor for each observation; the noise models (by relative standard deviation) are shared."""
    image, track = scene.tracks.image[index], scene.tracks.track[index]
    camera = scene.image_camera[image]
    is_normalized = np.isin(camera, [k for k, calibration in calibrations.items() if calibration is UNIT])
    _add_normalized(graph, scene, state, index[is_normalized], config)
    index, image, track, camera = (rows[~is_normalized] for rows in (index, image, track, camera))
    noise_of = [noises[sigma] for sigma in scene.sigmas[index].tolist()]
    rows = zip(scene.pixels[index], noise_of, image.tolist(), track.tolist(), camera.tolist(), strict=True)
    for pixel, noise, i, t, k in rows:
        calibration = calibrations[k]
        if calibration is None:
            factor = (
                gtsam.GeneralSFMFactor2Cal3Fisheye
                if state.cameras[k].lens == "equidistant"
                else gtsam.GeneralSFMFactor2Cal3Bundler
            )
            graph.push_back(factor(pixel, noise, X(i), P(t), K(k)))
        elif isinstance(calibration, gtsam.Cal3DS2):
            graph.push_back(gtsam.GenericProjectionFactorCal3DS2(pixel, noise, X(i), P(t), calibration, False, False))
        elif isinstance(calibration, gtsam.Cal3Fisheye):
            graph.push_back(
                gtsam.GenericProjectionFactorCal3Fisheye(pixel, noise, X(i), P(t), calibration, False, False)
            )


def _add_normalized(
    graph: gtsam.NonlinearFactorGraph, scene: Scene, state: SfmState, index: Indices, config: BundleAdjustmentConfig
) -> None:
    """Add a factor in normalized coordinates for each observation of a camera that GTSAM does not have."""
    camera = scene.image_camera[scene.tracks.image[index]]
    for k in np.unique(camera).tolist():
        rows = index[camera == k]
        xy, derivative = normalized(state.cameras[k], scene.pixels[rows])
        per_px = derivative * (config.noise_px * scene.sigmas[rows])[:, None, None]
        covariance = per_px @ np.swapaxes(per_px, 1, 2)
        images, tracks = scene.tracks.image[rows].tolist(), scene.tracks.track[rows].tolist()
        for measured, cov, i, t in zip(xy, covariance, images, tracks, strict=True):
            noise = _robust(gtsam.noiseModel.Gaussian.Covariance(cov), config)
            graph.push_back(gtsam.GenericProjectionFactorCal3_S2(measured, noise, X(i), P(t), UNIT, False, False))


def _add_rig(graph: gtsam.NonlinearFactorGraph, rig: Sequence[RelativePose]) -> None:
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.repeat(RIG_SIGMAS, 3))
    for pair in rig:
        graph.push_back(
            gtsam.BetweenFactorPose3(X(pair.first), X(pair.second), gtsam.Pose3(pair.T_first_second), noise)
        )


def _add_priors(graph: gtsam.NonlinearFactorGraph, priors: KnownPoses, images: Indices) -> None:
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.repeat([priors.sigma_rad, priors.sigma_m], 3))
    for i in images[priors.is_known[images]].tolist():
        graph.push_back(gtsam.PriorFactorPose3(X(i), gtsam.Pose3(priors.Ts_world_cam[i]), noise))


def _add_positions(
    graph: gtsam.NonlinearFactorGraph, positions: PositionPriors, state: SfmState, images: Indices, tracks: Indices
) -> None:
    """Add priors on positions, and a weak one on a rotation, for positions on a line do not determine all of them."""
    loss = gtsam.noiseModel.mEstimator.Cauchy.Create(positions.cauchy_sigmas)

    def noise(sigmas: Array) -> gtsam.noiseModel.Base:
        return gtsam.noiseModel.Robust.Create(loss, gtsam.noiseModel.Diagonal.Sigmas(sigmas))

    for i in images[np.isfinite(positions.cameras[images, 0])].tolist():
        graph.push_back(gtsam.GPSFactor(X(i), positions.cameras[i], noise(positions.camera_sigmas[i])))
    first = len(state.points) - len(positions.points)
    for t in tracks[tracks >= first].tolist():
        row = t - first
        graph.push_back(gtsam.PriorFactorPoint3(P(t), positions.points[row], noise(positions.point_sigmas[row])))
    held = gtsam.Rot3(state.Ts_world_cam[images[0], :3, :3])
    weak = gtsam.noiseModel.Isotropic.Sigma(3, WEAK_ROTATION_SIGMA_RAD)
    graph.push_back(gtsam.PoseRotationPrior3D(X(int(images[0])), held, weak))


def _fix_gauge(
    graph: gtsam.NonlinearFactorGraph, state: SfmState, images: Indices, is_fixed: Mask, has_scale: bool
) -> None:
    """Hold the fixed poses, or else the first, and its distance to the farthest one unless the scale is determined."""
    held = images[is_fixed] if is_fixed.any() else images[:1]
    first = int(held[0])
    positions = state.Ts_world_cam[:, :3, 3]
    distances = np.linalg.norm(positions[images] - positions[first], axis=1)
    scale = float(distances.max())
    pose_noise = gtsam.noiseModel.Diagonal.Sigmas(np.repeat([FIXED_SIGMA, FIXED_SIGMA * scale], 3))
    for i in held.tolist():
        graph.push_back(gtsam.PriorFactorPose3(X(i), gtsam.Pose3(state.Ts_world_cam[i]), pose_noise))
    if not has_scale and len(held) == 1:
        farthest = int(images[np.argmax(distances)])
        range_noise = gtsam.noiseModel.Isotropic.Sigma(1, RANGE_SIGMA * scale)
        graph.push_back(gtsam.RangeFactorPose3(X(first), X(farthest), scale, range_noise))


def _fisheye_prior(focal_px: float) -> gtsam.noiseModel.Base:
    """Return the noise of the prior of a fisheye: one focal length, no skew, and the principal point at the centre.

    The order of the parameters is fx, fy, skew, cx, cy, k1, k2, k3, k4.
    """
    covariance = np.diag(np.square([1.0, 1.0, 1e-6, 1e-3, 1e-3, *FISHEYE_SIGMAS]))
    covariance[:2, :2] = (0.5 * focal_px) ** 2 * (np.ones((2, 2)) + 1e-10 * np.eye(2))
    return gtsam.noiseModel.Gaussian.Covariance(covariance)


def _estimated(camera: CameraModel, values: gtsam.Values, k: int) -> CameraModel:
    """Return a camera with the estimated focal length and distortion."""
    if camera.lens == "equidistant":
        fisheye = values.atCal3Fisheye(K(k))
        f = float(0.5 * (fisheye.fx() + fisheye.fy()))
        distortion = float(fisheye.k1()), float(fisheye.k2()), float(fisheye.k3()), float(fisheye.k4())
        return replace(camera, fx=f, fy=f, distortion=distortion)
    bundler = values.atCal3Bundler(K(k))
    f = float(bundler.fx())
    return replace(camera, fx=f, fy=f, distortion=(float(bundler.k1()), float(bundler.k2()), 0.0, 0.0))
