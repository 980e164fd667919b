"""Recognition of places: revisits are found and confirmed, impossible and ambiguous ones are not."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from dronevio.estimator.slam.map.keyframe import NO_KEYFRAME_FEATURES, MapKeyframe
from dronevio.estimator.slam.places.recognizer import PlaceConfig, PlaceRecognizer
from dronevio.estimator.slam.places.verification import PlaceMatch
from dronevio.models.errors import ConfigError
from dronevio.models.rotation import inverse_pose
from tests.estimator.slam.conftest import RIG, Errors, Scene, keyframe, pose, scene

Array = npt.NDArray[Any]

NOISE = Errors(pixel=0.5, depth=0.01, bits=4)


def place(number: int) -> Scene:
    """Return one of several places that lie 8 m apart."""
    return scene(np.random.default_rng(number), 160, (5.0, 8.0 * number, 0.0))


@cache
def world() -> Scene:
    """Return all places."""
    places = [place(number) for number in range(4)]
    return Scene(np.concatenate([p.points for p in places]), np.concatenate([p.descriptors for p in places]))


def lap(
    first: int, start_s: float, offset_m: float, shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
) -> list[MapKeyframe]:
    """Return keyframes of a flight along the places, 0.5 s and 1 m apart, with an odometry that is shifted."""
    keyframes = []
    for k in range(25):
        T = pose([offset_m, 1.0 * k, 0.1 * offset_m])
        T_odom = T.copy()
        T_odom[:3, 3] += shift
        rng = np.random.default_rng([first + k, 9])
        keyframes.append(keyframe(first + k, T, world(), NOISE, rng, T_odom, start_s + 0.5 * k))
    return keyframes


def found(recognizer: PlaceRecognizer, keyframes: list[MapKeyframe]) -> list[PlaceMatch]:
    """Return all matches while keyframes are added."""
    return [match for each in keyframes for match in recognizer.add(each)]


def test_a_second_lap_is_recognized_at_the_right_places() -> None:
    recognizer = PlaceRecognizer(RIG)
    first, second = lap(0, 0.0, 0.0), lap(25, 30.0, 0.3, (0.4, -0.3, 0.1))
    assert found(recognizer, first) == []
    matches = found(recognizer, second)
    assert len({match.query for match in matches}) == len(matches) >= 20
    by_number = {each.number: each for each in (*first, *second)}
    for match in matches:
        assert match.match < 25 <= match.query
        T_true = inverse_pose(true_pose(match.match)) @ true_pose(match.query)
        assert np.linalg.norm(match.T_match_query[:3, 3] - T_true[:3, 3]) < 0.05
        assert match.old_landmarks >= 8
        assert match.new_landmarks >= 8
        assert by_number[match.query].t_ns - by_number[match.match].t_ns >= 10_000_000_000


def true_pose(number: int) -> Array:
    """Return the true pose of a keyframe of the two laps."""
    offset_m = 0.3 if number >= 25 else 0.0
    return pose([offset_m, 1.0 * (number % 25), 0.1 * offset_m])


def test_one_match_alone_is_not_published() -> None:
    recognizer = PlaceRecognizer(RIG)
    found(recognizer, lap(0, 0.0, 0.0))
    second = lap(25, 30.0, 0.3)
    assert recognizer.add(second[3]) == ()
    empty = replace(second[4], features=NO_KEYFRAME_FEATURES, landmark_ids=np.zeros(0, np.int64))
    assert recognizer.add(replace(empty, landmarks_imu=np.zeros((0, 3)))) == ()
    published = recognizer.add(second[5])
    assert [match.query for match in published] == [second[3].number, second[5].number]
    # The next one is confirmed by those, and they are not published again.
    assert [match.query for match in recognizer.add(second[6])] == [second[6].number]


def test_a_match_waits_only_for_some_time() -> None:
    recognizer = PlaceRecognizer(RIG)
    found(recognizer, lap(0, 0.0, 0.0))
    second = lap(25, 30.0, 0.3)
    assert recognizer.add(second[3]) == ()
    assert recognizer.add(second[8]) == ()  # 2.5 s later


def test_recent_keyframes_are_not_recognized() -> None:
    recognizer = PlaceRecognizer(RIG, PlaceConfig(min_age_s=100.0))
    found(recognizer, lap(0, 0.0, 0.0))
    assert found(recognizer, lap(25, 30.0, 0.3)) == []


def test_more_drift_than_possible_is_refused() -> None:
    recognizer = PlaceRecognizer(RIG)
    found(recognizer, lap(0, 0.0, 0.0))
    assert found(recognizer, lap(25, 30.0, 0.3, (3.0, 0.0, 0.0))) == []


def test_another_odometry_frame_may_be_anywhere() -> None:
    recognizer = PlaceRecognizer(RIG)
    found(recognizer, lap(0, 0.0, 0.0))
    recognizer.start_track()
    matches = found(recognizer, lap(25, 30.0, 0.3, (30.0, -20.0, 5.0)))
    assert len(matches) >= 20


def test_a_recent_keyframe_of_another_track_is_recognized() -> None:
    recognizer = PlaceRecognizer(RIG)
    found(recognizer, lap(0, 0.0, 0.0))
    recognizer.start_track()
    matches = found(recognizer, lap(25, 13.0, 0.3, (30.0, -20.0, 5.0)))  # the last one is 1 s older
    assert any(match.match == 24 for match in matches)


def test_keyframes_are_located_before_they_are_added() -> None:
    recognizer = PlaceRecognizer(RIG)
    found(recognizer, lap(0, 0.0, 0.0))
    recognizer.start_track()
    second = lap(25, 30.0, 0.3, (30.0, -20.0, 5.0))
    assert recognizer.locate(second[3]) is None  # no other keyframe confirms it
    located = recognizer.locate(second[4])
    assert located is not None and located.query == second[4].number
    T_true = inverse_pose(true_pose(located.match)) @ true_pose(located.query)
    assert np.linalg.norm(located.T_match_query[:3, 3] - T_true[:3, 3]) < 0.05
    assert len(recognizer) == 25
    assert recognizer.add(second[3]) == ()  # what was located does not confirm what is added


def test_two_equal_places_are_ambiguous() -> None:
    """A place that exists twice is recognized in neither, where the odometry does not say which one it is."""
    recognizer = PlaceRecognizer(RIG, PlaceConfig(island=3))
    original = place(0)

    def visit(number: int, start_s: float, y: float) -> list[MapKeyframe]:
        copy = Scene(original.points + [0.0, y, 0.0], original.descriptors)
        rng = np.random.default_rng([number, 5])
        return [
            keyframe(number + k, pose([0.1, y + 0.1 * k, 0.0]), copy, NOISE, rng, t_s=start_s + 0.5 * k)
            for k in range(6)
        ]

    assert found(recognizer, visit(0, 0.0, 0.0)) == []
    assert found(recognizer, visit(10, 20.0, 40.0)) == []  # the odometry knows that this is 40 m away
    recognizer.start_track()
    assert found(recognizer, visit(20, 40.0, -30.0)) == []
    # With one copy alone it is recognized.
    alone = PlaceRecognizer(RIG)
    found(alone, visit(0, 0.0, 0.0))
    alone.start_track()
    assert len(found(alone, visit(20, 40.0, -30.0))) >= 4


def test_the_matches_have_the_same_bytes_twice() -> None:
    keyframes = [*lap(0, 0.0, 0.0), *lap(25, 30.0, 0.3)]
    first, second = (found(PlaceRecognizer(RIG), keyframes) for _ in range(2))
    assert [match.T_match_query.tobytes() for match in first] == [match.T_match_query.tobytes() for match in second]
    assert [match.covariance.tobytes() for match in first] == [match.covariance.tobytes() for match in second]
    assert len(first) >= 20


def test_keyframes_have_to_come_in_order() -> None:
    recognizer = PlaceRecognizer(RIG)
    first = lap(0, 0.0, 0.0)
    recognizer.add(first[1])
    with pytest.raises(ConfigError, match="expected a larger number and a later time"):
        recognizer.add(first[0])


def test_a_removed_keyframe_is_not_recognized() -> None:
    recognizer = PlaceRecognizer(RIG)
    first, second = lap(0, 0.0, 0.0), lap(25, 30.0, 0.3)
    removed = found(recognizer, [*first, *second])[-1].match
    again = PlaceRecognizer(RIG)
    found(again, first)
    again.remove(removed)
    assert len(again) == len(first) - 1
    matches = {match.match for match in found(again, second)}
    assert len(matches) >= 15 and removed not in matches
