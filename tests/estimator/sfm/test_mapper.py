"""Triangulation, resection, bundle adjustment and incremental mapping of synthetic scenes."""

from dataclasses import replace
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import pytest

from dronevio.estimator.sfm.bearings import midpoints
from dronevio.estimator.sfm.config import (
    MapperConfig,
    MatchingConfig,
    ResectionConfig,
    TriangulationConfig,
    VerificationConfig,
)
from dronevio.estimator.sfm.intrinsics import IntrinsicsPrior
from dronevio.estimator.sfm.mapper import MAX_DISCARDS, _Mapper, finish, map_scene
from dronevio.estimator.sfm.matching import match_features
from dronevio.estimator.sfm.model import Scene, SfmState, initial_state
from dronevio.estimator.sfm.resection import resect
from dronevio.estimator.sfm.structure import remove_outliers, triangulate
from dronevio.estimator.sfm.tracks import Tracks, connect_tracks
from dronevio.estimator.sfm.triangulation import triangulate_tracks
from dronevio.estimator.sfm.two_view import TwoView, verify, view_of
from dronevio.estimator.sfm.visibility import Visibility
from dronevio.eval.metrics.alignment import umeyama
from dronevio.models.arrays import Array
from dronevio.models.camera import CameraModel
from dronevio.models.progress import silent
from dronevio.models.rotation import exp_so3, log_so3

if TYPE_CHECKING:
    from tests.estimator.sfm.conftest import MakeScene, SyntheticScene


def measured(scene: "SyntheticScene", camera: CameraModel, is_calibrated: bool) -> tuple[Scene, list[TwoView]]:
    """Return the tracks and the verified pairs of a scene, with a camera model that may be a guess."""
    views = [view_of(f.pixels, camera, is_calibrated) for f in scene.features]
    pairs = []
    for i, j in combinations(range(len(views)), 2):
        matches = match_features(scene.features[i], scene.features[j], MatchingConfig())
        pair = verify(i, j, (views[i], views[j]), matches, VerificationConfig())
        pairs += [pair] if pair is not None else []
    tracks = connect_tracks(pairs, np.array([len(f) for f in scene.features]))
    pixels = np.stack([scene.features[i].pixels[f] for i, f in zip(tracks.image, tracks.feature, strict=True)])
    return Scene(tracks, pixels, np.ones(len(pixels)), np.zeros(len(views), np.int64), np.array([is_calibrated])), pairs


def position_errors(scene: "SyntheticScene", state: SfmState) -> Array:
    """Return the distances of the registered cameras from the true positions after a similarity transformation."""
    true, estimated = scene.Ts_world_cam[state.is_registered, :3, 3], state.Ts_world_cam[state.is_registered, :3, 3]
    found = umeyama(true, estimated, with_scale=True)
    return np.asarray(np.linalg.norm(true - (found.scale * estimated @ found.R_truth_estimate.T + found.t_m), axis=1))


def test_a_calibrated_scene_is_reconstructed(scene: "SyntheticScene") -> None:
    problem, pairs = measured(scene, scene.camera, is_calibrated=True)
    [state] = map_scene(problem, (scene.camera,), pairs, MapperConfig())
    assert state.is_registered.all()
    assert state.has_point.mean() > 0.95
    assert position_errors(scene, state).max() < 0.005
    errors = state.errors_px(problem, np.flatnonzero(state.used(problem)))
    # The distances of two coordinates with a standard deviation of .3 px have a median of .3 * 1.18 px.
    assert 0.28 < np.median(errors) < 0.36
    assert state.cameras == (scene.camera,)


