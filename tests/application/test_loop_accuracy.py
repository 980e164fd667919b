"""The script that measures what loops do to the accuracy: right and wrong loops, recall, and errors after revisits."""

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from dronevio.eval.metrics.revisits import Views, find_revisits
from dronevio.models.camera import CameraModel
from dronevio.models.rig import RigCamera
from dronevio.models.rotation import inverse_pose, pose_matrix, rotation_z
from dronevio.models.slam_map import SlamMap

CAMERA = CameraModel(640, 480, 400.0, 400.0, 319.5, 239.5)
T_IMU_CAM = pose_matrix(rotation_z(0.3), np.array([0.1, 0.0, 0.05]))


@pytest.fixture(scope="module")
def loop_accuracy(script: Callable[[str], Any]) -> Any:
    """The script."""
    return script("loop_accuracy")


@pytest.fixture
def views() -> Views:
    """Five keyframes before a wall at 5 m, 20 s and 10 m of path apart; the third and the fourth are at the first."""
    Ts = np.tile(np.eye(4), (5, 1, 1)).astype(np.float64)
    Ts[:, 0, 3] = [0.0, 10.0, 0.0, 0.1, 20.0]
    t_ns = np.array([0, 20, 40, 60, 80]) * 1_000_000_000
    rays = CAMERA.unproject(np.stack(np.meshgrid(np.arange(16) * 40.0, np.arange(12) * 40.0), axis=-1))
    return Views(
        t_ns, np.linspace(0.0, 40.0, 5), Ts, CAMERA, np.asarray(np.tile(5.0 / rays[..., 2], (5, 1, 1)), np.float64)
    )


@pytest.fixture
def slam_map(views: Views) -> SlamMap:
    """A map with a right loop of the third keyframe, a wrong one of the fourth, and a rejected one that is right."""
    Ts_imu = views.Ts_world_cam @ inverse_pose(T_IMU_CAM)
    rows = np.array([[0, 2], [0, 3], [2, 3]])
    measured = inverse_pose(Ts_imu[rows[:, 0]]) @ Ts_imu[rows[:, 1]]
    measured[1, 1, 3] += 0.2  # more than 5 cm and 2 % of 5 m
    rejected, starts_ns = np.array([False, False, True]), np.array([-1])
    tracks = np.zeros(5, np.int64)
    return SlamMap(views.t_ns, Ts_imu, Ts_imu, rows, measured, rejected, np.zeros((0, 3)), tracks, starts_ns)


def test_wrong_loops_are_counted_by_hand(loop_accuracy: Any, views: Views, slam_map: SlamMap) -> None:
    revisits = find_revisits(views)
    assert np.flatnonzero(revisits.revisiting).tolist() == [2, 3]
    quality = loop_accuracy.loop_quality(slam_map, views, revisits, RigCamera(CAMERA, T_IMU_CAM))
    assert (quality.loops, quality.wrong, quality.first_revisit_ns) == (2, 1, 40_000_000_000)
    assert quality.recall == pytest.approx(0.5)  # the wrong loop does not count


def test_a_map_without_loops_has_no_recall(loop_accuracy: Any, views: Views, slam_map: SlamMap) -> None:
    none = replace(slam_map, rejected=np.ones(3, dtype=bool))
    quality = loop_accuracy.loop_quality(none, views, find_revisits(views), RigCamera(CAMERA, T_IMU_CAM))
    assert (quality.loops, quality.wrong, quality.recall) == (0, 0, 0.0)


def test_errors_count_from_a_time_on(loop_accuracy: Any) -> None:
    scored = SimpleNamespace(
        translation_error_m=np.array([9.0, 3.0, 4.0]), truth=SimpleNamespace(t_ns=np.array([0, 10, 20]))
    )
    assert loop_accuracy.rmse_after_m(scored, 10) == pytest.approx(np.sqrt(12.5))
    assert loop_accuracy.rmse_after_m(scored, None) == pytest.approx(np.sqrt(106.0 / 3.0))
    assert np.isnan(loop_accuracy.rmse_after_m(scored, 30))


def test_keyframes_are_those_of_the_nearest_frames(loop_accuracy: Any) -> None:
    frames = np.array([100, 200, 300])
    assert loop_accuracy.nearest_frames(np.array([90, 149, 151, 205, 400]), frames).tolist() == [
        100,
        100,
        200,
        200,
        300,
    ]
