"""The IMU factor graph of the chapter: its structure, its solutions and its covariance."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest

from dronevio.estimator.book.drift import predicted_covariance
from dronevio.estimator.book.imu import (
    ACCEL_NOISE_DENSITY,
    GRAVITY_M_S2,
    GYRO_NOISE_DENSITY,
    PRIOR_SIGMA,
    ImuExperiment,
    run_imu_experiment,
)
from dronevio.estimator.book.loop import Counting, LoopFlight
from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError
from dronevio.models.imu import ImuModel


@pytest.fixture(scope="module")
def experiment() -> ImuExperiment:
    return run_imu_experiment(np.random.default_rng(0))


@pytest.fixture(scope="module")
def equal() -> ImuExperiment:
    return run_imu_experiment(np.random.default_rng(0), LoopFlight(counting="equal"))


def fitted_circle(points: Array) -> tuple[Array, float]:
    """Return the centre and radius of the circle through points (N, 2), by Kåsa's least squares."""
    A = np.column_stack([2.0 * points, np.ones(len(points))])
    x, y, c = np.linalg.lstsq(A, np.sum(points**2, axis=1), rcond=None)[0]
    return np.array([x, y]), float(np.sqrt(c + x * x + y * y))


def test_the_arc_has_105_degrees_and_a_radius_of_3_82_m(experiment: ImuExperiment) -> None:
    assert experiment.flight.radius_m == pytest.approx(12.0 / math.pi) == pytest.approx(3.8197, abs=1e-4)
    assert math.degrees(experiment.flight.arc_rad) == pytest.approx(105.0)
    centre, radius = fitted_circle(experiment.path_m[:, [0, 2]])
    assert radius == pytest.approx(experiment.flight.radius_m, rel=1e-9)
    np.testing.assert_allclose(centre, [0.0, radius], atol=1e-9)  # the drone pitches up, so the centre is above it
    np.testing.assert_allclose(experiment.path_m[:, 1], 0.0, atol=1e-12)
    sine, cosine = math.sin(math.radians(105.0)), math.cos(math.radians(105.0))
    np.testing.assert_allclose(experiment.path_m[-1], radius * np.array([sine, 0.0, 1.0 - cosine]), rtol=1e-12)


def test_states_of_the_loop_are_those_of_gtsam() -> None:
    flight, t_s = LoopFlight(), np.array([0.0, 0.7, 3.5])
    states = flight.states(t_s)
    for i, t in enumerate(t_s):
        expected = flight.scenario.navState(t)
        np.testing.assert_allclose(states.R_world_imu[i], expected.attitude().matrix(), atol=1e-12)
        np.testing.assert_allclose(states.p_world_imu[i], expected.position(), atol=1e-12)
        np.testing.assert_allclose(states.velocity_m_s[i], expected.velocity(), atol=1e-12)


@pytest.mark.parametrize(
    ("counting", "samples", "last_s"), [("book", (6, 5, 5, 5, 5, 5), 3.1), ("equal", (5,) * 7, 3.5)]
)
def test_samples_of_each_factor(counting: Counting, samples: tuple[int, ...], last_s: float) -> None:
    flight = LoopFlight(counting=counting)
    assert flight.samples == 35
    assert flight.factor_samples == samples
    assert flight.t_s[-1] == pytest.approx(last_s)
    np.testing.assert_allclose(flight.nominal_t_s, 0.5 * np.arange(len(samples) + 1))


def test_counting_of_the_book_is_that_of_its_loop() -> None:
    """A factor ends after sample j if j > 0 and j % 5 == 0, for any number of samples."""
    for samples in range(6, 60):
        ends = [j for j in range(samples) if j > 0 and j % 5 == 0]
        expected = tuple(np.diff([-1, *ends]).tolist())
        assert LoopFlight(duration_s=0.1 * samples).factor_samples == expected


@pytest.mark.parametrize(
    "changes", [{"duration_s": 0.5}, {"samples_per_factor": 0}, {"pitch_rate_rad_s": 0.0}, {"counting": "other"}]
)
def test_a_flight_without_a_factor_is_refused(changes: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match="expected"):
        dataclasses.replace(LoopFlight(), **changes)


@pytest.mark.parametrize("name", ["experiment", "equal"])
def test_zero_error_is_reached_from_distant_initial_values(name: str, request: pytest.FixtureRequest) -> None:
    experiment = request.getfixturevalue(name)
    assert experiment.initial_error > 1e6
    assert experiment.final_error < 1e-20


def test_the_solution_is_dead_reckoning(experiment: ImuExperiment) -> None:
    assert experiment.dead_reckoning_difference_m < 1e-10
    np.testing.assert_allclose(experiment.Ts_world_imu[0], np.eye(4), atol=1e-10)


def test_batch_and_incremental_solutions_agree(experiment: ImuExperiment, equal: ImuExperiment) -> None:
    assert experiment.incremental_difference < 1e-6
    assert equal.incremental_difference < 1e-6
    assert experiment.incremental_updates >= len(experiment.t_s)


