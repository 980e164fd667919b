"""The baseline: GTSAM's equivariant filter behind our front end, on flights made of formulas."""

from collections.abc import Callable

import numpy as np
import pytest

from dronevio.estimator.baselines.eqvio import (
    EquivariantConfig,
    EquivariantFilter,
    EquivariantOdometry,
    FilterSettings,
    shortest_turn_up,
)
from dronevio.estimator.imu.buffer import Increments
from dronevio.eval.metrics.alignment import align
from dronevio.models.imu import GRAVITY_M_S2, ImuSamples
from dronevio.models.protocols import Estimator, measurements
from dronevio.models.rig import euroc_rig
from dronevio.models.state import Estimate, Health, Trajectory


def flown(flight, **settings: object) -> list[Estimate]:
    estimator: Estimator = EquivariantOdometry(flight.rig, EquivariantConfig(**settings), flight.front_end())
    estimates = []
    for measurement in measurements(flight):
        if isinstance(measurement, ImuSamples):
            estimator.add_imu(measurement)
        else:
            estimates.append(estimator.add_frame(measurement))
    return estimates


@pytest.mark.parametrize(
    "up", [(0.3, -1.2, 9.5), (-7.0, 4.0, 5.0), (9.0, 0.5, -0.1), (-1.0, 2.0, -9.0), (0.0, 0.0, 9.8), (0.0, 0.0, -9.8)]
)
def test_shortest_turn_takes_up_to_z(up: tuple[float, float, float]) -> None:
    R = shortest_turn_up(np.array(up))
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(R @ up, [0.0, 0.0, np.linalg.norm(up)], atol=1e-12)
    cosine = up[2] / np.linalg.norm(up)
    assert np.linalg.det(R) == pytest.approx(1.0) and (np.trace(R) - 1.0) / 2.0 == pytest.approx(cosine)


def test_filter_begins_level_with_velocity_in_the_imu_frame() -> None:
    """Nothing but a push along one axis of the IMU: where it goes in the world is what the filter's attitude says."""
    up, dt_s = np.array([3.0, -2.0, 9.0]), np.full(20, 0.01)
    gravity_imu = GRAVITY_M_S2 * up / np.linalg.norm(up)
    for axis in np.eye(3):
        running = EquivariantFilter(np.eye(4), FilterSettings(), up)
        running.predict(Increments(dt_s, np.zeros((20, 3)), np.tile(gravity_imu + axis, (20, 1))))
        np.testing.assert_allclose(running.velocity_imu_m_s, 0.2 * axis, atol=1e-3)  # its g is 9.80665
        np.testing.assert_allclose(running.position_m, 0.02 * shortest_turn_up(up) @ axis, atol=0.0011)


def test_it_flies_and_is_near_the_truth(make_flight: Callable) -> None:
    flight = make_flight(seed=1, max_features=24, duration_s=9.0)
    estimates = flown(flight)
    states = [e.state for e in estimates if e.state is not None]
    assert 0.7 < (states[0].t_ns - flight.frame_times_ns[0]) * 1e-9 < 1.2
    assert {e.health for e in estimates} == {Health.INITIALIZING, Health.TRACKING}
    found, truth = Trajectory.from_states(states), flight.truth_at(np.array([s.t_ns for s in states]))
    fit = align(truth.p_world_imu, found.p_world_imu, "yaw")
    away_m = np.linalg.norm(truth.p_world_imu - fit.positions(found.p_world_imu), axis=1)
    assert truth.length_m > 6.0 and np.sqrt(np.mean(away_m**2)) < 0.2
    assert found.velocity_m_s is not None and truth.velocity_m_s is not None
    speeds = np.linalg.norm(found.velocity_m_s, axis=1), np.linalg.norm(truth.velocity_m_s, axis=1)
    assert np.sqrt(np.mean((speeds[0] - speeds[1]) ** 2)) < 0.15


def test_in_the_dark_it_goes_on_by_the_imu(make_flight: Callable) -> None:
    estimates = flown(make_flight(seed=1, max_features=24, duration_s=4.0, dark_s=(3.0, 3.5)))
    health = np.array([e.health for e in estimates])
    assert np.all(health[61:70] == Health.INERTIAL_ONLY)
    assert health[-1] == Health.TRACKING


def test_without_a_rest_it_never_starts_and_says_so(make_flight: Callable) -> None:
    estimates = flown(make_flight(rest_s=-5.0, duration_s=3.0))
    assert all(e.health == Health.INITIALIZING and e.state is None for e in estimates)
    assert estimates[-1].health_report is not None and "0.8 s are needed" in estimates[-1].health_report.reason


def test_what_diverges_is_lost_for_good(make_flight: Callable, monkeypatch: pytest.MonkeyPatch) -> None:
    speeds = iter([*np.linspace(0.0, 59.0, 20).tolist(), np.nan, *np.zeros(100)])
    monkeypatch.setattr(
        EquivariantFilter, "velocity_imu_m_s", property(lambda self: np.array([next(speeds), 0.0, 0.0]))
    )
    health = [e.health for e in flown(make_flight(duration_s=3.0, max_features=12))]
    first = health.index(Health.LOST)
    assert health[first - 20 : first] == [Health.TRACKING] * 20 and health[first - 21] == Health.INITIALIZING
    assert len(health) > first + 10 and set(health[first:]) == {Health.LOST}


def test_an_exception_of_the_filter_ends_no_flight(make_flight: Callable, monkeypatch: pytest.MonkeyPatch) -> None:
    flight, calls = make_flight(duration_s=3.0), []

    def fail(self: EquivariantFilter, ids: object, xy: object) -> None:
        calls.append(1)
        if len(calls) > 10:
            raise RuntimeError("\nIndeterminant linear system\nand more")

    monkeypatch.setattr(EquivariantFilter, "update", fail)
    estimates = flown(flight)
    assert estimates[-1].health == Health.LOST and len(calls) == 11
    assert estimates[-1].health_report is not None
    assert estimates[-1].health_report.reason == "Indeterminant linear system"


def test_it_fits_the_protocol_of_estimators() -> None:
    estimator: Estimator = EquivariantOdometry(euroc_rig())
    assert estimator is not None
