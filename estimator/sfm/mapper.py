"""Incremental mapping: a seed pair grows by one image at a time (Schönberger and Frahm, "Structure-from-motion
revisited", CVPR 2016).

Each image is registered against the points that it observes, and the tracks that it completes are triangulated. The
whole reconstruction is adjusted on a subset of its observations whenever it has grown by a given ratio, and on all of
them at the end.
"""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from dronevio.estimator.sfm.adjustment import BundleAdjustmentConfig, adjust, intrinsics_covariances
from dronevio.estimator.sfm.config import MapperConfig
from dronevio.estimator.sfm.intrinsics import PARAMETERS, self_calibration, without_undetermined
from dronevio.estimator.sfm.model import Scene, SfmState, initial_state
from dronevio.estimator.sfm.resection import resect
from dronevio.estimator.sfm.structure import complete, remove_outliers, repair, triangulate
from dronevio.estimator.sfm.two_view import Geometry, TwoView
from dronevio.estimator.sfm.visibility import Visibility
from dronevio.models.arrays import Array, Mask
from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError
from dronevio.models.progress import Progress, silent
from dronevio.models.reconstruction import SelfCalibration

Indices = npt.NDArray[np.int64]

SEED_STAGES = ((100, 16.0), (50, 8.0), (30, 4.0), (20, 2.0))
"""Smallest numbers of matches of a seed pair and smallest median angles [deg], from the strictest to the weakest."""
SEED_TRIALS = 10
"""Largest number of seed pairs that are tried in each stage."""
MIN_POINTS = 10
"""Smallest number of points of the reconstruction that a component starts from."""
MIN_AGREEMENT = 0.2
"""Smallest share of the observations that agree with known poses from which a reconstruction grows."""
GLOBAL_RATIO = 1.2
"""Growth of the number of images between two adjustments of the whole reconstruction."""
INTERMEDIATE_OBSERVATIONS = 300
"""Number of observations of an image in the adjustments before the last; tracks of many images are preferred."""
INTERMEDIATE_TRACK = 40
"""Number of observations above which a track is thinned in these adjustments."""
INTERMEDIATE_MINIMUM = 100
"""Number of observations of an image below which none of them is left out in this way."""
INTERMEDIATE_CAUCHY_PX = 1.0
"""Scale of the Cauchy loss of the adjustments before the last [px]."""
INTERMEDIATE_ADJUSTMENT = BundleAdjustmentConfig(15, 1e-4, INTERMEDIATE_CAUCHY_PX)
"""Adjustments while the reconstruction grows."""
SETTLED = BundleAdjustmentConfig(100, 1e-5, INTERMEDIATE_CAUCHY_PX)
"""The last adjustment of a subset."""
MIN_SUPPORT = 0.6
"""Smallest ratio of the inliers of a registered image to the points that it observes; an image below it is
registered anew."""
MAX_DISCARDS = 2
"""Number of wrong registrations after which an image is left out."""
CALIBRATED_TOLERANCE = 1e-3
"""Relative decrease of the error at which the last adjustment stops."""
UNCALIBRATED_TOLERANCE = 1e-5
"""The same if intrinsics are estimated, which converge more slowly."""
MAX_FOCAL_CHANGE = 10.0
"""Largest factor between the focal length of a camera and its longest side, in both directions."""


def map_scene(
    scene: Scene,
    cameras: tuple[CameraModel, ...],
    pairs: list[TwoView],
    config: MapperConfig,
    progress: Progress = silent,
    start: SfmState | None = None,
    is_final: bool = True,
) -> list[SfmState]:
    """Reconstruct all components of a scene, the one with the most images first.

    Args:
        scene: The measurements.
        cameras: (K,) Initial camera models.
        pairs: Verified pairs, from which the seeds are taken.
        config: Settings.
        progress: Receives the number of registered images.
        start: Known poses and cameras, from which the first component grows, whatever its size; None without any.
        is_final: Whether all observations are adjusted at the end, as by `finish`.
    """
    mapper = _Mapper(scene, config, progress)
    available = np.ones(scene.images, np.bool_)
    grown = None if start is None else mapper.extend(start)
    if grown is not None:
        available &= ~grown.is_registered
    components: list[SfmState] = []
    while available.sum() >= 2:
        state = mapper.component(cameras, pairs, available)
        if state is None:
            break
        components.append(state)
        available &= ~state.is_registered
    components.sort(key=lambda state: -int(state.is_registered.sum()))
    if grown is not None:
        components.insert(0, grown)
    return [finish(scene, state, config) for state in components] if is_final else components


