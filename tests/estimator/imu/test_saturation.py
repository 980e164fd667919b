"""A sensor at its limit is told from one at rest or in motion, and what it does not tell is not believed."""

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dronevio.estimator.imu.buffer import GAP_SIGMA, ImuBuffer, Increments, joined
from dronevio.estimator.imu.preintegration import PreintegrationConfig, integrate, preintegration_params
from dronevio.estimator.imu.saturation import MIN_GYRO_RANGE_RAD_S, SaturationDetector
from dronevio.estimator.initialization.gauge import LastBelieved
from dronevio.estimator.initialization.static import InitialSigmas
from dronevio.estimator.propagator import Propagation
from dronevio.models.imu import EUROC_IMU, GRAVITY_M_S2, ImuSamples
from dronevio.models.state import NavState

STEP_NS = 5_000_000
LIMIT_RAD_S = 1.0
NOISE_RAD_S = 0.0024  # EuRoC's
DATA_SHEET = PreintegrationConfig(gyro_noise_inflation=1.0, accel_noise_inflation=1.0)


def turning(
    n: int, seed: int, peak_rad_s: float, resolution_rad_s: float = EUROC_IMU.gyro_resolution_rad_s
) -> np.ndarray:
    """Return a gyroscope's readings (n, 3) of a drone that turns to and fro, of EuRoC's noise and resolution."""
    rng = np.random.default_rng(seed)
    t_s, phase = np.arange(n) * 0.005, rng.uniform(0.0, 2.0 * np.pi, 3)
    true = peak_rad_s * np.sin(t_s[:, None] * [1.1, 2.3, 3.1] + phase)
    noisy = true + rng.normal(0.0, NOISE_RAD_S, true.shape)
    return resolution_rad_s * np.rint(noisy / resolution_rad_s)


def fed(limit: SaturationDetector, values: np.ndarray, batch: int) -> np.ndarray:
    """Return where readings have reached a limit, (N, 3), asked after each batch of them."""
    found = []
    for start in range(0, len(values), batch):
        limit.update(values[start : start + batch])
        found.append(limit.saturation_limits(values[start : start + batch]) > 0.0)
    return np.concatenate(found)


@given(seed=st.integers(0, 10_000), batch=st.integers(1, 40))
@settings(max_examples=40, deadline=None)
def test_a_limit_is_found_by_its_readings_alone(seed: int, batch: int) -> None:
    true = turning(2000, seed, 1.7)
    clipped = np.clip(true, -LIMIT_RAD_S, LIMIT_RAD_S)
    limit = SaturationDetector(EUROC_IMU.gyro_range_rad_s, MIN_GYRO_RANGE_RAD_S)
    found = fed(limit, clipped, batch)
    assert limit.limit == LIMIT_RAD_S
    beyond = np.abs(true) > LIMIT_RAD_S
    late = np.flatnonzero(np.any(beyond & ~found, axis=1))
    assert len(late) <= 30 and not np.any(found & (np.abs(true) < 0.99 * LIMIT_RAD_S))
    assert len(late) == 0 or late.max() <= np.flatnonzero(found.any(axis=1))[0]  # none, once the limit is known


@given(seed=st.integers(0, 10_000), batch=st.integers(1, 40), peak_rad_s=st.floats(0.3, 10.0))
@settings(max_examples=40, deadline=None)
def test_motion_within_the_range_is_believed(seed: int, batch: int, peak_rad_s: float) -> None:
    found = fed(SaturationDetector(np.inf, MIN_GYRO_RANGE_RAD_S), turning(2000, seed, peak_rad_s), batch)
    assert found.mean() < 1e-3


@pytest.mark.parametrize("step", [1e-4, 5e-3, 0.1], ids=["fine", "coarse", "coarser than its noise"])
def test_rest_is_no_limit_however_coarse_the_sensor(step: float) -> None:
    rng = np.random.default_rng(0)
    gyro = step * np.rint((0.08 + rng.normal(0.0, NOISE_RAD_S, (2000, 3))) / step)
    accel = step * np.rint((np.array([0.0, 0.0, GRAVITY_M_S2]) + rng.normal(0.0, 0.03, (2000, 3))) / step)
    buffer = ImuBuffer(EUROC_IMU)
    buffer.add(ImuSamples(np.arange(2000) * STEP_NS, gyro, accel))
    assert not buffer.take_until(1999 * STEP_NS).is_degraded


def test_what_is_exceeded_was_no_limit() -> None:
    limit = SaturationDetector(np.inf, MIN_GYRO_RANGE_RAD_S)
    limit.update(np.full((10, 3), 2.0))
    assert limit.limit == 2.0
    limit.update(np.full((1, 3), 2.5))
    assert limit.limit == np.inf


def test_a_stated_range_is_known_from_the_first_reading_on() -> None:
    limit = SaturationDetector(2.0, MIN_GYRO_RANGE_RAD_S)
    values = np.array([[0.0, -2.0, 1.99]])
    limit.update(values)
    np.testing.assert_array_equal(limit.saturation_limits(values), [[0.0, 2.0, 0.0]])


