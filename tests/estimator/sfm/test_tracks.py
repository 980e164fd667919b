"""Tracks from verified matches: components, conflicts, and their order."""

import numpy as np

from dronevio.estimator.sfm.tracks import Tracks, connect_tracks
from dronevio.estimator.sfm.two_view import Geometry, TwoView


def pair(first: int, second: int, *matches: tuple[int, int]) -> TwoView:
    return TwoView(first, second, np.array(matches, np.int64), Geometry.GENERAL, np.eye(4), 0.1)


def as_sets(tracks: Tracks) -> list[set[tuple[int, int]]]:
    rows = list(zip(tracks.track.tolist(), tracks.image.tolist(), tracks.feature.tolist(), strict=True))
    return [{(i, f) for t, i, f in rows if t == track} for track in range(tracks.count)]


def test_matches_are_joined() -> None:
    tracks = connect_tracks([pair(0, 1, (0, 5), (1, 6)), pair(1, 2, (5, 2))], np.array([10, 10, 10]))
    assert as_sets(tracks) == [{(0, 0), (1, 5), (2, 2)}, {(0, 1), (1, 6)}]


def test_a_wrong_match_between_two_tracks_is_removed() -> None:
    # Two tracks over three images, each confirmed by a triangle of matches, and one wrong match between them.
    pairs = [pair(0, 1, (0, 0), (1, 1)), pair(1, 2, (0, 0), (1, 1)), pair(0, 2, (0, 0), (1, 1)), pair(0, 3, (0, 3))]
    wrong = pair(1, 3, (1, 3))
    tracks = connect_tracks([*pairs, wrong], np.array([4, 4, 4, 4]))
    found = as_sets(tracks)
    assert {(0, 1), (1, 1), (2, 1)} in found
    assert any({(0, 0), (1, 0), (2, 0)} <= track for track in found)


def test_matches_of_a_weak_pair_are_removed() -> None:
    # A repetitive scene: weak pairs of images confirm a wrong match by triangles, strong pairs contradict it.
    strong = [pair(0, 1, *((k, k) for k in range(5))), pair(1, 2, *((k, k) for k in range(5)))]
    weak = [pair(0, 2, (0, 1)), pair(0, 3, (0, 7)), pair(2, 3, (1, 7))]
    found = as_sets(connect_tracks([*strong, *weak], np.full(4, 10)))
    assert any({(0, 0), (1, 0), (2, 0)} <= track for track in found)
    assert any({(0, 1), (1, 1), (2, 1)} <= track for track in found)


def test_no_track_has_two_features_of_an_image() -> None:
    rng = np.random.default_rng(0)
    pairs = [
        pair(i, j, *zip(rng.permutation(30)[:20].tolist(), rng.permutation(30)[:20].tolist(), strict=True))
        for i in range(6)
        for j in range(i + 1, 6)
    ]
    tracks = connect_tracks(pairs, np.full(6, 30))
    keys = tracks.track * 6 + tracks.image
    assert tracks.count > 0
    assert len(np.unique(keys)) == len(keys)
    assert np.bincount(tracks.track).min() >= 2
    assert np.all(np.diff(tracks.track) >= 0)


def test_without_matches_there_are_no_tracks() -> None:
    assert connect_tracks([], np.array([3, 3])).count == 0


def test_observations_by_track_and_by_image() -> None:
    tracks = Tracks(np.array([0, 1, 2, 0, 2, 1]), np.array([5, 6, 7, 8, 9, 3]), np.array([0, 0, 0, 1, 1, 3]))
    np.testing.assert_array_equal(tracks.of_tracks(np.array([1, 0])), [3, 4, 0, 1, 2])
    np.testing.assert_array_equal(tracks.of_tracks(np.array([2, 3])), [5])
    assert tracks.of_tracks(np.empty(0, np.int64)).size == 0
    np.testing.assert_array_equal(tracks.of_image(0), [0, 3])
    np.testing.assert_array_equal(tracks.of_image(2), [2, 4])
    assert tracks.of_image(3).size == 0  # without an observation
