"""Structure from motion from images alone: detection, matching, verification, tracks and incremental mapping.

Source: Dellaert and Hutchinson, *Introduction to Robotics and Perception*, section 7.4.2; Schönberger and Frahm,
"Structure-from-motion revisited", CVPR 2016.
"""

import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from itertools import groupby

import numpy as np
import numpy.typing as npt

from dronevio.estimator.array_store import digest
from dronevio.estimator.sfm.completion import add_observations, merge_tracks
from dronevio.estimator.sfm.config import SfmConfig, VerificationConfig
from dronevio.estimator.sfm.earlier import earlier_cameras, earlier_images, earlier_pairs, shared_points
from dronevio.estimator.sfm.features import NO_FEATURES, Features, detect_features
from dronevio.estimator.sfm.focal import guess_fisheyes, guess_pinholes
from dronevio.estimator.sfm.intrinsics import FOCAL_SIGMAS, IntrinsicsPrior
from dronevio.estimator.sfm.links import wrong_links
from dronevio.estimator.sfm.mapper import finish, hold_undetermined, map_scene, self_calibrations
from dronevio.estimator.sfm.matching import match_features
from dronevio.estimator.sfm.model import KnownPoses, Scene, SfmState, initial_state
from dronevio.estimator.sfm.pairs import select_pairs
from dronevio.estimator.sfm.placement.gauge import aligned
from dronevio.estimator.sfm.placement.world import WorldFrame, place
from dronevio.estimator.sfm.tracks import MatchedPair, connect_tracks
from dronevio.estimator.sfm.two_view import ImageView, TwoView, verify, view_of
from dronevio.estimator.sfm.workspace import Workspace
from dronevio.estimator.threads import map_with_progress, single_threaded
from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError, InputError
from dronevio.models.image_sets import ImageSet
from dronevio.models.progress import Progress, Stages, silent_stages
from dronevio.models.reconstruction import Reconstruction, SelfCalibration

Indices = npt.NDArray[np.int64]

_REPAIRS = 3  # largest number of times at which wrong links are removed


@dataclass(frozen=True, eq=False)
class SfmResult:
    """Reconstructions of a set of images."""

    reconstructions: tuple[Reconstruction, ...]
    """One for each component, the one with the most images first; empty if no pair of images can be reconstructed."""
    match_counts: npt.NDArray[np.int64]
    """(I, I) Number of verified matches of each pair of images, symmetric."""
    feature_counts: npt.NDArray[np.int64]
    """(I,) Number of features of each image."""
    times_s: dict[str, float]
    """Elapsed time of each stage [s]."""
    worlds: tuple[WorldFrame, ...]
    """How the world frame of each reconstruction is determined."""
    calibrations: tuple[tuple[SelfCalibration | None, ...], ...]
    """Which parameters of each camera of each reconstruction were estimated; None for cameras with a calibration."""
    unreadable: Mapping[int, InputError] = field(default_factory=dict)
    """Why an image, or its mask, cannot be read, by the index of the image."""

    @property
    def is_metric(self) -> bool:
        """Whether the unit of all reconstructions is the metre; otherwise it is arbitrary."""
        return all(world.is_metric for world in self.worlds)


