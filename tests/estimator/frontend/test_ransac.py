"""Outlier rejection on synthetic matches with known inliers."""

from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest

from dronevio.estimator.frontend.ransac import MIN_MATCHES, epipolar_inliers, essential_inliers, samples_of_five
from dronevio.models.arrays import Array, Mask
from dronevio.models.rotation import exp_so3

PIXEL = 1.0 / 458.0
THRESHOLD = 0.35 * PIXEL
ROTATION_RAD = np.array([0.02, -0.05, 0.03])
TRANSLATION_M = np.array([0.08, 0.03, 0.05])


class MatchSet(NamedTuple):
    """Matches of two frames: normalized coordinates (N, 2), rotation (3, 3), and which are correct (N,)."""

    xy0: Array
    xy1: Array
    R_1_0: Array
    correct: Mask


def matches(
    seed: int, n: int = 120, outliers: int = 0, noise_px: float = 0.0, translation_m: Array = TRANSLATION_M
) -> MatchSet:
    """Return matches of random points, some of them displaced by up to 30 px."""
    rng = np.random.default_rng(seed)
    xy0 = rng.uniform([-0.8, -0.5], [0.8, 0.5], (n, 2))
    depth = rng.uniform(2.0, 8.0, (n, 1))
    R_1_0 = exp_so3(ROTATION_RAD)
    p1 = np.column_stack([xy0, np.ones(n)]) * depth @ R_1_0.T + R_1_0 @ -translation_m
    xy1 = p1[:, :2] / p1[:, 2:]
    correct = np.ones(n, dtype=np.bool_)
    correct[rng.permutation(n)[:outliers]] = False
    xy1[~correct] += rng.uniform(-30.0, 30.0, (outliers, 2)) * PIXEL
    noise = rng.normal(size=(2, n, 2)) * noise_px * PIXEL
    return MatchSet(xy0 + noise[0], xy1 + noise[1], R_1_0, correct)


def inliers(xy0: Array, xy1: Array, R_1_0: Array, seed: int = 0) -> Mask:
    return epipolar_inliers(xy0, xy1, R_1_0, THRESHOLD, np.random.default_rng(seed))


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    "direction", [np.eye(3)[0], np.eye(3)[1], np.eye(3)[2], TRANSLATION_M / np.linalg.norm(TRANSLATION_M)]
)
def test_exact_matches_are_inliers(seed: int, direction: Array) -> None:
    xy0, xy1, R_1_0, _ = matches(seed, translation_m=0.1 * direction)
    assert inliers(xy0, xy1, R_1_0).all()


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("ratio", [0.1, 0.3, 0.5])
def test_outliers_are_rejected(seed: int, ratio: float) -> None:
    n = 120
    xy0, xy1, R_1_0, correct = matches(seed, n, int(ratio * n), noise_px=0.08)
    kept = inliers(xy0, xy1, R_1_0, seed)
    assert kept[correct].mean() > 0.95
    # An outlier lies on its epipolar line by chance: 0.7 px of 60, and more where the line is oblique.
    assert kept[~correct].mean() < 0.15
    assert correct[kept].mean() > 0.95 - 0.1 * (ratio == 0.5)


@pytest.mark.parametrize("seed", range(8))
def test_duplicate_matches_do_not_admit_outliers(seed: int) -> None:
    """Two copies of one match have parallel normals, which define no translation."""
    xy0, xy1, R_1_0, correct = matches(seed, 60, 20)
    kept = inliers(np.concatenate([xy0, xy0]), np.concatenate([xy1, xy1]), R_1_0, seed)
    correct = np.concatenate([correct, correct])
    assert kept[correct].mean() > 0.95 and kept[~correct].mean() < 0.15


def test_pure_rotation_keeps_all_matches() -> None:
    xy0, xy1, R_1_0, _ = matches(1, translation_m=np.zeros(3), noise_px=0.1)
    assert inliers(xy0, xy1, R_1_0).all()


def test_pure_rotation_rejects_displaced_matches() -> None:
    xy0, xy1, R_1_0, _ = matches(1, translation_m=np.zeros(3))
    xy1[:5] += 10.0 * PIXEL
    np.testing.assert_array_equal(inliers(xy0, xy1, R_1_0), np.arange(len(xy0)) >= 5)


@pytest.mark.parametrize("n", range(MIN_MATCHES))
def test_too_few_matches_are_all_kept(n: int) -> None:
    xy0, xy1, R_1_0, _ = matches(0, n=n, outliers=n)
    kept = inliers(xy0, xy1, R_1_0)
    assert kept.shape == (n,) and kept.all()


def test_wrong_rotation_has_no_consensus() -> None:
    xy0, xy1, R_1_0, _ = matches(2)
    wrong = exp_so3(np.array([0.0, 0.0, 0.2])) @ R_1_0
    assert inliers(xy0, xy1, R_1_0).all()
    assert inliers(xy0, xy1, wrong).mean() < 0.2


def test_small_rotation_error_is_tolerated() -> None:
    """A gyroscope bias of 0.3 °/s rotates by 0.015° between two frames: 0.12 px."""
    xy0, xy1, R_1_0, _ = matches(3)
    perturbed = exp_so3(np.radians([0.009, -0.009, 0.009])) @ R_1_0
    assert inliers(xy0, xy1, perturbed).mean() > 0.95


def test_same_seed_gives_the_same_inliers() -> None:
    xy0, xy1, R_1_0, _ = matches(4, outliers=60, noise_px=0.2)
    np.testing.assert_array_equal(inliers(xy0, xy1, R_1_0, 9), inliers(xy0, xy1, R_1_0, 9))


def test_order_of_matches_does_not_matter() -> None:
    xy0, xy1, R_1_0, _ = matches(5, outliers=30)
    order = np.random.default_rng(0).permutation(len(xy0))
    np.testing.assert_array_equal(inliers(xy0[order], xy1[order], R_1_0), inliers(xy0, xy1, R_1_0)[order])


def test_essential_matrix_rejects_outliers_without_rotation() -> None:
    xy0, xy1, _, correct = matches(6, outliers=36, noise_px=0.08)
    kept = essential_inliers(xy0, xy1, THRESHOLD, 0.5)
    assert kept[correct].mean() > 0.9 and kept[~correct].mean() < 0.2
    assert not essential_inliers(xy0[: MIN_MATCHES - 1], xy1[: MIN_MATCHES - 1], THRESHOLD, 0.5).any()


def test_samples_suffice_for_the_ratio_of_inliers(monkeypatch: pytest.MonkeyPatch) -> None:
    """At one half, a sample is free of outliers with a probability of 1/32: 1 - (31/32)^218 = 0.999."""
    assert [samples_of_five(ratio) for ratio in (0.0, 0.37, 0.5, 1.0)] == [993, 993, 218, 3]
    drawn = list[int]()
    find: Any = cv2.findEssentialMat

    def counted(*arguments: Any, maxIters: int, **options: Any) -> Any:
        drawn.append(maxIters)
        return find(*arguments, maxIters=maxIters, **options)

    monkeypatch.setattr(cv2, "findEssentialMat", counted)
    xy0, xy1, _, _ = matches(6, outliers=36)
    essential_inliers(xy0, xy1, THRESHOLD, 0.5)
    assert drawn == [218]