def test_drift_without_noise_is_that_of_held_samples(equal: ImuExperiment) -> None:
    """The acceleration vω is half a sampling interval behind, so the error of the acceleration is vω · ω Δt/2.

    It is tangential, like the acceleration turned by 90°: integrating ω²v Δt/2 (cos ωt, sin ωt) twice gives the
    displacement v Δt/2 (1 − cos ωt, ωt − sin ωt).
    """
    flight, angle = equal.flight, equal.flight.arc_rad
    expected = 0.5 * flight.speed_m_s * flight.dt_s * math.hypot(1.0 - math.cos(angle), angle - math.sin(angle))
    assert equal.noise_free_drift_m == pytest.approx(expected, rel=0.02)
    assert equal.drift_m == pytest.approx(equal.noise_free_drift_m, abs=0.04)  # 1σ of the noise is 15 mm


def test_a_higher_imu_rate_reduces_drift(experiment: ImuExperiment) -> None:
    fast = run_imu_experiment(np.random.default_rng(0), LoopFlight(imu_rate_hz=200.0, samples_per_factor=100))
    assert fast.noise_free_drift_m < 0.06 * experiment.noise_free_drift_m
    _, radius = fitted_circle(fast.Ts_world_imu[:, :3, 3][:, [0, 2]])
    assert radius == pytest.approx(fast.flight.radius_m, rel=0.01)
    np.testing.assert_allclose(np.linalg.norm(fast.velocity_m_s, axis=1), 2.0, atol=0.02)


def test_graph_of_the_book_has_three_priors_and_six_factors(experiment: ImuExperiment, equal: ImuExperiment) -> None:
    kinds = [factor.kind for factor in experiment.factors]
    assert kinds == ["PriorFactorPose3", "PriorFactorVector", "PriorFactorConstantBias", *["ImuFactor"] * 6]
    keys = [factor.variables for factor in experiment.factors]
    assert keys[:3] == [("x0",), ("v0",), ("b0",)]
    assert keys[3:] == [(f"x{i}", f"v{i}", f"x{i + 1}", f"v{i + 1}", "b0") for i in range(6)]
    assert len(equal.factors) == 10
    assert experiment.dot.startswith("graph {") and 'label="x6"' in experiment.dot and "x7" not in experiment.dot


def test_variances_of_the_sources_add_up(experiment: ImuExperiment) -> None:
    total = sum(source.sigma_m**2 for source in experiment.sources)
    assert total == pytest.approx(experiment.sigma_m[-1] ** 2, rel=1e-9)
    noise = np.trace(experiment.noise_covariance_m2[-1])
    assert experiment.sources[-1].sigma_m == pytest.approx(np.sqrt(noise), rel=1e-9)
    assert np.all(np.diff(experiment.sigma_m) > 0.0)


def test_priors_act_on_the_path_as_worked_by_hand(equal: ImuExperiment) -> None:
    """Position: √3 σ. Velocity: √3 σ t. Orientation: a tilt turns gravity and the whole path about the start.

    With the displacement d of the path and the effect ½ g t² of gravity, an error δθ moves the end by δθ × (d + ½ g t²
    up), so that its variance is 2 σ² |d + ½ g t² up|².
    """
    sigma = {source.name: source.sigma_m for source in equal.sources}
    t_s = equal.t_s[-1]
    assert sigma["initial position"] == pytest.approx(math.sqrt(3.0) * PRIOR_SIGMA, rel=1e-6)
    assert sigma["initial velocity"] == pytest.approx(math.sqrt(3.0) * PRIOR_SIGMA * t_s, rel=1e-6)
    lever = equal.Ts_world_imu[-1, :3, 3] - [2.0 * t_s, 0.0, -0.5 * GRAVITY_M_S2 * t_s**2]  # without the first velocity
    assert sigma["initial orientation"] == pytest.approx(math.sqrt(2.0) * PRIOR_SIGMA * np.linalg.norm(lever), rel=1e-6)


def test_covariance_equals_that_of_forward_propagation() -> None:
    """No later measurement exists, so smoothing has nothing to add to what a filter predicts."""
    experiment = run_imu_experiment(
        np.random.default_rng(0), LoopFlight(imu_rate_hz=200.0, samples_per_factor=100, counting="equal")
    )
    imu = ImuModel(
        gyro_noise_density=GYRO_NOISE_DENSITY,
        accel_noise_density=ACCEL_NOISE_DENSITY,
        gyro_random_walk=0.0,
        accel_random_walk=0.0,
    )
    for initial, covariance_m2 in (
        (np.zeros((15, 15)), experiment.noise_covariance_m2),
        (PRIOR_SIGMA**2 * np.eye(15), experiment.covariance_m2),
    ):
        P = predicted_covariance(experiment.flight, imu, experiment.t_s[1:], initial, step_s=0.005)
        predicted = P[:, 3:6, 3:6]
        scale = np.trace(predicted[-1])
        np.testing.assert_allclose(covariance_m2[1:] / scale, predicted / scale, atol=0.005)


def test_same_seed_gives_the_same_solution(experiment: ImuExperiment) -> None:
    again = run_imu_experiment(np.random.default_rng(0))
    for field in dataclasses.fields(ImuExperiment):
        one, other = getattr(again, field.name), getattr(experiment, field.name)
        assert np.array_equal(one, other) if isinstance(one, np.ndarray) else one == other, field.name
    another = run_imu_experiment(np.random.default_rng(1))
    assert another.initial_error != experiment.initial_error
