"""The script that measures reloaded maps: what a flight made of a map, in the frame of the flight that was mapped."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from dronevio.eval.run import EstimatorRun
from dronevio.models.errors import ConfigError
from dronevio.models.recordings.open import open_recording
from dronevio.models.rotation import inverse_pose, pose_matrix, rotation_z
from dronevio.models.slam_map import SlamMap
from dronevio.models.state import Estimate, Health, NavState, Trajectory

S = 1_000_000_000
T_WORLD_MAP = pose_matrix(rotation_z(0.7), np.array([3.0, -1.0, 0.5]))
T_MAP_ODOM = pose_matrix(rotation_z(-2.0), np.array([0.0, 4.0, 1.0]))
N = 8


@pytest.fixture(scope="module")
def reloaded(script: Callable[[str], Any]) -> Any:
    """The script."""
    return script("reloaded_maps")


def true_poses() -> np.ndarray[Any, Any]:
    """True poses in the world, one second apart, on a curve."""
    Ts = np.tile(np.eye(4), (N, 1, 1))
    Ts[:, :3, 3] = np.stack([np.arange(N), np.sin(np.arange(N)), 0.1 * np.arange(N)], axis=1)
    return Ts


def truth() -> Trajectory:
    """The ground truth."""
    zero = np.zeros(3)
    return Trajectory.from_states(NavState(i * S, T, zero, zero, zero) for i, T in enumerate(true_poses()))


def flight(joined_at: int, error_m: float = 0.0) -> EstimatorRun:
    """Estimates whose poses are in the map from a frame on, where height errs, twice as much at the last frame."""
    T_odom_world, estimates = inverse_pose(T_WORLD_MAP @ T_MAP_ODOM), []
    for i, T in enumerate(true_poses()):
        state = NavState(i * S, T_odom_world @ T, np.zeros(3), np.zeros(3), np.zeros(3))
        T_map_odom = T_MAP_ODOM.copy()
        T_map_odom[2, 3] += 2.0 * error_m if i == N - 1 else error_m
        estimate = Estimate(i * S, Health.TRACKING, state, T_map_odom=T_map_odom)
        estimates.append(estimate if i >= joined_at else replace(estimate, T_map_odom=None))
    return EstimatorRun(tuple(estimates), np.ones(N), np.ones(N))


def with_map(run: EstimatorRun) -> EstimatorRun:
    """A run whose map has two keyframes of an earlier flight, and all frames of this one, with five loops."""
    eye = np.tile(np.eye(4), (N + 2, 1, 1))
    mapped = np.concatenate([eye[:2], inverse_pose(T_WORLD_MAP) @ true_poses()])
    odometry = np.concatenate([eye[:2], inverse_pose(T_WORLD_MAP @ T_MAP_ODOM) @ true_poses()])
    return replace(
        run,
        map=SlamMap(
            t_ns=np.concatenate([[-3 * S, -2 * S], run.t_ns]),
            Ts_map_imu=mapped,
            Ts_odom_imu=odometry,
            loops=np.array([[0, 1], [0, 2], [0, 5], [3, 8], [1, 9]]),
            Ts_then_now=eye[:5],
            rejected=np.array([False, False, False, True, False]),
            points=np.zeros((0, 3)),
            track=np.repeat([0, 1], [2, N]),
            starts_ns=np.array([-10 * S, -S]),
            adjustment="scale by the IMU",
        ),
    )


def test_errors_are_in_the_frame_of_the_file(reloaded: Any) -> None:
    in_world, final_m = reloaded.map_frame_in_world(with_map(flight(0)), truth())
    assert final_m == pytest.approx(0.0, abs=1e-9)
    np.testing.assert_allclose(in_world.R_truth_estimate, T_WORLD_MAP[:3, :3], atol=1e-9)
    np.testing.assert_allclose(in_world.t_m, T_WORLD_MAP[:3, 3], atol=1e-9)
    found = reloaded.outcome_of(with_map(flight(joined_at=4, error_m=0.03)), truth(), in_world)
    assert (found.joined_s, found.loops) == (4.0, 3)  # one loop is of the first flight, and one is rejected
    assert found.first_error_m == pytest.approx(0.03)
    assert found.rmse_m == pytest.approx(np.sqrt((3 * 0.03**2 + 0.06**2) / 4))  # a constant offset remains
    assert found.odometry_m == pytest.approx(0.0, abs=1e-9)
    assert found.final_m == pytest.approx(0.0, abs=1e-9)  # where the map has the true poses
    assert tuple(reloaded.row_of("light", 10.0, found).values()) == (
        *("`light`", "10", "4.00", "30.0", "39.7", "0.0", "3", "0.0"),
        "scale by the IMU",
    )


def test_time_until_joined_begins_with_the_odometry(reloaded: Any) -> None:
    in_world, _ = reloaded.map_frame_in_world(with_map(flight(0)), truth())
    joined = flight(joined_at=4)
    initializing = tuple(Estimate(t_ns, Health.INITIALIZING, None) for t_ns in (0, S))
    found = reloaded.outcome_of(replace(joined, estimates=(*initializing, *joined.estimates[2:])), truth(), in_world)
    assert found.joined_s == 2.0


def test_a_flight_that_is_not_joined_has_no_errors(reloaded: Any) -> None:
    in_world, _ = reloaded.map_frame_in_world(with_map(flight(0)), truth())
    found = reloaded.outcome_of(flight(joined_at=N), truth(), in_world)
    assert (found.joined_s, found.first_error_m, found.rmse_m, found.loops) == (None, None, None, 0)
    assert tuple(reloaded.row_of("far", 0.0, found).values())[2:7] == ("–", "–", "–", "–", "0")


def test_a_map_of_another_world_is_refused(reloaded: Any, flown: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reloaded, "world_of", lambda folder: ("room", len(folder.name)))
    with pytest.raises(ConfigError, match="is in another world than"):
        reloaded.main(reloaded.ReloadedMapsCommand(flown.folder, (flown.folder / "other",)))


@pytest.mark.slow
def test_the_same_flight_finds_its_own_map(reloaded: Any, flown: Any, capsys: pytest.CaptureFixture[str]) -> None:
    reloaded.main(reloaded.ReloadedMapsCommand(flown.folder, (flown.folder,), starts_s=(0.0,)))
    printed = capsys.readouterr().out.splitlines()
    assert printed[0].startswith("Final path of the first flight: RMSE ")
    row = [cell.strip() for cell in printed[-1].strip("|").split("|")]
    assert 0.0 < float(row[2]) < 4.0 and float(row[3]) < 20.0 and int(row[6]) > 0


def test_the_beginning_of_a_recording(reloaded: Any, flown: Any) -> None:
    whole = open_recording(flown.folder, 1)
    begun = reloaded.beginning(whole, 1.0)
    count, end_ns = len(begun.frame_times_ns), whole.frame_times_ns[0] + S
    assert 0 < count < len(whole.frame_times_ns) and whole.frame_times_ns[count] >= end_ns > begun.frame_times_ns[-1]
    assert begun.imu.t_ns[-1] < end_ns <= whole.imu.t_ns[len(begun.imu)]
    assert begun.ground_truth.t_ns[-1] < end_ns and begun.frame(0).t_ns == whole.frame(0).t_ns