def clipped_flight(clip: float) -> tuple[Increments, np.ndarray]:
    """Return increments of a turn about x, up to 2 rad/s and read up to a limit, and the true turn [rad]."""
    t_s = np.arange(201) * 0.005
    true = np.column_stack([2.0 * np.sin(np.pi * t_s), 0.0 * t_s, 0.0 * t_s])
    buffer = ImuBuffer(EUROC_IMU)
    up = np.tile([0.0, 0.0, GRAVITY_M_S2], (201, 1))
    buffer.add(ImuSamples(np.arange(201) * STEP_NS, np.clip(true, -clip, clip), up))
    return buffer.take_until(200 * STEP_NS), np.array([4.0 / np.pi, 0.0, 0.0])


def test_the_covariance_holds_what_a_limit_hides() -> None:
    """And only about the axis that is at its limit; a motion within the range has the noise that it always had."""
    params = preintegration_params(EUROC_IMU, PreintegrationConfig())
    sigmas, errors = {}, {}
    for name, clip in (("clipped", 1.0), ("whole", 10.0)):
        increments, true_turn = clipped_flight(clip)
        pim = gtsam.PreintegratedCombinedMeasurements(params, gtsam.imuBias.ConstantBias())
        integrate(pim, increments, params)
        sigmas[name] = np.sqrt(np.diag(pim.preintMeasCov())[:3])
        errors[name] = np.abs(gtsam.Rot3.Logmap(pim.deltaRij()) - true_turn)
        assert increments.is_degraded is (name == "clipped")
    assert errors["whole"][0] < 1e-3 < 0.3 < errors["clipped"][0] < 3.0 * sigmas["clipped"][0]
    np.testing.assert_allclose(sigmas["clipped"][1:], sigmas["whole"][1:], rtol=0.1)
    assert sigmas["whole"][0] < 0.01
    np.testing.assert_array_equal(params.getGyroscopeCovariance(), np.eye(3) * params.getGyroscopeCovariance()[0, 0])


@pytest.mark.parametrize("config", [PreintegrationConfig(), DATA_SHEET], ids=["inflated", "data sheet"])
def test_doubt_reaches_the_state_between_keyframes(config: PreintegrationConfig) -> None:
    params = preintegration_params(EUROC_IMU, config)
    start = NavState(0, np.eye(4), np.zeros(3), np.zeros(3), np.zeros(3), 1e-8 * np.eye(15))
    found = {}
    for clip in (1.0, 10.0):
        state = gtsam.NavState(gtsam.Pose3(), np.zeros(3)), gtsam.imuBias.ConstantBias()
        propagation = Propagation(params, EUROC_IMU, start, state)
        propagation.add(clipped_flight(clip)[0])
        covariance = propagation.state_at(200 * STEP_NS).covariance
        assert covariance is not None
        found[clip] = np.sqrt(np.diag(covariance)[:9]), propagation.is_degraded
        propagation.restart(())
        assert not propagation.is_degraded
    (clipped, is_degraded), (whole, was_whole) = found[1.0], found[10.0]
    assert is_degraded and not was_whole
    assert clipped[0] > 0.1 and clipped[4] > 0.1 and clipped[7] > 0.1  # a turn about x tilts the force towards y
    noise_m_s = config.accel_noise_inflation * EUROC_IMU.accel_noise_density  # of velocity, after a second
    assert whole[:3].max() < 1e-3 and whole[6:].min() > noise_m_s  # tilt adds a little
    if config == DATA_SHEET:
        assert whole.max() < 0.01
    else:
        np.testing.assert_allclose(whole[6:], noise_m_s, rtol=0.05)


def test_a_gap_in_the_samples_is_in_doubt() -> None:
    t_ns = np.concatenate([np.arange(50), np.arange(110, 150)]) * STEP_NS
    buffer = ImuBuffer(EUROC_IMU)
    buffer.add(ImuSamples(t_ns, np.zeros((90, 3)), np.tile([0.0, 0.0, GRAVITY_M_S2], (90, 1))))
    parts = [buffer.take_until(k * 10 * STEP_NS) for k in range(1, 15)]
    whole = joined(parts)
    doubted_s = whole.dt_s[whole.excess_sigma.any(axis=1)].sum()
    assert doubted_s == pytest.approx(61 * 0.005, abs=0.02)
    np.testing.assert_array_equal(whole.excess_sigma.max(axis=0), GAP_SIGMA)
    assert parts[6].rotation_excess_sigma_rad == pytest.approx(0.05 * GAP_SIGMA[0])
    assert parts[0].rotation_excess_sigma_rad == 0.0


def test_saturated_turn_after_a_loss_makes_yaw_uncertain() -> None:
    believed = NavState(0, np.eye(4), np.zeros(3), np.zeros(3), np.zeros(3), 1e-8 * np.eye(15))
    start = NavState(200 * STEP_NS, np.eye(4), np.zeros(3), np.zeros(3), np.zeros(3))
    yaw_sigmas = []
    for clip in (1.0, 10.0):
        origin = LastBelieved(believed)
        origin.turn(clipped_flight(clip)[0])
        yaw_sigmas.append(float(np.sqrt(origin.covariance(start, InitialSigmas())[2, 2])))
    assert yaw_sigmas[0] > 0.1 > 0.05 > yaw_sigmas[1]
