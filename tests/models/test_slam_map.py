"""The map as arrays: checks, closed loops and the correction."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from dronevio.models.errors import ConfigError
from dronevio.models.rotation import pose_matrix, rotation_z
from dronevio.models.slam_map import SlamMap


@pytest.fixture
def slam_map() -> SlamMap:
    """Three keyframes in a row, of which the map shifts the last one by 0.1 m and turns it by 90 degrees."""
    Ts_odom = pose_matrix(np.tile(np.eye(3), (3, 1, 1)), np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0]]))
    Ts_map = Ts_odom.copy()
    Ts_map[2] = pose_matrix(rotation_z(np.pi / 2), np.array([2.0, 0.1, 0.0]))
    loops = np.array([[0, 1], [0, 2]])
    return SlamMap(
        np.array([0, 10, 20]),
        Ts_map,
        Ts_odom,
        loops,
        Ts_odom[[1, 2]],
        np.array([True, False]),
        np.zeros((5, 3)),
        track=np.array([0, 0, 2]),
        starts_ns=np.array([-100, 12, 18]),
    )


def test_correction_maps_the_odometry_to_the_map(slam_map: SlamMap) -> None:
    np.testing.assert_allclose(slam_map.correction.Ts_map_odom @ slam_map.Ts_odom_imu, slam_map.Ts_map_imu, atol=1e-12)
    np.testing.assert_allclose(slam_map.correction.Ts_map_odom[2][:3, 3], [2.0, -1.9, 0.0], atol=1e-12)


def test_closed_loops_are_those_that_are_not_rejected(slam_map: SlamMap) -> None:
    assert slam_map.closed.tolist() == [[0, 2]]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"points": np.zeros((5, 2))}, r"points has shape \(5, 2\); expected \(5, 3\)"),
        ({"rejected": np.zeros(3, bool)}, r"rejected has shape \(3,\); expected \(2,\)"),
        ({"Ts_map_imu": np.zeros((2, 4, 4))}, r"Ts_map_imu has shape \(2, 4, 4\)"),
        ({"t_ns": np.array([0, 20, 20])}, "do not increase"),
        ({"loops": np.array([[0, 1], [0, 3]])}, "keyframe 3; expected one of the 3"),
        ({"track": np.array([0, 2, 1])}, "tracks do not increase"),
        ({"starts_ns": np.array([-100, 12, 12])}, "tracks do not increase"),
        ({"track": np.array([0, 0, 3])}, "track 3; expected one of the 3"),
        ({"track": np.array([-1, 0, 0])}, "track -1; expected one of the 3"),
        ({"loops": np.array([[-1, 1], [0, 2]])}, "keyframe -1; expected one of the 3"),
    ],
)
def test_wrong_maps_are_refused(slam_map: SlamMap, change: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        replace(slam_map, **change)
