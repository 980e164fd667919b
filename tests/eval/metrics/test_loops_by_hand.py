"""Right and wrong loops, recall, and errors after the first revisit."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from dronevio.eval.metrics.loops import (
    FlightRevisits,
    LoopQuality,
    loop_quality,
    rmse_after_revisit_m,
)
from dronevio.eval.metrics.revisits import Views, find_revisits
from dronevio.models.camera import CameraModel
from dronevio.models.rig import RigCamera
from dronevio.models.rotation import inverse_pose, pose_matrix, rotation_z
from dronevio.models.slam_map import SlamMap

CAMERA = CameraModel(640, 480, 400.0, 400.0, 319.5, 239.5)
T_IMU_CAM = pose_matrix(rotation_z(0.3), np.array([0.1, 0.0, 0.05]))
CAMERA_ON_IMU = RigCamera(CAMERA, T_IMU_CAM)


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


@pytest.fixture
def revisits(views: Views) -> FlightRevisits:
    """The revisits of the keyframes."""
    return FlightRevisits(40_000_000_000, views, find_revisits(views).revisiting)


def test_wrong_loops_are_counted_by_hand(slam_map: SlamMap, revisits: FlightRevisits) -> None:
    assert np.flatnonzero(revisits.revisiting).tolist() == [2, 3]
    assert loop_quality(slam_map, revisits, CAMERA_ON_IMU) == LoopQuality(2, 1, 0.5)  # the wrong loop does not count


def test_a_map_without_loops_has_no_recall(slam_map: SlamMap, revisits: FlightRevisits) -> None:
    none = replace(slam_map, rejected=np.ones(3, dtype=bool))
    assert loop_quality(none, revisits, CAMERA_ON_IMU) == LoopQuality(0, 0, 0.0)


def test_errors_count_later_than_two_seconds() -> None:
    t_ns = 1_000_000_000 * np.array([0, 1, 3, 4])
    truth = SimpleNamespace(t_ns=t_ns)
    scored: Any = SimpleNamespace(translation_error_m=np.array([9.0, 7.0, 3.0, 4.0]), truth=truth)
    assert rmse_after_revisit_m(scored, 500_000_000) == pytest.approx(np.sqrt(12.5))
    assert rmse_after_revisit_m(scored, 1_000_000_000) == pytest.approx(4.0)  # not the one exactly two seconds later
    assert rmse_after_revisit_m(scored, None) == pytest.approx(np.sqrt(155.0 / 4.0))
    assert rmse_after_revisit_m(scored, 3_000_000_000) is None


def test_some_of_the_views_are_those_of_their_rows(views: Views) -> None:
    chosen = views[np.array([1, 3])]
    assert chosen.t_ns.tolist() == [20_000_000_000, 60_000_000_000] and chosen.path_m.tolist() == [10.0, 30.0]
    assert chosen.Ts_world_cam[:, 0, 3].tolist() == [10.0, 0.1] and chosen.ranges_m.shape == (2, 12, 16)
    assert len(views[1:]) == 4 and len(views[views.path_m > 25.0]) == 2
