"""Bundle adjustment of the map of a synthetic flight, from the poses of its graph and from worse ones."""

from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import pytest

from dronevio.estimator.backend.observations import ObservationTable
from dronevio.estimator.backend.triangulation import triangulate
from dronevio.estimator.slam.adjustment.bundle_adjustment import (
    AdjustmentConfig,
    AdjustmentInputs,
    SavedKeyframes,
    Scale,
    _imu_intervals,
    _odometry,
    adjust,
)
from dronevio.estimator.slam.map.odometry_factors import RelativePose
from dronevio.estimator.slam.map.pose_graph import OptimizedGraph, PoseGraph
from dronevio.models.arrays import Array
from dronevio.models.rotation import exp_so3, inverse_pose, pose_matrix

if TYPE_CHECKING:
    from tests.estimator.slam.mapping.conftest import OdometryFlight


def rmse_m(odometry_flight: "OdometryFlight", adjustment_inputs: AdjustmentInputs, poses: Mapping[int, Array]) -> float:
    """Return the root mean square error of positions in the frame of the first keyframe [m]."""
    true = {keyframe.number: odometry_flight.true_poses[keyframe.t_ns] for keyframe in adjustment_inputs.keyframes}
    start = adjustment_inputs.keyframes[0].number
    first, true_first = inverse_pose(poses[start]), inverse_pose(true[start])
    errors = [(first @ poses[k] - true_first @ T)[:3, 3] for k, T in true.items()]
    return float(np.sqrt(np.mean(np.sum(np.array(errors) ** 2, axis=1))))


def test_adjustment_is_better_than_the_odometry(
    odometry_flight: "OdometryFlight", adjustment_inputs: AdjustmentInputs, graph_solution: OptimizedGraph
) -> None:
    adjusted = adjust(adjustment_inputs, AdjustmentConfig()).poses
    odometry = {number: estimate.T_odom_imu for number, estimate in enumerate(odometry_flight.marginalized)}
    assert set(adjusted) == {keyframe.number for keyframe in adjustment_inputs.keyframes}
    error_m, of_odometry_m, of_graph_m = (
        rmse_m(odometry_flight, adjustment_inputs, poses) for poses in (adjusted, odometry, graph_solution.graph.poses)
    )
    # The graph, whose loops are measured to a millimetre, is better here than it was: 2.2 mm of 6.8 mm.
    assert error_m < 0.45 * of_odometry_m and of_graph_m < 0.4 * of_odometry_m, (error_m, of_odometry_m, of_graph_m)


def test_adjustment_converges_from_worse_poses(
    odometry_flight: "OdometryFlight", adjustment_inputs: AdjustmentInputs
) -> None:
    rng = np.random.default_rng(0)
    first, *later = adjustment_inputs.keyframes
    moved = [
        replace(
            each, T_map_imu=each.T_map_imu @ pose_matrix(exp_so3(2e-3 * rng.normal(size=3)), 0.01 * rng.normal(size=3))
        )
        for each in later
    ]
    reference = adjust(adjustment_inputs, AdjustmentConfig()).poses
    found = adjust(replace(adjustment_inputs, keyframes=[first, *moved]), AdjustmentConfig(iterations=40)).poses
    difference_m = [np.linalg.norm((found[k] - reference[k])[:3, 3]) for k in reference]
    assert np.sqrt(np.mean(np.square(difference_m))) < 2e-3


def test_a_certain_loop_is_fulfilled(adjustment_inputs: AdjustmentInputs) -> None:
    first, second = adjustment_inputs.keyframes[5], adjustment_inputs.keyframes[60]
    between = inverse_pose(first.T_map_imu) @ second.T_map_imu
    moved = between @ pose_matrix(np.eye(3), np.array([0.02, 0.0, 0.0]))
    loop = RelativePose(first.number, second.number, moved, 1e-10 * np.eye(6))
    adjusted = adjust(replace(adjustment_inputs, loops=[loop]), AdjustmentConfig()).poses
    found = inverse_pose(adjusted[first.number]) @ adjusted[second.number]
    np.testing.assert_allclose(found, moved, atol=2e-3)


