"""The vocabulary and the index of places."""

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dronevio.estimator.slam.places.index import FIRST_COLUMNS, PlaceIndex
from dronevio.estimator.slam.places.vocabulary import (
    BRANCHES,
    LEAVES,
    default_vocabulary,
    hamming_distances,
    learn_vocabulary,
    vocabulary_from_array,
)
from dronevio.models.errors import ConfigError

Array = npt.NDArray[Any]

WORDS = 50
DOCUMENTS = st.lists(st.lists(st.integers(0, WORDS - 1), min_size=1, max_size=30), min_size=1, max_size=8)


def random_descriptors(count: int, seed: int = 0) -> Array:
    """Return random descriptors (count, 32)."""
    return np.random.default_rng(seed).integers(0, 256, (count, 32), dtype=np.uint8)


def indexed(documents: list[list[int]]) -> PlaceIndex:
    """Return an index of some documents."""
    index = PlaceIndex(WORDS)
    for words in documents:
        index.add(np.array(words))
    return index


@settings(deadline=None, max_examples=60)
@given(DOCUMENTS)
def test_similarity_is_that_of_the_definition(documents: list[list[int]]) -> None:
    index = indexed(documents)
    frequency = np.array([sum(w in words for words in documents) for w in range(WORDS)])
    weight = np.log(1.0 + (len(documents) + 1.0) / (frequency + 1.0))
    query = documents[0]
    found = index.similarities(np.array(query), len(documents))
    for words, similarity in zip(documents, found, strict=True):
        shared = sum(weight[w] * min(query.count(w), words.count(w)) for w in set(query))
        mean = np.mean(weight[query])
        assert similarity == pytest.approx(shared / (mean * max(len(query), len(words))), rel=1e-5)
        assert -1e-9 <= similarity <= 1.0 + 1e-5
    assert found[0] == pytest.approx(1.0, rel=1e-5)


@settings(deadline=None, max_examples=30)
@given(DOCUMENTS, st.lists(st.booleans(), max_size=8))
def test_only_allowed_keyframes_are_returned(documents: list[list[int]], allowed: list[bool]) -> None:
    index = indexed(documents)
    mask = np.array(allowed[: len(documents)], np.bool_)
    found = index.query(np.array(documents[-1]), mask, 3, 0.05)
    assert len(found.rows) <= min(3, mask.sum())
    assert np.all(mask[found.rows])
    assert np.all(np.diff(found.similarity) <= 0.0)
    assert np.all(found.similarity >= 0.05)


def test_a_word_of_every_keyframe_says_little() -> None:
    index = indexed([[0, k + 1] for k in range(20)])
    similarity = index.similarities(np.array([0, 5]), 20)
    assert similarity.argmax() == 4
    assert similarity[4] > 3.0 * np.delete(similarity, 4).max()


def test_the_index_grows_beyond_its_first_size() -> None:
    rng = np.random.default_rng(0)
    documents = [rng.integers(0, WORDS, 20).tolist() for _ in range(2 * FIRST_COLUMNS + 3)]
    index = indexed(documents)
    assert len(index) == len(documents)
    for row in (0, FIRST_COLUMNS - 1, FIRST_COLUMNS, 2 * FIRST_COLUMNS, len(documents) - 1):
        assert index.query(np.array(documents[row]), np.ones(len(documents), np.bool_), 1, 0.0).rows.tolist() == [row]


def test_counts_beyond_a_byte_do_not_overflow() -> None:
    index = indexed([[7] * 300, [7]])
    assert index.similarities(np.array([7] * 300), 2) == pytest.approx([255 / 300, 1 / 300])


def test_the_package_has_a_vocabulary() -> None:
    vocabulary = default_vocabulary()
    array = vocabulary.as_array()
    assert array.nbytes == BRANCHES * (1 + LEAVES) * 32 == 133_120
    assert vocabulary.size == 4096
    again = vocabulary_from_array(array)
    descriptors = random_descriptors(200)
    words = vocabulary.assign(descriptors)
    assert np.array_equal(words, again.assign(descriptors))
    branch = hamming_distances(descriptors, vocabulary.branches).argmin(axis=1)
    leaf = [hamming_distances(d[None], vocabulary.words[b]).argmin() for d, b in zip(descriptors, branch, strict=True)]
    assert np.array_equal(words, branch * LEAVES + leaf)
    assert len(vocabulary.assign(descriptors[:0])) == 0


def test_words_are_distinct_and_stable() -> None:
    vocabulary = default_vocabulary()
    flat = vocabulary.words.reshape(-1, 32)
    assert len(np.unique(flat, axis=0)) > 0.95 * len(flat)
    # Three of 256 bits seldom move a word's own code to another word.
    changed = flat.copy()
    changed[:, :3] ^= np.uint8(1)
    assert np.mean(vocabulary.assign(changed) == vocabulary.assign(flat)) > 0.6


def test_hamming_distances_count_bits() -> None:
    zeros, ones = np.zeros((1, 32), np.uint8), np.full((1, 32), 255, np.uint8)
    one_bit = zeros.copy()
    one_bit[0, 17] = 8
    assert hamming_distances(np.concatenate([zeros, ones]), np.concatenate([zeros, one_bit])).tolist() == [
        [0, 1],
        [256, 255],
    ]


@pytest.mark.slow
def test_clusters_are_found_again() -> None:
    centres = random_descriptors(BRANCHES * LEAVES, 1)
    rng = np.random.default_rng(2)
    samples = np.repeat(centres, 10, axis=0)
    flips = rng.integers(0, 256, (len(samples), 6))
    np.bitwise_xor.at(
        samples, (np.arange(len(samples))[:, None], flips // 8), np.uint8(1) << (flips % 8).astype(np.uint8)
    )
    vocabulary = learn_vocabulary(samples, seed=3)
    assert np.array_equal(vocabulary.as_array(), learn_vocabulary(samples, seed=3).as_array())
    words = vocabulary.assign(samples).reshape(-1, 10)
    together = np.mean(words == np.median(words, axis=1, keepdims=True))
    assert together > 0.8


@pytest.mark.parametrize("array", [np.zeros((10, 32), np.uint8), np.zeros((BRANCHES * (1 + LEAVES), 32), np.int64)])
def test_another_array_is_no_vocabulary(array: Array) -> None:
    with pytest.raises(ConfigError, match=r"expected uint8 of shape \(4160, 32\)"):
        vocabulary_from_array(array)


def test_too_few_descriptors_are_refused() -> None:
    with pytest.raises(ConfigError, match="40960 or more"):
        learn_vocabulary(random_descriptors(100))


@settings(deadline=None, max_examples=30)
@given(DOCUMENTS, st.data())
def test_an_index_without_a_keyframe_is_as_if_it_never_had_it(documents: list[list[int]], data: st.DataObject) -> None:
    row = data.draw(st.integers(0, len(documents) - 1))
    index, expected = indexed(documents), indexed(documents[:row] + documents[row + 1 :])
    index.remove(row)
    query = np.array(documents[0])
    assert len(index) == len(expected)
    np.testing.assert_array_equal(index.similarities(query, len(index)), expected.similarities(query, len(index)))
    for each in (index, expected):
        each.add(query)
    np.testing.assert_array_equal(index.similarities(query, len(index)), expected.similarities(query, len(index)))
