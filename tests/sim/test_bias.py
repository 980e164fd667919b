"""Random walks and flicker noise of biases against the forms of Allan variance (IEEE 952; Riley, NIST SP 1065)."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from dronevio.models.imu import EUROC_IMU, ImuModel, ImuSamples
from dronevio.models.imu_presets import ADIS16448, TACTICAL
from dronevio.sim.inertial.bias import FLICKER_FLOOR, FLICKER_SHARE, FLICKER_TIMES_S
from dronevio.sim.inertial.imu import ImuErrors

MINUTE_NS = 60_000_000_000


def stationary_samples(count: int, step_ns: int) -> ImuSamples:
    return ImuSamples(np.arange(count, dtype=np.int64) * step_ns, np.zeros((count, 3)), np.zeros((count, 3)))


def test_bias_variance_grows_linearly_with_time() -> None:
    """The random walk depends on the elapsed time, not on the number of samples."""
    minutes, rng = stationary_samples(61, MINUTE_NS), np.random.default_rng(0)
    hours = [np.hstack(ImuErrors(EUROC_IMU, rng).add_to(minutes)[1:]) for _ in range(1000)]
    walks = np.stack(hours) / np.repeat([EUROC_IMU.gyro_random_walk, EUROC_IMU.accel_random_walk], 3)
    walks = walks - walks[:, :1]
    for k in (1, 6, 60):  # over a minute, six, and the hour
        steps = walks[:, k::k] - walks[:, :-k:k]
        gyro, accel = steps[..., :3], steps[..., 3:]
        np.testing.assert_allclose([gyro.var(), accel.var()], 60.0 * k, rtol=0.05)
    correlation = np.corrcoef(np.diff(walks, axis=1).reshape(-1, 6).T)
    assert np.abs(correlation - np.eye(6)).max() < 0.02


def allan_variance(rate: np.ndarray, m: int, step_s: float) -> np.ndarray:
    """Return the overlapping Allan variances (axes,) of rates (N, axes) averaged over m steps (SP 1065, eq. 11)."""
    angle = np.vstack([np.zeros(rate.shape[1]), np.cumsum(rate, axis=0)]) * step_s
    second = angle[2 * m :] - 2.0 * angle[m:-m] + angle[: -2 * m]
    return np.asarray(np.square(second).mean(axis=0) / (2.0 * (m * step_s) ** 2))


def expected_variance(
    model: ImuModel, kind: str, m: np.ndarray, step_s: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the expected parts (M,) of the Allan variance: white noise with rounding, flicker, walk."""
    tau = m * step_s
    unit = {"gyro": "rad_s", "accel": "m_s2"}[kind]
    noise, walk = getattr(model, f"{kind}_noise_density"), getattr(model, f"{kind}_random_walk")
    step, floor = getattr(model, f"{kind}_resolution_{unit}"), getattr(model, f"{kind}_bias_instability_{unit}")
    white = (noise**2 + step**2 / 12.0 * step_s) / tau
    r = np.exp(-step_s / FLICKER_TIMES_S)  # a process from one sample to the next
    r_m = np.exp(-tau[:, None] / FLICKER_TIMES_S)
    mean_term = m[:, None] * (1.0 + r) / (1.0 - r) - 2.0 * r * (1.0 - r_m) / (1.0 - r) ** 2
    covariance_term = r * (1.0 - r_m) ** 2 / (1.0 - r) ** 2
    markov = (mean_term - covariance_term) / m[:, None] ** 2
    flicker = (floor / FLICKER_FLOOR) ** 2 * FLICKER_SHARE * markov.sum(axis=1)
    return white, flicker, walk**2 * tau / 3.0 * (1.0 + 0.5 / m**2)


def degrees_of_freedom(n: int, m: np.ndarray) -> np.ndarray:
    """Return the fewest degrees of freedom (M,) of the estimate over three noise types (SP 1065, table 5)."""
    n_angles = n + 1
    white = (3.0 * (n_angles - 1) / (2.0 * m) - 2.0 * (n_angles - 2) / n_angles) * 4.0 * m**2 / (4.0 * m**2 + 5.0)
    flicker = 5.0 * n_angles**2 / (4.0 * m * (n_angles + 3.0 * m))
    walk = (n_angles - 2) / m * ((n_angles - 1) ** 2 - 3.0 * m * (n_angles - 1) + 4.0 * m**2) / (n_angles - 3) ** 2
    return np.asarray(np.minimum(np.minimum(white, flicker), walk))


