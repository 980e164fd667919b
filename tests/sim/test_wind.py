"""The wind model against the formulas of the standard: variances, correlations over distance, spectra."""

from dataclasses import replace

import numpy as np
import pytest

from dronevio.models.errors import ConfigError
from dronevio.sim.physics.wind import CALM, Air, Wind

BREEZE = Wind((5.0, 0.0, 0.0), gusts=1.0)
FOOT_M = 0.3048


def test_lengths_and_deviations_are_those_of_the_standard() -> None:
    low, high = BREEZE, replace(BREEZE, height_m=1000.0 * FOOT_M)
    np.testing.assert_allclose(low.gust_lengths_m / FOOT_M, [75.67, 75.67, 10.0], rtol=1e-3)
    np.testing.assert_allclose(high.gust_lengths_m / FOOT_M, 1000.0)  # where turbulence becomes isotropic
    np.testing.assert_allclose(high.gust_deviations_m_s, high.gust_deviations_m_s[2])
    at_gauge = replace(BREEZE, height_m=20.0 * FOOT_M)
    np.testing.assert_allclose(at_gauge.gust_deviations_m_s[2], 0.5)  # a tenth of the wind at 20 ft
    # The same mean wind at a lower height implies stronger gusts
    assert np.all(low.gust_deviations_m_s > at_gauge.gust_deviations_m_s)
    np.testing.assert_allclose(replace(BREEZE, gusts=0.5).gust_deviations_m_s, 0.5 * low.gust_deviations_m_s)


@pytest.mark.parametrize("steps", [1, 7])
def test_gust_statistics_do_not_depend_on_the_step_length(steps: int) -> None:
    air = Air(BREEZE, np.random.default_rng(0), (40_000,))
    before = air.velocity_m_s() - BREEZE.mean_m_s
    distance = 2.0
    for _ in range(steps):
        air.move_through(np.full(40_000, distance / steps))
    after = air.velocity_m_s() - BREEZE.mean_m_s
    sigma, d = BREEZE.gust_deviations_m_s, distance / BREEZE.gust_lengths_m
    np.testing.assert_allclose(before.std(axis=0), sigma, rtol=0.015)
    np.testing.assert_allclose(after.std(axis=0), sigma, rtol=0.015)
    # Dryden's correlations: exp(−d) along the wind, (1 − d/2) exp(−d) across it
    expected = np.exp(-d) * [1.0, 1.0 - d[1] / 2.0, 1.0 - d[2] / 2.0]
    np.testing.assert_allclose(np.mean(before * after, axis=0) / sigma**2, expected, atol=0.015)


def test_spectra_are_those_of_the_standard() -> None:
    runs, samples, step = 200, 2048, 0.5
    air = Air(BREEZE, np.random.default_rng(1), (runs,))
    gusts = np.empty((samples, runs, 3))
    for k in range(samples):
        gusts[k] = air.velocity_m_s() - BREEZE.mean_m_s
        air.move_through(np.full(runs, step))
    window = np.hanning(samples)[:, None, None]
    density = np.mean(np.abs(np.fft.rfft(gusts * window, axis=0)) ** 2, axis=1)
    density *= 2.0 * step / (2.0 * np.pi) / np.sum(window**2)  # one-sided, by wave number
    wave = 2.0 * np.pi * np.fft.rfftfreq(samples, step)
    band = (wave > 0.02) & (wave < 1.0)
    length, sigma = BREEZE.gust_lengths_m, BREEZE.gust_deviations_m_s
    x = (length * wave[band, None]) ** 2
    along = sigma[0] ** 2 * 2.0 * length[0] / np.pi / (1.0 + x[:, 0])
    across = sigma[1:] ** 2 * length[1:] / np.pi * (1.0 + 3.0 * x[:, 1:]) / (1.0 + x[:, 1:]) ** 2
    ratio = density[band] / np.column_stack([along, across])
    for part in np.array_split(ratio, 6):
        np.testing.assert_allclose(part.mean(axis=0), 1.0, atol=0.07)


def test_gust_axes_follow_the_direction_of_the_wind() -> None:
    wind = Wind((-3.0, 4.0, 0.0), gusts=1.0)
    gusts = Air(wind, np.random.default_rng(2), (40_000,)).velocity_m_s() - wind.mean_m_s
    np.testing.assert_allclose(gusts @ wind.axes.T @ wind.axes, gusts, atol=1e-12)
    np.testing.assert_allclose((gusts @ wind.axes.T).std(axis=0), BREEZE.gust_deviations_m_s, rtol=0.015)
    np.testing.assert_allclose(wind.axes[0], [-0.6, 0.8, 0.0])


def test_parallel_gusts_are_independent_and_renewed_on_restart() -> None:
    air = Air(BREEZE, np.random.default_rng(3), (2,))
    first = air.velocity_m_s()
    assert not np.any(first[0] == first[1])
    air.reset()
    assert not np.any(air.velocity_m_s() == first)
    again = Air(BREEZE, np.random.default_rng(3), (2,))
    np.testing.assert_array_equal(again.velocity_m_s(), first)


def test_gusts_do_not_change_without_motion() -> None:
    air = Air(BREEZE, np.random.default_rng(4))
    before = air.velocity_m_s()
    air.move_through(np.array(0.0))
    np.testing.assert_array_equal(air.velocity_m_s(), before)


def test_steady_wind_needs_no_random_generator() -> None:
    steady = Air(Wind((1.0, 2.0, -0.5)), None)
    steady.move_through(np.array(3.0))
    np.testing.assert_array_equal(steady.velocity_m_s(), [1.0, 2.0, -0.5])
    assert not Air(CALM).velocity_m_s().any()
    with pytest.raises(ConfigError, match="random generator"):
        Air(BREEZE, None)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"gusts": -1.0}, "-1"),
        ({"height_m": 1.0}, "height_m = 1.0; expected a number, 3.048 to 304.8"),
        ({"mean_m_s": (np.nan, 0.0, 0.0)}, "nan"),
    ],
)
def test_invalid_winds_are_refused(change: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        replace(BREEZE, **change)  # type: ignore[arg-type]
