"""The map of the odometry's keyframes: without loops it is the odometry, and with loops it is better."""

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import pytest

from dronevio.estimator.slam.map.keyframe import NO_KEYFRAME_FEATURES
from dronevio.estimator.slam.map.map_frame import with_frame_offset
from dronevio.estimator.slam.map.pose_graph import optimize
from dronevio.estimator.slam.mapper import Mapper, MappingConfig
from dronevio.estimator.slam.places.localization import KeyframeView
from dronevio.models.arrays import Array
from dronevio.models.rotation import adjoint, inverse_pose
from tests.estimator.slam.mapping.conftest import NoRecognizer, TrueRecognizer, marginal_covariance

if TYPE_CHECKING:
    from tests.estimator.conftest import SyntheticFlight
    from tests.estimator.slam.mapping.conftest import MappedFlight, OdometryFlight


@pytest.fixture(scope="module")
def without_loops(odometry_flight: "OdometryFlight") -> "MappedFlight":
    """Return the map of a flight in which no place is recognized."""
    return odometry_flight.mapped(NoRecognizer())


def test_observer_leaves_the_odometry_as_it_is(
    make_flight: Callable[..., "SyntheticFlight"], odometry_flight: "OdometryFlight"
) -> None:
    frames = 200
    plain = make_flight(4, duration_s=25.0).cut_after(frames).run()
    for a, b in zip(plain, odometry_flight.estimates[:frames], strict=True):
        assert (a.state is None) == (b.state is None) and a.events == b.events
        if a.state is not None and b.state is not None:
            assert a.state.T_world_imu.tobytes() == b.state.T_world_imu.tobytes()
            assert a.state.covariance is not None and b.state.covariance is not None
            assert a.state.covariance.tobytes() == b.state.covariance.tobytes()


def test_marginalized_keyframes_are_close_to_the_truth(odometry_flight: "OdometryFlight") -> None:
    marginalized, true_poses = odometry_flight.marginalized, odometry_flight.true_poses
    times = [estimate.t_ns for estimate in marginalized]
    assert len(times) > 80 and times == sorted(set(times))
    first = marginalized[0]
    for estimate in marginalized:
        T = inverse_pose(first.T_odom_imu) @ estimate.T_odom_imu
        true_T = inverse_pose(true_poses[first.t_ns]) @ true_poses[estimate.t_ns]
        assert np.linalg.norm(T[:3, 3] - true_T[:3, 3]) < 0.1
        assert np.all(np.linalg.eigvalsh(estimate.covariance) > 0.0)
        assert np.all(np.linalg.eigvalsh(estimate.relative_covariance) > 0.0)
        assert estimate.t_ns < estimate.next_t_ns and len(estimate.landmark_ids) == len(estimate.landmarks_odom)


def test_landmarks_of_a_marginalized_keyframe_are_true(odometry_flight: "OdometryFlight") -> None:
    estimate = odometry_flight.marginalized[60]
    T = odometry_flight.true_poses[estimate.t_ns] @ inverse_pose(estimate.T_odom_imu)
    in_world = estimate.landmarks_odom @ T[:3, :3].T + T[:3, 3]
    distance = np.linalg.norm(in_world[:, None] - odometry_flight.flight.landmarks, axis=2).min(axis=1)
    assert len(distance) > 20 and np.median(distance) < 0.02


def test_without_loops_the_graph_gives_the_odometry_back(
    odometry_flight: "OdometryFlight", without_loops: "MappedFlight"
) -> None:
    graph = without_loops.mapper.graph
    assert graph is not None
    solved = optimize(graph).graph
    for number, estimate in enumerate(odometry_flight.marginalized):
        np.testing.assert_allclose(solved.poses[number], estimate.T_odom_imu, atol=1e-6)
    T_map_odom = without_loops.corrections[-1].T_map_odom
    assert T_map_odom is not None
    np.testing.assert_allclose(T_map_odom, np.eye(4), atol=1e-9)


