"""Choice of the pairs of images that are matched.

All pairs of a small set are matched. In a sequence, each image is matched to the next ones and, at distances that
double, to later ones; images of the same place are found by their appearance, the VLAD descriptor (Jégou, Douze,
Schmid and Pérez, "Aggregating local descriptors into a compact image representation", CVPR 2010).
"""

from collections.abc import Iterator, Sequence

import numpy as np
from scipy.cluster.vq import kmeans2

from dronevio.estimator.sfm.config import PairConfig
from dronevio.estimator.sfm.features import Features
from dronevio.models.arrays import Floats

WORDS = 64
"""Number of visual words of the descriptor of an image."""
TRAINING_DESCRIPTORS = 20_000
"""Number of descriptors from which the words are learnt."""

BLOCK = 256
"""Number of images that are compared with all others at a time."""


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
        excluded = config.overlap if method == "sequential" else 0
        for image, others in enumerate(_most_similar(image_descriptors(features), config.similar, excluded)):
            pairs |= {(min(image, other), max(image, other)) for other in others}
    return sorted(pairs)


def image_descriptors(features: Sequence[Features]) -> Floats:
    """Return the VLAD descriptors (I, words · 128) of I images, of length 1."""
    # A sample of all descriptors, which are not copied: those of 10 000 images take gigabytes
    offsets = np.cumsum([0] + [len(f) for f in features])
    rng = np.random.default_rng(0)
    rows = np.sort(rng.choice(offsets[-1], min(int(offsets[-1]), TRAINING_DESCRIPTORS), replace=False))
    bounds = np.searchsorted(rows, offsets)
    training = np.concatenate(
        [f.descriptors[rows[a:b] - o] for f, a, b, o in zip(features, bounds, bounds[1:], offsets, strict=False)]
    ).astype(np.float32)
    words, _ = kmeans2(training, min(WORDS, len(training)), iter=15, minit="points", seed=rng)
    return np.stack([_vlad(f, words) for f in features])


def _most_similar(descriptors: Floats, count: int, excluded: int) -> Iterator[list[int]]:
    """Yield the indices of the images with the largest cosine similarities to each image, the largest first.

    Args:
        descriptors: (I, D) Descriptors of length 1.
        count: Number of images.
        excluded: Images within as many places of an image are left out, and so is itself.
    """
    for start in range(0, len(descriptors), BLOCK):
        similarity = descriptors[start : start + BLOCK] @ descriptors.T
        images = np.arange(start, start + len(similarity))
        similarity[np.abs(images[:, None] - np.arange(len(descriptors))) <= excluded] = -np.inf
        nearest = np.argsort(-similarity, axis=1, kind="stable")[:, :count]
        is_finite = np.isfinite(np.take_along_axis(similarity, nearest, axis=1))
        yield from (row[kept].tolist() for row, kept in zip(nearest, is_finite, strict=True))


def _vlad(features: Features, words: Floats) -> Floats:
    """Return the VLAD descriptor (words · 128,) of an image, of length 1."""
    descriptors = features.descriptors.astype(np.float32)
    distance = np.sum(words**2, axis=1) - 2.0 * descriptors @ words.T
    word = np.argmin(distance, axis=1)
    sums = np.zeros(words.shape)
    np.add.at(sums, word, descriptors - words[word])
    sums /= np.maximum(np.linalg.norm(sums, axis=1, keepdims=True), 1e-9)  # a word has one vote, however frequent
    vector = sums.ravel()
    return np.asarray(vector / max(float(np.linalg.norm(vector)), 1e-9), np.float32)