def test_a_wrong_angle_between_two_parts_is_corrected() -> None:
    """Few points connect two halves of a path, of which one is rotated by 1° together with its points."""
    rng, images = np.random.default_rng(0), np.arange(24)
    camera = CameraModel(640, 480, 500.0, 500.0, 320.0, 240.0)
    Ts_world_cam = np.tile(np.eye(4), (24, 1, 1))
    true = np.column_stack([0.5 * images, 0.3 * np.sin(images), 0.3 * np.cos(0.7 * images)])
    Ts_world_cam[:, :3, 3] = true
    points = rng.uniform([-2.0, -1.5, 3.0], [14.0, 1.5, 6.0], (1500, 3))
    pixels = camera.project(points - true[:, None])
    is_right, is_common = points[:, 0] >= 6.0, np.arange(1500) % 40 == 0
    seen = np.all((pixels > 0.0) & (pixels < [639.0, 479.0]), axis=2)
    seen &= (is_right == (images >= 12)[:, None]) | is_common
    seen &= seen.sum(axis=0) >= 2
    track, image = np.nonzero(seen.T)
    observed = pixels[image, track] + rng.normal(scale=0.1, size=(len(track), 2))
    used, track = np.unique(track, return_inverse=True)
    tracks = Tracks(image, np.arange(len(image)), track)
    problem = Scene(tracks, observed, np.ones(len(image)), np.zeros(24, np.int64), np.array([True]))
    R, joint = exp_so3(np.array([0.0, np.radians(1.0), 0.0])), np.array([5.75, 0.0, 0.0])
    Ts_world_cam[12:, :3, :3] = R
    Ts_world_cam[12:, :3, 3] = (true[12:] - joint) @ R.T + joint
    rotated = np.where(is_right[:, None], (points - joint) @ R.T + joint, points)[used]
    state = finish(problem, SfmState((camera,), Ts_world_cam, rotated, np.ones(len(image), np.bool_)), MapperConfig())
    found = umeyama(true, state.Ts_world_cam[:, :3, 3], with_scale=True)
    aligned = found.scale * state.Ts_world_cam[:, :3, 3] @ found.R_truth_estimate.T + found.t_m
    assert np.sqrt(np.mean(np.sum((true - aligned) ** 2, axis=1))) < 0.003  # 15 mm at the start


def test_the_noise_is_that_of_small_features() -> None:
    """Half of the observations err by 1 px and half, three times as uncertain, by 3 px: 1 px by 1.1774."""
    image = np.repeat(np.arange(2), 4)
    sigmas = np.tile([1.0, 3.0], 4)
    points = np.column_stack([np.linspace(-0.2, 0.2, 4), np.zeros(4), np.full(4, 2.0)])
    order = np.lexsort([image, np.tile(np.arange(4), 2)])
    track, image = np.tile(np.arange(4), 2)[order], image[order]
    sigmas = sigmas[order]
    camera = CameraModel(640, 480, 500.0, 500.0, 320.0, 240.0)
    pixels = camera.project(points[track]) + sigmas[:, None] * [0.6, 0.8]
    problem = Scene(Tracks(image, np.arange(8), track), pixels, sigmas, np.zeros(2, np.int64), np.array([True]))
    state = SfmState((camera,), np.tile(np.eye(4), (2, 1, 1)), points, np.ones(8, np.bool_))
    assert state.noise_px(problem) == pytest.approx(1.0 / 1.1774)


def test_an_unknown_focal_length_is_estimated(scene: "SyntheticScene") -> None:
    guess = CameraModel(640, 480, 700.0, 700.0, 320.0, 240.0)
    problem, pairs = measured(scene, guess, is_calibrated=False)
    [state] = map_scene(problem, (guess,), pairs, MapperConfig())
    assert state.is_registered.all()
    assert state.cameras[0].fx == pytest.approx(500.0, rel=0.02)
    assert state.cameras[0].distortion[0] == pytest.approx(-0.1, abs=0.03)


def test_an_adjustment_to_an_absurd_camera_is_repeated_with_the_guess(
    scene: "SyntheticScene", monkeypatch: pytest.MonkeyPatch
) -> None:
    guess = replace(scene.camera, fx=520.0, fy=520.0, distortion=(0.0, 0.0, 0.0, 0.0))
    problem, _ = measured(scene, guess, is_calibrated=False)
    problem = replace(problem, priors=(IntrinsicsPrior(guess),))
    state = triangulate(problem, initial_state(problem, (guess,), scene.Ts_world_cam), TriangulationConfig())
    cameras, estimated = [], []

    def absurd(own: Scene, before: SfmState, *others: object) -> SfmState:
        cameras.append(before.cameras[0])
        estimated.append(own.priors[0].estimated)
        (camera,) = before.cameras
        k1 = 2.2 if own.priors[0].estimated else 0.0
        return replace(before, cameras=(replace(camera, distortion=(k1, 0.0, 0.0, 0.0)),))

    monkeypatch.setattr("dronevio.estimator.sfm.mapper.adjust", absurd)
    drifted = replace(state, cameras=(replace(guess, fx=700.0, fy=700.0),))
    adjusted = _Mapper(problem, MapperConfig(), silent).adjust_growing(drifted)
    assert estimated == [2, 0]
    assert cameras == [drifted.cameras[0], guess]
    assert adjusted.cameras == (guess,)