def test_growth_of_covariance_is_that_of_the_odometry(
    odometry_flight: "OdometryFlight", without_loops: "MappedFlight"
) -> None:
    graph = without_loops.mapper.graph
    assert graph is not None
    ratios = []
    for number in range(len(odometry_flight.marginalized) // 3, len(odometry_flight.marginalized), 4):
        estimate = odometry_flight.marginalized[number]
        expected, found = estimate.covariance, marginal_covariance(graph, number)
        up = estimate.T_odom_imu[2, :3]
        yaw, position = up @ found[:3, :3] @ up / (up @ expected[:3, :3] @ up), np.trace(found[3:, 3:])
        ratios.append((yaw, position / np.trace(expected[3:, 3:])))
    # That of a single camera becomes smaller where the vehicle returns to the start; that of a graph does not.
    assert np.sqrt(np.mean(ratios, axis=0)) == pytest.approx(1.0, abs=0.25)


def errors_m(odometry_flight: "OdometryFlight", poses: dict[int, Array]) -> Array:
    """Return the errors (N,) of positions in the frame of the first keyframe [m]."""
    true = list(odometry_flight.true_poses.values())
    from_first, true_from_first = inverse_pose(poses[0]), inverse_pose(true[0])
    errors = [(from_first @ poses[k] - true_from_first @ T)[:3, 3] for k, T in enumerate(true)]
    return np.asarray(np.linalg.norm(np.array(errors), axis=1))


def test_loops_remove_the_drift(odometry_flight: "OdometryFlight", without_loops: "MappedFlight") -> None:
    _, mapped = odometry_flight.with_loops(every=3)
    graph = mapped.mapper.graph
    assert graph is not None and len(graph.loops) > 15
    corrected = optimize(graph)
    assert not corrected.rejected
    without = {k: d.T_odom_imu for k, d in enumerate(odometry_flight.marginalized)}
    before, after = errors_m(odometry_flight, without)[30:], errors_m(odometry_flight, dict(corrected.graph.poses))[30:]
    assert np.sqrt(np.mean(after**2)) < 0.7 * np.sqrt(np.mean(before**2))
    closed = [loop for correction in mapped.corrections for loop in correction.loops]
    assert len(closed) > 10 and {loop.second for loop in closed} <= {loop.second for loop in graph.loops}


def test_covariances_of_corrections_are_those_of_the_best_path(
    odometry_flight: "OdometryFlight", without_loops: "MappedFlight"
) -> None:
    mapper = Mapper(
        TrueRecognizer(odometry_flight.true_poses, every=7, sigma=1e-5), MappingConfig(optimization_interval_s=0.0)
    )
    compared, by_odometry = 0, [np.trace(c.covariance[3:, 3:]) for c in without_loops.corrections]
    for number, estimate in enumerate(odometry_flight.marginalized):
        correction, submap = mapper.add(estimate, KeyframeView(NO_KEYFRAME_FEATURES)), mapper._submaps[0]
        by_path = submap.covariances[number]
        in_map = with_frame_offset(by_path, submap.graph.poses[number], submap.T_map_first)
        np.testing.assert_array_equal(correction.covariance, in_map)
        variance = np.trace(by_path[3:, 3:])
        assert variance <= by_odometry[number] * 1.001  # a loop never makes it larger
        for loop in correction.loops:
            # The match is certain, so the keyframe is as certain as the old one, whose yaw moves it.
            T = loop.T_first_second
            expected = adjoint(inverse_pose(T)) @ without_loops.corrections[loop.first].covariance
            expected = expected @ adjoint(inverse_pose(T)).T
            assert variance < 1.02 * np.trace(expected[3:, 3:])
            compared += 1
    assert compared > 5


def test_optimizations_are_rarer_with_many_loops(odometry_flight: "OdometryFlight") -> None:
    config = MappingConfig(optimization_interval_s=0.5, interval_loops=1)
    mapper = Mapper(TrueRecognizer(odometry_flight.true_poses, every=1), config)
    times_s, loops = [], []
    for estimate in odometry_flight.marginalized:
        correction, graph = mapper.add(estimate, KeyframeView(NO_KEYFRAME_FEATURES)), mapper.graph
        if graph is not None and correction.loops:
            times_s.append(1e-9 * estimate.t_ns)
            loops.append(len(graph.loops))
    waited_s, least_s = np.diff(times_s), 0.5 * np.array(loops[:-1])
    assert len(waited_s) >= 2 and loops[0] == 1 and np.all(waited_s >= least_s) and np.all(waited_s < least_s + 1.0)


def test_wrong_loops_are_rejected_and_right_ones_kept(odometry_flight: "OdometryFlight") -> None:
    recognizer, mapped = odometry_flight.with_loops(every=3, wrong=0.4, seed=1)
    graph = mapped.mapper.graph
    assert graph is not None
    solved = optimize(graph)
    rejected = {(graph.loops[i].first, graph.loops[i].second) for i in solved.rejected}
    assert len(recognizer.wrong_pairs) > 5 and rejected == recognizer.wrong_pairs
    assert np.max(errors_m(odometry_flight, dict(solved.graph.poses))) < 0.05


def test_final_map_has_the_optimized_graph_as_arrays(odometry_flight: "OdometryFlight") -> None:
    _, mapped = odometry_flight.with_loops(every=3, wrong=0.4, seed=1)
    graph, solved = mapped.mapper.graph, mapped.mapper.final_solution()
    assert graph is not None and solved is not None
    final = mapped.mapper.map_of(solved)
    correction = final.correction
    poses = np.stack([solved.graph.poses[k.number] for k in mapped.mapper.keyframes])
    np.testing.assert_allclose(final.Ts_map_imu, poses, atol=1e-9)
    assert set(np.flatnonzero(final.rejected).tolist()) == solved.rejected and solved.rejected
    assert final.loops.tolist() == [[loop.first, loop.second] for loop in graph.loops]
    measured = inverse_pose(final.Ts_map_imu[final.loops[:, 0]]) @ final.Ts_map_imu[final.loops[:, 1]]
    right = ~final.rejected
    np.testing.assert_allclose(final.Ts_then_now[right], measured[right], atol=0.02)
    np.testing.assert_allclose(correction.Ts_map_odom @ final.Ts_odom_imu, final.Ts_map_imu, atol=1e-9)


def test_points_of_the_map_are_where_the_last_keyframe_puts_them(odometry_flight: "OdometryFlight") -> None:
    mapped = odometry_flight.mapped(NoRecognizer())
    solved = mapped.mapper.final_solution()
    assert solved is not None
    final = mapped.mapper.map_of(solved)
    last: dict[int, Array] = {}
    for estimate in odometry_flight.marginalized:  # without loops, the map is the odometry
        last |= dict(zip(estimate.landmark_ids.tolist(), estimate.landmarks_odom, strict=True))
    assert len(final.points) == len(last)
    np.testing.assert_allclose(final.points, np.stack([last[k] for k in sorted(last)]), atol=1e-5)


def test_closed_loops_are_reported_with_times(odometry_flight: "OdometryFlight") -> None:
    _, mapped = odometry_flight.with_loops(every=3)
    keyframes = mapped.mapper.keyframes
    reported = [(loop, times) for c in mapped.corrections for loop, times in zip(c.loops, c.loop_times_ns, strict=True)]
    assert len(reported) > 10
    assert all(times == (keyframes[loop.first].t_ns, keyframes[loop.second].t_ns) for loop, times in reported)
