"""Detection of saturated readings, and the covariance of a motion that a sensor could not follow."""

from dataclasses import dataclass

import gtsam
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dronevio.estimator.imu.buffer import GAP_SIGMA, ImuBuffer, Increments, joined
from dronevio.estimator.imu.preintegration import Preintegration, PreintegrationConfig, PreintegrationParams
from dronevio.estimator.imu.saturation import MIN_GYRO_RANGE_RAD_S, SaturationDetector
from dronevio.estimator.initialization.gauge import LastPublished
from dronevio.estimator.initialization.static import InitialSigmas
from dronevio.estimator.propagator import ImuPropagation
from dronevio.models.arrays import Array
from dronevio.models.imu import EUROC_IMU, GRAVITY_M_S2, ImuSamples
from dronevio.models.state import NavState

STEP_NS = 5_000_000
RANGE_RAD_S = 1.0
NOISE_RAD_S = 0.0024
"""Standard deviation of a reading of EuRoC's gyroscope [rad/s]."""
DATA_SHEET = PreintegrationConfig(gyro_noise_inflation=1.0, accel_noise_inflation=1.0)


def gyroscope(n: int, seed: int, peak_rad_s: float) -> Array:
    """Return readings (n, 3) of a rotation to and fro, with the noise and resolution of EuRoC's gyroscope."""
    rng = np.random.default_rng(seed)
    t_s, phase = np.arange(n) * 0.005, rng.uniform(0.0, 2.0 * np.pi, 3)
    true = peak_rad_s * np.sin(t_s[:, None] * [1.1, 2.3, 3.1] + phase)
    return quantized(true + rng.normal(0.0, NOISE_RAD_S, true.shape), EUROC_IMU.gyro_resolution_rad_s)


def quantized(values: Array, step: float) -> Array:
    """Return values rounded to multiples of a step."""
    return np.asarray(step * np.rint(values / step))


def detected(detector: SaturationDetector, values: Array, batch: int) -> npt.NDArray[np.bool_]:
    """Return whether readings (N, 3) are saturated; each batch updates the detector before its query."""
    found = []
    for start in range(0, len(values), batch):
        detector.update(values[start : start + batch])
        found.append(detector.saturation_limits(values[start : start + batch]) > 0.0)
    return np.concatenate(found)


@given(seed=st.integers(0, 10_000), batch=st.integers(1, 40))
@settings(max_examples=40, deadline=None)
def test_range_is_found_from_readings_alone(seed: int, batch: int) -> None:
    """The data sheet states a larger range; until the smaller one is found, up to 30 readings are missed."""
    true = gyroscope(2000, seed, 1.7)
    detector = SaturationDetector(EUROC_IMU.gyro_range_rad_s, MIN_GYRO_RANGE_RAD_S)
    found = detected(detector, np.clip(true, -RANGE_RAD_S, RANGE_RAD_S), batch)
    assert detector.limit == RANGE_RAD_S
    missed = np.flatnonzero(np.any((np.abs(true) > RANGE_RAD_S) & ~found, axis=1))
    assert len(missed) <= 30 and not np.any(found & (np.abs(true) < 0.99 * RANGE_RAD_S))
    assert len(missed) == 0 or missed.max() <= np.flatnonzero(found.any(axis=1))[0]


@pytest.mark.parametrize("batch", [4, 40])
def test_motion_within_the_range_is_not_saturated(batch: int) -> None:
    """Noise repeats the largest reading by chance in some of a thousand flights, until a larger one is read."""
    shares = []
    for seed, peak_rad_s in enumerate(np.geomspace(0.3, 10.0, 200)):
        detector = SaturationDetector(np.inf, MIN_GYRO_RANGE_RAD_S)
        shares.append(detected(detector, gyroscope(2000, seed, peak_rad_s), batch).mean())
    assert np.mean(shares) < 1e-3
    assert np.sum(np.array(shares) >= 1e-3) <= 2


