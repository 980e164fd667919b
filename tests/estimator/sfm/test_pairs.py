"""Choice of pairs: exhaustive, in a sequence, and by appearance."""

from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np
import pytest

from dronevio.estimator.sfm.config import PairConfig
from dronevio.estimator.sfm.features import Features
from dronevio.estimator.sfm.pairs import image_descriptors, select_pairs

if TYPE_CHECKING:
    from tests.estimator.sfm.conftest import MakeScene


def places(count: int, visits: int) -> list[Features]:
    """Return the features of a route that visits each of some places several times."""
    made = []
    for index in range(count * visits):
        of_place, own = np.random.default_rng(index % count), np.random.default_rng(100 + index)
        descriptors = of_place.integers(0, 60, (80, 128)) + own.integers(0, 10, (80, 128))
        blank = np.zeros((80, 3), np.uint8)
        made.append(Features(own.random((80, 2)), np.ones(80), descriptors.astype(np.uint8), blank))
    return made


def test_small_sets_are_matched_exhaustively() -> None:
    assert select_pairs(places(5, 1), is_ordered=True, config=PairConfig()) == list(combinations(range(5), 2))


def test_sequences_are_matched_at_doubling_distances() -> None:
    config = PairConfig(method="sequential", overlap=2, similar=0)
    distances = {j - i for i, j in select_pairs(places(12, 1), is_ordered=True, config=config)}
    assert distances == {1, 2, 4, 8}


def test_places_seen_again_are_found() -> None:
    features = places(20, 2)
    pairs = select_pairs(features, is_ordered=True, config=PairConfig(method="sequential", overlap=3, similar=1))
    assert {(i, i + 20) for i in range(20)} <= set(pairs)


def test_similar_images_of_an_unordered_set() -> None:
    features = places(15, 3)
    pairs = select_pairs(features, is_ordered=False, config=PairConfig(max_exhaustive=10, similar=2))
    assert set(pairs) == {(i, j) for i, j in combinations(range(45), 2) if (j - i) % 15 == 0}
    assert pairs == sorted(pairs)


def test_images_are_described_by_unit_vectors(make_scene: "MakeScene") -> None:
    features = make_scene(images=4).features
    descriptors = image_descriptors(features)
    np.testing.assert_allclose(np.linalg.norm(descriptors, axis=1), 1.0, atol=1e-6)
    np.testing.assert_allclose(image_descriptors(features[::-1]).shape, descriptors.shape)


def test_blocks_of_images_do_not_matter(monkeypatch: pytest.MonkeyPatch) -> None:
    config, features = PairConfig(method="retrieval", similar=3), places(7, 4)
    whole = select_pairs(features, is_ordered=False, config=config)
    monkeypatch.setattr("dronevio.estimator.sfm.pairs.BLOCK", 5)
    assert select_pairs(features, is_ordered=False, config=config) == whole


def test_images_without_features_have_no_similar_ones() -> None:
    blank = Features(np.empty((0, 2)), np.empty(0), np.empty((0, 128), np.uint8), np.empty((0, 3), np.uint8))
    features = [blank, *places(6, 2), blank]
    config = PairConfig(method="retrieval", similar=1)
    assert {(i, i + 6) for i in range(1, 7)} <= set(select_pairs(features, is_ordered=False, config=config))
