"""Initialization in motion with outliers: gyroscope bias, closed form, refinement and their robust weights."""

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dronevio.estimator.initialization.closed_form import (
    NoiseModel,
    ViewGeometry,
    WindowState,
    on_sphere,
    solve_closed_form,
)
from dronevio.estimator.initialization.dynamic import (
    DynamicInitializationConfig,
    DynamicStart,
    probable_cause,
)
from dronevio.estimator.initialization.gauge import BiasPrior
from dronevio.estimator.initialization.gyro_bias import EpipolarSolution, epipolar_gyro_bias
from dronevio.estimator.initialization.not_observable import NotObservable
from dronevio.estimator.initialization.refinement import by_gyro_bias, refine
from dronevio.estimator.initialization.robust import INLIER_WEIGHT, MEDIAN_FACTOR, robust_weights
from dronevio.estimator.initialization.views import WindowMeasurements
from dronevio.estimator.monitoring.causes import Cause
from dronevio.estimator.types import FramePacket
from dronevio.models.arrays import Array
from dronevio.models.imu import GRAVITY_M_S2
from dronevio.models.rotation import exp_so3, log_so3, pose_matrix
from tests.estimator.initialization.test_dynamic import errors, initialize_dynamic, window_of

if TYPE_CHECKING:
    from tests.estimator.conftest import SyntheticFlight

MakeFlight = Callable[..., "SyntheticFlight"]

BIAS = np.array([0.03, -0.02, 0.08])
UNKNOWN, UNKNOWN_ACCEL = BiasPrior(np.zeros(3), 0.05), BiasPrior(np.zeros(3), 0.1)
SIGMA = 0.5 / 458.0


def random_errors(k: int, ids: npt.NDArray[np.int64]) -> Array:
    """Return independent errors of 46 px."""
    return 0.1 * np.random.default_rng([1, k]).normal(size=(10_000, 2))[ids]


def common_drift(k: int, ids: npt.NDArray[np.int64]) -> Array:
    """Return the errors of tracks on an object that moves by 1.4 px per frame."""
    return np.tile([0.0018 * k, 0.0024 * k], (len(ids), 1))


def sliding(k: int, ids: npt.NDArray[np.int64]) -> Array:
    """Return the errors of tracks that slide along edges, each in its own direction."""
    angle = np.random.default_rng(2).uniform(0.0, 2.0 * np.pi, 10_000)[ids]
    return 0.003 * k * np.stack([np.cos(angle), np.sin(angle)], axis=1)


WRONG = {"random": random_errors, "common drift": common_drift, "sliding": sliding}


def corrupted(
    window: list[FramePacket], share: float, errors_of: Callable[[int, npt.NDArray[np.int64]], Array]
) -> list[FramePacket]:
    """Return a window in which a share of the tracks, selected by their identities, has errors."""
    packets = []
    for k, packet in enumerate(window):
        ids = packet.observations.ids
        wrong = np.random.default_rng(0).random(10_000)[ids] < share
        xy = packet.observations.xy + np.where(wrong[:, None], errors_of(k, ids), 0.0)
        packets.append(replace(packet, observations=replace(packet.observations, xy=xy)))
    return packets


def is_wrong(ids: npt.NDArray[np.int64], share: float) -> npt.NDArray[np.bool_]:
    """Return which tracks `corrupted` changes."""
    return np.asarray(np.random.default_rng(0).random(10_000)[ids] < share)


def poses_of(flight: "SyntheticFlight") -> Array:
    """Return the poses (C, 4, 4) of a flight's cameras in the IMU frame."""
    return np.stack([camera.T_imu_cam for camera in flight.rig.cameras])


def biases_of(flight: "SyntheticFlight") -> tuple[Array, Array]:
    """Return the true biases (3,) of gyroscope [rad/s] and accelerometer [m/s²] at the first frame."""
    truth = flight.truth_at(flight.frame_times_ns[:1])
    assert truth.gyro_bias_rad_s is not None and truth.accel_bias_m_s2 is not None
    return truth.gyro_bias_rad_s[0], truth.accel_bias_m_s2[0]


def measured(window: list[FramePacket], flight: "SyntheticFlight") -> WindowMeasurements:
    """Return the measurements of a window as initialization uses them."""
    return WindowMeasurements.of(window, poses_of(flight), max_frames=16, min_observations=6)


