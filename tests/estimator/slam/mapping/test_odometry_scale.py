"""The scale of the odometry for an adjusted map."""

from dataclasses import replace

import numpy as np
import pytest

from dronevio.estimator.slam.adjustment.bundle_adjustment import AdjustmentInputs, SavedKeyframes
from dronevio.estimator.slam.adjustment.odometry_scale import odometry_scale, with_scale_of_odometry
from dronevio.estimator.slam.map.pose_graph import PoseGraph
from dronevio.models.arrays import Array
from dronevio.models.rotation import pose_matrix, rotation_z

T_MAP_ODOM = pose_matrix(rotation_z(np.array(0.4)), np.array([2.0, -3.0, 1.0]))


def map_of(inputs: AdjustmentInputs, size: float) -> dict[int, Array]:
    """Return the poses of the odometry in a map of another size, and in another frame."""
    poses = {k.number: k.estimate.T_odom_imu.copy() for k in inputs.keyframes}
    for T in poses.values():
        T[:3, 3] *= size
    return {number: T_MAP_ODOM @ T for number, T in poses.items()}


def test_a_map_gets_the_size_of_the_odometry(adjustment_inputs: AdjustmentInputs) -> None:
    poses, expected = (map_of(adjustment_inputs, size) for size in (0.98, 1.0))
    found, first = with_scale_of_odometry(adjustment_inputs, poses), adjustment_inputs.first
    shift = poses[first][:3, 3] - expected[first][:3, 3]
    for number, T in found.items():
        np.testing.assert_array_equal(T[:3, :3], poses[number][:3, :3])
        np.testing.assert_allclose(T[:3, 3], expected[number][:3, 3] + shift, atol=1e-6)
    np.testing.assert_array_equal(found[first], poses[first])


def test_drift_of_the_odometry_matters_little(adjustment_inputs: AdjustmentInputs) -> None:
    """A drift of 2 cm, independent of the path of some metres, changes the scale by a small part of 2 cm / path."""
    rng, drifted = np.random.default_rng(3), []
    for k, step in zip(
        adjustment_inputs.keyframes,
        np.cumsum(0.002 * rng.normal(size=(len(adjustment_inputs.keyframes), 3)), axis=0),
        strict=True,
    ):
        T = k.estimate.T_odom_imu.copy()
        T[:3, 3] += step
        drifted.append(replace(k, estimate=replace(k.estimate, T_odom_imu=T)))
    assert odometry_scale(drifted, map_of(adjustment_inputs, 0.98)) == pytest.approx(1.0 / 0.98, abs=0.003)


def test_each_track_has_a_frame_of_its_own(adjustment_inputs: AdjustmentInputs) -> None:
    T_other = pose_matrix(rotation_z(np.array(2.0)), np.array([50.0, 60.0, -7.0]))
    half = len(adjustment_inputs.keyframes) // 2
    first, second = adjustment_inputs.keyframes[:half], adjustment_inputs.keyframes[half:]
    moved = [
        replace(k, track=1, estimate=replace(k.estimate, T_odom_imu=T_other @ k.estimate.T_odom_imu)) for k in second
    ]
    poses = map_of(adjustment_inputs, 1.05)
    assert odometry_scale([*first, *moved], poses) == pytest.approx(1.0 / 1.05, rel=1e-5)


def test_a_flight_on_the_spot_tells_no_scale(adjustment_inputs: AdjustmentInputs) -> None:
    poses = {number: T.copy() for number, T in map_of(adjustment_inputs, 1.0).items()}
    middle = np.mean([T[:3, 3] for T in poses.values()], axis=0)
    size = np.sqrt(np.mean([np.sum((T[:3, 3] - middle) ** 2) for T in poses.values()]))
    for wanted_m, is_known in ((1.01, True), (0.99, False)):
        smaller = {number: T.copy() for number, T in poses.items()}
        for T in smaller.values():
            T[:3, 3] *= wanted_m / size
        expected = size / wanted_m if is_known else 1.0
        assert odometry_scale(adjustment_inputs.keyframes, smaller) == pytest.approx(expected, rel=1e-4)


def test_a_loaded_map_keeps_its_scale(adjustment_inputs: AdjustmentInputs) -> None:
    graph = PoseGraph(-1, np.eye(6), {-1: np.eye(4)})
    inputs = replace(adjustment_inputs, saved=SavedKeyframes(graph, adjustment_inputs.keyframes[0].observations))
    poses = map_of(inputs, 0.98)
    for number, T in with_scale_of_odometry(inputs, poses).items():
        np.testing.assert_array_equal(T, poses[number])
