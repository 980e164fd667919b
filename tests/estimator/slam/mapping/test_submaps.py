"""Tracks of the odometry after a loss: submaps of their own until a place of the map is recognized."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from dronevio.estimator.backend.keyframe_estimate import KeyframeEstimate
from dronevio.estimator.slam.correction import Correction
from dronevio.estimator.slam.map.keyframe import NO_KEYFRAME_FEATURES, MapKeyframe
from dronevio.estimator.slam.map.odometry_factors import RelativePose, first_node, propagated
from dronevio.estimator.slam.map.pose_graph import PoseGraph, joined_graphs, optimize
from dronevio.estimator.slam.map.submap import Submap
from dronevio.estimator.slam.mapper import Mapper
from dronevio.estimator.slam.places.localization import KeyframeView
from dronevio.estimator.slam.places.verification import PlaceMatch
from dronevio.models.arrays import Array
from dronevio.models.map_correction import MapCorrection
from dronevio.models.rotation import exp_so3, inverse_pose, log_so3, pose_matrix, rotation_z
from dronevio.models.state import Trajectory
from tests.estimator.slam.mapping.conftest import NoRecognizer, TrueRecognizer, marginal_covariance

if TYPE_CHECKING:
    from tests.estimator.slam.mapping.conftest import OdometryFlight


T_SHIFTED_ODOM = pose_matrix(rotation_z(2.0), np.array([30.0, -20.0, 5.0]))
"""Pose of the first odometry frame in that of the second track."""
SPLIT = 50
"""Number of keyframes of the first track."""


Tracks = tuple[list[KeyframeEstimate], list[KeyframeEstimate]]
"""Keyframes before and after a loss."""


class FirstMatchWrong(TrueRecognizer):
    """Recognizes places, the first of them wrongly by 1 m and 0.5 rad of yaw."""

    is_wrong = True

    def locate(self, keyframe: MapKeyframe) -> PlaceMatch | None:
        """Return a match, of which the first is wrong."""
        match = super().locate(keyframe)
        if match is None or not self.is_wrong:
            return match
        self.is_wrong = False
        error = pose_matrix(exp_so3(0.5 * keyframe.T_odom_imu[2, :3]), np.array([1.0, 0.0, 0.0]))
        self.wrong_pairs.add((match.match, match.query))
        return replace(match, T_match_query=match.T_match_query @ error)


class KeptMatches(TrueRecognizer):
    """Recognizes places, and keeps the matches of keyframes that are not added yet."""

    def __init__(self, true_poses: Mapping[int, Array]) -> None:
        """Begin without keyframes, with the true poses of the flight."""
        super().__init__(true_poses, every=1)
        self.matches: list[PlaceMatch] = []

    def locate(self, keyframe: MapKeyframe) -> PlaceMatch | None:
        """Return a match, and keep it."""
        match = super().locate(keyframe)
        self.matches += [] if match is None else [match]
        return match


def shifted(estimate: KeyframeEstimate) -> KeyframeEstimate:
    """Return a keyframe in the odometry frame of the second track."""
    R, t = T_SHIFTED_ODOM[:3, :3], T_SHIFTED_ODOM[:3, 3]
    landmarks = estimate.landmarks_odom @ R.T + t
    return replace(estimate, T_odom_imu=T_SHIFTED_ODOM @ estimate.T_odom_imu, landmarks_odom=landmarks)


def added(mapper: Mapper, estimates: Sequence[KeyframeEstimate]) -> list[Correction]:
    """Let keyframes without images join the map, and return the corrections."""
    return [mapper.add(estimate, KeyframeView(NO_KEYFRAME_FEATURES)) for estimate in estimates]


@pytest.fixture
def tracks(odometry_flight: "OdometryFlight") -> Tracks:
    """Return the keyframes of a flight as two tracks, the second in another odometry frame."""
    marginalized = odometry_flight.marginalized
    return marginalized[:SPLIT], [shifted(estimate) for estimate in marginalized[SPLIT:]]


def kidnapped(recognizer: TrueRecognizer, tracks: Tracks) -> tuple[Mapper, Array]:
    """Return a mapper after both tracks, and which corrections (N,) of the second one are known."""
    mapper = Mapper(recognizer)
    added(mapper, tracks[0])
    mapper.start_track(tracks[1][0].t_ns)
    corrections = added(mapper, tracks[1])
    return mapper, np.array([correction.T_map_odom is not None for correction in corrections])


def final_correction(mapper: Mapper) -> MapCorrection:
    """Return the correction by the optimized graph of the map."""
    solution = mapper.final_solution()
    assert solution is not None
    return mapper.map_of(solution).correction


def test_a_new_track_is_joined_where_a_place_is_recognized(odometry_flight: "OdometryFlight", tracks: Tracks) -> None:
    mapper = Mapper(TrueRecognizer(odometry_flight.true_poses, every=7, min_age=SPLIT))
    added(mapper, tracks[0])
    mapper.start_track(tracks[1][0].t_ns)
    before, after = (
        added(mapper, tracks[1][:13]),
        added(mapper, tracks[1][13:14]),
    )  # the second place confirms the first
    assert all(correction.T_map_odom is None and not correction.is_joined for correction in before)
    assert [correction.track for correction in before] == [1] * 13
    assert after[0].is_joined and after[0].T_map_odom is not None
    error = T_SHIFTED_ODOM @ after[0].T_map_odom
    assert np.linalg.norm(error[:3, 3]) < 0.1 and np.linalg.norm(log_so3(error[:3, :3])) < 0.02
    graph = mapper.graph
    assert graph is not None and set(graph.poses) == set(range(SPLIT + 14)) and graph.joined == (SPLIT,)
    assert mapper.summary.separate_tracks == 0


def test_one_wrong_match_does_not_join_tracks(odometry_flight: "OdometryFlight", tracks: Tracks) -> None:
    recognizer = FirstMatchWrong(odometry_flight.true_poses, every=4, min_age=SPLIT)
    mapper, is_known = kidnapped(recognizer, tracks)
    assert is_known[-1] and not recognizer.is_wrong
    final, graph = final_correction(mapper), mapper.graph
    assert graph is not None
    assert not recognizer.wrong_pairs & {(loop.first, loop.second) for loop in graph.loops}
    assert not optimize(graph).rejected and len(graph.loops) > 8
    error = T_SHIFTED_ODOM @ final.Ts_map_odom[-1]
    assert np.linalg.norm(error[:3, 3]) < 0.1 and np.linalg.norm(log_so3(error[:3, :3])) < 0.02


def test_a_joined_graph_keeps_its_tilt_and_not_its_yaw() -> None:
    P = np.diag([1e-6, 1e-6, 1e-6, 1e-4, 1e-4, 1e-4])
    first, second = PoseGraph(0, P, {0: np.eye(4)}), PoseGraph(1, P, {1: np.eye(4)})
    loop = RelativePose(0, 1, np.eye(4), 0.01 * np.eye(6))
    joined = joined_graphs(first, second, np.eye(4)).with_loops([loop])
    variances = np.diag(marginal_covariance(joined, 1))
    # Gravity knows roll and pitch to 1e-6, and the loop knows yaw and position to 0.01, of which the prior takes 1 %.
    np.testing.assert_allclose(variances[:2], 1e-6, rtol=1e-3)
    np.testing.assert_allclose(variances[2:], [0.0099, 0.0101, 0.0101, 0.0101], rtol=2e-3)


def test_a_track_without_recognized_places_stays_apart(odometry_flight: "OdometryFlight", tracks: Tracks) -> None:
    mapper, is_known = kidnapped(TrueRecognizer(odometry_flight.true_poses, min_age=1000), tracks)
    assert not is_known.any() and mapper.summary.separate_tracks == 1
    graph, final = mapper.graph, final_correction(mapper)
    assert graph is not None and len(graph.poses) == SPLIT == len(mapper.keyframes)
    times = np.array([estimate.t_ns for estimate in (*tracks[0], *tracks[1])])
    odometry = Trajectory(times, np.zeros((len(times), 3)), np.tile([1.0, 0.0, 0.0, 0.0], (len(times), 1)))
    assert np.array_equal(odometry.corrected(final).t_ns, times[:SPLIT])


def test_final_correction_has_a_step_between_tracks(odometry_flight: "OdometryFlight", tracks: Tracks) -> None:
    mapper, _ = kidnapped(TrueRecognizer(odometry_flight.true_poses, min_age=SPLIT), tracks)
    final, start_ns = final_correction(mapper), tracks[1][0].t_ns
    last, first = final.at(np.array([start_ns - 1, start_ns]))
    assert np.linalg.norm(last[:3, 3]) < 0.1
    np.testing.assert_allclose(first[:3, 3], inverse_pose(T_SHIFTED_ODOM)[:3, 3], atol=0.5)


def test_contradictory_loops_do_not_join_tracks(odometry_flight: "OdometryFlight", tracks: Tracks) -> None:
    first, second = (Submap.begin(10 * i, track[0], i) for i, track in enumerate(tracks))
    _, second = second.extended(first_node(10, tracks[1][0]), 11, tracks[1][1])
    T_old, *Ts_new = (odometry_flight.true_poses[k.t_ns] for k in (tracks[0][0], *tracks[1][:2]))
    offsets_m = np.array([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0]])  # more than the odometry errs; each alone could be right
    loops = [
        RelativePose(
            0, 10 + i, inverse_pose(T_old) @ pose_matrix(np.eye(3), offsets_m[i]) @ Ts_new[i], 1e-8 * np.eye(6)
        )
        for i in range(2)
    ]
    t_ns = tracks[1][1].t_ns
    assert second.joined(first, loops, t_ns, other_stays=True) is None
    for loop in loops:
        alone = second.joined(first, [loop], t_ns, other_stays=True)
        assert alone is not None and alone.closed_loops == (loop,) and alone.tracks == {0, 1}


@pytest.mark.parametrize("other_stays", [True, False])
def test_the_submap_that_stays_keeps_its_frame(
    odometry_flight: "OdometryFlight", tracks: Tracks, other_stays: bool
) -> None:
    first, second = (
        replace(Submap.begin(10 * i, track[0], i), T_map_first=pose_matrix(np.eye(3), np.full(3, 0.1 * i)))
        for i, track in enumerate(tracks)
    )
    T_old, T_new = (odometry_flight.true_poses[track[0].t_ns] for track in tracks)
    loop = RelativePose(0, 10, inverse_pose(T_old) @ T_new, 1e-8 * np.eye(6))
    joined, stays = second.joined(first, [loop], 0, other_stays=other_stays), first if other_stays else second
    assert joined is not None
    assert joined.first_poses == stays.first_poses and joined.T_map_first is stays.T_map_first


def located(mapper: Mapper, estimates: Sequence[KeyframeEstimate]) -> list[Correction | None]:
    """Return the corrections by keyframes without images that are still in the window."""
    return [mapper.locate(estimate, KeyframeView(NO_KEYFRAME_FEATURES)) for estimate in estimates]


def test_keyframes_in_the_window_are_located(odometry_flight: "OdometryFlight", tracks: Tracks) -> None:
    recognizer = KeptMatches(odometry_flight.true_poses)
    mapper = Mapper(recognizer)
    added(mapper, tracks[0])
    mapper.start_track(tracks[1][0].t_ns)
    first, correction, third = located(mapper, tracks[1][:3])
    assert first is None and third is None  # the second keyframe confirms the first one
    assert correction is not None and correction.T_map_odom is not None and correction.is_joined
    assert np.linalg.norm((T_SHIFTED_ODOM @ correction.T_map_odom)[:3, 3]) < 0.2
    # The pose is as uncertain as that of the old keyframe and the match together.
    match = recognizer.matches[-1]
    place = RelativePose.measured(match.match, match.query, match.T_match_query, match.covariance)
    expected = propagated(mapper._submaps[0].covariance_in_map(match.match), place, None)
    np.testing.assert_allclose(correction.covariance, expected, rtol=1e-9)
    assert len(mapper.keyframes) == SPLIT  # they are not part of the map yet
    # Until the track is joined, corrections are those of the located keyframe.
    mapper._recognizer = NoRecognizer()
    later = added(mapper, tracks[1][:2])[-1]
    assert later.T_map_odom is correction.T_map_odom and not later.is_joined
    assert later.anchor is tracks[1][1] and later.covariance is correction.covariance


def drifting(estimates: Sequence[KeyframeEstimate], step_m: float) -> list[KeyframeEstimate]:
    """Return keyframes that the odometry puts farther away from one to the next, as with a wrong velocity."""
    return [
        replace(k, T_odom_imu=pose_matrix(np.eye(3), np.array([i * step_m, 0.0, 0.0])) @ k.T_odom_imu)
        for i, k in enumerate(estimates)
    ]


def test_an_odometry_with_a_wrong_velocity_is_not_located(odometry_flight: "OdometryFlight", tracks: Tracks) -> None:
    mapper = Mapper(TrueRecognizer(odometry_flight.true_poses, every=1, sigma=1e-6))
    added(mapper, tracks[0])
    mapper.start_track(tracks[1][0].t_ns)
    assert located(mapper, drifting(tracks[1][:4], 0.05)) == [None] * 4
    assert located(mapper, tracks[1][4:6])[-1] is not None


def test_a_track_with_a_wrong_velocity_is_not_joined(odometry_flight: "OdometryFlight", tracks: Tracks) -> None:
    mapper = Mapper(TrueRecognizer(odometry_flight.true_poses, every=1, min_age=SPLIT, sigma=1e-6))
    added(mapper, tracks[0])
    mapper.start_track(tracks[1][0].t_ns)
    wrong, right = drifting(tracks[1][:8], 0.05), tracks[1][8:10]
    shift = pose_matrix(np.eye(3), np.array([7 * 0.05, 0.0, 0.0]))
    assert all(correction.T_map_odom is None for correction in added(mapper, wrong))
    assert mapper.summary.separate_tracks == 1
    after = added(mapper, [replace(k, T_odom_imu=shift @ k.T_odom_imu) for k in right])
    assert after[0].is_joined and after[1].T_map_odom is not None and mapper.summary.separate_tracks == 0


def test_recent_keyframes_of_another_track_are_references(tracks: Tracks) -> None:
    mapper = Mapper(NoRecognizer())
    added(mapper, tracks[0])
    graph, newest = mapper.graph, tracks[1][0]
    assert graph is not None
    last = mapper.keyframes[-1]
    assert newest.t_ns - last.t_ns < 10_000_000_000
    for track, expected in ((0, False), (1, True)):
        found = mapper._references(graph, replace(last, number=SPLIT, t_ns=newest.t_ns, track=track))
        assert (last in found) is expected and mapper.keyframes[0] in found


def test_too_small_a_map_is_given_up(tracks: Tracks) -> None:
    mapper = Mapper(NoRecognizer())
    added(mapper, tracks[0][:3])
    mapper.start_track(tracks[1][0].t_ns)
    correction = added(mapper, tracks[1][:2])[-1]
    assert correction.T_map_odom is not None and len(mapper.keyframes) == 2
    np.testing.assert_allclose(correction.T_map_odom, np.eye(4), atol=1e-9)


def test_loops_with_fixed_keyframes_are_tested() -> None:
    """Factors between fixed keyframes contradict their poses here, and must not hide that the loops agree."""
    poses = {k: pose_matrix(rotation_z(0.05 * k), np.array([0.3 * k, np.sin(0.1 * k), 0.0])) for k in range(80)}
    between = {k: inverse_pose(poses[k]) @ poses[k + 1] for k in range(79)}
    wrong = pose_matrix(np.eye(3), np.array([0.5, 0.0, 0.0]))
    odometry = tuple(RelativePose(k, k + 1, wrong @ T if k < 39 else T, 1e-6 * np.eye(6)) for k, T in between.items())
    loops = [RelativePose(k, k + 40, inverse_pose(poses[k]) @ poses[k + 40], 1e-6 * np.eye(6)) for k in range(0, 40, 3)]
    loops[2] = replace(loops[2], T_first_second=loops[2].T_first_second @ wrong)
    fixed = RelativePose(3, 30, np.eye(4), 1e-6 * np.eye(6))  # not tested: both of its keyframes stay
    graph = PoseGraph(0, 1e-8 * np.eye(6), poses, odometry, loops=(*loops, fixed), fixed=tuple(range(40)))
    assert optimize(graph).rejected == {2}
