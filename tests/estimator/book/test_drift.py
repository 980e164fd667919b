"""The drift of dead reckoning: its integration, its prediction, and both compared."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from dronevio.estimator.book.drift import (
    SOURCES,
    dead_reckoning,
    predicted_covariance,
    run_drift_study,
    simulate_increments,
)
from dronevio.estimator.book.loop import LoopFlight
from dronevio.estimator.imu.buffer import Increments
from dronevio.estimator.imu.preintegration import Preintegration, PreintegrationConfig, PreintegrationParams
from dronevio.models.imu import GRAVITY_M_S2, ImuModel
from dronevio.models.imu_presets import BMI088, IMUS, MPU_6050

SILENT = ImuModel(gyro_noise_density=0.0, accel_noise_density=0.0, gyro_random_walk=0.0, accel_random_walk=0.0)


def test_samples_without_errors_lead_along_the_circle() -> None:
    flight = LoopFlight(duration_s=12.0, imu_rate_hz=200.0)  # one round
    gyro, accel = simulate_increments(flight, SILENT, np.random.default_rng(0), 2)
    positions = dead_reckoning(flight, gyro, accel)
    truth = flight.states(np.arange(1, flight.samples + 1, dtype=np.float64) * flight.dt_s).p_world_imu
    np.testing.assert_allclose(positions, np.broadcast_to(truth, positions.shape), atol=2e-5)
    np.testing.assert_allclose(positions[:, -1], 0.0, atol=2e-5)


def test_integration_agrees_with_preintegration_of_gtsam() -> None:
    flight = LoopFlight(duration_s=5.0, imu_rate_hz=BMI088.rate_hz)
    gyro, accel = simulate_increments(flight, BMI088, np.random.default_rng(1), 1)
    bias = gtsam.imuBias.ConstantBias()
    preintegration = Preintegration(PreintegrationParams.of(BMI088, PreintegrationConfig()), bias)
    preintegration.integrate(Increments(np.full(flight.samples, flight.dt_s), gyro[0], accel[0]))
    expected = preintegration.measurements.predict(flight.scenario.navState(0.0), bias).position()
    # GTSAM integrates in the tangent space, which differs by micrometres.
    np.testing.assert_allclose(dead_reckoning(flight, gyro, accel)[0, -1], expected, atol=1e-5)


def test_prediction_at_rest_is_the_closed_form() -> None:
    """Of an IMU at rest: σ_a² t³/3 + σ_ba² t⁵/20 vertically, and g² (σ_g² t⁵/20 + σ_bg² t⁷/252) horizontally more."""
    imu, t = MPU_6050, np.array([10.0, 60.0])
    at_rest = LoopFlight(speed_m_s=0.0, pitch_rate_rad_s=1e-9, duration_s=60.0)
    P = predicted_covariance(at_rest, imu, t)[:, 3:6, 3:6]
    vertical = imu.accel_noise_density**2 * t**3 / 3.0 + imu.accel_random_walk**2 * t**5 / 20.0
    tilt = imu.gyro_noise_density**2 * t**5 / 20.0 + imu.gyro_random_walk**2 * t**7 / 252.0
    np.testing.assert_allclose(P[:, 2, 2], vertical, rtol=0.02)
    np.testing.assert_allclose(P[:, 0, 0], vertical + GRAVITY_M_S2**2 * tilt, rtol=0.02)
    np.testing.assert_allclose(P[:, 1, 1], P[:, 0, 0], rtol=1e-6)


@pytest.mark.parametrize(("name", "duration_s"), [("MPU-6050", 20.0), ("euroc", 20.0)])
def test_measured_spread_is_that_of_theory(name: str, duration_s: float) -> None:
    study = run_drift_study(IMUS[name], np.random.default_rng(0), runs=40, duration_s=duration_s)
    assert study.error_m.shape == (40, 20, 3) and study.t_s[-1] == duration_s
    assert 0.8 < study.ratio[-1] < 1.25
    assert 0.8 < study.ratio[9] < 1.25
    assert 0.05 < study.ratio_sigma < 0.1  # between 1/√(6 R) for equal axes and 1/√(2 R) for a single one


def test_variances_of_the_sources_of_drift_add_up() -> None:
    study = run_drift_study(BMI088, np.random.default_rng(0), runs=1, duration_s=5.0)
    assert np.sum(study.source_sigma_m**2) == pytest.approx(study.sigma_m[-1] ** 2, rel=1e-9)
    assert len(study.source_sigma_m) == len(SOURCES)


def test_unknown_turn_on_biases_spread_as_theory_predicts() -> None:
    imu, flight = (
        replace(SILENT, gyro_turn_on_bias_rad_s=1e-3, accel_turn_on_bias_m_s2=2e-2),
        LoopFlight(duration_s=5.0),
    )
    study = run_drift_study(imu, np.random.default_rng(0), runs=200, duration_s=5.0)
    initial = np.diag(np.repeat([0.0, 0.0, 0.0, 1e-3, 2e-2], 3) ** 2)
    P = predicted_covariance(flight, SILENT, np.array([5.0]), initial)[-1, 3:6, 3:6]
    assert study.uncalibrated_rms_m == pytest.approx(np.sqrt(np.trace(P)), rel=0.1)  # two standard deviations
    assert study.rms_m[-1] < 1e-3


def test_mpu_6050_drifts_less_than_better_imus_only_if_it_is_calibrated() -> None:
    mpu, better = (
        run_drift_study(IMUS[name], np.random.default_rng(0), runs=10, duration_s=20.0)
        for name in ("MPU-6050", "ADIS16448")
    )
    assert mpu.rms_m[-1] < 0.7 * better.rms_m[-1]
    assert mpu.uncalibrated_rms_m > 2.0 * better.uncalibrated_rms_m


def test_twice_the_noise_is_twice_the_drift() -> None:
    noisier = replace(MPU_6050, **{source: 2.0 * getattr(MPU_6050, source) for source in SOURCES})
    one, two = (run_drift_study(imu, np.random.default_rng(3), runs=4, duration_s=5.0) for imu in (MPU_6050, noisier))
    np.testing.assert_allclose(two.sigma_m, 2.0 * one.sigma_m, rtol=1e-9)
    np.testing.assert_allclose(two.rms_m, 2.0 * one.rms_m, rtol=0.01)