@single_threaded()
def reconstruct(
    images: ImageSet,
    config: SfmConfig | None = None,
    workspace: Workspace | None = None,
    stages: Stages = silent_stages,
    *,
    earlier: Reconstruction | None = None,
    earlier_world: WorldFrame | None = None,
    poses: KnownPoses | None = None,
    strict: bool = False,
) -> SfmResult:
    """Reconstruct cameras and points from images.

    Args:
        images: The images, with calibrated cameras or a first guess of them.
        config: Settings.
        workspace: Where features and matches are kept; an earlier result is used if input and settings are the same.
        stages: Returns the progress callback of a stage by its name.
        earlier: A reconstruction of some of the images, to which the others are added. The first component of the
            result contains it, in its world frame and scale.
        earlier_world: How the world frame of the earlier reconstruction is determined; None if it is arbitrary.
        poses: Known poses of some of the images, which determine the world frame and the scale of the first component.
        strict: Whether an image that is skipped or cannot be read is an error; otherwise it has no features.

    Raises:
        InputError: An image is skipped or cannot be read, and `strict` is set.
        ConfigError: The earlier reconstruction contradicts the images, or the known poses contradict them.
    """
    config = config or SfmConfig()
    workspace = workspace or Workspace(None)
    if strict:
        for error in images.skipped.values():
            raise error
    _check_known(images, earlier, poses)
    index = np.empty(0, np.int64) if earlier is None else earlier_images(images, earlier)
    if earlier is not None:
        images = replace(images, cameras=earlier_cameras(images, earlier))
    clock = _Clock()
    with ThreadPoolExecutor(config.threads) as pool:
        # Features of all images
        features, keys, unreadable = _detect(images, config, workspace, pool, stages("features"), strict)
        clock.lap("features")
        # Pairs of images that may show the same points; those of earlier images are known
        known = None if earlier is None else earlier_pairs(index, earlier, features)
        matched = index if known is not None else index[:0]
        chosen = _chosen_pairs(images, features, matched, config)
        if earlier is None:
            cameras = guess_fisheyes(images, features, chosen, config.matching, config.verification)
            images = replace(images, cameras=cameras)
        # Matching and geometric verification
        pairs = _match(images, features, keys, chosen, config, workspace, pool, stages("matching"))
        if earlier is None:
            images, pairs = _with_focal_lengths(images, features, pairs, config.verification)
        clock.lap("matching")
    # Tracks, and where poses are known the state to begin with
    scene = _scene(images, features, [*(known or []), *pairs])
    Ts_earlier = np.full((len(images), 4, 4), np.nan)
    start = None
    if earlier is not None:
        Ts_earlier[index] = earlier.Ts_world_cam
        start = initial_state(scene, images.cameras, Ts_earlier)
    elif poses is not None and poses.is_exact:
        scene = replace(scene, fixed_images=poses.is_known)
        start = initial_state(scene, images.cameras, poses.Ts_world_cam)
    # Incremental mapping, one state per connected part of the scene
    scene, states, pairs = _mapped(scene, images, features, pairs, config, stages("mapping"), start)
    is_measured = poses is not None or images.geotags is not None or images.control_points is not None
    completed: list[tuple[Scene, SfmState]] = []
    for state in states:
        completed.append(_completed(*_with_known_cameras(scene, state, completed), features, config, is_measured))
    # World frame: scale, gravity and origin
    origin = None if earlier_world is None else earlier_world.origin
    placed = [(own, *place(own, state, images, config, poses, origin)) for own, state in completed]
    if earlier is not None:
        placed[0] = placed[0][0], aligned(placed[0][1], Ts_earlier), earlier_world or WorldFrame()
    clock.lap("mapping")
    shared = None if earlier is None else shared_points(index, earlier, len(features))
    return SfmResult(
        tuple(_reconstruction(own, state, images.names, features) for own, state, _ in placed),
        _match_counts(pairs, len(features), shared),
        np.array([len(f) for f in features], np.int64),
        clock.times_s,
        tuple(world for *_, world in placed),
        _calibrations(completed),
        unreadable,
    )


def _check_known(images: ImageSet, earlier: Reconstruction | None, poses: KnownPoses | None) -> None:
    """Raise ConfigError unless at most one of both is given, and the poses are those of the images."""
    if earlier is not None and poses is not None:
        raise ConfigError("an earlier reconstruction and known poses; expected one of them")
    if poses is not None and len(poses.Ts_world_cam) != len(images):
        raise ConfigError(f"known poses of {len(poses.Ts_world_cam)} images; expected {len(images)} (NaN if unknown)")


def _match_counts(pairs: Sequence[TwoView], count: int, shared: Indices | None) -> Indices:
    """Return the matches of each pair of images (I, I), for unmatched pairs the shared points of earlier images."""
    counts = np.zeros((count, count), np.int64) if shared is None else shared.copy()
    for pair in pairs:
        counts[pair.first, pair.second] = counts[pair.second, pair.first] = len(pair.matches)
    return counts


def _detect(
    images: ImageSet,
    config: SfmConfig,
    workspace: Workspace,
    pool: ThreadPoolExecutor,
    progress: Progress,
    strict: bool,
) -> tuple[list[Features], list[str], dict[int, InputError]]:
    """Return the features of each image, the hashes of what they depend on, and why images cannot be read."""
    unreadable: dict[int, InputError] = {}

    def detect(index: int) -> tuple[Features, str]:
        try:
            image, mask = images.read(index), images.read_mask(index)
        except InputError as error:
            if strict:
                raise
            unreadable[index] = error
            return NO_FEATURES, digest("unreadable")
        key = digest(image, image.shape, mask, config.features)
        features = workspace.load_features(index, key)
        if features is None:
            features = detect_features(image, config.features, mask)
            workspace.save_features(index, key, features)
        return features, key

    detected = map_with_progress(pool, detect, range(len(images.names)), progress)
    return [features for features, _ in detected], [key for _, key in detected], dict(sorted(unreadable.items()))