def test_imu_between_two_tracks_is_not_used(adjustment_inputs: AdjustmentInputs) -> None:
    """The second half is carried away by 2 m, to where a loop has found it."""
    half, carried = 40, pose_matrix(np.eye(3), np.array([2.0, 0.0, 0.0]))
    later = [replace(k, T_map_imu=carried @ k.T_map_imu, track=1) for k in adjustment_inputs.keyframes[half:]]
    keyframes = [*adjustment_inputs.keyframes[:half], *later]
    first, second = keyframes[half - 5], keyframes[half + 5]
    T = inverse_pose(first.T_map_imu) @ second.T_map_imu
    loop = RelativePose(first.number, second.number, T, 1e-6 * np.eye(6))
    # Landmarks of both tracks have other identities, as in a real odometry.
    renamed = [
        replace(k, observations=replace(k.observations, landmark=k.observations.landmark + 10**6 * k.track))
        for k in keyframes
    ]
    adjusted = adjust(replace(adjustment_inputs, keyframes=renamed, loops=[loop]), AdjustmentConfig()).poses
    for keyframe in keyframes:
        np.testing.assert_allclose(adjusted[keyframe.number][:3, 3], keyframe.T_map_imu[:3, 3], atol=0.1)


def test_same_measurements_give_the_same_bytes(adjustment_inputs: AdjustmentInputs) -> None:
    some = replace(adjustment_inputs, keyframes=adjustment_inputs.keyframes[:40], loops=[])
    first, second = (adjust(some, AdjustmentConfig(iterations=3)).poses for _ in range(2))
    assert all(first[k].tobytes() == second[k].tobytes() for k in first)


def true_camera_poses(
    odometry_flight: "OdometryFlight", adjustment_inputs: AdjustmentInputs, camera: int
) -> dict[int, Array]:
    """Return the true poses (4, 4) of a camera by the numbers of the keyframes."""
    T_imu_cam = adjustment_inputs.calibration.Ts_imu_cam[camera]
    return {each.number: odometry_flight.true_poses[each.t_ns] @ T_imu_cam for each in adjustment_inputs.keyframes}


def exact_landmarks(
    odometry_flight: "OdometryFlight", adjustment_inputs: AdjustmentInputs, keyframes: int
) -> tuple[npt.NDArray[np.int64], Array]:
    """Return landmarks with enough parallax among the first keyframes, and their positions (N, 3) by true poses [m]."""
    true = true_camera_poses(odometry_flight, adjustment_inputs, 0)
    table = ObservationTable.concatenated([each.observations for each in adjustment_inputs.keyframes[:keyframes]])
    table = table[table.camera == 0].by_landmark()
    _, starts, counts = np.unique(table.landmark, return_index=True, return_counts=True)
    T = np.stack([true[k] for k in table.keyframe.tolist()])
    found = triangulate(starts, T[:, :3, :3], T[:, :3, 3], table.xy)
    is_exact = (counts >= 3) & (found.parallax_rad > 0.05)
    return table.landmark[starts][is_exact], found.points[is_exact]


def with_second_camera(
    odometry_flight: "OdometryFlight", adjustment_inputs: AdjustmentInputs, shift: float
) -> AdjustmentInputs:
    """Return the measurements of a rig whose second camera, 11 cm to the right, sees all landmarks that the first sees.

    Args:
        odometry_flight: The flight.
        adjustment_inputs: Its measurements by one camera.
        shift: How far all matches are to the right of the true positions, in normalized coordinates.
    """
    calibration = adjustment_inputs.calibration
    (first,) = calibration.rig.cameras
    second = replace(first, T_imu_cam=first.T_imu_cam @ pose_matrix(np.eye(3), np.array([0.11, 0.0, 0.0])))
    rig = replace(calibration.rig, cameras=(first, second))
    keyframes = adjustment_inputs.keyframes
    inputs = replace(adjustment_inputs, calibration=replace(calibration, rig=rig))
    known, points = exact_landmarks(odometry_flight, adjustment_inputs, len(keyframes))
    true = true_camera_poses(odometry_flight, inputs, 1)
    changed = []
    for keyframe in keyframes:
        table = keyframe.observations[np.isin(keyframe.observations.landmark, known)]
        T = true[keyframe.number]
        in_cam = (points[np.searchsorted(known, table.landmark)] - T[:3, 3]) @ T[:3, :3]
        xy = in_cam[:, :2] / in_cam[:, 2:] + [shift, 0.0]
        matches = replace(table, camera=np.ones_like(table.camera), xy=xy)
        changed.append(replace(keyframe, observations=keyframe.observations + matches))
    return replace(inputs, keyframes=changed)