@pytest.mark.parametrize("kind", WRONG)
@pytest.mark.parametrize("seed", range(3))
def test_a_third_of_wrong_tracks_does_not_change_the_start(make_flight: MakeFlight, seed: int, kind: str) -> None:
    flight = make_flight(seed, rest_s=-5.0, duration_s=2.0, pixel_noise=0.3, max_features=120, gyro_bias=BIAS)
    window, config = window_of(flight), DynamicInitializationConfig()
    focal_px = flight.rig.cameras[0].model.fx
    clean = initialize_dynamic(window, poses_of(flight), focal_px, config, UNKNOWN, UNKNOWN_ACCEL)
    start = initialize_dynamic(
        corrupted(window, 0.33, WRONG[kind]), poses_of(flight), focal_px, config, UNKNOWN, UNKNOWN_ACCEL
    )
    assert isinstance(clean, DynamicStart) and isinstance(start, DynamicStart)
    truth = flight.truth_at(flight.frame_times_ns[:1])
    assert truth.velocity_m_s is not None
    speed_m_s = float(np.linalg.norm(truth.velocity_m_s[0]))
    for state in (clean.state, start.state):
        velocity, tilt, gyro_bias = errors(state, truth)
        assert velocity < 0.05 + 0.1 * speed_m_s and tilt < np.radians(2.0) and gyro_bias < 3e-3
    rejected = is_wrong(start.outliers, 0.33)
    assert rejected.mean() > 0.8 and rejected.sum() > 15


@pytest.mark.parametrize("kind", WRONG)
def test_epipolar_bias_needs_no_initial_value(make_flight: MakeFlight, kind: str) -> None:
    """The bias is twice its assumed standard deviation, and a third of the tracks is wrong."""
    flight = make_flight(2, rest_s=-5.0, duration_s=2.0, pixel_noise=0.3, noisy=False, gyro_bias=BIAS)
    window = corrupted(window_of(flight), 0.33, WRONG[kind])
    views = measured(window, flight)
    found = epipolar_gyro_bias(views, UNKNOWN, SIGMA, 2.0)
    bias, weights = found.bias_rad_s, found.weights
    np.testing.assert_allclose(bias, biases_of(flight)[0], atol=0.012)
    wrong = is_wrong(views.tracks.ids, 0.33)
    assert weights[~wrong].mean() > 0.7
    if kind == "random":  # the epipolar geometry of the others is nearly right
        assert weights[wrong].max() < 0.25


def test_epipolar_bias_is_exact_without_noise(make_flight: MakeFlight) -> None:
    flight = make_flight(1, rest_s=-5.0, duration_s=2.0, noisy=False, sampling="increment", gyro_bias=BIAS)
    found = epipolar_gyro_bias(measured(window_of(flight), flight), BiasPrior(np.zeros(3), 10.0), SIGMA, 2.0)
    bias, weights = found.bias_rad_s, found.weights
    assert found.residual_sigmas < 1e-3
    np.testing.assert_allclose(bias, biases_of(flight)[0], atol=1e-6)
    assert weights.min() > 0.9


def test_without_pairs_of_views_the_prior_remains(make_flight: MakeFlight) -> None:
    flight = make_flight(1, rest_s=-5.0, duration_s=2.0)
    prior = BiasPrior(np.array([0.01, 0.02, 0.03]), 0.05)
    found = epipolar_gyro_bias(measured(window_of(flight, 0.15), flight), prior, SIGMA, 2.0)
    bias, weights = found.bias_rad_s, found.weights
    np.testing.assert_array_equal(bias, prior.mean)
    assert (weights == 1.0).all()


def test_a_certain_prior_determines_the_bias(make_flight: MakeFlight) -> None:
    flight = make_flight(1, rest_s=-5.0, duration_s=2.0, gyro_bias=BIAS)
    views, prior = measured(window_of(flight), flight), BiasPrior(np.array([0.01, 0.02, 0.03]), 1e-7)
    bias = epipolar_gyro_bias(views, prior, SIGMA, 2.0).bias_rad_s
    np.testing.assert_allclose(bias, prior.mean, atol=1e-6)
    moved = BiasPrior(prior.mean + 1e-3, 1e-7)
    state = refine(
        views, solve_closed_form(views, bias, np.ones(len(views.tracks)), noise_of(0.1)), moved, noise_of(0.1)
    )
    np.testing.assert_allclose(state.state.gyro_bias, moved.mean, atol=1e-5)


def turned(flight: "SyntheticFlight", degrees: float) -> Array:
    """Return the poses of a flight's cameras in the IMU frame, rotated about their optical axes."""
    R = exp_so3(np.array([0.0, 0.0, np.radians(degrees)]))
    return poses_of(flight) @ pose_matrix(R, np.zeros(3))


