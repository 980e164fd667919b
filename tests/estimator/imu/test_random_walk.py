"""Estimation of the random walk of a bias from the changes of its estimate."""

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from dronevio.estimator.config import VioConfig
from dronevio.estimator.imu.noise import NoiseEstimationConfig
from dronevio.estimator.imu.random_walk import INTERVAL_S, RandomWalkEstimator
from dronevio.models.arrays import Array

if TYPE_CHECKING:
    from tests.estimator.conftest import SyntheticFlight

DENSITY = 2e-5
STEP_S = 0.2
AXES = 3


def filtered(
    bias_of: Callable[[Array, np.random.Generator], Array], duration_s: float = 300.0, *, adapts: bool = True
) -> tuple[RandomWalkEstimator, Array]:
    """Return the estimator after a flight, and the normalized squared errors (N,) of the bias.

    A Kalman filter estimates the bias from measurements of it, with the density that the estimator finds.

    Args:
        bias_of: Function that returns the bias (N, 3) at times (N,).
        duration_s: Length of the flight.
        adapts: Whether the filter uses the estimated density, or the initial one.
    """
    rng = np.random.default_rng(0)
    t_s = np.arange(0.0, duration_s, STEP_S)
    true = bias_of(t_s, rng)
    measured_sigma = 5.0 * DENSITY
    estimator = RandomWalkEstimator(DENSITY, max_factor=100.0)
    x, variance, squares = np.zeros(AXES), 1.0, []
    for t, at, measured in zip(t_s, true, true + rng.normal(0.0, measured_sigma, true.shape), strict=True):
        gain = variance / (variance + measured_sigma**2)
        x, variance = x + gain * (measured - x), (1.0 - gain) * variance
        squares.append(float(np.sum((x - at) ** 2) / variance))
        estimator.add(round(1e9 * t), x, np.full(AXES, variance))
        variance += (estimator.density if adapts else DENSITY) ** 2 * STEP_S
    return estimator, np.array(squares)


def walking(factor: float) -> Callable[[Array, np.random.Generator], Array]:
    """Return a bias that walks with a multiple of the initial density."""

    def bias(t_s: Array, rng: np.random.Generator) -> Array:
        return np.cumsum(rng.normal(0.0, factor * DENSITY * np.sqrt(STEP_S), (len(t_s), AXES)), axis=0)

    return bias


def warming(t_s: Array, _: np.random.Generator) -> Array:
    """Return a bias that follows the temperature, ten initial densities in one second at first."""
    return np.outer(10.0 * DENSITY * 30.0 * (1.0 - np.exp(-t_s / 30.0)), [1.0, -1.0, 1.0])