@pytest.mark.parametrize("step", [1e-4, 5e-3, 0.1], ids=["fine", "coarse", "coarser than its noise"])
def test_a_sensor_at_rest_is_not_saturated(step: float) -> None:
    """A coarse sensor at rest repeats its readings."""
    rng = np.random.default_rng(0)
    gyro = quantized(0.08 + rng.normal(0.0, NOISE_RAD_S, (2000, 3)), step)
    accel = quantized(np.array([0.0, 0.0, GRAVITY_M_S2]) + rng.normal(0.0, 0.03, (2000, 3)), step)
    buffer = ImuBuffer(EUROC_IMU)
    buffer.add(ImuSamples(np.arange(2000) * STEP_NS, gyro, accel))
    assert not buffer.take_until(1999 * STEP_NS).is_degraded


def test_a_limit_that_is_exceeded_is_discarded() -> None:
    detector = SaturationDetector(np.inf, MIN_GYRO_RANGE_RAD_S)
    detector.update(np.full((10, 3), 2.0))
    assert detector.limit == 2.0
    detector.update(np.full((1, 3), 2.5))
    assert detector.limit == np.inf


def test_the_nominal_range_is_known_from_the_start() -> None:
    detector = SaturationDetector(2.0, MIN_GYRO_RANGE_RAD_S)
    values = np.array([[0.0, -2.0, 1.99]])
    detector.update(values)
    np.testing.assert_array_equal(detector.saturation_limits(values), [[0.0, 2.0, 0.0]])


def clipped_rotation(range_rad_s: float) -> tuple[Increments, Array]:
    """Return increments of a rotation about x of up to 2 rad/s, clipped, and the true rotation vector [rad]."""
    t_s = np.arange(201) * 0.005
    true = np.column_stack([2.0 * np.sin(np.pi * t_s), 0.0 * t_s, 0.0 * t_s])
    buffer = ImuBuffer(EUROC_IMU)
    accel = np.tile([0.0, 0.0, GRAVITY_M_S2], (201, 1))
    buffer.add(ImuSamples(np.arange(201) * STEP_NS, np.clip(true, -range_rad_s, range_rad_s), accel))
    return buffer.take_until(200 * STEP_NS), np.array([4.0 / np.pi, 0.0, 0.0])


def test_saturation_enlarges_the_covariance_of_its_axis() -> None:
    params = PreintegrationParams.of(EUROC_IMU, PreintegrationConfig())

    def integrated(range_rad_s: float) -> tuple[Array, Array, bool]:
        """Return standard deviations and errors (3,) of the rotation [rad], and whether it is degraded."""
        increments, true_rotation = clipped_rotation(range_rad_s)
        pim = Preintegration(params, gtsam.imuBias.ConstantBias())
        pim.integrate(increments)
        error = np.abs(gtsam.Rot3.Logmap(pim.measurements.deltaRij()) - true_rotation)
        return np.sqrt(np.diag(pim.measurements.preintMeasCov())[:3]), error, increments.is_degraded

    sigmas, error, is_degraded = integrated(10.0)
    assert not is_degraded and error[0] < 1e-3 and sigmas[0] < 0.01
    clipped_sigmas, clipped_error, is_degraded = integrated(1.0)
    assert is_degraded and 0.3 < clipped_error[0] < 3.0 * clipped_sigmas[0]
    np.testing.assert_allclose(clipped_sigmas[1:], sigmas[1:], rtol=0.1)


def test_saturation_leaves_the_noise_of_later_samples_alone() -> None:
    params, bias = PreintegrationParams.of(EUROC_IMU, PreintegrationConfig()), gtsam.imuBias.ConstantBias()
    saturated, clean = clipped_rotation(1.0)[0], clipped_rotation(10.0)[0]
    variances = []
    for parts in ((clean,), (saturated,), (saturated, clean)):
        preintegration = Preintegration(params, bias)
        for part in parts:
            preintegration.integrate(part)
        variances.append(np.trace(preintegration.measurements.preintMeasCov()[:3, :3]))
    assert variances[1] > 100.0 * variances[0]
    assert variances[2] - variances[1] < 2.0 * variances[0]  # a covariance that leaks adds a hundred times as much