def scaled(window: list[FramePacket], gyro: Array, accel: Array) -> list[FramePacket]:
    """Return a window whose measurements of gyroscope and accelerometer are multiplied by matrices (3, 3)."""
    packets = []
    for packet in window:
        increments = packet.increments
        gyro_rad_s, accel_m_s2 = increments.gyro_rad_s @ gyro.T, increments.accel_m_s2 @ accel.T
        changed = replace(increments, gyro_rad_s=gyro_rad_s, accel_m_s2=accel_m_s2)
        packets.append(replace(packet, increments=changed))
    return packets


EYE, SWAPPED = np.eye(3), np.eye(3)[[1, 0, 2]]
MISTAKES = {
    "gyroscope in degrees": (np.degrees(1.0) * EYE, EYE, 0.0, Cause.ROTATION_DISAGREES),
    "axes of the gyroscope": (SWAPPED, EYE, 0.0, Cause.ROTATION_DISAGREES),
    "extrinsics": (EYE, EYE, 90.0, Cause.ROTATION_DISAGREES),
    "axes of the accelerometer": (EYE, SWAPPED, 0.0, Cause.ACCEL_DISAGREES),
    "accelerometer in g": (EYE, EYE / GRAVITY_M_S2, 0.0, Cause.FORCE_IS_NOT_GRAVITY),
    "both in other units": (np.degrees(1.0) * EYE, EYE / GRAVITY_M_S2, 0.0, Cause.FORCE_IS_NOT_GRAVITY),
}


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("mistake", MISTAKES)
def test_cause_of_a_failed_start_is_stated(make_flight: MakeFlight, mistake: str, seed: int) -> None:
    gyro, accel, degrees, cause = MISTAKES[mistake]
    flight = make_flight(seed, rest_s=-5.0, duration_s=2.0, pixel_noise=0.3, max_features=120)
    window, focal_px = scaled(window_of(flight), gyro, accel), flight.rig.cameras[0].model.fx
    found = initialize_dynamic(
        window, turned(flight, degrees), focal_px, DynamicInitializationConfig(), UNKNOWN, UNKNOWN_ACCEL
    )
    assert isinstance(found, NotObservable) and found.cause == cause


@pytest.mark.parametrize("seed", range(2))
def test_swapped_sensors_are_recognized(make_flight: MakeFlight, seed: int) -> None:
    """What is called a gyroscope reads a constant 9.8, and the accelerometer nearly nothing: no question of units."""
    flight = make_flight(seed, rest_s=-5.0, duration_s=2.0)
    window, focal_px = window_of(flight), flight.rig.cameras[0].model.fx
    swapped = [
        replace(
            p, increments=replace(p.increments, gyro_rad_s=p.increments.accel_m_s2, accel_m_s2=p.increments.gyro_rad_s)
        )
        for p in window
    ]
    found = initialize_dynamic(
        swapped, turned(flight, 0.0), focal_px, DynamicInitializationConfig(), UNKNOWN, UNKNOWN_ACCEL
    )
    assert isinstance(found, NotObservable) and found.cause == Cause.SENSORS_SWAPPED
    assert "units" not in str(found)


@pytest.mark.parametrize(
    ("residual_sigmas", "bias_sigmas", "rotation_rad_s", "cause"),
    [
        (0.8, 0.0, 0.0, Cause.ROTATION_DISAGREES),
        (0.1, 6.1, 0.0, Cause.ROTATION_DISAGREES),
        (0.7, 2.9, 0.21, Cause.ACCEL_DISAGREES),
        (0.7, 3.1, 0.21, Cause.MOTION_DISAGREES),
        (0.1, 0.0, 0.19, Cause.MOTION_DISAGREES),
    ],
)
def test_cause_needs_significant_rotation(
    residual_sigmas: float, bias_sigmas: float, rotation_rad_s: float, cause: str
) -> None:
    solution = EpipolarSolution(np.zeros(3), np.ones(4), residual_sigmas, bias_sigmas)
    assert probable_cause(solution, rotation_rad_s, DynamicInitializationConfig()) == cause


