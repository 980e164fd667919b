"""A vocabulary of binary descriptors: visual words, in a tree of two levels.

A descriptor is assigned to the nearest of the branches and then to the nearest word of that branch (Nistér and
Stewénius, "Scalable recognition with a vocabulary tree", CVPR 2006; Gálvez-López and Tardós, "Bags of binary words for
fast place recognition in image sequences", T-RO 2012). The vocabulary of the package was learnt on rendered flights by
``tools/learn_vocabulary.py``.

The centre of a cluster of binary descriptors is their bitwise majority, which minimizes the sum of Hamming distances
(k-majority; Grana et al., "A fast approach for integrating ORB descriptors in the bag of words model", 2013).
"""

from dataclasses import dataclass
from functools import cache
from importlib.resources import files

import numpy as np
import numpy.typing as npt

from dronevio.estimator.slam.map.keyframe import DESCRIPTOR_BYTES, Descriptors
from dronevio.models.errors import ConfigError

Words = npt.NDArray[np.int64]

BRANCHES, LEAVES = 64, 64
"""Number of branches, and of words in each branch."""
ITERATIONS = 12
"""Number of rounds in which the clusters are learnt."""


@dataclass(frozen=True, eq=False)
class Vocabulary:
    """Visual words in a tree of two levels."""

    branches: Descriptors
    """(B, 32) Centres of the branches."""
    words: Descriptors
    """(B, W, 32) Centres of the words of each branch."""

    @property
    def size(self) -> int:
        """Number of words."""
        return int(self.words.shape[0] * self.words.shape[1])

    def assign(self, descriptors: Descriptors) -> Words:
        """Return the words (N,), 0 to size − 1, of descriptors (N, 32)."""
        if not len(descriptors):
            return np.zeros(0, np.int64)
        branch = hamming_distances(descriptors, self.branches).argmin(axis=1)
        code = _as_integers(descriptors)
        # In the order of branches, each branch is one block, compared with its words alone.
        order = np.argsort(branch, kind="stable")
        words = _as_integers(self.words.reshape(-1, DESCRIPTOR_BYTES)).reshape(*self.words.shape[:2], -1)
        distance = np.zeros((len(order), words.shape[1]), np.uint16)
        for part in range(code.shape[1]):
            distance += np.bitwise_count(code[order, part, None] ^ words[branch[order], :, part])
        leaf = np.empty(len(order), np.int64)
        leaf[order] = distance.argmin(axis=1)
        return np.asarray(branch * words.shape[1] + leaf)

    def as_array(self) -> Descriptors:
        """Return the vocabulary as one array (B · (1 + W), 32): the branches, then the words of each branch."""
        return np.concatenate([self.branches, self.words.reshape(-1, DESCRIPTOR_BYTES)])


def vocabulary_from_array(array: npt.NDArray[np.generic]) -> Vocabulary:
    """Return the vocabulary of an array, as `Vocabulary.as_array` returns it.

    Raises:
        ConfigError: The array has another shape or type.
    """
    expected = (BRANCHES * (1 + LEAVES), DESCRIPTOR_BYTES)
    if array.shape != expected or array.dtype != np.uint8:
        raise ConfigError(f"vocabulary of {array.dtype} with shape {array.shape}; expected uint8 of shape {expected}")
    codes = np.asarray(array, np.uint8)
    return Vocabulary(codes[:BRANCHES], codes[BRANCHES:].reshape(BRANCHES, LEAVES, DESCRIPTOR_BYTES))


@cache
def default_vocabulary() -> Vocabulary:
    """Return the vocabulary of the package."""
    path = files("dronevio.estimator.slam.places") / "vocabulary.npy"
    with path.open("rb") as file:
        return vocabulary_from_array(np.lib.format.read_array(file, allow_pickle=False))


def hamming_distances(first: Descriptors, second: Descriptors) -> npt.NDArray[np.uint16]:
    """Return the numbers (N, M) of bits in which descriptors (N, 32) differ from others (M, 32)."""
    a, b = _as_integers(first), _as_integers(second)
    distance = np.zeros((len(a), len(b)), np.uint16)
    for part in range(a.shape[1]):
        distance += np.bitwise_count(a[:, part, None] ^ b[None, :, part])
    return distance


def learn_vocabulary(descriptors: Descriptors, seed: int = 0) -> Vocabulary:
    """Return a vocabulary of `BRANCHES` · `LEAVES` words, learnt from descriptors (N, 32).

    Raises:
        ConfigError: There are fewer than ten descriptors for each word.
    """
    if len(descriptors) < 10 * BRANCHES * LEAVES:
        raise ConfigError(
            f"{len(descriptors)} descriptors; expected {10 * BRANCHES * LEAVES} or more, ten for each word"
        )
    rng = np.random.default_rng(seed)
    branches, cluster = _k_majority(descriptors, BRANCHES, rng)
    words = [_k_majority(descriptors[cluster == k], LEAVES, rng)[0] for k in range(BRANCHES)]
    return Vocabulary(branches, np.stack(words))


def _k_majority(descriptors: Descriptors, k: int, rng: np.random.Generator) -> tuple[Descriptors, Words]:
    """Return the centres (k, 32) of clusters of descriptors (N, 32), and the cluster (N,) of each."""
    signs = (2.0 * np.unpackbits(descriptors, axis=1) - 1.0).astype(np.float32)
    chosen = rng.choice(len(signs), size=k, replace=len(signs) < k)
    centres = signs[chosen]
    cluster = np.zeros(len(signs), np.int64)
    for _ in range(ITERATIONS):
        # The inner product of signs is the number of equal bits less that of different ones.
        agreement = signs @ centres.T
        cluster = agreement.argmax(axis=1)
        sums = (cluster == np.arange(k)[:, None]).astype(np.float32) @ signs
        centres = np.where(sums >= 0.0, np.float32(1.0), np.float32(-1.0))
        is_empty = np.bincount(cluster, minlength=k) == 0
        # An empty cluster begins again at the descriptors that fit their clusters worst.
        worst = np.argsort(agreement.max(axis=1), kind="stable")[: is_empty.sum()]
        centres[np.flatnonzero(is_empty)[: len(worst)]] = signs[worst]
    return np.packbits(centres > 0.0, axis=1), cluster


def _as_integers(descriptors: Descriptors) -> npt.NDArray[np.uint64]:
    """Return descriptors (N, 32) as four integers of 64 bits each (N, 4)."""
    return np.ascontiguousarray(descriptors).view(np.uint64)