def curve_and_band(model: ImuModel, seed: int, hours: float) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Return the Allan variances of both sensors over their expectation (M, 3), and the bounds (M,) of their 95 % band.

    The band is that of the whole curve: each of its M points has an equal share of the 5 %.
    """
    step_s = 1.0 / model.rate_hz
    n = round(hours * 3600.0 / step_s)
    measured = ImuErrors(model, np.random.default_rng(seed)).add_to(stationary_samples(n, round(1e9 * step_s)))[0]
    m = 2 ** np.arange(int(np.log2(n / 8)))
    curves = []
    for kind, rate in (("gyro", measured.gyro_rad_s), ("accel", measured.accel_m_s2)):
        parts = expected_variance(model, kind, m, step_s)
        ratio = np.stack([allan_variance(rate, int(k), step_s) for k in m]) / np.sum(parts, axis=0)[:, None]
        freedom = degrees_of_freedom(n, m)
        tail = 0.025 / len(m)
        curves.append((ratio, chi2.ppf(tail, freedom) / freedom, chi2.ppf(1.0 - tail, freedom) / freedom))
    return curves


SLOW = replace(ADIS16448, rate_hz=20.0)


@pytest.mark.parametrize("model", [SLOW, replace(TACTICAL, rate_hz=20.0)], ids=["ADIS16448", "tactical"])
def test_allan_variance_is_within_its_confidence_band(model: ImuModel) -> None:
    for ratio, low, high in curve_and_band(model, 1, 6.0):
        assert len(ratio) == 15  # 50 ms to 14 minutes
        assert np.all((ratio > low[:, None]) & (ratio < high[:, None]))


@pytest.mark.slow
@pytest.mark.parametrize(
    "wrong",
    [
        {"gyro_noise_density": 1.05, "accel_noise_density": 1.05},
        {"gyro_bias_instability_rad_s": 1.6, "accel_bias_instability_m_s2": 1.6},
        {"gyro_random_walk": 4.0, "accel_random_walk": 4.0},
    ],
    ids=["noise", "instability", "walk"],
)
def test_wrong_noise_leaves_the_confidence_band(wrong: dict[str, float]) -> None:
    """The band excludes an error of 5 % of the white noise, or of 60 % of the bias instability."""
    other = replace(SLOW, **{name: factor * getattr(SLOW, name) for name, factor in wrong.items()})
    step_s = 1.0 / SLOW.rate_hz
    for kind, (ratio, low, high) in zip(("gyro", "accel"), curve_and_band(other, 1, 6.0), strict=True):
        m = 2 ** np.arange(len(ratio))
        other_variance, variance = (np.sum(expected_variance(one, kind, m, step_s), axis=0) for one in (other, SLOW))
        scaled = ratio * (other_variance / variance)[:, None]
        assert not np.all((scaled > low[:, None]) & (scaled < high[:, None]))


def test_flicker_noise_has_the_stated_bias_instability() -> None:
    """The sum of processes a decade apart is flat within a few per cent between the first and the last of them."""
    model = replace(SLOW, gyro_noise_density=0.0, gyro_random_walk=0.0, gyro_resolution_rad_s=0.0)
    _, flicker, _ = expected_variance(model, "gyro", np.geomspace(20.0, 2e4, 50), 0.05)  # 1 to 1000 s
    np.testing.assert_allclose(np.sqrt(flicker), model.gyro_bias_instability_rad_s, rtol=0.05)


def test_flicker_noise_does_not_depend_on_the_batches() -> None:
    """Variance and autocorrelation are the same for all batches and gaps between samples."""
    model = replace(EUROC_IMU, gyro_random_walk=0.0, gyro_turn_on_bias_rad_s=0.0, gyro_bias_instability_rad_s=1.0)
    variance = len(FLICKER_TIMES_S) * FLICKER_SHARE / FLICKER_FLOOR**2
    t_ns = np.cumsum(np.array([0, 1, 10, 100, 1_000, 3_000, 60_000, 400_000, 5_000]) * 1_000_000)
    samples = ImuSamples(t_ns, np.zeros((9, 3)), np.zeros((9, 3)))
    rng = np.random.default_rng(2)
    at_once = np.stack([ImuErrors(model, rng).add_to(samples)[1] for _ in range(2000)])
    cut = []
    for _ in range(2000):
        errors = ImuErrors(model, rng)
        cut.append(np.concatenate([errors.add_to(samples[k : k + 1])[1] for k in range(9)]))
    gaps_s = np.diff(t_ns) * 1e-9
    for biases in (at_once, np.stack(cut)):
        np.testing.assert_allclose(biases.var(axis=(0, 2)), variance, rtol=0.06)
        autocorrelation = np.exp(-gaps_s / FLICKER_TIMES_S[:, None]).mean(axis=0)
        products = (biases[:, 1:] * biases[:, :-1]).mean(axis=(0, 2)) / variance
        np.testing.assert_allclose(products, autocorrelation, atol=0.05)
