"""Corner detection: score, spacing and noise."""

import cv2
import numpy as np
import pytest

from dronevio.estimator.frontend.corners import CornerConfig, detect_corners
from dronevio.estimator.frontend.patches import noise_sigma
from dronevio.models.arrays import Image

WIDTH, HEIGHT = 320, 240


def squares(seed: int = 0) -> Image:
    """Return an image of bright squares on a grey background, with corners at whole pixels."""
    rng = np.random.default_rng(seed)
    image = np.full((HEIGHT, WIDTH), 90, np.uint8)
    for x, y in rng.integers(20, [WIDTH - 40, HEIGHT - 40], (25, 2)).tolist():
        image[y : y + 14, x : x + 14] = 190
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 0.8), np.uint8)


def test_corners_have_the_highest_score_nearby() -> None:
    image = squares()
    corners = detect_corners(image, 0.0, np.zeros((0, 2)), 12, CornerConfig())
    assert len(corners) > 10 and np.array_equal(corners, np.rint(corners))
    score = cv2.cornerMinEigenVal(image, blockSize=5, ksize=3)
    for u, v in corners.astype(int).tolist():
        assert score[v, u] > 0.6 * score[v - 3 : v + 4, u - 3 : u + 4].max()


def test_new_corners_keep_a_distance_from_existing_features() -> None:
    image, config = squares(), CornerConfig()
    first = detect_corners(image, 0.0, np.zeros((0, 2)), 12, config)
    occupied = first[::2]
    second = detect_corners(image, 0.0, occupied, 12, config)
    distance = np.linalg.norm(second[:, None] - occupied[None], axis=2)
    assert len(second) > 3 and distance.min() > config.spacing_px - 5


@pytest.mark.parametrize("sigma", [2.0, 6.0, 12.0, 25.0])
def test_noise_yields_no_corners(sigma: float) -> None:
    rng = np.random.default_rng(1)
    image = np.clip(np.rint(rng.normal(128.0, sigma, (480, 752))), 0, 255).astype(np.uint8)
    assert len(detect_corners(image, noise_sigma(image), np.zeros((0, 2)), 12, CornerConfig())) <= 2