def _chosen_pairs(
    images: ImageSet, features: list[Features], known: Indices, config: SfmConfig
) -> list[tuple[int, int]]:
    """Return the pairs of images that are matched, except those of two images whose matches are known."""
    is_known = np.isin(np.arange(len(features)), known)
    return [
        (i, j) for i, j in select_pairs(features, images.is_ordered, config.pairs) if not (is_known[i] and is_known[j])
    ]


def _match(
    images: ImageSet,
    features: list[Features],
    keys: list[str],
    chosen: list[tuple[int, int]],
    config: SfmConfig,
    workspace: Workspace,
    pool: ThreadPoolExecutor,
    progress: Progress,
) -> list[TwoView]:
    """Return the verified pairs among some pairs, in the order of their images."""
    views = _views(images, features)

    def match(group: tuple[int, list[int]]) -> list[TwoView]:
        first, others = group
        cameras = [images.cameras[images.image_camera[i]] for i in (first, *others)]
        key = digest(config.matching, config.verification, cameras, others, *(keys[i] for i in (first, *others)))
        stored = workspace.load_pairs(first, key)
        if stored is not None:
            return stored
        pairs = []
        for other in others:
            matches = match_features(features[first], features[other], config.matching)
            pair = verify(first, other, (views[first], views[other]), matches, config.verification)
            if pair is not None:
                pairs.append(pair)
        workspace.save_pairs(first, key, pairs)
        return pairs

    groups = [(first, [j for _, j in rows]) for first, rows in groupby(chosen, key=lambda pair: pair[0])]
    return [pair for pairs in map_with_progress(pool, match, groups, progress) for pair in pairs]


def _with_focal_lengths(
    images: ImageSet, features: list[Features], pairs: list[TwoView], config: VerificationConfig
) -> tuple[ImageSet, list[TwoView]]:
    """Return the images with first focal lengths of pinholes that have none, and the pairs with their motion."""
    cameras = guess_pinholes(images, features, pairs, config)
    changed = np.array([new is not old for new, old in zip(cameras, images.cameras, strict=True)])[images.image_camera]
    if not changed.any():
        return images, pairs
    images = replace(images, cameras=cameras)
    views = _views(images, features)
    verified = [
        verify(pair.first, pair.second, (views[pair.first], views[pair.second]), pair.matches, config)
        if changed[pair.first] or changed[pair.second]
        else pair
        for pair in pairs
    ]
    return images, [pair for pair in verified if pair is not None]


def _mapped(
    scene: Scene,
    images: ImageSet,
    features: list[Features],
    pairs: list[TwoView],
    config: SfmConfig,
    progress: Progress,
    start: SfmState | None,
) -> tuple[Scene, list[SfmState], list[TwoView]]:
    """Return the components of a scene, mapped once more without the links of the first one that have proved wrong."""
    states = map_scene(scene, images.cameras, pairs, config.mapper, progress, start, is_final=False)
    for _ in range(_REPAIRS if start is None and states else 0):
        largest = states[0]
        wrong = set(wrong_links(pairs, _views(images, features, largest.cameras), largest.Ts_world_cam).tolist())
        if not wrong:
            break
        pairs = [pair for k, pair in enumerate(pairs) if k not in wrong]
        scene = _scene(images, features, pairs)
        states = map_scene(scene, images.cameras, pairs, config.mapper, progress, is_final=False)
    return scene, states, pairs


def _views(images: ImageSet, features: list[Features], cameras: Sequence[CameraModel] | None = None) -> list[ImageView]:
    """Return what verification needs of each image; fisheyes count as calibrated, by their first focal length."""
    cameras = cameras or images.cameras
    is_known = [
        bool(known) or camera.lens == "equidistant" for known, camera in zip(images.is_calibrated, cameras, strict=True)
    ]
    of_image = zip(features, images.image_camera.tolist(), strict=True)
    return [view_of(f.pixels, cameras[k], is_known[k]) for f, k in of_image]


