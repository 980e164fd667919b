"""Merging of tracks of the same point, which matching has left apart.

Two tracks are merged if they have no image in common, their points lie close together, their descriptors are similar,
and the mean of the points agrees with the observations of both (Schönberger and Frahm, "Structure-from-motion
revisited", CVPR 2016, section 4.4).
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from dronevio.estimator.sfm.completion.descriptors import track_descriptors
from dronevio.estimator.sfm.config import CompletionConfig
from dronevio.estimator.sfm.features import Features
from dronevio.estimator.sfm.model import Scene, SfmState
from dronevio.estimator.sfm.tracks import Tracks
from dronevio.models.arrays import Array

Indices = npt.NDArray[np.int64]

MERGE_ROUNDS = 3
"""Largest number of rounds, in each of which a track is merged with one other."""
NEIGHBOURS = 4
"""Number of nearest points with which each point is compared."""


def merge_tracks(
    scene: Scene, state: SfmState, features: Sequence[Features], config: CompletionConfig
) -> tuple[Scene, SfmState]:
    """Return the measurements and the reconstruction with the tracks of the same point merged.

    Each round merges pairs of tracks, of which none has a nearer partner; rounds are repeated until nothing changes.

    Args:
        scene: The measurements.
        state: The reconstruction.
        features: (I,) Features of all images.
        config: Thresholds.
    """
    for _ in range(MERGE_ROUNDS):
        pairs = _candidates(scene, state, features, config)
        pairs, points = _agreeing(scene, state, pairs, config.merge_error_px)
        if len(pairs) == 0:
            break
        scene, state = _merged(scene, state, pairs, points)
    return scene, state


def _candidates(scene: Scene, state: SfmState, features: Sequence[Features], config: CompletionConfig) -> Indices:
    """Return pairs (P, 2) of different tracks with close points and similar descriptors, the nearest first."""
    used = state.used(scene)
    tracks = np.flatnonzero(state.has_point)
    if len(tracks) < 2:
        return np.empty((0, 2), np.int64)
    count = min(NEIGHBOURS + 1, len(tracks))
    distance, neighbour = cKDTree(state.points[tracks]).query(state.points[tracks], count)
    a, b = np.repeat(np.arange(len(tracks)), count - 1), neighbour[:, 1:].ravel()
    distance = distance[:, 1:].ravel()
    radius = config.merge_error_px * _pixel_sizes(scene, state)[tracks]
    relative = distance / np.maximum(np.minimum(radius[a], radius[b]), 1e-300)
    kept = (a < b) & (relative <= 1.0)
    a, b, relative = tracks[a[kept]], tracks[b[kept]], relative[kept]
    descriptors = track_descriptors(scene, used, features)
    is_similar = np.einsum("pi,pi->p", descriptors[a], descriptors[b]) >= np.cos(config.merge_angle_rad)
    order = np.argsort(relative[is_similar], kind="stable")
    return np.column_stack([a[is_similar], b[is_similar]])[order]


def _pixel_sizes(scene: Scene, state: SfmState) -> Array:
    """Return the length (T,) that a pixel covers at each point in the image of the farthest camera that observes it."""
    index = np.flatnonzero(state.used(scene))
    image, track = scene.tracks.image[index], scene.tracks.track[index]
    distance = np.linalg.norm(state.points[track] - state.Ts_world_cam[image, :3, 3], axis=1)
    sizes = np.zeros(scene.tracks.count)
    np.maximum.at(sizes, track, distance / state.focal_px(scene, index))
    return sizes


def _agreeing(scene: Scene, state: SfmState, pairs: Indices, max_error_px: float) -> tuple[Indices, Array]:
    """Return disjoint pairs of tracks that one point explains, and these points.

    The pairs that are given first are preferred.
    """
    used = np.flatnonzero(state.used(scene))
    lengths = np.bincount(scene.tracks.track[used], minlength=scene.tracks.count)
    starts = np.concatenate([[0], np.cumsum(lengths)])
    weights = lengths[pairs][..., None]
    points = np.sum(weights * state.points[pairs], axis=1) / np.maximum(weights.sum(axis=1), 1)
    # All observations of both tracks of each pair, tested against the mean of the points.
    counts = lengths[pairs].sum(axis=1)
    pair = np.repeat(np.arange(len(pairs)), counts)
    rows = [used[starts[t] : starts[t + 1]] for t in pairs.ravel()]
    index = np.concatenate([np.empty(0, np.int64), *rows])
    error = state.errors_px(scene, index, points[pair])
    is_explained = np.bincount(pair, error > max_error_px, len(pairs)) == 0
    images = np.unique(np.column_stack([pair, scene.tracks.image[index]]), axis=0)
    is_disjoint = np.bincount(images[:, 0], minlength=len(pairs)) == counts
    taken = np.zeros(scene.tracks.count, np.bool_)
    chosen = []
    for k in np.flatnonzero(is_explained & is_disjoint).tolist():
        if not taken[pairs[k]].any():
            taken[pairs[k]] = True
            chosen.append(k)
    return pairs[chosen], points[chosen]


def _merged(scene: Scene, state: SfmState, pairs: Indices, points: Array) -> tuple[Scene, SfmState]:
    """Return the scene in which the second track of each pair belongs to the first, with a new point.

    Observations that are outliers of the two tracks are dropped, so that a track has one feature of an image.
    """
    label = np.arange(scene.tracks.count)
    label[pairs[:, 1]] = pairs[:, 0]
    is_merged = np.zeros(scene.tracks.count, np.bool_)
    is_merged[pairs] = True
    kept = np.flatnonzero(~is_merged[scene.tracks.track] | state.used(scene))
    remaining, track = np.unique(label[scene.tracks.track[kept]], return_inverse=True)
    order = np.argsort(track, kind="stable")
    kept, track = kept[order], track[order].astype(np.int64)
    new_points = state.points.copy()
    new_points[pairs[:, 0]] = points
    tracks = Tracks(scene.tracks.image[kept], scene.tracks.feature[kept], track)
    return (
        replace(scene, tracks=tracks, pixels=scene.pixels[kept], sigmas=scene.sigmas[kept]),
        replace(state, points=new_points[remaining], is_inlier=state.is_inlier[kept]),
    )
