"""Choice of pairs: exhaustive, in a sequence, and by appearance."""

from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from dronevio.estimator.sfm.config import PairConfig
from dronevio.estimator.sfm.features import Features
from dronevio.estimator.sfm.pairs import image_similarities, select_pairs

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


def test_similarity_is_one_for_an_image_itself(make_scene: "MakeScene") -> None:
    similarity = image_similarities(make_scene(images=4).features)
    np.testing.assert_allclose(np.diag(similarity), 1.0, atol=1e-9)
    np.testing.assert_allclose(similarity, similarity.T, atol=1e-12)
