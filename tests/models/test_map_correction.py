"""Interpolation of the correction of the odometry between the keyframes of the map."""

import numpy as np
import pytest

from dronevio.models.map_correction import MapCorrection
from dronevio.models.rotation import exp_so3, pose_matrix, rotation_z
from dronevio.models.state import Trajectory

TIMES_NS = np.array([0, 100, 300], np.int64)


@pytest.fixture
def correction() -> MapCorrection:
    """Return a correction at three keyframes: none, by 0.2 rad about z, and by 1 m along x."""
    R = np.stack([np.eye(3), rotation_z(0.2), rotation_z(0.2)])
    return MapCorrection(TIMES_NS, pose_matrix(R, np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])))


def test_correction_is_exact_at_keyframes(correction: MapCorrection) -> None:
    np.testing.assert_allclose(correction.at(TIMES_NS), correction.Ts_map_odom, atol=1e-15)


def test_correction_is_linear_between_keyframes(correction: MapCorrection) -> None:
    first, second = correction.at(np.array([25, 150], np.int64))
    np.testing.assert_allclose(first[:3, :3], rotation_z(0.05), atol=1e-12)
    np.testing.assert_allclose(second[:3, 3], [0.25, 0.0, 0.0], atol=1e-15)


def test_correction_is_constant_outside(correction: MapCorrection) -> None:
    before, after = correction.at(np.array([-50, 900], np.int64))
    np.testing.assert_allclose(before, correction.Ts_map_odom[0], atol=1e-15)
    np.testing.assert_allclose(after, correction.Ts_map_odom[-1], atol=1e-15)


def test_single_keyframe_corrects_all_times() -> None:
    T = pose_matrix(exp_so3(np.array([0.1, -0.2, 0.3])), np.array([1.0, 2.0, 3.0]))
    single = MapCorrection(TIMES_NS[:1], T[None])
    np.testing.assert_array_equal(single.at(TIMES_NS), np.tile(T, (3, 1, 1)))


def test_applied_correction_maps_the_poses(correction: MapCorrection) -> None:
    rng = np.random.default_rng(0)
    odometry = Trajectory(TIMES_NS, rng.normal(size=(3, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (3, 1)), np.ones((3, 3)))
    mapped = odometry.corrected(correction)
    expected = correction.Ts_map_odom @ odometry.Ts_world_imu
    np.testing.assert_allclose(mapped.Ts_world_imu, expected, atol=1e-12)
    assert mapped.velocity_m_s is None and mapped.covariance is None


def test_a_track_is_joined_by_its_keyframes(correction: MapCorrection) -> None:
    empty = MapCorrection.empty()
    assert empty.of_track(0, 50) is None and np.isnan(empty.at(TIMES_NS)).all()
    lost = correction.with_track(200)
    assert lost.of_track(1, 250) is None
    for t_ns in (-5, 25, 100, 250, 400):  # also at times of the other track
        np.testing.assert_array_equal(lost.of_track(0, t_ns), correction.at(np.array([t_ns]))[0])
    np.testing.assert_array_equal(np.isnan(lost.at(TIMES_NS)[:, 0, 0]), [False, False, True])


def test_tracks_begin_one_after_another(correction: MapCorrection) -> None:
    starts_ns = correction.with_track(200).with_track(200).starts_ns
    assert starts_ns is not None and np.all(np.diff(starts_ns) > 0)
