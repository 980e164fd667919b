"""GTSAM's equivariant filter as an estimator, on synthetic flights."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from dronevio.estimator.baselines.eqvio import (
    EquivariantConfig,
    EquivariantFilter,
    EquivariantOdometry,
    FilterSettings,
    shortest_rotation_to_z,
)
from dronevio.estimator.imu.buffer import Increments
from dronevio.eval.metrics.alignment import align
from dronevio.models.imu import GRAVITY_M_S2, ImuSamples
from dronevio.models.protocols import Estimator, measurements
from dronevio.models.rig import euroc_rig
from dronevio.models.state import CameraFrame, Estimate, Health, Trajectory

MakeFlight = Callable[..., Any]  # tests/estimator/conftest.py has the class


def run(flight: Any) -> list[Estimate]:
    """Run the estimator over a synthetic flight, and return an estimate for each frame."""
    estimator: Estimator = EquivariantOdometry(flight.rig, EquivariantConfig(), flight.front_end())
    estimates = []
    for measurement in measurements(flight):
        if isinstance(measurement, ImuSamples):
            estimator.add_imu(measurement)
        else:
            estimates.append(estimator.add_frame(measurement))
    return estimates


@pytest.mark.parametrize(
    "up",
    [[-0.7, -0.2, 1.7], [0.7, -1.6, -0.4], [-0.6, 0.6, 1.7], [-0.2, -0.5, -1.0], [0.0, 0.0, 9.8], [0.0, 0.0, -9.8]],
)
def test_shortest_rotation_maps_up_to_z(up: list[float]) -> None:
    R = shortest_rotation_to_z(np.array(up))
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(R @ np.array(up), np.array([0.0, 0.0, np.linalg.norm(up)]), atol=1e-12)
    cosine = up[2] / np.linalg.norm(up)
    assert np.linalg.det(R) == pytest.approx(1.0) and (np.trace(R) - 1.0) / 2.0 == pytest.approx(cosine)


def test_filter_starts_with_the_shortest_rotation_to_z() -> None:
    """An acceleration along one axis of the IMU reveals the filter's attitude by its direction in the world."""
    up, dt_s = np.array([3.0, -2.0, 9.0]), np.full(20, 0.01)
    gravity_imu = GRAVITY_M_S2 * up / np.linalg.norm(up)
    for axis in np.eye(3):
        running = EquivariantFilter(np.eye(4), FilterSettings(), up)
        running.predict(Increments(dt_s, np.zeros((20, 3)), np.tile(gravity_imu + axis, (20, 1))))
        np.testing.assert_allclose(
            running.velocity_imu_m_s, 0.2 * axis, atol=1e-3
        )  # the filter's gravity is 9.80665 m/s²
        np.testing.assert_allclose(running.position_m, 0.02 * shortest_rotation_to_z(up) @ axis, atol=0.0011)


def test_estimate_is_near_the_truth(make_flight: MakeFlight) -> None:
    flight = make_flight(seed=1, max_features=24, duration_s=9.0)
    estimates = run(flight)
    states = [e.state for e in estimates if e.state is not None]
    assert 0.7 < (states[0].t_ns - flight.frame_times_ns[0]) * 1e-9 < 1.2
    assert {e.health for e in estimates} == {Health.INITIALIZING, Health.TRACKING}
    estimate, truth = Trajectory.from_states(states), flight.truth_at(np.array([s.t_ns for s in states]))
    fit = align(truth.p_world_imu, estimate.p_world_imu, "yaw")
    error_m = np.linalg.norm(truth.p_world_imu - fit.positions(estimate.p_world_imu), axis=1)
    assert truth.length_m > 6.0 and np.sqrt(np.mean(error_m**2)) < 0.2
    assert estimate.velocity_m_s is not None and truth.velocity_m_s is not None
    speeds = np.linalg.norm(estimate.velocity_m_s, axis=1), np.linalg.norm(truth.velocity_m_s, axis=1)
    assert np.sqrt(np.mean((speeds[0] - speeds[1]) ** 2)) < 0.15


def test_dark_frames_leave_the_imu_alone(make_flight: MakeFlight) -> None:
    estimates = run(make_flight(seed=1, max_features=24, duration_s=4.0, dark_s=(3.0, 3.5)))
    health = np.array([e.health for e in estimates])
    assert np.all(health[61:70] == Health.INERTIAL_ONLY)
    assert health[-1] == Health.TRACKING


def test_without_a_stationary_phase_it_does_not_start(make_flight: MakeFlight) -> None:
    estimates = run(make_flight(rest_s=-5.0, duration_s=3.0))
    assert all(e.health == Health.INITIALIZING and e.state is None for e in estimates)
    assert estimates[-1].health_report is not None and "0.8 s are needed" in estimates[-1].health_report.reason


def test_divergence_is_final(make_flight: MakeFlight, monkeypatch: pytest.MonkeyPatch) -> None:
    speeds = iter([*np.linspace(0.0, 59.0, 20).tolist(), np.nan, *np.zeros(100)])
    monkeypatch.setattr(
        EquivariantFilter, "velocity_imu_m_s", property(lambda self: np.array([next(speeds), 0.0, 0.0]))
    )
    health = [e.health for e in run(make_flight(duration_s=3.0, max_features=12))]
    first = health.index(Health.LOST)
    assert health[first - 20 : first] == [Health.TRACKING] * 20 and health[first - 21] == Health.INITIALIZING
    assert len(health) > first + 10 and set(health[first:]) == {Health.LOST}


def test_exceptions_of_the_filter_are_reported(make_flight: MakeFlight, monkeypatch: pytest.MonkeyPatch) -> None:
    flight = make_flight(duration_s=3.0)
    calls: list[int] = []

    def fail(self: EquivariantFilter, ids: object, xy: object) -> None:
        calls.append(1)
        if len(calls) > 10:
            raise RuntimeError("\nIndeterminant linear system\nand more")

    monkeypatch.setattr(EquivariantFilter, "update", fail)
    estimates = run(flight)
    assert estimates[-1].health == Health.LOST and len(calls) == 11
    assert estimates[-1].health_report is not None
    assert estimates[-1].health_report.reason == "Indeterminant linear system"


def test_the_default_front_end_tracks_images() -> None:
    rig = euroc_rig()
    estimator: Estimator = EquivariantOdometry(rig)
    model = rig.cameras[0].model
    rows, columns = np.indices((model.height, model.width)) // 40
    image = np.where((rows + columns) % 2, 190, 90).astype(np.uint8)  # a chessboard
    estimate = estimator.add_frame(CameraFrame(0, (image,)))
    assert estimate.health is Health.INITIALIZING and estimate.tracks is not None and len(estimate.tracks.ids) > 10
