"""An index of the places of a map: which earlier keyframes resemble a new one.

A keyframe is the histogram of its visual words. Its similarity to another one is the weight of the words that both
contain, relative to the weight of as many words as the larger of both has; a word that occurs in many keyframes says
little and has a small weight, its inverse document frequency (Sivic and Zisserman, "Video Google: A text retrieval
approach to object matching in videos", ICCV 2003; Gálvez-López and Tardós, T-RO 2012). The frequencies are those of the
map itself: in a place with repetitive texture, the words of the texture lose their weight.

The inverted file is a matrix with a row for each word and a column for each keyframe, of one byte an element: with some
thousand keyframes it is smaller than their descriptors, and a query reads only the rows of its own words.
"""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dronevio.estimator.slam.places.vocabulary import Words
from dronevio.models.arrays import Array, Integers

FIRST_COLUMNS = 64
"""Number of keyframes for which there is room at the beginning; it doubles when they are used."""
MAX_COUNT = 255
"""Largest number of equal words in a keyframe that is counted."""


@dataclass(frozen=True, eq=False)
class Candidates:
    """Earlier keyframes that resemble a keyframe, the most similar first."""

    rows: Integers
    """(K,) Positions of the keyframes in the order in which they were added."""
    similarity: Array
    """(K,) Similarities, 0 to 1."""


class PlaceIndex:
    """An inverted file of keyframes that grows."""

    def __init__(self, words: int) -> None:
        """Create an index without keyframes.

        Args:
            words: Number of words of the vocabulary.
        """
        self._counts = np.zeros((words, FIRST_COLUMNS), np.uint8)
        self._documents = np.zeros(words, np.int64)  # number of keyframes that contain each word
        self._sizes: list[int] = []  # number of words in each keyframe

    def __len__(self) -> int:
        """Return the number of keyframes."""
        return len(self._sizes)

    def add(self, words: Words) -> None:
        """Add a keyframe with its words (N,)."""
        column = len(self._sizes)
        if column == self._counts.shape[1]:
            self._counts = np.concatenate([self._counts, np.zeros_like(self._counts)], axis=1)
        distinct, counts = np.unique(words, return_counts=True)
        self._counts[distinct, column] = np.minimum(counts, MAX_COUNT)
        self._documents[distinct] += 1
        self._sizes.append(len(words))

    def remove(self, row: int) -> None:
        """Remove a keyframe; those after it move up by one row."""
        self._documents -= self._counts[:, row] > 0
        count = len(self._sizes)
        self._counts[:, row : count - 1] = self._counts[:, row + 1 : count].copy()
        self._counts[:, count - 1] = 0
        del self._sizes[row]

    def similarities(self, words: Words, stop: int) -> Array:
        """Return the similarities (stop,) of words (N,) to the keyframes that were added first, 0 to 1."""
        distinct, counts = np.unique(words, return_counts=True)
        if stop <= 0 or not len(distinct):
            return np.zeros(max(stop, 0))
        weights = self.weights(distinct)
        common = np.minimum(self._counts[distinct, :stop], np.minimum(counts, MAX_COUNT).astype(np.uint8)[:, None])
        shared = weights.astype(np.float32) @ common.astype(np.float32)
        mean = weights @ counts / len(words)
        sizes = np.maximum(np.array(self._sizes[:stop], np.float64), len(words))
        return np.asarray(shared / (mean * sizes), np.float64)

    def query(self, words: Words, allowed: npt.NDArray[np.bool_], count: int, min_similarity: float) -> Candidates:
        """Return the most similar of the keyframes that were added first.

        Args:
            words: (N,) Words of the new keyframe.
            allowed: (K,) Which of the first K keyframes may be returned.
            count: Largest number of keyframes to return.
            min_similarity: Smallest similarity of a keyframe that is returned.
        """
        similarity = np.where(allowed, self.similarities(words, len(allowed)), -1.0)
        order = np.argsort(-similarity, kind="stable")[:count]
        order = order[similarity[order] >= min_similarity]
        return Candidates(order, similarity[order])

    def weights(self, words: Words) -> Array:
        """Return the inverse document frequencies (N,) of words (N,)."""
        return np.asarray(np.log(1.0 + (len(self._sizes) + 1.0) / (self._documents[words] + 1.0)))
