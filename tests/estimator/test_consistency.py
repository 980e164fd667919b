"""Consistency of the odometry: errors agree with the published covariances, by a chi-squared test.

Where the estimator assumes the noise that the simulation has, the normalized estimation error squared (NEES) of three
components has a chi-squared distribution of three degrees of freedom, and the sum over M independent runs one of 3 M
(Bar-Shalom, Li, Kirubarajan, "Estimation with applications to tracking and navigation", 2001, section 5.4). Each run
has its own path, landmarks, biases and noise, and yields one value; seeds are fixed.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import gtsam
import numpy as np
import pytest
from scipy.stats import chi2

from dronevio.estimator.backend.config import SmootherConfig
from dronevio.estimator.backend.landmarks import LandmarkConfig
from dronevio.estimator.backend.smoother import KeyframeSmoother
from dronevio.estimator.baselines.dead_reckoning import DeadReckoning, DeadReckoningConfig
from dronevio.estimator.config import VioConfig
from dronevio.estimator.frontend.rolling_shutter import ExposureCompensation
from dronevio.estimator.imu.buffer import Increments
from dronevio.estimator.imu.covariance import covariance_from_gtsam
from dronevio.estimator.imu.preintegration import Preintegration, PreintegrationConfig, PreintegrationParams
from dronevio.estimator.initialization.gauge import LastPublished
from dronevio.estimator.initialization.static import InitialSigmas
from dronevio.estimator.optimization.linalg import CholeskyFactor
from dronevio.estimator.propagator import ImuPropagation
from dronevio.estimator.types import GAUGE_SIGMA, NO_FEATURES, Calibration
from dronevio.models.arrays import Array
from dronevio.models.imu import GRAVITY_M_S2, ImuModel, ImuSamples
from dronevio.models.rig import euroc_rig
from dronevio.models.rotation import exp_so3, log_so3, pose_matrix, rotation_z
from dronevio.models.state import CameraFrame, Estimate, Health, NavState, Trajectory

if TYPE_CHECKING:
    from tests.estimator.conftest import SyntheticFlight

MakeFlight = Callable[..., "SyntheticFlight"]

CONFIDENCE = 0.999
"""Probability that the sum of NEES of a consistent estimator is within the bounds."""
PIXEL_NOISE = 0.2
"""Standard deviation of the observations [px]."""


def matched_noise(c: VioConfig) -> VioConfig:
    """Return some settings with the noise of the simulation and nearly quadratic losses instead."""
    exact = {"gyro_noise_inflation": 1.0, "accel_noise_inflation": 1.0}
    exact |= {"min_gyro_noise_density": 0.0, "min_accel_noise_density": 0.0}
    return replace(
        c,
        smoother=replace(c.smoother, pixel_sigma=PIXEL_NOISE, robust_sigmas=30.0),
        preintegration=replace(c.preintegration, **exact),
        noise=replace(c.noise, prior_weight=1e9),
    )


def yaw_alignment(truth: Trajectory, estimated: Trajectory) -> Array:
    """Return the rotation (3, 3) about z from the estimated to the true world frame."""
    R = np.einsum("nij,nkj->nik", truth.rotations, estimated.rotations)
    yaw = np.arctan2((R[:, 1, 0] - R[:, 0, 1]).sum(), (R[:, 0, 0] + R[:, 1, 1]).sum())
    return rotation_z(yaw)


def first_window_ns(estimates: Sequence[Estimate]) -> int:
    """Return the time of the first frame in the window of a dynamic initialization [ns]."""
    initialized = next(e.t_ns for e in estimates if e.state is not None or "±" in str(e.health_report))
    return initialized - round(VioConfig().initialization.dynamic.window_s * 1e9)


def final_nees(flight: "SyntheticFlight", estimates: Sequence[Estimate], static: bool) -> Array:
    """Return the NEES (2, 3) of the newest state at a keyframe and of the newest one between keyframes.

    The columns are position, velocity and orientation. The gauge fixes position and yaw at the initialization: at the
    first pose of a static one, or at the first frame in the window of a dynamic one. The state at the latter is not
    published, so that the yaw is fitted to all poses. Then only the tilt counts for the orientation, with two degrees
    of freedom, because the fit leaves hardly any error of the yaw.
    """
    with_state = [e for e in estimates if e.state is not None]
    estimated = Trajectory.from_states(e.state for e in with_state if e.state is not None)
    truth = flight.truth_at(estimated.t_ns)
    if static:
        R, true_origin, origin = yaw_alignment(truth[:1], estimated[:1]), truth.p_world_imu[0], estimated.p_world_imu[0]
    else:
        first = flight.truth_at(np.array([first_window_ns(estimates)]))
        R, true_origin, origin = yaw_alignment(truth, estimated), first.p_world_imu[0], np.zeros(3)
    P = estimated.covariance
    assert truth.velocity_m_s is not None and estimated.velocity_m_s is not None and P is not None
    errors = (
        truth.p_world_imu - true_origin - (estimated.p_world_imu - origin) @ R.T,
        truth.velocity_m_s - estimated.velocity_m_s @ R.T,
        log_so3(np.swapaxes(estimated.rotations, 1, 2) @ R.T @ truth.rotations),
    )
    covariances = R @ P[:, 3:6, 3:6] @ R.T, R @ P[:, 6:9, 6:9] @ R.T, P[:, :3, :3]
    is_keyframe = np.array(["keyframe" in e.events for e in with_state])
    rows = [np.flatnonzero(is_keyframe)[-1], np.flatnonzero(~is_keyframe)[-1]]
    return np.array(
        [[e[k] @ np.linalg.solve(C[k], e[k]) for e, C in zip(errors, covariances, strict=True)] for k in rows]
    )


@pytest.mark.parametrize(
    ("rest_s", "duration_s", "runs", "degrees"),
    [(1.0, 3.5, 6, (3, 3, 3)), (-5.0, 5.5, 5, (3, 3, 2))],
    ids=["static", "dynamic"],
)
@pytest.mark.slow
def test_nees_has_the_expected_distribution(
    make_flight: MakeFlight,
    known_calibration: VioConfig,
    rest_s: float,
    duration_s: float,
    runs: int,
    degrees: tuple[int, int, int],
) -> None:
    nees = []
    for seed in range(runs):
        flight = make_flight(seed, rest_s, duration_s, sampling="increment", max_features=30, pixel_noise=PIXEL_NOISE)
        nees.append(final_nees(flight, flight.run(config=matched_noise(known_calibration)), static=rest_s > 0.0))
    for row, where in zip(np.mean(nees, axis=0), ("at keyframes", "between keyframes"), strict=True):
        for mean, quantity, n in zip(row, ("position", "velocity", "orientation"), degrees, strict=True):
            low, high = np.array(chi2.interval(CONFIDENCE, n * runs)) / runs
            assert low < mean < high, f"{quantity} {where}: {mean:.2f}; expected {low:.2f} to {high:.2f}"


def test_covariance_grows_by_the_noise_of_the_imu() -> None:
    """A keyframe without uncertainty is propagated for a second without rotation.

    White noise of density σ, inflated as configured, adds σ² t to orientation and velocity and σ² t³/3 to the position;
    a random walk of the acceleration adds σ² t to itself, σ² t³/3 to the velocity and σ² t⁵/20 to the position.
    """
    imu, config, n = ImuModel(), PreintegrationConfig(gyro_noise_inflation=2.0, accel_noise_inflation=5.0), 200
    R, t = exp_so3(np.array([0.3, -0.2, 1.0])), 1.0
    exact = NavState(0, pose_matrix(R, np.zeros(3)), np.zeros(3), np.zeros(3), np.zeros(3), np.zeros((15, 15)))
    start = gtsam.NavState(gtsam.Pose3(exact.T_world_imu), np.zeros(3)), gtsam.imuBias.ConstantBias()
    propagation = ImuPropagation(PreintegrationParams.of(imu, config), imu, exact, start)
    force = np.tile(R.T @ [0.0, 0.0, GRAVITY_M_S2], (n, 1))
    propagation.add(Increments(np.full(n, t / n), np.zeros((n, 3)), force))
    P = propagation.state_at(round(t * 1e9)).covariance
    assert P is not None
    gyro, accel = 2.0 * imu.gyro_noise_density, 5.0 * imu.accel_noise_density
    # Two random walks act on the velocity: gravity through the tilt, and the accelerometer bias
    walk = (gyro * GRAVITY_M_S2) ** 2 * np.diag([1.0, 1.0, 0.0]) + imu.accel_random_walk**2 * np.eye(3)
    velocity = accel**2 * t * np.eye(3) + walk * t**3 / 3.0
    position = accel**2 * t**3 / 3.0 * np.eye(3) + walk * t**5 / 20.0
    np.testing.assert_allclose(P[:3, :3], gyro**2 * t * np.eye(3), rtol=0.02, atol=1e-3 * gyro**2)
    np.testing.assert_allclose(P[6:9, 6:9], velocity, rtol=0.02, atol=1e-3 * accel**2)
    np.testing.assert_allclose(P[3:6, 3:6], position, rtol=0.02, atol=1e-3 * accel**2)
    np.testing.assert_allclose(P[9:12, 9:12], imu.gyro_random_walk**2 * t * np.eye(3))
    np.testing.assert_allclose(P[12:, 12:], imu.accel_random_walk**2 * t * np.eye(3))


def test_parameters_of_preintegration_are_densities_squared() -> None:
    imu = ImuModel()
    config = PreintegrationConfig(gyro_noise_inflation=2.0, accel_noise_inflation=5.0, walk_inflation=3.0)
    params = PreintegrationParams.of(imu, config).to_gtsam()
    for found, density in (
        (params.getGyroscopeCovariance(), 2.0 * imu.gyro_noise_density),
        (params.getAccelerometerCovariance(), 5.0 * imu.accel_noise_density),
        (params.getIntegrationCovariance(), config.integration_sigma),
        (params.getBiasOmegaCovariance(), 3.0 * imu.gyro_random_walk),
        (params.getBiasAccCovariance(), 3.0 * imu.accel_random_walk),
    ):
        np.testing.assert_allclose(found, density**2 * np.eye(3), rtol=1e-12)


def test_degraded_readings_count_as_white_noise() -> None:
    """An error of standard deviation s with correlation time τ = 0.2 s adds s² τ to the squared noise density."""
    imu, config, n, dt_s = ImuModel(), PreintegrationConfig(), 100, 0.005
    excess = np.array([[0.3, 0.2, 0.1, 3.0, 2.0, 1.0]])
    params = PreintegrationParams.of(imu, config)
    pim = Preintegration(params, gtsam.imuBias.ConstantBias())
    pim.integrate(Increments(np.full(n, dt_s), np.zeros((n, 3)), np.zeros((n, 3)), excess))
    found = np.diag(pim.measurements.preintMeasCov())
    gyro2 = (config.gyro_noise_inflation * imu.gyro_noise_density) ** 2
    accel2 = (config.accel_noise_inflation * imu.accel_noise_density) ** 2
    np.testing.assert_allclose(found[:3], (gyro2 + 0.2 * excess[0, :3] ** 2) * n * dt_s, rtol=1e-3)
    np.testing.assert_allclose(found[6:9], (accel2 + 0.2 * excess[0, 3:] ** 2) * n * dt_s, rtol=1e-3)


def test_uncertainty_of_stationary_dead_reckoning_grows() -> None:
    """While stationary, tilt and accelerometer bias add to the uncertainty of the velocity, and that to the position's.

    With gravity g and the standard deviations σ of the tilt, v of the velocity and b of the accelerometer bias, the
    variance of a horizontal velocity is v² + (g σ t)² + (b t)², and that of the position
    (v t)² + (g σ t²/2)² + (b t²/2)².
    """
    sigmas = InitialSigmas(tilt_rad=0.02, velocity_m_s=0.05, gyro_bias_rad_s=1e-6, accel_bias_m_s2=0.1)
    estimator = DeadReckoning(euroc_rig(), DeadReckoningConfig(sigmas=sigmas))
    t_ns = 5_000_000 * np.arange(401)
    up = np.array([0.0, 0.0, 1.0])
    estimator.add_imu(ImuSamples(t_ns, np.zeros((401, 3)), np.tile(GRAVITY_M_S2 * up, (401, 1))))
    states = [estimator.add_frame(CameraFrame(int(t), ())).state for t in t_ns[::10]]
    initialized = [state for state in states if state is not None]
    first, later = initialized[0].covariance, initialized[20].covariance
    assert first is not None and later is not None
    assert initialized[20].t_ns - initialized[0].t_ns == 10**9
    np.testing.assert_allclose(first, sigmas.covariance(np.eye(3)), atol=1e-12)
    gravity_error = GRAVITY_M_S2 * 0.02
    horizontal_velocity = 0.05**2 + gravity_error**2 + 0.1**2
    horizontal_position = 0.05**2 + (gravity_error / 2.0) ** 2 + 0.05**2
    np.testing.assert_allclose(np.diag(later)[6:9], [horizontal_velocity] * 2 + [0.05**2 + 0.1**2], rtol=0.01)
    np.testing.assert_allclose(np.diag(later)[3:6], [horizontal_position] * 2 + [0.05**2 + 0.05**2], rtol=0.01)


def test_first_keyframe_has_the_given_covariance() -> None:
    """The prior of the window is the inverse of the given covariance, except that the gauge fixes the position."""
    rng = np.random.default_rng(0)
    A, R = rng.normal(size=(15, 15)), exp_so3(np.array([0.3, -0.2, 1.0]))
    given = 1e-3 * (A @ A.T + np.eye(15))
    start = NavState(0, pose_matrix(R, rng.normal(size=3)), rng.normal(size=3), np.zeros(3), np.zeros(3), given)
    smoother = KeyframeSmoother(Calibration(euroc_rig()), SmootherConfig(), LandmarkConfig(), start, given, NO_FEATURES)
    assert smoother.state.covariance is not None
    np.testing.assert_array_equal(smoother.state.covariance, given)
    in_window = covariance_from_gtsam(CholeskyFactor(smoother._window.linearize().H).inverse_block(np.arange(15)), R)
    expected = given.copy()
    expected[3:6] = expected[:, 3:6] = 0.0
    expected[3:6, 3:6] = GAUGE_SIGMA**2 * np.eye(3)
    np.testing.assert_allclose(in_window, expected, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("time_offset_s", [0.0, 0.012])
def test_propagation_to_the_stamp_keeps_covariances(time_offset_s: float) -> None:
    """The covariance at the time stamp is that at the exposure, a few milliseconds away."""
    covariance = np.diag(np.arange(1.0, 16.0))
    state = NavState(12_000_000, np.eye(4), np.zeros(3), np.zeros(3), np.zeros(3), covariance)
    stamp_ns = 12_000_000 - round(time_offset_s * 1e9)
    stamped = ExposureCompensation().at_time(Estimate(12_000_000, Health.TRACKING, state), stamp_ns)
    assert stamped.state is not None
    np.testing.assert_array_equal(stamped.state.covariance, covariance)


def test_a_new_calibration_adds_its_uncertainty() -> None:
    """The covariance inflation for the error of the previous calibration is added to that of the state, once."""
    covariance, inflation = np.diag(np.arange(1.0, 16.0)) * 1e-3, np.diag(np.arange(15.0, 0.0, -1.0)) * 1e-3
    start = NavState(0, np.eye(4), np.zeros(3), np.zeros(3), np.zeros(3), covariance)
    calibration = Calibration(euroc_rig())
    smoother = KeyframeSmoother(calibration, SmootherConfig(), LandmarkConfig(), start, covariance, NO_FEATURES)
    smoother = smoother.restarted(calibration, inflation)
    assert smoother.state.covariance is not None
    np.testing.assert_allclose(smoother.state.covariance, covariance + inflation)


@pytest.mark.parametrize(("speed_m_s", "distance_m"), [(0.0, 2.0), (3.0, 6.0)])
def test_uncertainty_of_a_recovery_grows_with_the_outage(speed_m_s: float, distance_m: float) -> None:
    """After two seconds without a state, the flown distance adds to the position and the gyroscope drift to the yaw.

    The distance is that of the last speed, or of 1 m/s if it was lower; all other covariances are those of an
    initialization.
    """
    R = exp_so3(np.array([0.3, -0.2, 1.0]))
    velocity = np.array([0.0, speed_m_s, 0.0])
    last = NavState(0, pose_matrix(R, np.zeros(3)), velocity, np.zeros(3), np.zeros(3), 1e-4 * np.eye(15))
    start = NavState(2 * 10**9, last.T_world_imu, velocity, np.zeros(3), np.zeros(3))
    sigmas = InitialSigmas(tilt_rad=0.1, velocity_m_s=0.2, gyro_bias_rad_s=0.3, accel_bias_m_s2=0.4)
    P = LastPublished.of(last).covariance(start, sigmas)
    position = GAUGE_SIGMA**2 + 1e-4 + distance_m**2
    yaw = GAUGE_SIGMA**2 + 1e-4 + (2.0 * 0.003) ** 2
    np.testing.assert_allclose(R @ P[:3, :3] @ R.T, np.diag([0.01, 0.01, yaw]), atol=1e-12)
    np.testing.assert_allclose(P[3:, 3:], np.diag(np.repeat([position, 0.04, 0.09, 0.16], 3)))
    assert not P[:3, 3:].any()