def seen_again(
    odometry_flight: "OdometryFlight", adjustment_inputs: AdjustmentInputs, moved_m: float = 0.0
) -> tuple[RelativePose, ...]:
    """Return loops from keyframe 5 to late keyframes, with the landmarks of early ones as the late ones see them.

    The poses of the loops are wrong by metres, and not to be used.

    Args:
        odometry_flight: The flight.
        adjustment_inputs: Its measurements.
        moved_m: How far the late keyframes seem to be away from their true positions, upwards [m].
    """
    landmark, points = exact_landmarks(odometry_flight, adjustment_inputs, 12)
    true = true_camera_poses(odometry_flight, adjustment_inputs, 0)
    loops = []
    for second in adjustment_inputs.keyframes[-20::4]:
        T_second = true[second.number]
        in_cam = (points - T_second[:3, 3] - [0.0, 0.0, moved_m]) @ T_second[:3, :3]
        rows = np.flatnonzero(in_cam[:, 2] > 0.5)
        none = np.zeros(len(rows), np.int64)
        xy = in_cam[rows, :2] / in_cam[rows, 2:]
        sigma_px = np.full(len(rows), 0.4 if moved_m == 0.0 else 0.01)
        seen = ObservationTable(landmark[rows], np.full(len(rows), second.number), none, xy, sigma_px, none)
        wrong = pose_matrix(np.eye(3), np.array([3.0, 2.0, 1.0]))
        loops.append(RelativePose(adjustment_inputs.keyframes[5].number, second.number, wrong, 1e-8 * np.eye(6), seen))
    return tuple(loops)


def test_landmarks_that_are_seen_again_take_the_place_of_a_loop(
    odometry_flight: "OdometryFlight", adjustment_inputs: AdjustmentInputs
) -> None:
    """Late keyframes are where they see the early landmarks from, whatever the poses of the loops are."""
    right, moved = (seen_again(odometry_flight, adjustment_inputs, moved_m) for moved_m in (0.0, 0.02))
    assert min(len(loop.observations) for loop in right) > 10
    here, there = (
        adjust(replace(adjustment_inputs, loops=loops), AdjustmentConfig()).poses for loops in (right, moved)
    )
    assert rmse_m(odometry_flight, adjustment_inputs, here) < 0.004
    for loop in right:
        np.testing.assert_allclose((there[loop.second] - here[loop.second])[:3, 3], [0.0, 0.0, 0.02], atol=0.004)
    first = adjustment_inputs.keyframes[5].number
    np.testing.assert_allclose(there[first][:3, 3], here[first][:3, 3], atol=0.004)


def test_an_observation_by_several_loops_counts_once(
    odometry_flight: "OdometryFlight", adjustment_inputs: AdjustmentInputs
) -> None:
    loops = seen_again(odometry_flight, adjustment_inputs)
    once, thrice = (
        adjust(replace(adjustment_inputs, loops=each), AdjustmentConfig()).poses for each in (loops, 3 * loops)
    )
    assert all(once[k].tobytes() == thrice[k].tobytes() for k in once)


