"""Detection of features: which are kept, and that the same points are found in images of the same surface."""

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from dronevio.estimator.sfm.config import FeatureConfig, MatchingConfig
from dronevio.estimator.sfm.features import EDGE_THRESHOLD, NO_FEATURES, detect_features
from dronevio.estimator.sfm.matching import match_features

Image = npt.NDArray[np.uint8]
SHIFT_PX = 16


@pytest.fixture(scope="module")
def sand() -> tuple[Image, Image]:
    """Two images of smooth stones on sand, shifted; the grains have moved, and are of higher contrast."""
    rng = np.random.default_rng(0)
    stones = cv2.GaussianBlur(rng.normal(size=(480, 640 + SHIFT_PX)), (0, 0), 5.0)
    stones *= 25.0 / stones.std()

    def photograph(columns: slice) -> Image:
        grains = 40.0 * cv2.GaussianBlur(rng.normal(size=(480, 640)), (0, 0), 0.8)
        return np.clip(128.0 + stones[:, columns] + grains, 0.0, 255.0).astype(np.uint8)

    return photograph(slice(0, 640)), photograph(slice(SHIFT_PX, None))


def test_few_features_of_many_are_those_that_another_image_shows(sand: tuple[Image, Image]) -> None:
    config = FeatureConfig(max_features=300)
    first, second = (detect_features(image, config) for image in sand)
    assert len(first) == len(second) == 300
    matches = match_features(first, second, MatchingConfig())
    moved = first.pixels[matches[:, 0]] - second.pixels[matches[:, 1]]
    assert np.sum(np.linalg.norm(moved - [SHIFT_PX, 0.0], axis=1) < 2.0) > 100


def test_kept_are_the_strongest_of_the_largest(sand: tuple[Image, Image]) -> None:
    image, count = sand[0], 500
    detector = cv2.SIFT.create(contrastThreshold=0.02, edgeThreshold=EDGE_THRESHOLD, enable_precise_upscale=True)
    keypoints = detector.detect(image, None)
    assert len(keypoints) > 4 * count
    largest = sorted(keypoints, key=lambda keypoint: -keypoint.size)[: 2 * count]
    strongest = sorted(largest, key=lambda keypoint: -keypoint.response)[:count]
    expected = sorted((keypoint.pt[1], keypoint.pt[0]) for keypoint in strongest)
    found = detect_features(image, FeatureConfig(max_features=count)).pixels
    np.testing.assert_allclose(sorted(found[:, ::-1].tolist()), expected, atol=1e-4)


def test_all_features_are_kept_up_to_the_limit(sand: tuple[Image, Image]) -> None:
    detector = cv2.SIFT.create(contrastThreshold=0.02, edgeThreshold=EDGE_THRESHOLD, enable_precise_upscale=True)
    crop = np.ascontiguousarray(sand[0][:120, :160])
    keypoints, described = detector.detectAndCompute(crop, None)
    found = detect_features(crop, FeatureConfig())
    assert 50 < len(found) == len(keypoints) < 2000
    assert found.descriptors.shape == described.shape
    assert detect_features(np.full((64, 64), 128, np.uint8), FeatureConfig()) is NO_FEATURES


def test_features_lie_within_the_mask(sand: tuple[Image, Image]) -> None:
    mask = np.zeros(sand[0].shape, np.bool_)
    mask[:, 300:] = True
    found = detect_features(sand[0], FeatureConfig(max_features=100), mask)
    assert len(found) == 100 and found.pixels[:, 0].min() > 298.0
