"""Guided completion: points are projected into images that see them, and nearby features are added to their tracks.

Matching compares whole images, in which a descriptor may be ambiguous or slightly too different. Near the projection of
a point there are few features, so that a weaker similarity suffices.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.spatial import cKDTree

from dronevio.estimator.sfm.completion.descriptors import track_descriptors, unit_descriptors
from dronevio.estimator.sfm.config import CompletionConfig
from dronevio.estimator.sfm.features import Features
from dronevio.estimator.sfm.model import Scene, SfmState
from dronevio.estimator.sfm.tracks import Tracks
from dronevio.models.arrays import Array, Mask

Indices = npt.NDArray[np.int64]

MIN_SHARED_POINTS = 10
"""Smallest number of shared points of two images at which the points of one are looked for in the other."""
MAX_DISTANCE_RATIO = 2.0
"""Largest ratio between the distances from which a point is observed, in both directions."""
CANDIDATES = 3
"""Number of nearest features with which a projected point is compared."""


def add_observations(
    scene: Scene, state: SfmState, features: Sequence[Features], config: CompletionConfig
) -> tuple[Scene, SfmState]:
    """Return the measurements and the reconstruction with observations added to the tracks with a point.

    A feature is added if it belongs to no track with a point, lies near the projection of the point, and has the most
    similar descriptor of those near; the point must have the most similar one for the feature, too.

    Args:
        scene: The measurements.
        state: The reconstruction.
        features: (I,) Features of all images.
        config: Thresholds.
    """
    used = state.used(scene)
    observed = _observed(scene, used)
    shared = np.asarray((observed @ observed.T).todense())
    descriptors = track_descriptors(scene, used, features)
    distances = _distances(scene, state, used)
    added = [np.empty((0, 3), np.int64)]
    for image in np.flatnonzero(state.is_registered).tolist():
        neighbours = np.flatnonzero(shared[image] >= MIN_SHARED_POINTS)
        seen = np.asarray(observed[neighbours].sum(axis=0)).ravel() > 0
        own = scene.tracks.of_image(image)
        own = own[used[own]]
        seen[scene.tracks.track[own]] = False
        free = np.ones(len(features[image]), np.bool_)
        free[scene.tracks.feature[own]] = False
        tracks = np.flatnonzero(seen & state.has_point)
        matches = _matches(
            scene, state, image, tracks, np.flatnonzero(free), features[image], descriptors, distances, config
        )
        added.append(np.column_stack([np.full(len(matches), image), matches]))
    return _extended(scene, state, features, np.concatenate(added))


def _observed(scene: Scene, used: Mask) -> coo_array:
    """Return which tracks each image observes, as a sparse array (I, T) of ones."""
    image, track = scene.tracks.image[used], scene.tracks.track[used]
    return coo_array((np.ones(len(image), np.int32), (image, track)), shape=(scene.images, scene.tracks.count)).tocsr()


def _distances(scene: Scene, state: SfmState, used: Mask) -> Array:
    """Return the smallest and largest distances (T, 2) from which each track is observed."""
    image, track = scene.tracks.image[used], scene.tracks.track[used]
    distance = np.linalg.norm(state.points[track] - state.Ts_world_cam[image, :3, 3], axis=1)
    result = np.column_stack([np.full(scene.tracks.count, np.inf), np.zeros(scene.tracks.count)])
    np.minimum.at(result[:, 0], track, distance)
    np.maximum.at(result[:, 1], track, distance)
    return result


def _matches(
    scene: Scene,
    state: SfmState,
    image: int,
    tracks: Indices,
    free: Indices,
    features: Features,
    descriptors: npt.NDArray[np.float32],
    distances: Array,
    config: CompletionConfig,
) -> Indices:
    """Return the tracks and the features (K, 2) of an image that belong together."""
    # Points that the image should show, at a distance at which their descriptors hold
    T, camera = state.Ts_world_cam[image], state.cameras[scene.image_camera[image]]
    relative = state.points[tracks] - T[:3, 3]
    distance = np.linalg.norm(relative, axis=1)
    is_near = (distance <= MAX_DISTANCE_RATIO * distances[tracks, 1]) & (
        distance >= distances[tracks, 0] / MAX_DISTANCE_RATIO
    )
    projected = camera.project(relative @ T[:3, :3])
    inside = np.all((projected >= 0.0) & (projected <= [camera.width - 1.0, camera.height - 1.0]), axis=1)
    kept = inside & is_near
    tracks, projected = tracks[kept], projected[kept]
    if len(tracks) == 0 or len(free) == 0:
        return np.empty((0, 2), np.int64)
    # Free features near their projections, with similar descriptors
    count = min(CANDIDATES, len(free))
    distance, nearest = cKDTree(features.pixels[free]).query(
        projected, count, distance_upper_bound=config.guided_error_px
    )
    row, column = np.nonzero(np.isfinite(distance.reshape(len(tracks), count)))
    feature = free[nearest.reshape(len(tracks), count)[row, column]]
    similarity = np.einsum("ki,ki->k", descriptors[tracks[row]], unit_descriptors(features)[feature])
    accepted = similarity >= np.cos(config.guided_angle_rad)
    row, feature, similarity = row[accepted], feature[accepted], similarity[accepted]
    order = np.argsort(-similarity, kind="stable")
    row, feature = row[order], feature[order]
    # The most similar pair of its track and of its feature.
    first_row, first_feature = (np.zeros(len(order), np.bool_) for _ in range(2))
    first_row[np.unique(row, return_index=True)[1]] = True
    first_feature[np.unique(feature, return_index=True)[1]] = True
    best = first_row & first_feature
    return np.column_stack([tracks[row[best]], feature[best]])


def _extended(scene: Scene, state: SfmState, features: Sequence[Features], added: Indices) -> tuple[Scene, SfmState]:
    """Return the scene with observations (K, 3) of image, track and feature added as inliers.

    A feature leaves the track to which it belonged, and outliers of the same image leave the track that it joins.
    """
    sizes = np.array([len(f) for f in features], np.int64)
    offsets = np.cumsum(sizes) - sizes
    joined = np.zeros(int(sizes.sum()), np.bool_)
    joined[offsets[added[:, 0]] + added[:, 2]] = True
    replaced = np.isin(scene.tracks.track * scene.images + scene.tracks.image, added[:, 1] * scene.images + added[:, 0])
    kept = np.flatnonzero(~joined[offsets[scene.tracks.image] + scene.tracks.feature] & ~replaced)
    image = np.concatenate([scene.tracks.image[kept], added[:, 0]])
    feature = np.concatenate([scene.tracks.feature[kept], added[:, 2]])
    label = np.concatenate([scene.tracks.track[kept], added[:, 1]])
    is_inlier = np.concatenate([state.is_inlier[kept], np.ones(len(added), np.bool_)])
    order = np.lexsort([image, label])
    remaining, track = np.unique(label[order], return_inverse=True)
    image, feature = image[order], feature[order]
    rows = offsets[image] + feature
    pixels = np.concatenate([f.pixels for f in features])[rows]
    sigmas = np.concatenate([f.sigmas for f in features])[rows]
    return (
        replace(scene, tracks=Tracks(image, feature, track.astype(np.int64)), pixels=pixels, sigmas=sigmas),
        replace(state, points=state.points[remaining], is_inlier=is_inlier[order]),
    )
