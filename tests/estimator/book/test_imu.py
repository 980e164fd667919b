"""Dead reckoning on the loop of the chapter."""

import dataclasses

import numpy as np
import numpy.typing as npt
import pytest

from dronevio.estimator.book.imu import ImuExperiment, LoopFlight, run_imu_experiment

Array = npt.NDArray[np.float64]


@pytest.fixture(scope="module")
def experiment() -> ImuExperiment:
    return run_imu_experiment(np.random.default_rng(0))


def fitted_circle(points: Array) -> tuple[Array, float]:
    """Return the centre and radius of the circle through points (N, 2), by Kåsa's least squares."""
    A = np.column_stack([2.0 * points, np.ones(len(points))])
    x, y, c = np.linalg.lstsq(A, np.sum(points**2, axis=1), rcond=None)[0]
    return np.array([x, y]), float(np.sqrt(c + x * x + y * y))


def test_zero_error_is_reached_from_distant_initial_values(experiment: ImuExperiment) -> None:
    assert experiment.initial_error > 1e6
    assert experiment.final_error < 1e-15


def test_true_path_is_a_circle_of_radius_v_over_omega(experiment: ImuExperiment) -> None:
    centre, radius = fitted_circle(experiment.path_m[:, [0, 2]])
    assert radius == pytest.approx(2.0 / (np.pi / 6.0), rel=1e-9)
    np.testing.assert_allclose(centre, [0.0, radius], atol=1e-9)  # the drone pitches up, so the centre is above it
    np.testing.assert_allclose(experiment.path_m[:, 1], 0.0, atol=1e-12)


def test_estimated_states_are_near_the_circle(experiment: ImuExperiment) -> None:
    _, radius = fitted_circle(experiment.Ts_world_imu[:, :3, 3][:, [0, 2]])
    assert radius == pytest.approx(experiment.flight.radius_m, rel=0.05)  # coarse because of the IMU rate of 10 Hz
    speeds = np.linalg.norm(experiment.velocity_m_s, axis=1)
    np.testing.assert_allclose(speeds, 2.0, atol=0.15)
    assert 0.0 < experiment.drift_m < 0.3


def test_a_higher_imu_rate_reduces_drift(experiment: ImuExperiment) -> None:
    fast = run_imu_experiment(np.random.default_rng(0), LoopFlight(imu_rate_hz=200.0, samples_per_factor=100))
    assert fast.drift_m < 0.25 * experiment.drift_m
    _, radius = fitted_circle(fast.Ts_world_imu[:, :3, 3][:, [0, 2]])
    assert radius == pytest.approx(fast.flight.radius_m, rel=0.005)


def test_graph_has_three_priors_and_seven_imu_factors(experiment: ImuExperiment) -> None:
    assert len(experiment.t_s) == 8
    np.testing.assert_allclose(np.diff(experiment.t_s), 0.5)
    assert experiment.factors[:3] == (("x0",), ("v0",), ("b0",))
    assert experiment.factors[3:] == tuple((f"x{i}", f"v{i}", f"x{i + 1}", f"v{i + 1}", "b0") for i in range(7))
    assert experiment.dot.startswith("graph {") and 'label="x7"' in experiment.dot


def test_same_seed_gives_the_same_solution(experiment: ImuExperiment) -> None:
    again = run_imu_experiment(np.random.default_rng(0))
    for field in dataclasses.fields(ImuExperiment):
        one, other = getattr(again, field.name), getattr(experiment, field.name)
        assert np.array_equal(one, other) if isinstance(one, np.ndarray) else one == other, field.name
    another = run_imu_experiment(np.random.default_rng(1))
    assert another.initial_error != experiment.initial_error
