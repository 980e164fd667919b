"""Two-point RANSAC on matches of which the truth is known."""

import numpy as np
import pytest

from dronevio.estimator.frontend.ransac import MIN_MATCHES, epipolar_inliers
from dronevio.models.rotation import exp_so3

PIXEL = 1.0 / 458.0
THRESHOLD = 0.35 * PIXEL
TURN = np.array([0.02, -0.05, 0.03])
STEP_M = np.array([0.08, 0.03, 0.05])


def matches(
    seed: int, n: int = 120, outliers: int = 0, noise_px: float = 0.0, step_m: np.ndarray = STEP_M
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return coordinates in two frames (N, 2), the rotation between them, and which matches are right (N,)."""
    rng = np.random.default_rng(seed)
    xy0 = rng.uniform([-0.8, -0.5], [0.8, 0.5], (n, 2))
    depth = rng.uniform(2.0, 8.0, (n, 1))
    R_1_0 = exp_so3(TURN)
    p1 = np.column_stack([xy0, np.ones(n)]) * depth @ R_1_0.T + R_1_0 @ -step_m
    xy1 = p1[:, :2] / p1[:, 2:]
    right = np.ones(n, dtype=np.bool_)
    right[rng.permutation(n)[:outliers]] = False
    xy1[~right] += rng.uniform(-30.0, 30.0, (outliers, 2)) * PIXEL
    noise = rng.normal(size=(2, n, 2)) * noise_px * PIXEL
    return xy0 + noise[0], xy1 + noise[1], R_1_0, right


def found(xy0: np.ndarray, xy1: np.ndarray, R_1_0: np.ndarray, seed: int = 0) -> np.ndarray:
    return epipolar_inliers(xy0, xy1, R_1_0, THRESHOLD, np.random.default_rng(seed))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("along", [np.eye(3)[0], np.eye(3)[1], np.eye(3)[2], STEP_M / np.linalg.norm(STEP_M)])
def test_exact_matches_are_all_kept(seed: int, along: np.ndarray) -> None:
    xy0, xy1, R_1_0, _ = matches(seed, step_m=0.1 * along)
    assert found(xy0, xy1, R_1_0).all()


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("share", [0.1, 0.3, 0.5])
def test_planted_outliers_are_found(seed: int, share: float) -> None:
    n = 120
    xy0, xy1, R_1_0, right = matches(seed, n, int(share * n), noise_px=0.08)
    kept = found(xy0, xy1, R_1_0, seed)
    assert kept[right].mean() > 0.95
    # An outlier may lie on its epipolar line by chance: 0.7 px of 60, and somewhat more as the line is oblique.
    assert kept[~right].mean() < 0.15
    assert right[kept].mean() > 0.95 - 0.1 * (share == 0.5)


@pytest.mark.parametrize("seed", range(8))
def test_matches_that_come_twice_do_not_make_everything_agree(seed: int) -> None:
    xy0, xy1, R_1_0, right = (np.concatenate([part, part]) if len(part) > 3 else part for part in matches(seed, 60, 20))
    kept = found(xy0, xy1, R_1_0, seed)
    assert kept[right].mean() > 0.95 and kept[~right].mean() < 0.15


def test_rotation_alone_keeps_all() -> None:
    xy0, xy1, R_1_0, _ = matches(1, step_m=np.zeros(3), noise_px=0.1)
    assert found(xy0, xy1, R_1_0).all()


def test_rotation_alone_does_not_keep_what_jumps() -> None:
    xy0, xy1, R_1_0, _ = matches(1, step_m=np.zeros(3))
    xy1[:5] += 10.0 * PIXEL
    np.testing.assert_array_equal(found(xy0, xy1, R_1_0), np.arange(len(xy0)) >= 5)


@pytest.mark.parametrize("n", range(MIN_MATCHES))
def test_too_few_matches_are_all_kept(n: int) -> None:
    xy0, xy1, R_1_0, _ = matches(0, n=n, outliers=n)
    assert found(xy0, xy1, R_1_0).shape == (n,) and found(xy0, xy1, R_1_0).all()


def test_wrong_rotation_finds_no_consensus() -> None:
    xy0, xy1, R_1_0, _ = matches(2)
    wrong = exp_so3(np.array([0.0, 0.0, 0.2])) @ R_1_0
    assert found(xy0, xy1, R_1_0).all()
    assert found(xy0, xy1, wrong).mean() < 0.2


def test_small_error_of_the_rotation_is_forgiven() -> None:
    """A gyroscope's bias of 0.3 °/s turns 0.015° between frames: 0.12 px."""
    xy0, xy1, R_1_0, _ = matches(3)
    nearly = exp_so3(np.radians([0.009, -0.009, 0.009])) @ R_1_0
    assert found(xy0, xy1, nearly).mean() > 0.95


def test_same_draws_same_answer() -> None:
    xy0, xy1, R_1_0, _ = matches(4, outliers=60, noise_px=0.2)
    np.testing.assert_array_equal(found(xy0, xy1, R_1_0, 9), found(xy0, xy1, R_1_0, 9))


def test_matches_may_be_numbered_otherwise() -> None:
    xy0, xy1, R_1_0, _ = matches(5, outliers=30)
    order = np.random.default_rng(0).permutation(len(xy0))
    np.testing.assert_array_equal(found(xy0[order], xy1[order], R_1_0), found(xy0, xy1, R_1_0)[order])