@pytest.mark.parametrize("factor", [2.0, 5.0, 20.0])
def test_estimate_converges_to_the_walk(factor: float) -> None:
    estimator, squares = filtered(walking(factor))
    assert estimator.density == pytest.approx(factor * DENSITY, rel=0.3)
    assert squares[len(squares) // 2 :].mean() == pytest.approx(AXES, rel=0.3)


@pytest.mark.parametrize("factor", [0.0, 0.5, 1.0])
def test_smaller_walks_keep_the_initial_density(factor: float) -> None:
    estimator, _ = filtered(walking(factor))
    assert DENSITY <= estimator.density < 1.3 * DENSITY


def test_a_warming_sensor_has_consistent_biases() -> None:
    _, with_walk = filtered(warming, 60.0)
    _, without = filtered(warming, 60.0, adapts=False)
    late = with_walk[len(with_walk) // 4 :]
    assert late.mean() < 2.0 * AXES < 0.1 * without[len(without) // 4 :].mean()


@pytest.mark.parametrize(("gained", "square"), [(0.0, 7.0), (4.0, 20.0)])
def test_density_of_one_interval_worked_out_by_hand(gained: float, square: float) -> None:
    """In units of the initial walk during the interval, x = 4 solves 1/x² - 1/x + s/(d + x)² - 1/(d + x) = 0.

    s is the squared change, d the certainty gained; the first two terms are those of the prior.
    """
    unit = DENSITY**2 * 3.0
    estimator = RandomWalkEstimator(DENSITY, max_factor=16.0)
    estimator.add(0, np.zeros(3), np.full(3, (1.0 + gained) * unit))
    estimator.add(3_000_000_000, np.full(3, np.sqrt(square * unit)), np.full(3, unit))
    assert estimator.density == pytest.approx(2.0 * DENSITY)


def test_an_unobserved_bias_shows_nothing() -> None:
    """Its variance grows by the walk, and its estimate stays."""
    estimator = RandomWalkEstimator(DENSITY, max_factor=100.0)
    for i in range(100):
        t_s = 0.5 * INTERVAL_S * i
        estimator.add(round(1e9 * t_s), np.zeros(3), np.full(3, DENSITY**2 * (1.0 + t_s)))
    assert estimator.density == pytest.approx(DENSITY)


def test_an_unobserved_interval_keeps_what_is_known() -> None:
    unit = DENSITY**2 * 3.0
    estimator = RandomWalkEstimator(DENSITY, max_factor=16.0)
    estimator.add(0, np.zeros(3), np.full(3, unit))
    bias = np.full(3, np.sqrt(7.0 * unit))
    estimator.add(3_000_000_000, bias, np.full(3, unit))
    walked = estimator.density**2 * 3.0  # its variance grows by the walk, and its estimate stays
    estimator.add(6_000_000_000, bias, np.full(3, unit + walked))
    assert estimator.density == pytest.approx(2.0 * DENSITY)


def test_a_walk_that_ends_is_forgotten() -> None:
    """Ten intervals with 16 times the expected squares, then 40 with the expected ones, of which the last ten count."""
    estimator, bias = RandomWalkEstimator(DENSITY, max_factor=16.0), 0.0
    for i in range(51):
        bias += np.sqrt(3.0) * DENSITY * (4.0 if 0 < i <= 10 else 1.0)
        estimator.add(i * 3_000_000_000, np.full(3, bias), np.full(3, DENSITY**2))
        if i == 10:
            assert estimator.density > 3.0 * DENSITY
    assert estimator.density < 1.2 * DENSITY


@pytest.mark.parametrize(
    ("jump", "is_forgotten", "raises"), [(5.0, False, True), (5.0, True, False), (1e4, False, False)]
)
def test_jumps_that_a_walk_explains_raise_the_density(jump: float, is_forgotten: bool, raises: bool) -> None:
    """Others, and those whose cause is known, do not."""
    estimator = RandomWalkEstimator(DENSITY, max_factor=100.0)
    for i in range(3):
        if is_forgotten and i == 2:
            estimator.forget_bias()
        bias = jump * DENSITY * np.sqrt(3.0) if i == 2 else 0.0
        estimator.add(i * 3_000_000_000, np.full(3, bias), np.full(3, DENSITY**2))
    assert (estimator.density > DENSITY) == raises


def test_limits() -> None:
    """The density follows its smallest value, and a factor of 1 keeps it; a walk of zero stays zero."""
    for initial, factor in ((DENSITY, 1.0), (0.0, 10.0)):
        estimator = RandomWalkEstimator(initial, max_factor=factor)
        for i in range(50):
            estimator.add(i * 3_000_000_000, np.full(3, 5.0 * DENSITY * i), np.full(3, DENSITY**2))
        assert estimator.density == initial
        estimator.set_smallest(2.0 * initial)
        assert estimator.density == 2.0 * initial


@pytest.mark.slow
def test_odometry_of_a_warming_gyroscope_has_consistent_biases(make_flight: Callable[..., "SyntheticFlight"]) -> None:
    """Its bias follows 5 mrad/s with a time constant of 30 s; without the learned walk, the bias is far beyond 3 σ."""
    flight = make_flight(3, rest_s=2.0, duration_s=25.0)
    elapsed_s = 1e-9 * (flight.imu.t_ns - flight.imu.t_ns[0])
    drift = np.outer(0.005 * (1.0 - np.exp(-elapsed_s / 30.0)), [1.0, 1.0, -1.0])
    true_bias = flight.state_at(int(flight.imu.t_ns[0])).gyro_bias_rad_s + drift
    vars(flight).update(imu=replace(flight.imu, gyro_rad_s=flight.imu.gyro_rad_s + drift))

    def sigmas(config: VioConfig) -> Array:
        states = [e.state for e in flight.run(config=config) if e.state is not None and e.state.covariance is not None]
        late = states[3 * len(states) // 4 :]
        true = np.array([true_bias[np.searchsorted(flight.imu.t_ns, state.t_ns)] for state in late])
        variances = np.array([np.diag(state.covariance)[9:12] for state in late if state.covariance is not None])
        return np.asarray(np.abs(np.array([state.gyro_bias_rad_s for state in late]) - true) / np.sqrt(variances))

    kept = VioConfig(noise=NoiseEstimationConfig(max_walk_factor=1.0))
    assert np.median(sigmas(VioConfig())) < 3.0 < 0.3 * np.median(sigmas(kept))