def test_singular_refinement_is_no_start(make_flight: MakeFlight, monkeypatch: pytest.MonkeyPatch) -> None:
    """With measurements that contradict each other, a landmark may come to lie in the centre of a camera."""

    def singular(*_: object) -> None:
        raise np.linalg.LinAlgError("Singular matrix")

    monkeypatch.setattr("dronevio.estimator.initialization.dynamic.refine", singular)
    flight = make_flight(0, rest_s=-5.0, duration_s=2.0)
    focal_px, Ts = flight.rig.cameras[0].model.fx, turned(flight, 0.0)
    found = initialize_dynamic(window_of(flight), Ts, focal_px, DynamicInitializationConfig(), UNKNOWN, UNKNOWN_ACCEL)
    assert isinstance(found, NotObservable) and found.cause
    assert found.reason == "no motion explains images and IMU together"


def noise_of(accel_bias_sigma_m_s2: float) -> NoiseModel:
    """Return a noise model with a standard deviation of the accelerometer bias."""
    return NoiseModel(SIGMA, 2.0, BiasPrior(np.zeros(3), accel_bias_sigma_m_s2), GRAVITY_M_S2)


def test_closed_form_is_exact_with_known_biases(make_flight: MakeFlight) -> None:
    flight = make_flight(
        0,
        rest_s=-5.0,
        duration_s=2.0,
        noisy=False,
        sampling="increment",
        gyro_bias=BIAS,
        accel_bias=np.array([0.15, -0.1, 0.2]),
    )
    gyro_bias, accel_bias = biases_of(flight)
    views, truth = measured(window_of(flight), flight), flight.state_at(int(flight.frame_times_ns[0]))
    noise = NoiseModel(SIGMA, 2.0, BiasPrior(accel_bias, 0.1), GRAVITY_M_S2)
    found = solve_closed_form(views, gyro_bias, np.ones(len(views.tracks)), noise)
    R = truth.T_world_imu[:3, :3]
    np.testing.assert_allclose(found.velocity, R.T @ truth.velocity_m_s, atol=2e-3)
    np.testing.assert_allclose(found.gravity, -GRAVITY_M_S2 * R[2], atol=2e-3)
    np.testing.assert_array_equal(found.accel_bias, accel_bias)


def test_accelerometer_bias_is_estimated(make_flight: MakeFlight) -> None:
    """With a wide prior it is exact; with a narrow one it is nearly zero, and the velocity is wrong instead."""
    vector = np.array([0.15, -0.1, 0.2])
    flight = make_flight(
        0, rest_s=-5.0, duration_s=2.0, noisy=False, sampling="increment", gyro_bias=BIAS, accel_bias=vector
    )
    gyro_bias, accel_bias = biases_of(flight)
    views = measured(window_of(flight), flight)
    truth = flight.truth_at(flight.frame_times_ns[:1])
    assert truth.velocity_m_s is not None
    true_velocity = truth.rotations[0].T @ truth.velocity_m_s[0]
    found: list[WindowState] = []
    for sigma in (10.0, 1e-4):
        initial = solve_closed_form(views, gyro_bias, np.ones(len(views.tracks)), noise_of(sigma))
        found.append(refine(views, initial, BiasPrior(gyro_bias, 0.01), noise_of(sigma)).state)
    wide, narrow = found
    np.testing.assert_allclose(wide.accel_bias, accel_bias, atol=0.01)
    np.testing.assert_allclose(wide.velocity, true_velocity, atol=5e-3)
    assert np.linalg.norm(narrow.accel_bias) < 1e-2
    assert np.linalg.norm(narrow.velocity - true_velocity) > 3.0 * np.linalg.norm(wide.velocity - true_velocity)
    for state in found:
        assert np.linalg.norm(state.gravity) == pytest.approx(GRAVITY_M_S2, abs=1e-9)


def test_refinement_finds_the_minimum(make_flight: MakeFlight) -> None:
    """From a state and a gyroscope bias that are wrong, it returns to the same state."""
    flight = make_flight(0, rest_s=-5.0, duration_s=2.0, pixel_noise=0.3, gyro_bias=BIAS)
    views, noise, gyro_bias = measured(window_of(flight), flight), noise_of(0.1), biases_of(flight)[0]
    initial = solve_closed_form(views, gyro_bias, np.ones(len(views.tracks)), noise)
    prior = BiasPrior(gyro_bias, 0.02)
    best = refine(views, initial, prior, noise)
    moved = replace(initial, velocity=initial.velocity + 0.05, gyro_bias=gyro_bias + 0.002)
    again = refine(views, moved, prior, noise)
    np.testing.assert_allclose(again.state.velocity, best.state.velocity, atol=2e-3)
    np.testing.assert_allclose(again.state.gyro_bias, best.state.gyro_bias, atol=1e-4)
    np.testing.assert_allclose(again.velocity_covariance, best.velocity_covariance, rtol=0.05)
    assert np.linalg.eigvalsh(best.velocity_covariance)[0] > 0.0
    assert best.inliers.mean() > 0.95