def finish(scene: Scene, state: SfmState, config: MapperConfig) -> SfmState:
    """Return a reconstruction of which all observations are adjusted until the error settles, without outliers.

    A subset of the observations is adjusted first until it has converged. The angle between parts that few images
    connect converges slowly, which is cheaper with fewer observations.
    """
    state = _Mapper(scene, config, silent).adjust_all(state, SETTLED)
    state = remove_outliers(scene, complete(scene, state, config.triangulation), config.triangulation)
    tolerance = CALIBRATED_TOLERANCE if scene.is_calibrated.all() else UNCALIBRATED_TOLERANCE
    adjustment = BundleAdjustmentConfig(
        config.max_iterations, tolerance, config.final_cauchy_sigmas * state.noise_px(scene)
    )
    return remove_outliers(scene, adjust(scene, state, state.used(scene), adjustment), config.triangulation)


def hold_undetermined(scene: Scene, state: SfmState, config: MapperConfig, least: int = 0) -> tuple[Scene, SfmState]:
    """Estimate all intrinsics that the images determine, hold the others, and adjust a subset of observations.

    Args:
        scene: The measurements.
        state: The reconstruction.
        config: Settings.
        least: Number of parameters that are estimated in any case: 1 if positions of the cameras are measured,
            which determine the focal length where images do not.

    Returns:
        The scene, whose priors state which parameters are estimated, and the adjusted state; both as they are if all
        cameras are calibrated.
    """
    if scene.is_calibrated.all():
        return scene, state
    scene = replace(scene, priors=tuple(replace(prior, estimated=PARAMETERS) for prior in scene.priors))
    for _ in range(PARAMETERS + 1):
        state = _Mapper(scene, config, silent).adjust_all(state, SETTLED)
        priors, cameras = list(scene.priors), list(state.cameras)
        for k, covariance in _covariances(scene, state).items():
            if priors[k].is_pinhole:
                held = without_undetermined(priors[k], cameras[k], covariance)
                priors[k] = replace(held, estimated=max(held.estimated, least))
                cameras[k] = priors[k].held(cameras[k])
        if tuple(priors) == scene.priors:
            break
        scene, state = replace(scene, priors=tuple(priors)), replace(state, cameras=tuple(cameras))
    return scene, state


def self_calibrations(scene: Scene, state: SfmState) -> tuple[SelfCalibration | None, ...]:
    """Return which parameters of each camera (K,) are estimated, None for cameras with a calibration."""
    covariances = _covariances(scene, state)
    return tuple(
        None if is_calibrated else self_calibration(prior, covariances.get(k))
        for k, (prior, is_calibrated) in enumerate(zip(scene.priors, scene.is_calibrated, strict=True))
    )


def _covariances(scene: Scene, state: SfmState) -> dict[int, Array]:
    """Return the covariances of the intrinsics that are estimated, by the noise of the observations."""
    if scene.is_calibrated.all():
        return {}
    noise_px = state.noise_px(scene)
    config = BundleAdjustmentConfig(cauchy_px=noise_px, noise_px=noise_px)
    return intrinsics_covariances(scene, state, state.used(scene), config)


