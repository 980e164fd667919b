"""Incremental mapping: a seed pair grows by one image at a time (Schönberger and Frahm, "Structure-from-motion
revisited", CVPR 2016).

Each image is registered against the points that it observes, and the tracks that it completes are triangulated. The
whole reconstruction is adjusted on a subset of its observations whenever it has grown by a given ratio, and on all of
them at the end.
"""

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from dronevio.estimator.sfm.adjustment import BundleAdjustmentConfig, adjust
from dronevio.estimator.sfm.config import MapperConfig
from dronevio.estimator.sfm.model import Scene, SfmState
from dronevio.estimator.sfm.resection import resect
from dronevio.estimator.sfm.triangulation import triangulate_tracks, widest_angles
from dronevio.estimator.sfm.two_view import Geometry, TwoView
from dronevio.models.camera import CameraModel
from dronevio.models.progress import Progress, silent

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]

SEED_STAGES = ((100, 16.0), (50, 8.0), (30, 4.0), (20, 2.0))
"""Smallest numbers of matches of a seed pair and smallest median angles [deg], from the strictest to the weakest."""
SEED_TRIALS = 10
"""Largest number of seed pairs that are tried in each stage."""
VISIBILITY_LEVELS = 6
"""Number of levels of the grids that measure how evenly the visible points cover an image."""
INTERMEDIATE_CAUCHY_PX = 1.0
"""Scale of the Cauchy loss of the adjustments before the last [px]."""
MAX_DISCARDS = 2
"""Largest number of times that an image is registered anew."""
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
) -> list[SfmState]:
    """Reconstruct all components of a scene, the one with the most images first.

    Args:
        scene: The measurements.
        cameras: (K,) Initial camera models.
        pairs: Verified pairs, from which the seeds are taken.
        config: Settings.
        progress: Receives the number of registered images.
    """
    mapper = _Mapper(scene, config, progress)
    components: list[SfmState] = []
    available = np.ones(scene.images, np.bool_)
    while available.sum() >= 2:
        state = mapper.component(cameras, pairs, available)
        if state is None:
            break
        components.append(state)
        available &= ~state.is_registered
    return sorted(components, key=lambda state: -int(state.is_registered.sum()))


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

    def _initialize(self, cameras: tuple[CameraModel, ...], seed: TwoView) -> SfmState | None:
        """Return the adjusted reconstruction of a seed pair, None if it does not hold."""
        scene = self.scene
        Ts_world_cam = np.full((scene.images, 4, 4), np.nan)
        Ts_world_cam[seed.first] = np.eye(4)
        Ts_world_cam[seed.second] = seed.T_first_second
        state = SfmState(
            cameras, Ts_world_cam, np.full((scene.tracks.count, 3), np.nan), np.zeros(len(scene.pixels), np.bool_)
        )
        state = self.triangulate(state)
        if state.has_point.sum() < 10:
            return None
        state = self.filter(self.adjust_all(state))
        is_plausible = all(
            1.0 / MAX_FOCAL_CHANGE < camera.fx / max(camera.width, camera.height) < MAX_FOCAL_CHANGE
            for camera in state.cameras
        )
        return state if is_plausible and state.has_point.sum() >= 10 else None

    def _grow(self, state: SfmState, available: Mask) -> SfmState:
        """Register images until none is left that can be."""
        scene, config = self.scene, self.config
        adjusted_images = int(state.is_registered.sum())
        failed_at = np.zeros(scene.images, np.int64)  # number of visible points at the last failure
        discards = np.zeros(scene.images, np.int64)  # how often each image was registered with a wrong pose
        while True:
            visible, score = self._visibility(state)
            # An image that failed is tried again when it sees a quarter more points.
            candidates = available & ~state.is_registered & (visible >= config.resection.min_inliers)
            candidates &= 4 * visible > 5 * failed_at
            if candidates.any():
                image = int(np.argmax(np.where(candidates, score, -1.0)))
                registered = self._register(state, image)
                if registered is None:
                    failed_at[image] = visible[image]
                    continue
                state = self.filter(self.triangulate(registered))
                count = int(state.is_registered.sum())
                self.progress(count, scene.images)
                if count >= config.global_ratio * adjusted_images:
                    state = self._discard(self._refine(state), discards)
                    adjusted_images = count
                continue
            count = int(state.is_registered.sum())
            if count == adjusted_images:
                return self._finish(state)
            state = self._discard(self._refine(state), discards)  # better points may admit further images
            adjusted_images = count
            failed_at[:] = 0

    def _visibility(self, state: SfmState) -> tuple[Indices, Array]:
        """Return how many points each image observes (I,), and how evenly they cover it (I,)."""
        scene = self.scene
        seen = state.has_point[scene.tracks.track]
        image = scene.tracks.image[seen]
        sizes = np.array([[camera.width, camera.height] for camera in state.cameras])[scene.image_camera[image]]
        relative = np.clip((scene.pixels[seen] + 0.5) / sizes, 0.0, 1.0 - 1e-9)
        score = np.zeros(scene.images)
        for level in range(1, VISIBILITY_LEVELS + 1):
            cells = (relative * 2**level).astype(np.int64)
            is_occupied = np.zeros((scene.images, 4**level), np.bool_)
            is_occupied[image, cells[:, 0] * 2**level + cells[:, 1]] = True
            score += 4**level * is_occupied.sum(axis=1)
        return np.bincount(image, minlength=scene.images), score

    def _register(self, state: SfmState, image: int) -> SfmState | None:
        scene = self.scene
        index = np.flatnonzero((scene.tracks.image == image) & state.has_point[scene.tracks.track])
        bearings = state.bearings(scene, index)
        is_defined = np.isfinite(bearings[:, 0])
        index, bearings = index[is_defined], bearings[is_defined]
        camera = state.cameras[scene.image_camera[image]]
        found = resect(
            state.points[scene.tracks.track[index]],
            bearings,
            float(np.sqrt(camera.fx * camera.fy)),
            self.config.resection,
        )
        if found is None:
            return None
        Ts_world_cam, is_inlier = state.Ts_world_cam.copy(), state.is_inlier.copy()
        Ts_world_cam[image] = found[0]
        is_inlier[index] = found[1]
        return replace(state, Ts_world_cam=Ts_world_cam, is_inlier=is_inlier)

    def triangulate(self, state: SfmState, again: Mask | None = None) -> SfmState:
        """Triangulate tracks without a point, and those (T,) marked to be triangulated again."""
        scene = self.scene
        wanted = ~state.has_point if again is None else ~state.has_point | again
        index = np.flatnonzero(state.is_registered[scene.tracks.image] & wanted[scene.tracks.track])
        bearings = state.bearings(scene, index)
        is_defined = np.isfinite(bearings[:, 0])
        index, bearings = index[is_defined], bearings[is_defined]
        tracks, track = np.unique(scene.tracks.track[index], return_inverse=True)
        enough = np.bincount(track, minlength=len(tracks)) >= 2
        index, bearings = index[enough[track]], bearings[enough[track]]
        tracks, track = np.unique(scene.tracks.track[index], return_inverse=True)
        T = state.Ts_world_cam[scene.tracks.image[index]]
        rng = np.random.default_rng(0)
        found = triangulate_tracks(
            track.astype(np.int64),
            T[:, :3, 3],
            np.einsum("mij,mj->mi", T[:, :3, :3], bearings),
            state.focal_px(scene, index),
            self.config.triangulation,
            rng,
        )
        points, is_inlier = state.points.copy(), state.is_inlier.copy()
        points[tracks], is_inlier[index] = found.points, found.is_inlier
        return replace(state, points=points, is_inlier=is_inlier)

    def _subset(self, state: SfmState, used: Mask, images: Mask) -> Mask:
        """Return a subset of the used observations: per image, those of the longest tracks."""
        scene = self.scene
        lengths = np.bincount(scene.tracks.track[used], minlength=scene.tracks.count)
        index = np.flatnonzero(used & images[scene.tracks.image])
        order = index[np.lexsort([scene.tracks.track[index], -lengths[scene.tracks.track[index]]])]
        order = order[np.argsort(scene.tracks.image[order], kind="stable")]
        counts = np.bincount(scene.tracks.image[order], minlength=scene.images)
        rank = np.arange(len(order)) - np.repeat(np.cumsum(counts) - counts, counts)
        kept = np.zeros(scene.tracks.count, np.bool_)
        kept[scene.tracks.track[order[rank < self.config.intermediate_observations]]] = True
        return np.asarray(used & kept[scene.tracks.track])

    def adjust_all(self, state: SfmState) -> SfmState:
        """Adjust the whole reconstruction on a subset of its observations, with a robust loss."""
        used = state.used(self.scene)
        selected = self._subset(state, used, state.is_registered)
        config = BundleAdjustmentConfig(max_iterations=15, relative_tolerance=1e-4, cauchy_px=INTERMEDIATE_CAUCHY_PX)
        adjusted = adjust(self.scene, state, state.is_registered, selected, config)
        return self._repair(adjusted, np.ones(self.scene.tracks.count, np.bool_))

    def _repair(self, state: SfmState, moved: Mask) -> SfmState:
        """Triangulate again the points that an adjustment of a subset has left behind."""
        errors = self._errors(state, moved)
        worst = np.zeros(self.scene.tracks.count)
        np.maximum.at(worst, self.scene.tracks.track, errors)
        return self.triangulate(state, moved & (worst > 1.0))

    def _errors(self, state: SfmState, tracks: Mask) -> Array:
        """Return reprojection errors (M,) of the used observations of some tracks, zero for others [px]."""
        errors = np.zeros(len(self.scene.pixels))
        index = np.flatnonzero(state.used(self.scene) & tracks[self.scene.tracks.track])
        errors[index] = state.errors_px(self.scene, index)
        return errors

    def filter(self, state: SfmState, tracks: Mask | None = None) -> SfmState:
        """Remove outliers, and points with fewer than two observations or too small an angle."""
        scene, config = self.scene, self.config.triangulation
        tracks = state.has_point if tracks is None else state.has_point & tracks
        is_inlier = state.is_inlier & (self._errors(state, tracks) <= config.max_error_px)
        state = replace(state, is_inlier=is_inlier)
        index = np.flatnonzero(state.used(scene) & tracks[scene.tracks.track])
        ids, track = np.unique(scene.tracks.track[index], return_inverse=True)
        keep = np.zeros(scene.tracks.count, np.bool_)
        if len(index):
            counts = np.bincount(track)
            starts = np.concatenate([[0], np.cumsum(counts)[:-1]])
            origins = state.Ts_world_cam[scene.tracks.image[index], :3, 3]
            angles = widest_angles(track, starts, state.points[ids], origins, np.ones(len(index), np.bool_))
            keep[ids] = (counts >= 2) & (angles >= np.radians(config.min_angle_deg))
        points = state.points.copy()
        points[tracks & ~keep] = np.nan
        return replace(state, points=points, is_inlier=is_inlier & np.isfinite(points[scene.tracks.track, 0]))

    def _complete(self, state: SfmState) -> SfmState:
        """Add observations that agree with the point of their track, and triangulate tracks without a point."""
        scene = self.scene
        state = self.triangulate(state)
        index = np.flatnonzero(
            ~state.is_inlier & state.is_registered[scene.tracks.image] & state.has_point[scene.tracks.track]
        )
        is_inlier = state.is_inlier.copy()
        is_inlier[index] = state.errors_px(scene, index) <= self.config.triangulation.max_error_px
        return replace(state, is_inlier=is_inlier)

    def _refine(self, state: SfmState) -> SfmState:
        """Complete, adjust and filter the whole reconstruction."""
        return self.filter(self.adjust_all(self._complete(state)))

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
        is_wrong = state.is_registered & (inliers < self.config.min_support * visible) & (discards < MAX_DISCARDS)
        if not is_wrong.any() or (state.is_registered & ~is_wrong).sum() < 2:
            return state
        discards[is_wrong] += 1
        Ts_world_cam = state.Ts_world_cam.copy()
        Ts_world_cam[is_wrong] = np.nan
        is_inlier = state.is_inlier & ~is_wrong[scene.tracks.image]
        return self.filter(replace(state, Ts_world_cam=Ts_world_cam, is_inlier=is_inlier))

    def _finish(self, state: SfmState) -> SfmState:
        """Adjust all observations until the error settles, and remove outliers."""
        state = self.filter(self._complete(state))
        is_calibrated = self.scene.is_calibrated.all()
        tolerance = CALIBRATED_TOLERANCE if is_calibrated else UNCALIBRATED_TOLERANCE
        config = BundleAdjustmentConfig(self.config.max_iterations, tolerance, self.config.final_cauchy_px)
        return self.filter(adjust(self.scene, state, state.is_registered, state.used(self.scene), config))


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
