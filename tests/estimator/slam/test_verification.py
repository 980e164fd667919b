"""Geometric verification: exact without noise, consistent with noise, and strict about other places."""

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from dronevio.estimator.slam.places.gravity_pose import LevelMatches, solve_two_points, squared_errors
from dronevio.estimator.slam.places.matching import described_landmarks, match_landmarks
from dronevio.estimator.slam.places.relative_pose import RelativePoseConfig
from dronevio.estimator.slam.places.verification import PlaceMatch, Rejection, VerificationConfig, verify
from dronevio.models.rig import Rig, RigCamera
from dronevio.models.rotation import exp_so3, inverse_pose, log_so3, rotation_z
from tests.estimator.slam.conftest import EXACT, RIG, Errors, Scene, keyframe, pose, random_pose, scene

Array = npt.NDArray[Any]

CONFIG = VerificationConfig()


def verified(
    first: Errors, second: Errors, seed: int, config: VerificationConfig = CONFIG
) -> tuple[PlaceMatch | Rejection, Array]:
    """Return the result of a random case, and the true relative pose."""
    rng = np.random.default_rng(seed)
    places, T_match, T_query = scene(rng), random_pose(rng), random_pose(rng)
    match, query = keyframe(0, T_match, places, first, rng), keyframe(1, T_query, places, second, rng)
    return verify(query, match, RIG, config), inverse_pose(T_match) @ T_query


def error(result: PlaceMatch, T_true: Array) -> Array:
    """Return the error (6,) of a relative pose in the order of its covariance."""
    T = result.T_match_query
    return np.concatenate([log_so3(T_true[:3, :3].T @ T[:3, :3]), T[:3, 3] - T_true[:3, 3]])


def test_two_matches_determine_the_pose_exactly() -> None:
    rng = np.random.default_rng(0)
    n = 200
    yaw, t = rng.uniform(-3.0, 3.0, n), rng.uniform(-1.0, 1.0, (n, 3))
    R = rotation_z(yaw)
    pairs = []
    for _ in range(2):
        seen = rng.uniform(-1.0, 1.0, (n, 3)) * [1.0, 2.0, 2.0] + [5.0, 0.0, 0.0]
        origins = rng.uniform(-0.1, 0.1, (n, 3))
        bearings = (seen - origins) / np.linalg.norm(seen - origins, axis=1, keepdims=True)
        pairs.append(LevelMatches(np.einsum("nij,nj->ni", R, seen) + t, bearings, origins))
    for k in range(n):
        first, second = (LevelMatches(m.points[k : k + 1], m.bearings[k : k + 1], m.origins[k : k + 1]) for m in pairs)
        found = solve_two_points(first, second)
        assert 1 <= len(found) <= 2
        assert np.min(np.abs(found.t - t[k]).max(axis=1) + np.abs(np.sin(0.5 * (found.yaw_rad - yaw[k])))) < 1e-9
        assert squared_errors(found, first).max() < 1e-12
        assert squared_errors(found, second).max() < 1e-12


def test_the_pose_is_exact_without_noise() -> None:
    for seed in range(20):
        result, T_true = verified(EXACT, EXACT, seed)
        assert isinstance(result, PlaceMatch), result
        assert np.abs(error(result, T_true)).max() < 1e-6
        assert min(result.old_landmarks, result.new_landmarks) > 30
        seen = result.observations
        assert np.sum(seen.keyframe == result.query) == result.old_landmarks
        assert np.sum(seen.keyframe == result.match) == result.new_landmarks
        assert np.all(seen.landmark >= 0) and np.all(seen.sigma_scale == CONFIG.pose.pixel_sigma)


@pytest.mark.slow
def test_the_covariance_is_consistent() -> None:
    assumed = RelativePoseConfig()
    noise = Errors(assumed.pixel_sigma, assumed.depth_sigma, assumed.scale_sigma, np.radians(assumed.tilt_sigma_deg))
    every_case = replace(CONFIG, max_tilt_sigmas=100.0, max_position_m=1.0, max_rotation_deg=20.0)
    nees, components = [], []
    for seed in range(200):
        result, T_true = verified(noise, noise, seed, every_case)
        assert isinstance(result, PlaceMatch), result
        e = error(result, T_true)
        nees.append(e @ np.linalg.solve(result.covariance, e))
        components.append(e / np.sqrt(np.diag(result.covariance)))
    # Conservative: at most the six of the assumed errors, but not half of it.
    assert 3.0 < np.mean(nees) < 6.6
    assert np.all(np.sqrt(np.mean(np.square(components), axis=0)) < 1.15)
    assert np.mean(np.array(nees) > 16.8) < 0.03  # 99 % quantile of χ² with six degrees of freedom


