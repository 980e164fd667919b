"""Bundle adjustment of the map of a synthetic flight, from the poses of its graph and from worse ones."""

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import pytest

from dronevio.estimator.backend.observations import observation_table
from dronevio.estimator.imu.preintegration import PreintegrationConfig, PreintegrationParams
from dronevio.estimator.slam.bundle_adjustment import AdjustmentConfig, AdjustmentInputs, AdjustmentKeyframe, adjust
from dronevio.estimator.slam.odometry_factors import RelativePose
from dronevio.estimator.slam.pose_graph import OptimizedGraph
from dronevio.models.rotation import exp_so3, inverse_pose, pose_matrix

if TYPE_CHECKING:
    from tests.estimator.slam.mapping.conftest import OdometryFlight

Array = npt.NDArray[np.float64]


@pytest.fixture(scope="module")
def solution(odometry_flight: "OdometryFlight") -> OptimizedGraph:
    """Return the optimized pose graph of a flight with loops."""
    _, mapped = odometry_flight.with_loops(every=5)
    found = mapped.mapper.final_solution()
    assert found is not None
    return found


@pytest.fixture(scope="module")
def inputs(odometry_flight: "OdometryFlight", solution: OptimizedGraph) -> AdjustmentInputs:
    """Return the measurements of the map, with the poses of the graph as initial ones."""
    of_time = {keyframe.t_ns: keyframe for keyframe in odometry_flight.keyframes}
    keyframes, flight = [], odometry_flight.flight
    for number, estimate in enumerate(odometry_flight.marginalized):
        if estimate.t_ns not in of_time:  # a keyframe of the initialization
            continue
        known = of_time[estimate.t_ns]
        keyframes.append(
            AdjustmentKeyframe(
                number,
                estimate.t_ns,
                solution.graph.poses[number],
                known.state.velocity_m_s,
                known.state.gyro_bias_rad_s,
                known.state.accel_bias_m_s2,
                observation_table(number, known.observations),
            )
        )
    params = PreintegrationParams.of(flight.rig.imu, PreintegrationConfig())
    first = keyframes[0].number
    loops = [loop for loop in solution.without_rejected.loops if loop.first >= first]
    covariance, calibration = odometry_flight.marginalized[first].covariance, odometry_flight.keyframes[-1].calibration
    return AdjustmentInputs(keyframes, loops, flight.imu, flight.rig.imu, params, calibration, first, covariance)


def rmse_m(odometry_flight: "OdometryFlight", inputs: AdjustmentInputs, poses: Mapping[int, Array]) -> float:
    """Return the root mean square error of positions in the frame of the first keyframe [m]."""
    true = {keyframe.number: odometry_flight.true_poses[keyframe.t_ns] for keyframe in inputs.keyframes}
    start = inputs.keyframes[0].number
    first, true_first = inverse_pose(poses[start]), inverse_pose(true[start])
    errors = [(first @ poses[k] - true_first @ T)[:3, 3] for k, T in true.items()]
    return float(np.sqrt(np.mean(np.sum(np.array(errors) ** 2, axis=1))))


def test_adjustment_is_better_than_the_odometry(
    odometry_flight: "OdometryFlight", inputs: AdjustmentInputs, solution: OptimizedGraph
) -> None:
    adjusted = adjust(inputs, AdjustmentConfig())
    odometry = {number: estimate.T_odom_imu for number, estimate in enumerate(odometry_flight.marginalized)}
    assert set(adjusted) == {keyframe.number for keyframe in inputs.keyframes}
    error_m, of_odometry_m, of_graph_m = (
        rmse_m(odometry_flight, inputs, poses) for poses in (adjusted, odometry, solution.graph.poses)
    )
    assert error_m < 0.8 * of_odometry_m and error_m < 1.1 * of_graph_m, (error_m, of_odometry_m, of_graph_m)


def test_adjustment_converges_from_worse_poses(odometry_flight: "OdometryFlight", inputs: AdjustmentInputs) -> None:
    rng = np.random.default_rng(0)
    first, *later = inputs.keyframes
    moved = [
        replace(
            each, T_map_imu=each.T_map_imu @ pose_matrix(exp_so3(2e-3 * rng.normal(size=3)), 0.01 * rng.normal(size=3))
        )
        for each in later
    ]
    reference = adjust(inputs, AdjustmentConfig())
    found = adjust(replace(inputs, keyframes=[first, *moved]), AdjustmentConfig(iterations=40))
    difference_m = [np.linalg.norm((found[k] - reference[k])[:3, 3]) for k in reference]
    assert np.sqrt(np.mean(np.square(difference_m))) < 2e-3


def test_a_certain_loop_is_fulfilled(inputs: AdjustmentInputs) -> None:
    first, second = inputs.keyframes[5], inputs.keyframes[60]
    between = inverse_pose(first.T_map_imu) @ second.T_map_imu
    moved = between @ pose_matrix(np.eye(3), np.array([0.02, 0.0, 0.0]))
    loop = RelativePose(first.number, second.number, moved, 1e-10 * np.eye(6))
    adjusted = adjust(replace(inputs, loops=[loop]), AdjustmentConfig())
    found = inverse_pose(adjusted[first.number]) @ adjusted[second.number]
    np.testing.assert_allclose(found, moved, atol=2e-3)


def test_imu_between_two_tracks_is_not_used(inputs: AdjustmentInputs) -> None:
    """The second half is carried away by 2 m, to where a loop has found it."""
    half, carried = 40, pose_matrix(np.eye(3), np.array([2.0, 0.0, 0.0]))
    later = [replace(k, T_map_imu=carried @ k.T_map_imu, track=1) for k in inputs.keyframes[half:]]
    keyframes = [*inputs.keyframes[:half], *later]
    first, second = keyframes[half - 5], keyframes[half + 5]
    T = inverse_pose(first.T_map_imu) @ second.T_map_imu
    loop = RelativePose(first.number, second.number, T, 1e-6 * np.eye(6))
    # Landmarks of both tracks have other identities, as in a real odometry.
    renamed = [
        replace(k, observations=replace(k.observations, landmark=k.observations.landmark + 10**6 * k.track))
        for k in keyframes
    ]
    adjusted = adjust(replace(inputs, keyframes=renamed, loops=[loop]), AdjustmentConfig())
    for keyframe in keyframes:
        np.testing.assert_allclose(adjusted[keyframe.number][:3, 3], keyframe.T_map_imu[:3, 3], atol=0.1)


def test_same_measurements_give_the_same_bytes(inputs: AdjustmentInputs) -> None:
    some = replace(inputs, keyframes=inputs.keyframes[:40], loops=[])
    first, second = (adjust(some, AdjustmentConfig(iterations=3)) for _ in range(2))
    assert all(first[k].tobytes() == second[k].tobytes() for k in first)