def test_fisheye_images_are_reconstructed(make_scene: "MakeScene") -> None:
    fisheye = CameraModel(640, 640, 200.0, 200.0, 320.0, 320.0, (0.02, -0.003, 0.0, 0.0), "equidistant")
    scene = make_scene(camera=fisheye)
    problem, pairs = measured(scene, fisheye, is_calibrated=True)
    [state] = map_scene(problem, (fisheye,), pairs, MapperConfig())
    assert state.is_registered.all()
    assert position_errors(scene, state).max() < 0.02


def test_two_scenes_are_two_components(make_scene: "MakeScene") -> None:
    first, second = make_scene(images=6, seed=1), make_scene(images=4, seed=2)
    both = replace(
        first,
        Ts_world_cam=np.concatenate([first.Ts_world_cam, second.Ts_world_cam]),
        features=first.features + second.features,
        point_of=first.point_of + second.point_of,
    )
    problem, pairs = measured(both, first.camera, is_calibrated=True)
    states = map_scene(problem, (first.camera,), pairs, MapperConfig())
    assert [np.flatnonzero(state.is_registered).tolist() for state in states] == [[0, 1, 2, 3, 4, 5], [6, 7, 8, 9]]


@pytest.mark.parametrize("degenerate", [{"flat": True}, {"rotation_only": True}], ids=["plane", "rotation"])
def test_degenerate_pairs_are_not_seeds(degenerate: dict[str, bool], make_scene: "MakeScene") -> None:
    scene = make_scene(images=4, **degenerate)
    problem, pairs = measured(scene, scene.camera, is_calibrated=True)
    assert pairs
    assert map_scene(problem, (scene.camera,), pairs, MapperConfig()) == []


def test_the_same_input_gives_the_same_bytes(scene: "SyntheticScene") -> None:
    problem, pairs = measured(scene, scene.camera, is_calibrated=True)
    a, b = (map_scene(problem, (scene.camera,), pairs, MapperConfig())[0] for _ in range(2))
    np.testing.assert_array_equal(a.Ts_world_cam, b.Ts_world_cam)
    np.testing.assert_array_equal(a.points, b.points)


def test_triangulation_removes_an_outlier() -> None:
    origins = np.array([[0.0, 0, 0], [1.0, 0, 0], [2.0, 0, 0], [3.0, 0, 0]])
    point = np.array([1.0, 0.5, 6.0])
    rays = point - origins
    rays[2] += [1.0, 2.0, 0.0]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    found = triangulate_tracks(
        np.zeros(4, np.int64), origins, rays, np.full(4, 500.0), TriangulationConfig(), np.random.default_rng(0)
    )
    assert found.is_inlier.tolist() == [True, True, False, True]
    np.testing.assert_allclose(found.points, [point], atol=1e-9)


def test_small_angles_are_not_triangulated() -> None:
    point = np.array([0.0, 0.0, 100.0])
    origins = np.array([[0.0, 0, 0], [2.0, 0, 0]])  # an angle of 1.15 degrees
    rays = (point - origins) / np.linalg.norm(point - origins, axis=1, keepdims=True)
    arguments = np.zeros(2, np.int64), origins, rays, np.full(2, 500.0)
    rng = np.random.default_rng(0)
    assert np.isnan(triangulate_tracks(*arguments, TriangulationConfig(min_angle_deg=1.5), rng).points).all()
    assert np.isfinite(triangulate_tracks(*arguments, TriangulationConfig(min_angle_deg=1.0), rng).points).all()