def test_derivatives_by_the_gyroscope_bias(make_flight: MakeFlight) -> None:
    """Of rotations and positions by the IMU, and of the landmarks in the cameras, against differences."""
    flight = make_flight(0, rest_s=-5.0, duration_s=2.0, R_mount=exp_so3(np.array([0.4, -0.2, 0.9])))
    window = measured(window_of(flight), flight)
    state = WindowState(np.array([1.0, -0.5, 0.2]), np.array([0.3, 0.2, 9.8]), np.array([0.2, -0.3, 0.1]), BIAS)
    landmarks = np.random.default_rng(0).normal(size=(len(window.tracks), 3)) + np.array([0.0, 0.0, 4.0])

    def in_cameras(bias: Array) -> Array:
        return ViewGeometry.of(window.imu.integrated(bias).motion(), window.Ts_imu_cam).in_cameras(landmarks, state.y)

    at, step = window.imu.integrated(BIAS), 1e-5
    geometry = ViewGeometry.of(at.motion(), window.Ts_imu_cam)
    by_bias = by_gyro_bias(at, geometry, window.Ts_imu_cam, landmarks, state.y)
    for axis, change in enumerate(step * np.eye(3)):
        before, after = window.imu.integrated(BIAS - change), window.imu.integrated(BIAS + change)
        turned = log_so3(after.rotations @ np.swapaxes(before.rotations, 1, 2)) / (2.0 * step)
        np.testing.assert_allclose(turned, at.rotations_by_gyro_bias[..., axis], atol=1e-3)
        moved = (after.motion().dp - before.motion().dp) / (2.0 * step)
        expected = at.dp_by_gyro_bias(np.zeros(3))[..., axis]
        np.testing.assert_allclose(moved, expected, atol=2e-3 * np.abs(moved).max())
        seen = (in_cameras(BIAS + change) - in_cameras(BIAS - change)) / (2.0 * step)
        np.testing.assert_allclose(seen, by_bias[..., axis], atol=2e-3 * np.abs(seen).max())


def test_weight_at_the_threshold_is_a_quarter() -> None:
    """The threshold is that of the assumed noise, or follows the median where it is larger."""
    np.testing.assert_allclose(robust_weights(np.array([0.0, 0.0, 9.0]), 3.0), [1.0, 1.0, INLIER_WEIGHT])
    noisy = np.array([40.0, 40.0, 40.0 * MEDIAN_FACTOR])
    np.testing.assert_allclose(robust_weights(noisy, 3.0), [4.0 / 9.0, 4.0 / 9.0, INLIER_WEIGHT])
    only_first = np.array([True, False, False])
    np.testing.assert_allclose(robust_weights(np.array([1.0, 80.0, 9.0]), 3.0, only_first)[2], INLIER_WEIGHT)


@given(st.lists(st.floats(0.0, 1e6), min_size=1, max_size=20), st.floats(0.5, 5.0))
def test_at_least_half_of_the_landmarks_are_inliers(squares: list[float], sigmas: float) -> None:
    values = np.array(squares)
    weights = robust_weights(values, sigmas)
    assert ((weights >= 0.0) & (weights <= 1.0)).all()
    assert (weights >= INLIER_WEIGHT).mean() >= 0.5
    assert (np.diff(weights[np.argsort(values)]) <= 0.0).all()


@given(st.integers(0, 2**32 - 1), st.floats(0.1, 20.0))
def test_minimum_on_the_sphere_is_stationary(seed: int, radius: float) -> None:
    """The gradient D x − d is parallel to x, and no random point of the sphere is better."""
    rng = np.random.default_rng(seed)
    A, d = rng.normal(size=(4, 3)), rng.normal(size=3)
    D = A.T @ A
    x = on_sphere(D, d, radius)
    assert np.linalg.norm(x) == pytest.approx(radius, rel=1e-9)
    points = rng.normal(size=(200, 3))
    points *= radius / np.linalg.norm(points, axis=1, keepdims=True)
    values = np.einsum("ni,ij,nj->n", points, D, points) - 2.0 * points @ d
    assert x @ D @ x - 2.0 * x @ d <= values.min() + 1e-6 * abs(values.min())
