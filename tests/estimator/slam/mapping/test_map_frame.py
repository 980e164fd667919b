"""The choice of the map frame after bundle adjustment."""

import numpy as np
import pytest

from dronevio.estimator.slam.map_frame import aligned_with
from dronevio.models.rotation import exp_so3, pose_matrix, rotation_z

RNG = np.random.default_rng(4)
POSES = {n: pose_matrix(exp_so3(RNG.normal(size=3)), RNG.uniform(-5.0, 5.0, 3)) for n in range(0, 40, 2)}
"""Poses of keyframes, of which every other one was culled."""
MOVED = pose_matrix(rotation_z(np.array(0.3)), np.array([2.0, -1.0, 0.5]))


def test_a_map_that_is_moved_as_a_whole_is_moved_back() -> None:
    aligned = aligned_with({number: MOVED @ T for number, T in POSES.items()}, POSES)
    for number, T in POSES.items():
        np.testing.assert_allclose(aligned[number], T, atol=1e-12)


@pytest.mark.parametrize("seed", range(3))
def test_no_other_frame_is_nearer(seed: int) -> None:
    rng = np.random.default_rng(seed)
    changed = {n: T @ pose_matrix(exp_so3(0.1 * rng.normal(size=3)), rng.normal(size=3)) for n, T in POSES.items()}

    def squares(T: np.ndarray) -> float:
        points = np.column_stack([np.zeros(3), np.eye(3)])
        ends = [(T @ aligned[n] - POSES[n])[:3] @ np.vstack([points, np.ones(4)]) for n in POSES]
        return float(np.sum(np.square(ends)))

    aligned = aligned_with(changed, POSES)
    least = squares(np.eye(4))
    for yaw, t in (
        (1e-3, np.zeros(3)),
        (-1e-3, np.zeros(3)),
        *((0.0, s * e) for s in (-1e-3, 1e-3) for e in np.eye(3)),
    ):
        assert squares(pose_matrix(rotation_z(np.array(yaw)), t)) > least


def test_inclinations_stay() -> None:
    tilted = {number: exp_so3(np.array([0.2, -0.1, 0.0])) for number in POSES}
    changed = {number: pose_matrix(tilted[number], np.zeros(3)) @ T for number, T in POSES.items()}
    for number, T in aligned_with(changed, POSES).items():
        np.testing.assert_allclose(T[2, :3], changed[number][2, :3], atol=1e-12)


def test_yaw_is_that_of_the_axes_without_motion() -> None:
    still = {number: pose_matrix(T[:3, :3], np.zeros(3)) for number, T in POSES.items()}
    aligned = aligned_with({number: MOVED @ T for number, T in still.items()}, still)
    for number, T in still.items():
        np.testing.assert_allclose(aligned[number], T, atol=1e-12)


def test_only_common_keyframes_count() -> None:
    reference = {number: POSES[number] for number in (4, 10, 16)} | {99: np.eye(4)}
    aligned = aligned_with({number: MOVED @ T for number, T in POSES.items()}, reference)
    np.testing.assert_allclose(aligned[30], POSES[30], atol=1e-12)
    unknown = aligned_with(POSES, {99: np.eye(4)})
    assert unknown.keys() == POSES.keys() and all(unknown[number] is POSES[number] for number in POSES)