def _scene(images: ImageSet, features: list[Features], pairs: Sequence[MatchedPair]) -> Scene:
    counts = np.array([len(f) for f in features], np.int64)
    tracks = connect_tracks(pairs, counts)
    pixels, sigmas = np.concatenate([f.pixels for f in features]), np.concatenate([f.sigmas for f in features])
    rows = (np.cumsum(counts) - counts)[tracks.image] + tracks.feature
    return Scene(tracks, pixels[rows], sigmas[rows], images.image_camera, images.is_calibrated, priors_of(images))


def priors_of(images: ImageSet) -> tuple[IntrinsicsPrior, ...]:
    """Return what is known of each camera (K,) beforehand."""
    sigmas = [FOCAL_SIGMAS[source] for source in images.focal_source] or [FOCAL_SIGMAS["assumed"]] * len(images.cameras)
    return tuple(IntrinsicsPrior(camera, sigma) for camera, sigma in zip(images.cameras, sigmas, strict=True))


def _with_known_cameras(
    scene: Scene, state: SfmState, larger: Sequence[tuple[Scene, SfmState]]
) -> tuple[Scene, SfmState]:
    """Return a component with the cameras that larger ones share with it, held."""
    cameras, is_calibrated = list(state.cameras), scene.is_calibrated.copy()
    for known, other in reversed(larger):
        for k in np.unique(known.image_camera[other.is_registered]).tolist():
            cameras[k], is_calibrated[k] = other.cameras[k], True
    return replace(scene, is_calibrated=is_calibrated), replace(state, cameras=tuple(cameras))


def _calibrations(completed: Sequence[tuple[Scene, SfmState]]) -> tuple[tuple[SelfCalibration | None, ...], ...]:
    """Return which parameters of the cameras of each component were estimated, in it or in a larger one."""
    known: dict[int, SelfCalibration | None] = {}
    result = []
    for scene, state in completed:
        used = np.unique(scene.image_camera[state.is_registered]).tolist()
        own = self_calibrations(scene, state)
        known |= {k: own[k] for k in used if k not in known}
        result.append(tuple(known[k] for k in used))
    return tuple(result)


def _completed(
    scene: Scene, state: SfmState, features: list[Features], config: SfmConfig, is_measured: bool
) -> tuple[Scene, SfmState]:
    """Return a reconstruction with longer tracks, finally adjusted, and its measurements.

    Where positions of the cameras are measured, focal lengths are estimated in any case.
    """
    if config.completion.merge:
        scene, state = merge_tracks(scene, state, features, config.completion)
    if config.completion.guided:
        scene, state = add_observations(scene, state, features, config.completion)
    scene, state = hold_undetermined(scene, state, config.mapper, least=int(is_measured))
    return scene, finish(scene, state, config.mapper)


def _reconstruction(scene: Scene, state: SfmState, names: tuple[str, ...], features: list[Features]) -> Reconstruction:
    """Return the registered images and the triangulated tracks of a state, numbered anew."""
    images, points = np.flatnonzero(state.is_registered), np.flatnonzero(state.has_point)
    used = np.flatnonzero(state.used(scene))
    image, track = scene.tracks.image[used], scene.tracks.track[used]
    counts = np.array([len(f) for f in features], np.int64)
    row = (np.cumsum(counts) - counts)[image] + scene.tracks.feature[used]
    colours = np.concatenate([f.colours for f in features])[row].astype(np.float64)
    new_point = np.searchsorted(points, track)
    sums = np.stack([np.bincount(new_point, colours[:, k], len(points)) for k in range(3)], axis=1)
    lengths = np.bincount(new_point, minlength=len(points))
    cameras = np.unique(scene.image_camera[images])
    return Reconstruction(
        cameras=tuple(state.cameras[k] for k in cameras),
        image_names=tuple(names[i] for i in images),
        image_camera=np.searchsorted(cameras, scene.image_camera[images]).astype(np.int64),
        Ts_world_cam=state.Ts_world_cam[images],
        points=state.points[points],
        colours=np.round(sums / np.maximum(lengths, 1)[:, None]).astype(np.uint8),
        observation_image=np.searchsorted(images, image).astype(np.int64),
        observation_point=new_point.astype(np.int64),
        observation_px=scene.pixels[used],
    )


class _Clock:
    """Elapsed times of successive stages."""

    def __init__(self) -> None:
        self.times_s: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, stage: str) -> None:
        """Record the time since the last lap."""
        now = time.perf_counter()
        self.times_s[stage] = now - self._last
        self._last = now