def test_an_error_of_scale_is_part_of_the_covariance() -> None:
    noise, seen = Errors(scale=0.05), []
    exact = replace(CONFIG.pose, pixel_sigma=0.1, depth_sigma=0.0, scale_sigma=0.05)
    config = replace(
        CONFIG, pose=exact, max_error_px=20.0, max_error_sigmas=1e2, max_position_m=5.0, max_rotation_deg=45.0
    )
    for seed in range(60):
        result, T_true = verified(noise, noise, seed, config)
        assert isinstance(result, PlaceMatch), result
        e = error(result, T_true)[3:]
        seen.append(e @ np.linalg.solve(result.covariance[3:, 3:], e) / 3.0)
    assert np.mean(seen) < 1.5
    without = replace(config, pose=replace(config.pose, scale_sigma=0.0))
    result, T_true = verified(noise, noise, 0, without)
    assert isinstance(result, PlaceMatch), result
    e = error(result, T_true)[3:]
    assert e @ np.linalg.solve(result.covariance[3:, 3:], e) / 3.0 > 4.0


def test_seventy_percent_of_wrong_matches_survive() -> None:
    noise = Errors(pixel=0.5, depth=0.02, bits=10)
    for seed in range(20):
        result, T_true = verified(replace(noise, wrong=0.45), replace(noise, wrong=0.45), seed)  # 0.55² are right
        assert isinstance(result, PlaceMatch), (seed, result)
        e = error(result, T_true)
        assert np.linalg.norm(e[3:]) < 0.05
        assert np.degrees(np.linalg.norm(e[:3])) < 1.0


def test_different_places_never_match() -> None:
    noise = Errors(pixel=0.5, depth=0.02)
    for seed in range(100):
        rng = np.random.default_rng(seed)
        first, second = scene(rng), scene(rng)
        # Random descriptors give no matches at all; the same descriptors at other positions give as many as possible.
        second = second if seed % 2 else Scene(second.points, first.descriptors)
        query, match = (
            keyframe(1, random_pose(rng), second, noise, rng),
            keyframe(0, random_pose(rng), first, noise, rng),
        )
        assert isinstance(verify(query, match, RIG, CONFIG), Rejection)


def test_two_poses_that_fit_equally_are_rejected() -> None:
    rng = np.random.default_rng(3)
    wall = scene(rng, 200)
    shifted = wall.points + np.where(np.arange(200)[:, None] % 2 == 0, [0.0, 1.2, 0.0], 0.0)
    match = keyframe(0, pose([0.0, 0.0, 0.0]), wall)
    result = verify(keyframe(1, pose([0.1, 0.1, 0.0]), Scene(shifted, wall.descriptors)), match, RIG, CONFIG)
    assert result == Rejection("competitor")
    tolerant = replace(CONFIG, max_competitor_ratio=1.0)
    result = verify(keyframe(1, pose([0.1, 0.1, 0.0]), Scene(shifted, wall.descriptors)), match, RIG, tolerant)
    assert isinstance(result, PlaceMatch)


def test_a_tilted_place_contradicts_gravity() -> None:
    rng = np.random.default_rng(4)
    places, tilt = scene(rng), exp_so3(np.array([0.0, np.radians(8.0), 0.0]))
    tilted = Scene((places.points - [5.0, 0.0, 0.0]) @ tilt.T + [5.0, 0.0, 0.0], places.descriptors)
    match, query = keyframe(0, pose([0.0, 0.0, 0.0]), places), keyframe(1, pose([0.1, 0.2, 0.1]), tilted)
    permissive = replace(CONFIG, max_error_px=40.0, max_error_sigmas=30.0)
    assert verify(query, match, RIG, permissive) == Rejection("gravity")


@pytest.mark.parametrize("direction", ["old", "new"])
def test_landmarks_of_both_keyframes_are_required(direction: str) -> None:
    rng = np.random.default_rng(5)
    places = scene(rng)
    match, query = keyframe(0, random_pose(rng), places), keyframe(1, random_pose(rng), places)
    few = query if direction == "new" else match
    few = replace(few, landmark_ids=few.landmark_ids[:7], landmarks_imu=few.landmarks_imu[:7])
    pair = (few, match) if direction == "new" else (query, few)
    assert verify(*pair, RIG, CONFIG) == Rejection("matches")