def test_common_error_of_stereo_matches_is_estimated(
    odometry_flight: "OdometryFlight", adjustment_inputs: AdjustmentInputs
) -> None:
    """Matches that are all 0.1 px too far to the right change the scale, if the second camera cannot be rotated."""
    some = replace(adjustment_inputs, keyframes=adjustment_inputs.keyframes[:60], loops=())
    exact, shifted = (with_second_camera(odometry_flight, some, shift) for shift in (0.0, 2e-4))
    exact_m, estimated_m, fixed_m = (
        rmse_m(odometry_flight, some, adjust(inputs, AdjustmentConfig(rig_rotation_sigma_deg=sigma_deg)).poses)
        for inputs, sigma_deg in ((exact, 0.0), (shifted, 0.1), (shifted, 0.0))
    )
    assert exact_m < estimated_m < 0.3 * fixed_m, (exact_m, estimated_m, fixed_m)


def test_landmarks_with_few_views_leave_the_imu_alone(
    odometry_flight: "OdometryFlight", adjustment_inputs: AdjustmentInputs
) -> None:
    some = replace(adjustment_inputs, keyframes=adjustment_inputs.keyframes[:5], loops=())
    poses = adjust(some, AdjustmentConfig(min_views=100)).poses
    assert set(poses) == {keyframe.number for keyframe in some.keyframes}
    assert rmse_m(odometry_flight, some, poses) < 0.05


def shaken(odometry_flight: "OdometryFlight", adjustment_inputs: AdjustmentInputs) -> AdjustmentInputs:
    """Return measurements whose camera shakes by 4 mm from keyframe to keyframe, which the IMU does not feel.

    The noise of the IMU is what these measurements suggest, ten times that of the data sheet.
    """
    rng, landmarks = np.random.default_rng(5), exact_landmarks(odometry_flight, adjustment_inputs, 10**6)
    known, points = landmarks
    true, keyframes = true_camera_poses(odometry_flight, adjustment_inputs, 0), []
    for keyframe in adjustment_inputs.keyframes:
        table, T = keyframe.observations, true[keyframe.number]
        table = table[np.isin(table.landmark, known) & (table.camera == 0)]
        in_cam = (points[np.searchsorted(known, table.landmark)] - T[:3, 3] - 0.004 * rng.normal(size=3)) @ T[:3, :3]
        keyframes.append(replace(keyframe, observations=replace(table, xy=in_cam[:, :2] / in_cam[:, 2:])))
    params = adjustment_inputs.params
    sheet = odometry_flight.flight.rig.imu
    noisy = params.with_noise(params.gyro_variance**0.5, 10.0 * sheet.accel_noise_density)
    return replace(adjustment_inputs, keyframes=keyframes, loops=(), params=noisy)


def test_the_odometry_keeps_the_scale_of_a_shaking_camera(
    odometry_flight: "OdometryFlight", adjustment_inputs: AdjustmentInputs
) -> None:
    """The accelerations by the images are noisy, so that their regression on those by the IMU is attenuated."""
    measured = shaken(odometry_flight, adjustment_inputs)
    true = {k.number: odometry_flight.true_poses[k.t_ns] for k in measured.keyframes}

    def size(inputs: AdjustmentInputs, scale: Scale) -> float:
        adjusted = adjust(inputs, AdjustmentConfig(), scale).poses
        p = np.array([(adjusted[number][:3, 3], T[:3, 3]) for number, T in true.items()])
        adjusted_m, true_m = np.linalg.norm(p - p.mean(axis=0), axis=(0, 2))
        return float(adjusted_m / true_m)

    by_imu, by_odometry = (size(measured, scale) for scale in Scale)
    assert by_imu < 0.97 and abs(by_odometry - 1.0) < 0.01, (by_imu, by_odometry)
    # Each of its two parts counts: long intervals alone help, and an odometry of another scale changes it.
    alone = [replace(k, estimate=replace(k.estimate, next_t_ns=0)) for k in measured.keyframes]
    assert size(replace(measured, keyframes=alone), Scale.ODOMETRY) > by_imu + 0.01
    larger = []
    for k in measured.keyframes:
        T = k.estimate.T_imu_next.copy()
        T[:3, 3] *= 1.02
        larger.append(replace(k, estimate=replace(k.estimate, T_imu_next=T)))
    assert size(replace(measured, keyframes=larger), Scale.ODOMETRY) > by_odometry + 0.005


