"""Choice of the pairs of images that are matched.

All pairs of a small set are matched. In a sequence, each image is matched to the next ones and, at distances that
double, to later ones; images of the same place are found by their appearance, the VLAD descriptor (Jégou, Douze,
Schmid and Pérez, "Aggregating local descriptors into a compact image representation", CVPR 2010).
"""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy.cluster.vq import kmeans2

from dronevio.estimator.sfm.config import PairConfig
from dronevio.estimator.sfm.features import Features

WORDS = 64
"""Number of visual words of the descriptor of an image."""
TRAINING_DESCRIPTORS = 20_000
"""Number of descriptors from which the words are learnt."""


def select_pairs(features: Sequence[Features], is_ordered: bool, config: PairConfig) -> list[tuple[int, int]]:
    """Return pairs of different images, the smaller index first, in increasing order.

    Args:
        features: Features of each image.
        is_ordered: Whether the order of the images is that of time.
        config: Settings.
    """
    count = len(features)
    method = config.method
    if method == "automatic":
        is_small = count <= config.max_exhaustive
        method = "exhaustive" if is_small else "sequential" if is_ordered else "retrieval"
    if method == "exhaustive":
        return [(i, j) for i in range(count) for j in range(i + 1, count)]
    pairs: set[tuple[int, int]] = set()
    if method == "sequential":
        distances = list(range(1, config.overlap + 1))
        while 2 * distances[-1] < count:
            distances.append(2 * distances[-1])
        pairs |= {(i, i + d) for d in distances for i in range(count - d)}
    if config.similar > 0 and count > 2:
        similarity = image_similarities(features)
        excluded = config.overlap if method == "sequential" else 0
        i, j = np.indices(similarity.shape)
        similarity[np.abs(i - j) <= excluded] = -np.inf
        nearest = np.argsort(-similarity, axis=1, kind="stable")[:, : config.similar]
        pairs |= {
            (min(a, b), max(a, b))
            for a, row in enumerate(nearest.tolist())
            for b in row
            if np.isfinite(similarity[a, b])
        }
    return sorted(pairs)


def image_similarities(features: Sequence[Features]) -> npt.NDArray[np.float64]:
    """Return the cosine similarities (I, I) of the VLAD descriptors of I images."""
    stacked = np.concatenate([f.descriptors for f in features])
    rng = np.random.default_rng(0)
    sample = rng.choice(len(stacked), min(len(stacked), TRAINING_DESCRIPTORS), replace=False)
    training = stacked[np.sort(sample)].astype(np.float32)
    words, _ = kmeans2(training, min(WORDS, len(training)), iter=15, minit="points", seed=rng)
    return np.asarray((vectors := np.stack([_vlad(f, words) for f in features])) @ vectors.T)


def _vlad(features: Features, words: npt.NDArray[np.float32]) -> npt.NDArray[np.float64]:
    """Return the VLAD descriptor (words · 128,) of an image, of length 1."""
    descriptors = features.descriptors.astype(np.float32)
    distance = np.sum(words**2, axis=1) - 2.0 * descriptors @ words.T
    word = np.argmin(distance, axis=1)
    sums = np.zeros(words.shape)
    np.add.at(sums, word, descriptors - words[word])
    sums /= np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-9)  # a word has one vote, however frequent
    vector = sums.ravel()
    return np.asarray(vector / max(float(np.linalg.norm(vector)), 1e-9))
