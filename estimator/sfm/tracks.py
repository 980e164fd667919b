"""Feature tracks: the features of all images that verified matches connect, at most one in each image."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree

Indices = npt.NDArray[np.int64]

_EDGES_AT_ONCE = 200_000  # whose neighbours are in memory


class MatchedPair(Protocol):
    """Two images with matches, of which `TwoView` is an example."""

    @property
    def first(self) -> int:
        """Index of the first image."""

    @property
    def second(self) -> int:
        """Index of the second image."""

    @property
    def matches(self) -> Indices:
        """(K, 2) Matches: indices of features of the first image and of the second."""


@dataclass(frozen=True, eq=False)
class Tracks:
    """M observations of T tracks, in the order of the tracks."""

    image: Indices
    """(M,) Image of each observation."""
    feature: Indices
    """(M,) Feature of each observation in its image."""
    track: Indices
    """(M,) Track of each observation, non-decreasing, from 0 to T − 1."""

    @property
    def count(self) -> int:
        """Number of tracks T."""
        return int(self.track[-1]) + 1 if len(self.track) else 0

    def of_tracks(self, tracks: Indices) -> Indices:
        """Return the observations of some tracks, in the order of the tracks as they are given."""
        return _rows(self._track_starts, tracks)

    def of_image(self, image: int) -> Indices:
        """Return the observations of an image, in the order of their tracks."""
        order, starts = self._by_image
        return order[starts[image] : starts[image + 1]] if image < len(starts) - 1 else order[:0]

    @cached_property
    def _track_starts(self) -> Indices:
        return np.concatenate([[0], np.cumsum(np.bincount(self.track, minlength=self.count))]).astype(np.int64)

    @cached_property
    def _by_image(self) -> tuple[Indices, Indices]:
        starts = np.concatenate([[0], np.cumsum(np.bincount(self.image))]).astype(np.int64)
        return np.argsort(self.image, kind="stable"), starts


def _rows(starts: Indices, groups: Indices) -> Indices:
    """Return the rows of some groups of consecutive rows, of which group k begins at row ``starts[k]``."""
    counts = starts[groups + 1] - starts[groups]
    first = np.repeat(starts[groups] - (np.cumsum(counts) - counts), counts)
    return np.asarray(first + np.arange(len(first)))


def connect_tracks(pairs: Sequence[MatchedPair], feature_counts: Indices) -> Tracks:
    """Connect verified matches to tracks.

    A component of the graph of matches that contains two features of one image is inconsistent. Its matches between
    the images with the fewest matches are removed, and so on until it falls apart: where a scene repeats itself, images
    of different places have few matches, and images of one place many. Of equal pairs, the matches that fewer triangles
    of matches confirm are removed first.

    Args:
        pairs: Pairs with verified matches.
        feature_counts: (I,) Number of features of each image.
    """
    offsets = np.concatenate([[0], np.cumsum(feature_counts)]).astype(np.int64)
    total = int(offsets[-1])
    image_of = np.repeat(np.arange(len(feature_counts)), feature_counts)
    if not pairs:
        return Tracks(*(np.empty(0, np.int64) for _ in range(3)))
    # Graph of all features, whose edges are matches; support orders the pairs of images
    edges = np.concatenate([pair.matches + offsets[[pair.first, pair.second]] for pair in pairs])
    counts = [len(pair.matches) for pair in pairs]
    triangles = _triangles(edges, total)
    support = np.repeat(counts, counts) * (triangles.max(initial=0) + 1) + triangles
    edges, support = _spanning_forest(edges, support, total)
    consistent = [np.empty((0, 2), np.int64)]
    while len(edges):
        # Only the features of inconsistent components are left, and numbered anew.
        nodes, compact = np.unique(edges, return_inverse=True)
        compact = compact.reshape(edges.shape)
        labels = _components(compact, len(nodes))
        label = labels[compact[:, 0]]
        in_conflict = _conflicts(labels, image_of[nodes])[label]
        consistent.append(edges[~in_conflict])
        edges, support, label = edges[in_conflict], support[in_conflict], label[in_conflict]
        # Within each inconsistent component, the matches of the weakest pairs of images go.
        least = np.full(len(nodes), np.iinfo(np.int64).max)
        np.minimum.at(least, label, support)
        keep = support > least[label]
        edges, support = edges[keep], support[keep]
    # A track is a component of the consistent matches
    edges = np.concatenate(consistent)
    labels = _components(edges, total)
    used = np.unique(edges)
    order = np.lexsort([used, labels[used]])
    nodes = used[order]
    _, track = np.unique(labels[nodes], return_inverse=True)
    return Tracks(image_of[nodes], nodes - offsets[image_of[nodes]], track.astype(np.int64))


def _spanning_forest(edges: Indices, support: Indices, total: int) -> tuple[Indices, Indices]:
    """Return the edges of a maximum spanning forest with their support.

    Whatever the least support of the edges that are kept, its components are those of all edges.
    """
    cost = (support.max() + 1 - support).astype(np.float64)
    graph = coo_array((cost, (edges[:, 0], edges[:, 1])), shape=(total, total)).tocsr()
    forest = minimum_spanning_tree(graph).tocoo()
    return np.column_stack(forest.coords).astype(np.int64), (support.max() + 1 - forest.data).astype(np.int64)


def _components(edges: Indices, total: int) -> Indices:
    graph = coo_array((np.ones(len(edges), np.int8), (edges[:, 0], edges[:, 1])), shape=(total, total))
    return np.asarray(connected_components(graph, directed=False)[1], np.int64)


def _conflicts(labels: Indices, image_of: Indices) -> npt.NDArray[np.bool_]:
    """Return for each component whether it contains two features of one image."""
    counts = np.bincount(labels)
    keys = labels * (image_of.max() + 1) + image_of
    distinct = np.bincount(np.unique(keys) // (image_of.max() + 1), minlength=len(counts))
    return np.asarray(distinct < counts)


def _triangles(edges: Indices, total: int) -> Indices:
    """Return how many triangles of matches contain each match (E,)."""
    i, j = edges.T
    ends = np.concatenate([i, j]), np.concatenate([j, i])
    graph = coo_array((np.ones(len(ends[0]), np.int32), ends), shape=(total, total)).tocsr()
    graph.data[:] = 1
    triangles = np.empty(len(edges), np.int64)
    for start in range(0, len(edges), _EDGES_AT_ONCE):
        rows = slice(start, start + _EDGES_AT_ONCE)
        triangles[rows] = graph[i[rows]].multiply(graph[j[rows]]).sum(axis=1)
    return triangles
