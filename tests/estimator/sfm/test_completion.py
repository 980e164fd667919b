"""Merging of tracks of the same point, and guided completion of tracks."""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from dronevio.estimator.sfm.completion import add_observations, merge_tracks
from dronevio.estimator.sfm.config import CompletionConfig, MatchingConfig, SfmConfig, TriangulationConfig
from dronevio.estimator.sfm.features import Features
from dronevio.estimator.sfm.model import Scene, SfmState, initial_state
from dronevio.estimator.sfm.pipeline import reconstruct
from dronevio.estimator.sfm.structure import triangulate
from dronevio.estimator.sfm.tracks import Tracks

if TYPE_CHECKING:
    from pathlib import Path

    from tests.estimator.sfm.conftest import MakeImages, SyntheticScene

Indices = npt.NDArray[np.int64]
IMAGES, POINTS = 8, 400


def observations(scene: "SyntheticScene") -> tuple[Indices, Indices, Indices]:
    """Return image, feature and point of all features."""
    image = np.concatenate([np.full(len(f), i) for i, f in enumerate(scene.features)])
    feature = np.concatenate([np.arange(len(f)) for f in scene.features])
    return image, feature, np.concatenate(scene.point_of)


def triangulated(scene: "SyntheticScene", image: Indices, feature: Indices, label: Indices) -> tuple[Scene, SfmState]:
    """Return the scene with tracks that have some labels, and its reconstruction with the true poses."""
    order = np.lexsort([image, label])
    image, feature = image[order], feature[order]
    _, track = np.unique(label[order], return_inverse=True)
    pixels = np.stack([scene.features[i].pixels[f] for i, f in zip(image, feature, strict=True)])
    problem = Scene(
        Tracks(image, feature, track), pixels, np.ones(len(pixels)), np.zeros(IMAGES, np.int64), np.array([True])
    )
    state = initial_state(problem, (scene.camera,), scene.Ts_world_cam.copy())
    return problem, triangulate(problem, state, TriangulationConfig())


def points_of_tracks(scene: "SyntheticScene", problem: Scene) -> list[set[int]]:
    """Return the true points of the observations of each track."""
    point = [int(scene.point_of[i][f]) for i, f in zip(problem.tracks.image, problem.tracks.feature, strict=True)]
    return [set(np.array(point)[problem.tracks.track == t].tolist()) for t in range(problem.tracks.count)]


def split(scene: "SyntheticScene") -> tuple[Scene, SfmState]:
    """Return a scene in which images of even and odd number have tracks of their own."""
    image, feature, point = observations(scene)
    return triangulated(scene, image, feature, point + POINTS * (image % 2))


def shuffled(features: Features) -> Features:
    """Return features with the descriptors of others."""
    return replace(features, descriptors=np.roll(features.descriptors, 1, axis=0))


def test_divided_tracks_are_merged(scene: "SyntheticScene") -> None:
    problem, state = split(scene)
    merged, result = merge_tracks(problem, state, scene.features, CompletionConfig())
    assert problem.tracks.count > 1.9 * POINTS
    assert result.has_point.sum() < 1.15 * POINTS
    assert all(len(points) == 1 for points in points_of_tracks(scene, merged))
    used = result.used(merged)
    assert used.sum() == state.used(problem).sum()
    keys = merged.tracks.track * IMAGES + merged.tracks.image
    assert len(np.unique(keys)) == len(keys)
    assert np.all(np.diff(merged.tracks.track) >= 0)
    # The merged points are nearer to the true ones than those of the parts.
    errors = []
    for some, measurements in ((state, problem), (result, merged)):
        points = [points.pop() for points in points_of_tracks(scene, measurements)]
        errors.append(np.nanmedian(np.linalg.norm(some.points - scene.points[points], axis=1)))
    assert errors[1] < 0.9 * errors[0]


def test_other_descriptors_are_not_merged(scene: "SyntheticScene") -> None:
    problem, state = split(scene)
    features = [shuffled(f) if i % 2 else f for i, f in enumerate(scene.features)]
    _, result = merge_tracks(problem, state, features, CompletionConfig())
    assert result.has_point.sum() > 0.98 * state.has_point.sum()


def test_tracks_of_an_image_are_not_merged(scene: "SyntheticScene") -> None:
    image, feature, point = observations(scene)
    problem, state = triangulated(scene, image, feature, point)
    # Two points that coincide, with the same descriptor, but different features of the same images.
    twin = replace(state, points=np.where(np.arange(len(state.points))[:, None] == 1, state.points[0], state.points))
    features = [replace(f, descriptors=np.full_like(f.descriptors, 45)) for f in scene.features]
    shared = set(problem.tracks.image[problem.tracks.track == 0]) & set(problem.tracks.image[problem.tracks.track == 1])
    assert shared
    merged, _ = merge_tracks(problem, twin, features, CompletionConfig(merge_error_px=100.0))
    assert all(
        len(np.unique(merged.tracks.image[merged.tracks.track == t])) == np.sum(merged.tracks.track == t)
        for t in range(merged.tracks.count)
    )


def missing(scene: "SyntheticScene") -> tuple[Scene, SfmState, int]:
    """Return a scene in which a quarter of the observations belongs to no track, and their number."""
    image, feature, point = observations(scene)
    kept = np.random.default_rng(0).random(len(image)) > 0.25
    problem, state = triangulated(scene, image[kept], feature[kept], point[kept])
    return problem, state, int(np.sum(~kept))


def test_missing_observations_are_added(scene: "SyntheticScene") -> None:
    problem, state, removed = missing(scene)
    completed, result = add_observations(problem, state, scene.features, CompletionConfig())
    added = len(completed.pixels) - len(problem.pixels)
    assert added > 0.9 * removed
    assert sum(len(points) > 1 for points in points_of_tracks(scene, completed)) == 0
    errors = result.errors_px(completed, np.flatnonzero(result.used(completed)))
    assert errors.max() < 4.0
    np.testing.assert_array_equal(
        completed.pixels[0], scene.features[completed.tracks.image[0]].pixels[completed.tracks.feature[0]]
    )


def test_features_with_other_descriptors_are_not_added(scene: "SyntheticScene") -> None:
    problem, state, removed = missing(scene)
    features = [shuffled(f) if i == 3 else f for i, f in enumerate(scene.features)]
    completed, _ = add_observations(problem, state, features, CompletionConfig())
    before, after = (np.sum(some.tracks.image == 3) for some in (problem, completed))
    assert after - before <= 0.02 * removed


def test_a_reconstruction_has_longer_tracks(
    scene: "SyntheticScene", make_images: "MakeImages", tmp_path: "Path"
) -> None:
    images, workspace = make_images(scene, tmp_path)
    strict = SfmConfig(matching=MatchingConfig(max_angle_rad=0.055))  # about half of the matches
    off = replace(strict, completion=CompletionConfig(merge=False, guided=False))
    [short], [long] = (reconstruct(images, config, workspace).reconstructions for config in (off, strict))
    assert len(long.observation_px) > 1.05 * len(short.observation_px)
    assert len(long.points) <= len(short.points)
    assert np.median(long.reprojection_errors_px()) < 0.36
