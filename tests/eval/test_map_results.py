"""Results of an estimator with a map: corrected trajectories, their scores, and the correction over time."""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from dronevio.eval.map_results import map_results, online_correction
from dronevio.eval.metrics import score_trajectory
from dronevio.models.rotation import pose_matrix, rotation_z

if TYPE_CHECKING:
    from tests.eval.conftest import SyntheticFlight


def test_a_map_of_true_poses_removes_the_drift(mapped: "SyntheticFlight") -> None:
    results = map_results(mapped.run, mapped.recording)
    odometry = score_trajectory(mapped.truth, mapped.run.trajectory, mapped.recording.frame_times_ns)
    assert results is not None and results.scored_online is not None and results.scored_final is not None
    errors_m = [s.scores.ate_m.rmse for s in (odometry, results.scored_online, results.scored_final)]
    assert errors_m[2] < 1e-3 < errors_m[0]  # the correction is linear between keyframes
    np.testing.assert_array_equal(results.final.t_ns, mapped.run.trajectory.t_ns)
    assert results.final.velocity_m_s is None


def test_values_are_the_size_of_the_map_and_the_scores(mapped: "SyntheticFlight") -> None:
    results = map_results(mapped.run, mapped.recording)
    assert results is not None and results.scored_online is not None
    summary = results.summary
    assert (summary.keyframes, summary.points, summary.loops, summary.rejected_loops) == (12, 300, 3, 1)
    assert summary.online == results.scored_online.scores


def test_online_poses_are_those_of_their_frames(mapped: "SyntheticFlight") -> None:
    results = map_results(mapped.run, mapped.recording)
    assert results is not None
    for row, estimate in ((0, mapped.run.estimates[10]), (85, mapped.run.estimates[95])):
        assert estimate.T_map_imu is not None
        np.testing.assert_allclose(results.online.Ts_world_imu[row], estimate.T_map_imu, atol=1e-12)
    before = results.online.p_world_imu[:70]
    np.testing.assert_array_equal(before, mapped.run.trajectory.p_world_imu[:70])  # no loop is closed yet


def test_without_a_map_there_are_no_results(flight: "SyntheticFlight") -> None:
    assert map_results(flight.run, flight.recording) is None
    assert len(flight.run.final_trajectory) == 0


def test_without_truth_there_are_no_scores(mapped: "SyntheticFlight", flight_without_truth: "SyntheticFlight") -> None:
    results = map_results(mapped.run, flight_without_truth.recording)
    assert results is not None and results.summary.online is results.summary.final is None


def test_correction_over_time_by_hand(flight: "SyntheticFlight") -> None:
    T = pose_matrix(rotation_z(np.radians(2.0)), np.array([0.1, 0.2, -0.3]))
    first, second, third = flight.run.estimates[20:23]
    estimates = [
        replace(first, T_map_odom=np.eye(4)),
        replace(second, T_map_odom=T, closed_loops_ns=((0, 1), (2, 3))),
        third,  # without a map
        replace(flight.run.estimates[23], T_map_odom=T, closed_loops_ns=((4, 5),)),
    ]
    correction = online_correction(estimates)
    assert correction.t_ns.tolist() == [first.t_ns, second.t_ns, estimates[3].t_ns]
    assert correction.yaw_deg == pytest.approx([0.0, 2.0, 2.0])
    np.testing.assert_allclose(correction.position_m, [[0.0, 0.0, 0.0], [0.1, 0.2, -0.3], [0.1, 0.2, -0.3]])
    assert correction.loops.tolist() == [0, 2, 3]
    assert online_correction(estimates[3:], closed_before=2).loops.tolist() == [3]
    assert len(online_correction(flight.run.estimates).t_ns) == 0