def test_relative_poses_are_those_of_consecutive_keyframes(adjustment_inputs: AdjustmentInputs) -> None:
    """Not across a keyframe that has not joined the map, nor between two tracks."""
    keyframes = [replace(k, number=i, track=int(i >= 4)) for i, k in enumerate(adjustment_inputs.keyframes[10:17])]
    left_out = [*keyframes[:1], *keyframes[2:]]
    assert [(each.first, each.second) for each in _odometry(left_out)] == [(2, 3), (4, 5), (5, 6)]
    found = _odometry(left_out)[0]
    np.testing.assert_array_equal(found.T_first_second, keyframes[2].estimate.T_imu_next)
    np.testing.assert_array_equal(found.covariance, keyframes[2].estimate.relative_covariance)


def test_imu_intervals_end_with_the_track(adjustment_inputs: AdjustmentInputs) -> None:
    """Keyframes 0.2 s apart: intervals of 1 s, the last one of a track shorter, and none between two tracks."""
    known = adjustment_inputs.keyframes[0]
    keyframes = [replace(known, number=i, t_ns=200_000_000 * i, track=int(i >= 8)) for i in range(15)]
    found = [(first.number, second.number) for first, second in _imu_intervals(keyframes, 1.0)]
    assert found == [(0, 5), (5, 7), (8, 13), (13, 14)]
    every = [(first.number, second.number) for first, second in _imu_intervals(keyframes, 0.0)]
    assert every == [(i, i + 1) for i in range(14) if i != 7]
    assert list(_imu_intervals(keyframes[:1], 0.0)) == []


def reloaded(adjustment_inputs: AdjustmentInputs, true: Mapping[int, Array], *, is_fixed: bool) -> AdjustmentInputs:
    """Return a flight, the second half, in the loaded map of the first half, whose poses are true.

    Landmarks that both halves see connect them. The flight begins at another place.
    """
    half, carried = 40, pose_matrix(exp_so3(np.array([0.0, 0.0, 0.02])), np.array([0.1, 0.0, 0.0]))
    old, new = adjustment_inputs.keyframes[:half], adjustment_inputs.keyframes[half:]
    poses = {k.number: true[k.t_ns] for k in old}
    edges = tuple(RelativePose(a, b, inverse_pose(poses[a]) @ poses[b], 1e-8 * np.eye(6)) for a, b in pairwise(poses))
    fixed = tuple(poses) if is_fixed else ()
    graph = PoseGraph(old[0].number, 1e-8 * np.eye(6), poses, () if is_fixed else edges, fixed=fixed)
    connected = np.unique(np.concatenate([k.observations.landmark for k in new]))
    table = ObservationTable.concatenated([k.observations for k in old])
    # Some saved keyframes have no landmark in common with the flight.
    table = table[np.isin(table.landmark, connected) & (table.keyframe >= old[half // 2].number)]
    moved = [replace(k, T_map_imu=carried @ true[k.t_ns]) for k in new]
    return replace(adjustment_inputs, keyframes=moved, loops=[], first=graph.first, saved=SavedKeyframes(graph, table))


@pytest.mark.parametrize("is_fixed", [False, True])
def test_flight_in_a_loaded_map(
    odometry_flight: "OdometryFlight", adjustment_inputs: AdjustmentInputs, is_fixed: bool
) -> None:
    """Landmarks in common put the flight where it is in the map, whose keyframes stay."""
    true = odometry_flight.true_poses
    inputs = reloaded(adjustment_inputs, true, is_fixed=is_fixed)
    assert inputs.saved is not None
    adjusted = adjust(inputs, AdjustmentConfig(iterations=40, max_error_px=100.0)).poses
    assert set(adjusted) == {k.number for k in adjustment_inputs.keyframes}
    for number, T in inputs.saved.graph.poses.items():
        np.testing.assert_allclose(adjusted[number], T, atol=0.0 if is_fixed else 2e-3)
    error_m = [np.linalg.norm((adjusted[k.number] - true[k.t_ns])[:3, 3]) for k in inputs.keyframes]
    assert max(error_m) < 0.01, max(error_m)  # 0.1 m and more before