@dataclass(frozen=True, eq=False)
class Propagated:
    """The state after a rotation of one second."""

    sigmas: Array
    """(9,) Standard deviations of orientation [rad], position [m] and velocity [m/s]."""
    is_degraded: bool
    """Whether a sensor was saturated."""


@pytest.mark.parametrize("config", [PreintegrationConfig(), DATA_SHEET], ids=["inflated", "data sheet"])
def test_saturation_reaches_states_between_keyframes(config: PreintegrationConfig) -> None:
    params = PreintegrationParams.of(EUROC_IMU, config)
    start = NavState(0, np.eye(4), np.zeros(3), np.zeros(3), np.zeros(3), 1e-8 * np.eye(15))

    def propagated(range_rad_s: float) -> Propagated:
        state = gtsam.NavState(gtsam.Pose3(), np.zeros(3)), gtsam.imuBias.ConstantBias()
        propagation = ImuPropagation(params, EUROC_IMU, start, state)
        propagation.add(clipped_rotation(range_rad_s)[0])
        covariance, is_degraded = propagation.state_at(200 * STEP_NS).covariance, propagation.is_degraded
        assert not propagation.restarted(()).is_degraded
        assert covariance is not None
        return Propagated(np.sqrt(np.diag(covariance)[:9]), is_degraded)

    clipped, whole = propagated(1.0), propagated(10.0)
    assert clipped.is_degraded and not whole.is_degraded
    # A rotation about x tilts the specific force towards y
    assert clipped.sigmas[0] > 0.1 and clipped.sigmas[4] > 0.1 and clipped.sigmas[7] > 0.1
    velocity_sigma_m_s = config.accel_noise_inflation * EUROC_IMU.accel_noise_density  # white noise, after one second
    assert whole.sigmas[:3].max() < 1e-3 and whole.sigmas[6:].min() > velocity_sigma_m_s
    if config == DATA_SHEET:
        assert whole.sigmas.max() < 0.01
    else:
        np.testing.assert_allclose(whole.sigmas[6:], velocity_sigma_m_s, rtol=0.05)


def test_a_gap_in_the_samples_has_excess_noise() -> None:
    t_ns = np.concatenate([np.arange(50), np.arange(110, 150)]) * STEP_NS
    buffer = ImuBuffer(EUROC_IMU)
    buffer.add(ImuSamples(t_ns, np.zeros((90, 3)), np.tile([0.0, 0.0, GRAVITY_M_S2], (90, 1))))
    parts = [buffer.take_until(k * 10 * STEP_NS) for k in range(1, 15)]
    whole = joined(parts)
    degraded_s = whole.dt_s[whole.excess_sigma.any(axis=1)].sum()
    assert degraded_s == pytest.approx(61 * 0.005, abs=0.02)
    np.testing.assert_array_equal(whole.excess_sigma.max(axis=0), GAP_SIGMA)
    assert parts[6].rotation_excess_sigma_rad == pytest.approx(0.05 * GAP_SIGMA[0])
    assert parts[0].rotation_excess_sigma_rad == 0.0


def test_saturation_after_a_loss_makes_the_yaw_uncertain() -> None:
    last = NavState(0, np.eye(4), np.zeros(3), np.zeros(3), np.zeros(3), 1e-8 * np.eye(15))
    start = NavState(200 * STEP_NS, np.eye(4), np.zeros(3), np.zeros(3), np.zeros(3))

    def yaw_sigma_rad(range_rad_s: float) -> float:
        gauge = LastPublished.of(last).propagated(clipped_rotation(range_rad_s)[0])
        return float(np.sqrt(gauge.covariance(start, InitialSigmas())[2, 2]))

    assert yaw_sigma_rad(1.0) > 0.1 > 0.05 > yaw_sigma_rad(10.0)
