"""Minimum-snap curves against an independent solution and other curves; their times against the limits."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad_vec
from scipy.interpolate import BSpline
from scipy.optimize import minimize

from dronevio.models.errors import ConfigError
from dronevio.models.imu import GRAVITY_M_S2
from dronevio.sim.paths.limits import LIMITS, Limits
from dronevio.sim.paths.minimum_snap import minimum_snap, minimum_time_knots


def random_points(seed: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return np.concatenate([[0.0], np.cumsum(rng.uniform(0.4, 2.0, count - 1))]), rng.uniform(-3.0, 3.0, (count, 3))


def snap_of(curve: BSpline, knots: np.ndarray) -> float:
    """Return the integral of squared snap; four Gauss points are exact for a polynomial of degree 6 on each leg."""
    x, weights = np.polynomial.legendre.leggauss(4)
    half = 0.5 * np.diff(knots)
    t = knots[:-1, None] + half[:, None] * (1.0 + x)
    return float(np.sum((curve.derivative(4)(t) ** 2).sum(axis=-1) * weights * half[:, None]))


def polynomial_legs(knots: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the coefficients (K - 1, 8, D) of minimum-snap polynomials, from the KKT system of a quadratic program.

    The formulation is independent of the spline: each leg has eight free coefficients, and the constraints are the
    points, zero derivatives at the ends and continuity up to the third derivative.
    """
    legs, d = np.diff(knots), points.shape[1]
    powers = np.arange(8)

    def row(t: float, order: int) -> np.ndarray:
        factor = np.array([np.prod(np.arange(p - order + 1, p + 1)) if p >= order else 0.0 for p in powers])
        return factor * t ** np.maximum(powers - order, 0)

    n = 8 * len(legs)
    cost, constraints, values = np.zeros((n, n)), [], []

    def constrain(parts: list[tuple[int, np.ndarray]], value: np.ndarray) -> None:
        line = np.zeros(n)
        for leg, coefficients in parts:
            line[8 * leg : 8 * leg + 8] += coefficients
        constraints.append(line)
        values.append(value)

    for leg, length in enumerate(legs):
        block, _ = quad_vec(lambda t: np.outer(row(t, 4), row(t, 4)), 0.0, length)
        cost[8 * leg : 8 * leg + 8, 8 * leg : 8 * leg + 8] = block
        constrain([(leg, row(0.0, 0))], points[leg])
        constrain([(leg, row(length, 0))], points[leg + 1])
        if leg:
            for order in (1, 2, 3):
                constrain([(leg - 1, row(legs[leg - 1], order)), (leg, -row(0.0, order))], np.zeros(d))
    for order in (1, 2, 3):
        constrain([(0, row(0.0, order))], np.zeros(d))
        constrain([(len(legs) - 1, row(legs[-1], order))], np.zeros(d))
    A = np.array(constraints)
    system = np.block([[cost, A.T], [A, np.zeros((len(A), len(A)))]])
    right = np.concatenate([np.zeros((n, d)), np.array(values)])
    return np.asarray(np.linalg.lstsq(system, right, rcond=None)[0][:n].reshape(-1, 8, d))


@pytest.mark.parametrize("seed", range(3))
def test_the_curve_is_the_solution_of_the_quadratic_program(seed: int) -> None:
    knots, points = random_points(seed, 5)
    curve, legs = minimum_snap(knots, points), polynomial_legs(knots, points)
    for start, length, coefficients in zip(knots[:-1], np.diff(knots), legs, strict=True):
        t = np.linspace(0.0, length, 20)
        np.testing.assert_allclose(t[:, None] ** np.arange(8) @ coefficients, curve(start + t), atol=1e-6)


@given(seed=st.integers(0, 10_000), count=st.integers(2, 12))
@settings(max_examples=40, deadline=None)
def test_no_curve_with_the_same_constraints_has_less_snap(seed: int, count: int) -> None:
    knots, points = random_points(seed, count)
    curve = minimum_snap(knots, points)
    # Another feasible curve is the sum of the curve and one that vanishes at the points and rests at the ends.
    dense = np.sort(np.concatenate([knots, knots[:-1] + 0.5 * np.diff(knots)]))
    values = np.zeros((len(dense), 3))
    values[1::2] = 0.1 * np.random.default_rng(seed).normal(size=(len(knots) - 1, 3))
    difference = minimum_snap(dense, values)
    least, added = snap_of(curve, knots), snap_of(difference, dense)
    other = minimum_snap(dense, curve(dense) + values)
    assert added > 0.0
    assert snap_of(other, dense) == pytest.approx(least + added, rel=1e-6)  # Pythagoras: they are orthogonal
    assert snap_of(other, dense) > least


@pytest.mark.parametrize("order", range(7))
def test_curves_are_smooth_beyond_the_snap(order: int) -> None:
    knots, points = random_points(3, 9)
    derivative = minimum_snap(knots, points).derivative(order)
    before, after = derivative(knots[1:-1] - 1e-9), derivative(knots[1:-1] + 1e-9)
    np.testing.assert_allclose(before, after, atol=1e-6 * max(1.0, np.abs(derivative.c).max()))