def test_resection_with_outliers(scene: "SyntheticScene") -> None:
    rng = np.random.default_rng(3)
    pixels, points = scene.features[2].pixels, scene.points[scene.point_of[2]].copy()
    wrong = rng.random(len(points)) < 0.3
    points[wrong] = rng.permutation(points[wrong])
    found = resect(points, scene.camera.unproject(pixels), 500.0, ResectionConfig())
    assert found is not None
    T, is_inlier = found
    assert np.linalg.norm(T[:3, 3] - scene.Ts_world_cam[2, :3, 3]) < 0.005
    assert np.linalg.norm(log_so3(T[:3, :3].T @ scene.Ts_world_cam[2, :3, :3])) < 0.001
    assert is_inlier[~wrong].all()


def test_resection_without_consensus_fails(scene: "SyntheticScene") -> None:
    rng = np.random.default_rng(4)
    bearings = scene.camera.unproject(scene.features[2].pixels)
    assert resect(rng.normal(size=(len(bearings), 3)) + [0, 0, 5], bearings, 500.0, ResectionConfig()) is None


def test_a_new_world_frame_gives_the_same_pose(scene: "SyntheticScene") -> None:
    R, t = exp_so3(np.array([0.4, -1.0, 0.3])), np.array([3.0, -2.0, 1.0])
    bearings, points = scene.camera.unproject(scene.features[1].pixels), scene.points[scene.point_of[1]]
    a, b = (resect(p, bearings, 500.0, ResectionConfig()) for p in (points, points @ R.T + t))
    assert a is not None
    assert b is not None
    np.testing.assert_allclose(b[0][:3, :3], R @ a[0][:3, :3], atol=1e-5)
    np.testing.assert_allclose(b[0][:3, 3], R @ a[0][:3, 3] + t, atol=1e-4)


