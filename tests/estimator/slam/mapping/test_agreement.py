"""The comparison of an adjusted map with the odometry, by hand."""

from dataclasses import replace

import numpy as np
import pytest

from dronevio.estimator.backend.observations import NO_OBSERVATIONS
from dronevio.estimator.slam.adjustment.agreement import (
    ACCEL_BIAS_SIGMA_M_S2,
    SCALE_SIGMA,
    TILT_SIGMA_DEG,
    Difference,
    differences,
    odometry_scale_sigma,
)
from dronevio.estimator.slam.adjustment.bundle_adjustment import (
    AdjustedMap,
    AdjustmentInputs,
    AdjustmentKeyframe,
    SavedKeyframes,
    Scale,
)
from dronevio.estimator.slam.map.odometry_factors import RelativePose
from dronevio.estimator.slam.map.pose_graph import PoseGraph
from dronevio.models.rotation import exp_so3, inverse_pose, pose_matrix


def straight(adjustment_inputs: AdjustmentInputs, sigmas_m: tuple[float, ...]) -> list[AdjustmentKeyframe]:
    """Return keyframes every 4 m along x, whose x, and x alone, has given standard deviations."""
    known, keyframes = adjustment_inputs.keyframes[0], []
    for i, sigma_m in enumerate(sigmas_m):
        T, P = pose_matrix(np.eye(3), np.array([4.0 * i, 0.0, 0.0])), np.zeros((6, 6))
        P[3, 3] = sigma_m**2
        estimate = replace(known.estimate, T_odom_imu=T, covariance=P)
        keyframes.append(replace(known, number=i, T_map_imu=T, estimate=estimate, bias_covariance=np.zeros((6, 6))))
    return keyframes


def found(
    keyframes: list[AdjustmentKeyframe], inputs: AdjustmentInputs, adjusted: AdjustedMap
) -> dict[str, Difference]:
    """Return the differences by their names."""
    return {each.name: each for each in differences(replace(inputs, keyframes=keyframes), adjusted)}


def test_scale_of_the_odometry_is_known_where_it_is_known_best(adjustment_inputs: AdjustmentInputs) -> None:
    keyframes = straight(adjustment_inputs, (0.0, 0.04, 0.024, 0.12))
    assert odometry_scale_sigma(keyframes) == pytest.approx(0.003)  # 24 mm of 8 m
    assert odometry_scale_sigma(keyframes[:1]) is None
    across = [
        replace(k, estimate=replace(k.estimate, covariance=np.roll(k.estimate.covariance, 1, (0, 1))))
        for k in keyframes
    ]
    assert odometry_scale_sigma(across) == 0.0  # what is unknown across the direction says nothing of the scale


def test_differences_by_hand(adjustment_inputs: AdjustmentInputs) -> None:
    keyframes = straight(adjustment_inputs, (0.0, 0.04, 0.024, 0.12))
    newest, up = keyframes[-1], exp_so3(np.array([np.radians(0.25), 0.0, 0.0]))
    poses = {k.number: pose_matrix(up, 1.02 * k.T_map_imu[:3, 3]) for k in keyframes}
    accel_bias = newest.accel_bias_m_s2 + [0.0, 0.03, 0.0]
    by_name = found(keyframes, adjustment_inputs, AdjustedMap(poses, newest.gyro_bias_rad_s, accel_bias, Scale.IMU))
    scale, tilt, bias = (by_name[name] for name in ("scale", "inclination", "accelerometer bias"))
    assert scale.value == pytest.approx(2.0) and scale.sigma == pytest.approx(100.0 * np.hypot(0.003, SCALE_SIGMA))
    assert not scale.agrees and str(scale).startswith("scale differs by +2 % from that of the odometry")
    assert tilt.value == pytest.approx(0.25) and tilt.sigma == pytest.approx(TILT_SIGMA_DEG) and tilt.agrees
    assert bias.value == pytest.approx(0.03) and bias.sigma == pytest.approx(ACCEL_BIAS_SIGMA_M_S2) and bias.agrees
    assert by_name["gyroscope bias"].value == 0.0


def test_a_short_path_has_no_scale(adjustment_inputs: AdjustmentInputs) -> None:
    keyframes = straight(adjustment_inputs, (0.0, 0.04))
    newest, poses = keyframes[-1], {k.number: k.T_map_imu for k in keyframes}
    adjusted = AdjustedMap(poses, newest.gyro_bias_rad_s, newest.accel_bias_m_s2, Scale.IMU)
    assert "scale" not in found(keyframes, adjustment_inputs, adjusted)  # 4 m


def test_only_the_newest_track_is_compared(adjustment_inputs: AdjustmentInputs) -> None:
    """Its odometry frame is not that of the keyframes before it."""
    keyframes = straight(adjustment_inputs, (0.0, 0.04, 0.024, 0.12, 0.1))
    poses = {k.number: k.T_map_imu for k in keyframes}
    poses[0] = pose_matrix(np.eye(3), np.array([100.0, 0.0, 0.0]))
    keyframes = [replace(k, track=int(k.number > 0)) for k in keyframes]
    newest = keyframes[-1]
    adjusted = AdjustedMap(poses, newest.gyro_bias_rad_s, newest.accel_bias_m_s2, Scale.IMU)
    assert found(keyframes, adjustment_inputs, adjusted)["scale"].value == pytest.approx(0.0)


@pytest.mark.parametrize(("offset_m", "agrees"), [(0.02, True), (0.2, False)])
def test_loops_with_a_loaded_map_by_hand(adjustment_inputs: AdjustmentInputs, offset_m: float, agrees: bool) -> None:
    """One of two loops is fulfilled, and the other one misses by an offset, of which 1 cm is a standard deviation."""
    keyframes = straight(adjustment_inputs, (0.0, 0.04, 0.024, 0.12))
    newest, T_saved = keyframes[-1], pose_matrix(exp_so3(np.array([0.0, 0.0, 0.3])), np.array([1.0, 2.0, 0.0]))
    poses = {-1: T_saved, **{k.number: k.T_map_imu for k in keyframes}}
    measured = [inverse_pose(T_saved) @ poses[number] for number in (1, 2)]
    measured[1] = measured[1] @ pose_matrix(np.eye(3), np.array([offset_m, 0.0, 0.0]))
    loops = [RelativePose(-1, i + 1, T, 1e-4 * np.eye(6)) for i, T in enumerate(measured)]
    loops.append(RelativePose(0, 3, np.eye(4), 1e-4 * np.eye(6)))  # within the flight
    saved = SavedKeyframes(PoseGraph(-1, np.eye(6), {-1: T_saved}), NO_OBSERVATIONS)
    inputs = replace(adjustment_inputs, loops=loops, saved=saved)
    adjusted = AdjustedMap(poses, newest.gyro_bias_rad_s, newest.accel_bias_m_s2, Scale.IMU)
    difference = found(keyframes, inputs, adjusted)["pose"]
    assert difference.value == pytest.approx(np.sqrt((offset_m / 0.01) ** 2 / 12)) and difference.agrees == agrees
    assert "from the loops with the loaded map" in str(difference)
    assert "pose" not in found(keyframes, replace(inputs, saved=None), adjusted)