def test_curves_pass_their_points_and_rest_at_the_ends() -> None:
    knots, points = random_points(4, 9)
    curve = minimum_snap(knots, points)
    np.testing.assert_allclose(curve(knots), points, atol=1e-9)
    for order in (1, 2, 3):
        np.testing.assert_allclose(curve.derivative(order)(knots[[0, -1]]), 0.0, atol=1e-6)


@pytest.mark.slow
@given(
    seed=st.integers(0, 10_000),
    count=st.integers(2, 15),
    speed=st.floats(0.3, 12.0),
    accel=st.floats(0.3, 20.0),
    tilt_rate=st.floats(0.5, 10.0),
    thrust=st.floats(1.1, 3.0),
    tilt=st.floats(0.2, 1.3),
)
@settings(max_examples=60, deadline=None)
def test_limits_hold_and_are_nearly_reached(
    seed: int, count: int, speed: float, accel: float, tilt_rate: float, thrust: float, tilt: float
) -> None:
    points = random_points(seed, count)[1]
    limits = Limits(speed, accel, 1.0, tilt_rate, thrust, tilt)
    knots = minimum_time_knots(points, limits)
    curve, t = minimum_snap(knots, points), np.linspace(0.0, knots[-1], 20_000)
    velocity, acceleration = curve.derivative(1)(t), curve.derivative(2)(t)
    force = acceleration + [0.0, 0.0, GRAVITY_M_S2]
    lift = np.linalg.norm(force, axis=1)
    up = force / lift[:, None]
    # The tilt rate is differentiated numerically, independent of the formula under test.
    tilt_rates = np.linalg.norm(np.diff(up, axis=0), axis=1) / np.diff(t)
    shares = {
        "speed": np.linalg.norm(velocity, axis=1).max() / speed,
        "acceleration": np.linalg.norm(acceleration, axis=1).max() / accel,
        "thrust": lift.max() / (thrust * GRAVITY_M_S2),
        "tilt": np.arccos(np.clip(up[:, 2], -1.0, 1.0)).max() / tilt,
        "tilt rate": tilt_rates.max() / tilt_rate,
    }
    assert max(shares.values()) <= 1.0, shares
    light = (GRAVITY_M_S2 - lift.min()) / (0.7 * GRAVITY_M_S2)
    spare = (lift.max() / GRAVITY_M_S2 - 1.0) / (thrust - 1.0)
    assert max(*shares.values(), light, spare) > 0.9, shares


@pytest.mark.parametrize("name", LIMITS)
@pytest.mark.parametrize("seed", range(2))
def test_times_are_nearly_optimal(name: str, seed: int) -> None:
    points, limits = random_points(seed, 6)[1], LIMITS[name]
    knots = minimum_time_knots(points, limits)

    def total_s(logarithms: np.ndarray) -> float:
        other = np.concatenate([[0.0], np.cumsum(np.exp(logarithms))])
        curve, t = minimum_snap(other, points), np.linspace(other[:-1], other[1:], 24)
        derivatives = [curve.derivative(order)(t) for order in (1, 2, 3)]
        low, high = 0.1, 10.0
        while high > 1.001 * low:
            scale = np.sqrt(low * high)
            v, a, j = (d / scale**order for order, d in enumerate(derivatives, 1))
            low, high = (scale, high) if limits.limit_ratio(v, a, j).max() > 1.0 else (low, scale)
        return float(other[-1] * high)

    best = minimize(total_s, np.log(np.diff(knots)), method="Nelder-Mead", options={"maxfev": 250}).fun
    assert knots[-1] < 1.04 * best


def test_two_hundred_points_can_be_planned() -> None:
    points = random_points(0, 200)[1]
    knots = minimum_time_knots(points, LIMITS["medium"])
    again = minimum_time_knots(points, LIMITS["medium"], knots)
    assert again[-1] <= knots[-1] * 1.0001
    assert knots.shape == (200,) and np.all(np.diff(knots) > 0.0)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("speed_m_s", 0.0),
        ("accel_m_s2", -1.0),
        ("yaw_rate_rad_s", float("nan")),
        ("tilt_rate_rad_s", float("inf")),
        ("thrust_to_weight", 0.0),
        ("thrust_to_weight", 1.0),
        ("tilt_rad", 1.5),
    ],
)
def test_invalid_limits_are_refused_by_name_and_value(name: str, value: float) -> None:
    with pytest.raises(ConfigError, match=rf"{name} = {value}; expected"):
        Limits(**{name: value})


def test_limit_ratio_is_the_factor_of_the_required_time() -> None:
    limits, zero = Limits(2.0, 4.0, tilt_rate_rad_s=1.0), np.zeros(3)
    assert limits.limit_ratio(np.array([4.0, 0.0, 0.0]), zero, zero) == pytest.approx(2.0 / 0.99)
    assert limits.limit_ratio(zero, np.array([0.0, 16.0, 0.0]), zero) > 2.0
    jerk = 8.0 * GRAVITY_M_S2 * np.array([1.0, 0.0, 0.0])  # rotates the thrust of a hover at 8 rad/s
    assert limits.limit_ratio(zero, zero, jerk) == pytest.approx(2.0 / np.cbrt(0.99))
    assert limits.limit_ratio(zero, zero, zero) == 0.0