def test_an_image_with_a_wrong_pose_is_registered_anew(scene: "SyntheticScene") -> None:
    problem, pairs = measured(scene, scene.camera, is_calibrated=True)
    [state] = map_scene(problem, (scene.camera,), pairs, MapperConfig())
    # A third of the observations of image 3 agree with a wrong pose, as on a repetitive texture.
    of_image = np.flatnonzero(problem.tracks.image == 3)
    Ts_world_cam, is_inlier = state.Ts_world_cam.copy(), state.is_inlier.copy()
    Ts_world_cam[3, :3, 3] += 0.5
    is_inlier[of_image[len(of_image) // 3 :]] = False
    wrong = replace(state, Ts_world_cam=Ts_world_cam, is_inlier=is_inlier)
    mapper, discards = _Mapper(problem, MapperConfig(), silent), np.zeros(problem.images, np.int64)
    cleaned = mapper._discard(wrong, discards)
    assert np.flatnonzero(~cleaned.is_registered).tolist() == [3]
    assert discards.tolist() == [0, 0, 0, 1, 0, 0, 0, 0]
    again = mapper._grow(cleaned, np.ones(problem.images, np.bool_))
    assert again.is_registered.all()
    assert position_errors(scene, again).max() < 0.005


def test_an_image_that_was_left_out_has_a_last_trial(scene: "SyntheticScene", monkeypatch: pytest.MonkeyPatch) -> None:
    problem, pairs = measured(scene, scene.camera, is_calibrated=True)
    trials: list[int] = []

    def discard(mapper: _Mapper, state: SfmState, discards: npt.NDArray[np.int64]) -> SfmState:
        if not state.is_registered[3] or trials:
            return state
        trials.append(int(state.is_registered.sum()))
        discards[3] = MAX_DISCARDS
        Ts_world_cam = state.Ts_world_cam.copy()
        Ts_world_cam[3] = np.nan
        return mapper.clean(replace(state, Ts_world_cam=Ts_world_cam))

    monkeypatch.setattr(_Mapper, "_discard", discard)
    [state] = map_scene(problem, (scene.camera,), pairs, MapperConfig())
    assert len(trials) == 1
    assert state.is_registered.all()


def test_midpoints_by_hand() -> None:
    # Rays from (0, 0, 0) and (2, 0, 0) meet at (1, 0, 1); the reversed second ray leads away from it.
    diagonal = np.sqrt(0.5)
    first, second = np.array([[diagonal, 0.0, diagonal]]), np.array([[-diagonal, 0.0, diagonal]])
    origins = np.zeros((1, 3)), np.array([[2.0, 0.0, 0.0]])
    np.testing.assert_allclose(midpoints(origins[0], first, origins[1], second), [[1.0, 0.0, 1.0]], atol=1e-12)
    # A ray that passes one unit beside the first in y: the midpoint lies half a unit beside.
    beside = origins[1] + [0.0, 1.0, 0.0]
    np.testing.assert_allclose(midpoints(origins[0], first, beside, second), [[1.0, 0.5, 1.0]], atol=1e-12)
    assert np.isnan(midpoints(origins[0], first, origins[1], -second)).all()
    assert np.isnan(midpoints(origins[0], first, origins[1], first)).all()


def test_what_one_image_adds_is_what_all_tracks_would_give(scene: "SyntheticScene") -> None:
    problem, _ = measured(scene, scene.camera, is_calibrated=True)
    config, last = TriangulationConfig(), len(scene.features) - 1
    # Two registered images see the even tracks, of which the third sees some, and one of them sees the odd ones.
    kept = (problem.tracks.image != 1) | (problem.tracks.track % 2 == 0)
    kept &= (problem.tracks.image != last) | (problem.tracks.track % 3 > 0)
    tracks = Tracks(problem.tracks.image[kept], problem.tracks.feature[kept], problem.tracks.track[kept])
    problem = replace(problem, tracks=tracks, pixels=problem.pixels[kept], sigmas=problem.sigmas[kept])
    Ts_before = np.full_like(scene.Ts_world_cam, np.nan)
    Ts_before[:2] = scene.Ts_world_cam[:2]
    before = triangulate(problem, initial_state(problem, (scene.camera,), Ts_before), config)
    before = remove_outliers(problem, before, config)
    Ts_after = Ts_before.copy()
    Ts_after[last] = scene.Ts_world_cam[last]
    registered = replace(before, Ts_world_cam=Ts_after)
    observed = problem.tracks.track[problem.tracks.of_image(last)]
    alone = remove_outliers(problem, triangulate(problem, registered, config, tracks=observed), config, observed)
    whole = remove_outliers(problem, triangulate(problem, registered, config), config)
    assert alone.has_point.sum() > before.has_point.sum()
    np.testing.assert_array_equal(alone.is_inlier, whole.is_inlier)
    np.testing.assert_allclose(alone.points, whole.points, atol=1e-3)  # of other hypotheses of RANSAC
    seeing = np.unique(problem.tracks.image[problem.tracks.of_tracks(observed)])
    updated = Visibility.of(problem, before).updated(problem, alone, seeing)
    anew = Visibility.of(problem, alone)
    np.testing.assert_array_equal(updated.points, anew.points)
    np.testing.assert_array_equal(updated.score, anew.score)


def test_long_tracks_are_thinned_where_images_have_enough() -> None:
    """Of 400 images, all but the last see 1000 points; the last sees 30 of them."""
    images, points = 400, 1000
    image = np.concatenate([np.tile(np.arange(images - 1), points), np.full(30, images - 1)])
    track = np.concatenate([np.repeat(np.arange(points), images - 1), np.arange(30)])
    order = np.lexsort([image, track])
    tracks = Tracks(image[order], track[order], track[order])
    count = len(order)
    scene = Scene(tracks, np.zeros((count, 2)), np.ones(count), np.zeros(images, np.int64), np.array([True]))
    chosen = _Mapper(scene, MapperConfig(), silent)._subset(np.ones(count, np.bool_))
    per_image = np.bincount(tracks.image[chosen], minlength=images)
    assert per_image[:-1].min() >= 80 and per_image[:-1].max() <= 400  # 1000 observations, thinned by ten
    assert per_image[-1] == 30
    per_track = np.bincount(tracks.track[chosen], minlength=points)
    assert per_track.max() <= 41  # and the one of the last image
    first = np.sort(tracks.image[chosen & (tracks.track == 500)])
    assert set(np.diff(first)) == {10}
