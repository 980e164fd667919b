"""The table of a keyframe's observations and their uncertainty."""

from dataclasses import replace

import numpy as np

from dronevio.estimator.backend.observations import (
    DECORRELATION_SIGMA_SCALE,
    MATCH_SIGMA_SCALE,
    NO_OBSERVATIONS,
    ObservationTable,
    observation_table,
)
from dronevio.estimator.types import Matches, Observations


def test_sigma_scale_of_tracks_and_stereo_matches() -> None:
    """Decorrelation and magnification enlarge a track's sigma; a match refers to its track by identity, not by row."""
    ids, scale, zncc = np.array([3, 5, 8]), np.array([0.5, 1.0, 1.6]), np.array([1.0, 0.9, 0.95])
    matches = Matches(np.array([8, 3, 8]), np.array([1, 1, 2]), np.zeros((3, 2)))
    observations = Observations(ids, np.zeros((3, 2)), np.zeros((3, 2)), np.ones(3, np.int64), zncc=zncc, scale=scale)
    table = observation_table(4, replace(observations, matches=matches))
    np.testing.assert_array_equal(table.landmark, [3, 5, 8, 8, 3, 8])
    np.testing.assert_array_equal(table.keyframe, np.full(6, 4))
    np.testing.assert_array_equal(table.camera, [0, 0, 0, 1, 1, 2])
    of_tracks = [1.0, 1.0 + 0.1 * DECORRELATION_SIGMA_SCALE, 1.6 * (1.0 + 0.05 * DECORRELATION_SIGMA_SCALE)]
    np.testing.assert_allclose(table.sigma_scale, [*of_tracks, *(np.array([1.6, 1.0, 1.6]) * MATCH_SIGMA_SCALE)])
    np.testing.assert_array_equal(table.variance_growth, np.ones(6))
    heavier = observation_table(4, replace(observations, matches=matches), match_sigma_scale=0.5)
    np.testing.assert_allclose(heavier.sigma_scale, [*of_tracks, 0.8, 0.5, 0.8])


def test_keyframes_of_a_landmark_are_counted_once() -> None:
    """Several cameras in one keyframe count as one; a landmark without observations has none."""
    landmark, keyframe, camera = np.array([[7, 5, 7, 7, 5, 9], [3, 3, 3, 4, 9, 4], [0, 0, 1, 0, 0, 0]])
    table = ObservationTable(landmark, keyframe, camera, np.zeros((6, 2)), np.ones(6), np.zeros(6, np.int64))
    np.testing.assert_array_equal(table.keyframe_counts(np.array([9, 5, 7, 6])), [1, 2, 2, 0])
    np.testing.assert_array_equal(NO_OBSERVATIONS.keyframe_counts(np.array([0, 3])), [0, 0])