@dataclass(frozen=True, eq=False)
class _Mapper:
    scene: Scene
    config: MapperConfig
    progress: Progress

    def component(self, cameras: tuple[CameraModel, ...], pairs: list[TwoView], available: Mask) -> SfmState | None:
        """Return the reconstruction of one component among the available images, None if no seed succeeds."""
        for seed in _seeds(pairs, available, self.scene):
            state = self._initialize(cameras, seed)
            if state is not None:
                return self._grow(state, available)
        return None

    def extend(self, start: SfmState) -> SfmState:
        """Return the reconstruction that grows from known poses and cameras.

        Raises:
            ConfigError: The poses contradict the images.
        """
        state = self.clean(triangulate(self.scene, start, self.config.triangulation))
        visible = state.is_registered[self.scene.tracks.image]
        agreement = float(state.used(self.scene).sum() / max(visible.sum(), 1))
        if state.has_point.sum() < MIN_POINTS or agreement < MIN_AGREEMENT:
            raise ConfigError(
                f"{agreement:.0%} of the observations agree with the known poses; expected at least"
                f" {MIN_AGREEMENT:.0%} (poses of the cameras or of the IMU as stated, and the right calibration)"
            )
        return self._grow(state, np.ones(self.scene.images, np.bool_))

    def _initialize(self, cameras: tuple[CameraModel, ...], seed: TwoView) -> SfmState | None:
        """Return the adjusted reconstruction of a seed pair, None if it does not hold."""
        scene = self.scene
        Ts_world_cam = np.full((scene.images, 4, 4), np.nan)
        Ts_world_cam[seed.first] = np.eye(4)
        Ts_world_cam[seed.second] = seed.T_first_second
        state = triangulate(scene, initial_state(scene, cameras, Ts_world_cam), self.config.triangulation)
        if state.has_point.sum() < MIN_POINTS:
            return None
        state = self.clean(self.adjust_growing(state))
        is_plausible = all(
            1.0 / MAX_FOCAL_CHANGE < camera.fx / max(camera.width, camera.height) < MAX_FOCAL_CHANGE
            for camera in state.cameras
        )
        return state if is_plausible and state.has_point.sum() >= MIN_POINTS else None

    def _grow(self, state: SfmState, available: Mask) -> SfmState:
        """Register images until none is left that can be."""
        scene, config = self.scene, self.config
        adjusted_images = int(state.is_registered.sum())
        visibility = Visibility.of(scene, state)
        failed_at = np.zeros(scene.images, np.int64)  # number of visible points at the last failure
        discards = np.zeros(scene.images, np.int64)  # how often each image was registered with a wrong pose
        is_last = False  # whether images that were left out have had their last trial
        while True:
            visible = visibility.points
            # An image that failed is tried again when it sees a quarter more points.
            candidates = available & ~state.is_registered & (visible >= config.resection.min_inliers)
            candidates &= (4 * visible > 5 * failed_at) & (discards < MAX_DISCARDS)
            # Registration of the image that sees most, and triangulation of what it adds
            if candidates.any():
                image = int(np.argmax(np.where(candidates, visibility.score, -1.0)))
                registered = self._register(state, image)
                if registered is None:
                    failed_at[image] = visible[image]
                    continue
                tracks = scene.tracks.track[scene.tracks.of_image(image)]
                state = triangulate(scene, registered, config.triangulation, tracks=tracks)
                state = remove_outliers(scene, state, config.triangulation, tracks)
                seeing = np.unique(scene.tracks.image[scene.tracks.of_tracks(tracks)])
                visibility = visibility.updated(scene, state, seeing)
                count = int(state.is_registered.sum())
                self.progress(count, scene.images)
                if count >= GLOBAL_RATIO * adjusted_images:
                    state = self._discard(self._refine(state), discards)
                    visibility = Visibility.of(scene, state)
                    adjusted_images = count
                continue
            # Without a candidate, global adjustment of what is new, or the end
            count = int(state.is_registered.sum())
            if count == adjusted_images and (is_last or not (discards >= MAX_DISCARDS).any()):
                return state
            if count == adjusted_images:
                # An image that was left out may have been right where the others were not: it has a last trial.
                is_last = True
                discards[discards >= MAX_DISCARDS] = MAX_DISCARDS - 1
            state = self._discard(self._refine(state), discards)  # better points may admit further images
            visibility = Visibility.of(scene, state)
            adjusted_images = count
            failed_at[:] = 0

    def _register(self, state: SfmState, image: int) -> SfmState | None:
        scene = self.scene
        index = scene.tracks.of_image(image)
        index = index[state.has_point[scene.tracks.track[index]]]
        bearings = state.bearings(scene, index)
        is_defined = np.isfinite(bearings[:, 0])
        index, bearings = index[is_defined], bearings[is_defined]
        camera = state.cameras[scene.image_camera[image]]
        resected = resect(
            state.points[scene.tracks.track[index]],
            bearings,
            float(np.sqrt(camera.fx * camera.fy)),
            self.config.resection,
        )
        if resected is None:
            return None
        Ts_world_cam, is_inlier = state.Ts_world_cam.copy(), state.is_inlier.copy()
        Ts_world_cam[image] = resected[0]
        is_inlier[index] = resected[1]
        return replace(state, Ts_world_cam=Ts_world_cam, is_inlier=is_inlier)

    def _subset(self, used: Mask) -> Mask:
        """Return a subset of the used observations: per image, those of the longest tracks.

        A track couples all its images, at a cost that grows with the square of their number: of one that is longer than
        `INTERMEDIATE_TRACK`, observations at equal distances count, unless an image would have too few.
        """
        scene, tracks = self.scene, self.scene.tracks
        index = np.flatnonzero(used)
        track = tracks.track[index]
        lengths = np.bincount(track, minlength=tracks.count)
        rank = np.arange(len(index)) - (np.cumsum(lengths) - lengths)[track]
        thinned = np.zeros(len(used), np.bool_)
        thinned[index[(rank + track) % -(-lengths[track] // INTERMEDIATE_TRACK) == 0]] = True
        counts = np.bincount(tracks.image[thinned], minlength=scene.images)
        used = thinned | (used & (counts < INTERMEDIATE_MINIMUM)[tracks.image])
        lengths = np.bincount(tracks.track[used], minlength=tracks.count)
        index = np.flatnonzero(used)
        order = index[np.lexsort([tracks.track[index], -lengths[tracks.track[index]]])]
        order = order[np.argsort(tracks.image[order], kind="stable")]
        counts = np.bincount(tracks.image[order], minlength=scene.images)
        rank = np.arange(len(order)) - np.repeat(np.cumsum(counts) - counts, counts)
        kept = np.zeros(tracks.count, np.bool_)
        kept[tracks.track[order[rank < INTERMEDIATE_OBSERVATIONS]]] = True
        return np.asarray(used & kept[tracks.track])

    def adjust_all(self, state: SfmState, config: BundleAdjustmentConfig) -> SfmState:
        """Adjust the whole reconstruction on a subset of its observations, with a robust loss."""
        adjusted = adjust(self.scene, state, self._subset(state.used(self.scene)), config)
        return repair(self.scene, adjusted, self.config.triangulation)

    def adjust_growing(self, state: SfmState) -> SfmState:
        """Do the same while the reconstruction grows; cameras that leave their prior are set back to the first guess.

        Few images, or a camera that flies straight ahead, may determine the intrinsics so badly that they leave their
        prior, and the images that follow are registered by a wrong structure.
        """
        scene = self.scene
        adjusted = self.adjust_all(state, INTERMEDIATE_ADJUSTMENT)
        implausible = [
            k
            for k, prior in enumerate(scene.priors)
            if not scene.is_calibrated[k] and not prior.is_plausible(adjusted.cameras[k])
        ]
        if not implausible:
            return adjusted
        priors, cameras = list(scene.priors), list(state.cameras)
        for k in implausible:
            priors[k], cameras[k] = replace(priors[k], estimated=0), priors[k].camera
        held = replace(self, scene=replace(scene, priors=tuple(priors)))
        return held.adjust_all(replace(state, cameras=tuple(cameras)), INTERMEDIATE_ADJUSTMENT)

    def clean(self, state: SfmState) -> SfmState:
        """Remove outliers and points that are not determined."""
        return remove_outliers(self.scene, state, self.config.triangulation)

    def _refine(self, state: SfmState) -> SfmState:
        """Complete, adjust and filter the whole reconstruction."""
        return self.clean(self.adjust_growing(complete(self.scene, state, self.config.triangulation)))

    def _discard(self, state: SfmState, discards: Indices) -> SfmState:
        """Remove images with a wrong pose, which contradicts many of the points that they observe.

        Args:
            state: The adjusted reconstruction.
            discards: (I,) How often each image has been removed; it is increased.
        """
        scene = self.scene
        seen = state.has_point[scene.tracks.track] & state.is_registered[scene.tracks.image]
        visible = np.bincount(scene.tracks.image[seen], minlength=scene.images)
        inliers = np.bincount(scene.tracks.image[state.used(scene)], minlength=scene.images)
        is_wrong = state.is_registered & ~scene.is_fixed & (inliers < MIN_SUPPORT * visible)
        if not is_wrong.any() or (state.is_registered & ~is_wrong).sum() < 2:
            return state
        discards[is_wrong] += 1
        Ts_world_cam = state.Ts_world_cam.copy()
        Ts_world_cam[is_wrong] = np.nan
        is_inlier = state.is_inlier & ~is_wrong[scene.tracks.image]
        return self.clean(replace(state, Ts_world_cam=Ts_world_cam, is_inlier=is_inlier))


def _seeds(pairs: list[TwoView], available: Mask, scene: Scene) -> list[TwoView]:
    """Return the seed pairs in the order in which they are tried; planar pairs and pure rotations are never seeds."""
    degree = np.zeros(scene.images)
    for pair in pairs:
        degree[[pair.first, pair.second]] += len(pair.matches)
    usable = [p for p in pairs if p.geometry is Geometry.GENERAL and available[p.first] and available[p.second]]

    def quality(pair: TwoView) -> float:
        angle = min(np.degrees(pair.angle_rad) / 16.0, 1.0)
        return float(len(pair.matches) * angle * np.sqrt(degree[pair.first] * degree[pair.second]))

    seeds: list[TwoView] = []
    for matches, angle_deg in SEED_STAGES:
        stage = [p for p in usable if len(p.matches) >= matches and np.degrees(p.angle_rad) >= angle_deg]
        stage = [p for p in sorted(stage, key=quality, reverse=True) if p not in seeds]
        seeds += stage[:SEED_TRIALS]
    return seeds