def test_corners_in_one_spot_are_not_enough() -> None:
    rng = np.random.default_rng(6)
    near = Scene([5.0, 0.0, 0.0] + rng.uniform(-0.3, 0.3, (60, 3)), rng.integers(0, 256, (60, 32), dtype=np.uint8))
    match, query = keyframe(0, pose([0.0, 0.0, 0.0]), near), keyframe(1, pose([0.1, 0.2, 0.1]), near)
    assert verify(query, match, RIG, CONFIG) == Rejection("spread")


def test_the_result_has_the_same_bytes_twice() -> None:
    noise = Errors(pixel=0.5, depth=0.02, bits=10, wrong=0.3)
    first, second = (verified(noise, noise, 1)[0] for _ in range(2))
    assert isinstance(first, PlaceMatch)
    assert isinstance(second, PlaceMatch)
    assert first.T_match_query.tobytes() == second.T_match_query.tobytes()
    assert first.covariance.tobytes() == second.covariance.tobytes()


def test_matches_are_mutual_and_distinct() -> None:
    rng = np.random.default_rng(7)
    places = scene(rng)
    owner, other = keyframe(0, random_pose(rng), places), keyframe(1, random_pose(rng), places)
    rows, landmark = described_landmarks(owner)
    assert np.array_equal(owner.features.landmark[rows], owner.landmark_ids[landmark])
    common = np.intersect1d(owner.landmark_ids, other.features.landmark)
    matches = match_landmarks(owner, other, CONFIG.matching)
    assert len(matches) == len(common)
    expected = other.features.xy[np.isin(other.features.landmark, common)]
    assert np.array_equal(matches.xy, expected)
    # Two equal corners leave no match of their landmark.
    features = other.features
    double = replace(
        features,
        descriptors=np.where(np.arange(len(features))[:, None] == 1, features.descriptors[:1], features.descriptors),
    )
    fewer = match_landmarks(owner, replace(other, features=double), CONFIG.matching)
    assert not np.any(np.all(fewer.xy == features.xy[0], axis=1))


def test_both_directions_have_to_give_the_same_pose() -> None:
    rng = np.random.default_rng(8)
    places = scene(rng)
    match, query = keyframe(0, pose([0.0, 0.0, 0.0]), places), keyframe(1, pose([0.1, 0.2, 0.1]), places)
    permissive = replace(CONFIG, max_error_px=40.0, max_error_sigmas=30.0, max_tilt_sigmas=100.0)
    assert isinstance(verify(query, match, RIG, permissive), PlaceMatch)
    aside = replace(query, landmarks_imu=query.landmarks_imu + [0.0, 0.3, 0.0])
    assert verify(aside, match, RIG, permissive) == Rejection("directions")


def test_uncertain_and_distant_poses_are_rejected() -> None:
    rng = np.random.default_rng(9)
    places = scene(rng)
    match, query = keyframe(0, pose([0.0, 0.0, 0.0]), places), keyframe(1, pose([0.1, 0.2, 0.1]), places)
    uncertain = replace(CONFIG, pose=replace(CONFIG.pose, pixel_sigma=30.0))
    assert verify(query, match, RIG, uncertain) == Rejection("covariance")
    assert verify(query, match, RIG, replace(CONFIG, max_distance_m=0.2)) == Rejection("distance")


def test_landmarks_of_one_camera_are_found_in_another() -> None:
    """Two cameras look forward and backward, and the second visit flies in the opposite direction."""
    forward = RIG.cameras[0]
    T_imu_backward = np.eye(4)
    T_imu_backward[:3, :3] = exp_so3(np.array([np.pi, 0.0, 0.0])) @ forward.T_imu_cam[:3, :3]
    T_imu_backward[:3, 3] = [0.05, 0.02, -0.3]
    rig = Rig(cameras=(forward, RigCamera(forward.model, T_imu_backward)))
    rng = np.random.default_rng(10)
    places = scene(rng)
    T_match, T_query = pose([0.0, 0.0, 0.0]), pose([0.2, 0.1, 0.1], np.pi)
    match, query = keyframe(0, T_match, places, rig=rig), keyframe(1, T_query, places, rig=rig)
    assert set(match.features.camera.tolist()) == {0}
    assert set(query.features.camera.tolist()) == {1}
    result = verify(query, match, rig, CONFIG)
    assert isinstance(result, PlaceMatch), result
    assert np.abs(error(result, inverse_pose(T_match) @ T_query)).max() < 1e-6
