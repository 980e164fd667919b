"""Covariances: two orders of the same thing, and dead reckoning against numerical derivatives."""

import gtsam
import numpy as np
import pytest

from dronevio.estimator.imu.covariance import covariance_from_gtsam, covariance_to_gtsam, propagate_covariance
from dronevio.models.imu import EUROC_IMU, GRAVITY_M_S2, ImuModel
from dronevio.models.rotation import exp_so3, log_so3

NOISELESS = ImuModel("none", 200.0, 0.0, 0.0, 0.0, 0.0)
GRAVITY = np.array([0.0, 0.0, -GRAVITY_M_S2])
DT_S, STEPS = 0.005, 40


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(5)


def random_covariance(rng: np.random.Generator) -> np.ndarray:
    A = rng.normal(size=(15, 15))
    return A @ A.T


def assert_proper(P: np.ndarray) -> None:
    np.testing.assert_allclose(P, P.T, atol=1e-12 * np.abs(P).max())
    assert np.linalg.eigvalsh(P).min() > -1e-12 * np.abs(P).max()


@pytest.mark.parametrize("seed", range(5))
def test_there_and_back_again(seed: int) -> None:
    rng = np.random.default_rng(seed)
    P, R = random_covariance(rng), exp_so3(rng.normal(size=3))
    np.testing.assert_allclose(covariance_to_gtsam(covariance_from_gtsam(P, R), R), P, atol=1e-12)
    np.testing.assert_allclose(covariance_from_gtsam(covariance_to_gtsam(P, R), R), P, atol=1e-12)
    for Q in (covariance_from_gtsam(P, R), covariance_to_gtsam(P, R)):
        assert_proper(Q)
        np.testing.assert_allclose(np.linalg.eigvalsh(Q), np.linalg.eigvalsh(P), atol=1e-9)  # nothing is stretched


def test_order_is_gtsams_own(rng: np.random.Generator) -> None:
    """What GTSAM's retractions do with small steps, is what our order says of them."""
    R, p, step = exp_so3(rng.normal(size=3)), rng.normal(size=3), 1e-5 * rng.normal(size=15)
    pose = gtsam.Pose3(gtsam.Rot3(R), p)
    moved = pose.retract(step[:6])
    bias = gtsam.imuBias.ConstantBias(np.zeros(3), np.zeros(3)).retract(step[9:])
    ours = np.concatenate(
        [
            log_so3(R.T @ moved.rotation().matrix()),
            moved.translation() - p,
            step[6:9],
            bias.gyroscope(),
            bias.accelerometer(),
        ]
    )
    np.testing.assert_allclose(covariance_from_gtsam(np.outer(step, step), R), np.outer(ours, ours), atol=1e-14)


class Stretch:
    """Some tenths of a second of sensed motion, and dead reckoning over it."""

    def __init__(self, steps: int = STEPS) -> None:
        t = np.arange(steps)[:, None] * DT_S
        self.gyro = np.array([0.8, -1.1, 0.5]) + 0.5 * np.sin(5.0 * t + [0.0, 1.0, 2.0])
        self.accel = np.array([2.0, -1.0, 9.0]) + 1.5 * np.sin(7.0 * t + [2.0, 0.0, 1.0])
        self.t_s = steps * DT_S

    def go(self, x: list[np.ndarray]) -> list[np.ndarray]:
        """Return where a state (R, p, v, b_gyro, b_accel) gets to."""
        R, p, v, b_gyro, b_accel = x
        for turn, accel in zip(exp_so3((self.gyro - b_gyro) * DT_S), self.accel - b_accel, strict=True):
            a = R @ accel + GRAVITY
            p, v, R = p + v * DT_S + 0.5 * a * DT_S**2, v + a * DT_S, R @ turn
        return [R, p, v, b_gyro, b_accel]

    def preintegrated(self, x: list[np.ndarray]) -> dict[str, np.ndarray | float]:
        """Return what the preintegration of the same stretch says."""
        R, p, v, *_ = x
        R1, p1, v1, *_ = self.go(x)
        t = self.t_s
        dp, dv = R.T @ (p1 - p - v * t - 0.5 * GRAVITY * t * t), R.T @ (v1 - v - GRAVITY * t)
        return {"dR": R.T @ R1, "dp": dp, "dv": dv, "dt_s": t}


def moved_by(x: list[np.ndarray], step: np.ndarray) -> list[np.ndarray]:
    return [x[0] @ exp_so3(step[:3]), *(part + step[3 * k : 3 * k + 3] for k, part in enumerate(x[1:], 1))]


def difference(x: list[np.ndarray], y: list[np.ndarray]) -> np.ndarray:
    return np.concatenate([log_so3(x[0].T @ y[0]), *(b - a for a, b in zip(x[1:], y[1:], strict=True))])


@pytest.fixture
def state(rng: np.random.Generator) -> list[np.ndarray]:
    return [exp_so3(np.array([0.4, -0.7, 1.5])), rng.normal(size=3), rng.normal(size=3), np.zeros(3), np.zeros(3)]


def numerical_jacobian(stretch: Stretch, state: list[np.ndarray]) -> np.ndarray:
    h, end = 1e-6, stretch.go(state)
    steps = h * np.eye(15)
    return np.stack([difference(end, stretch.go(moved_by(state, step))) for step in steps], axis=1) / h


def test_correlations_are_spread_too(state: list[np.ndarray], rng: np.random.Generator) -> None:
    """A full covariance of orientation, position and velocity, with all its correlations."""
    stretch, P = Stretch(), np.zeros((15, 15))
    P[:9, :9] = random_covariance(rng)[:9, :9]
    F = numerical_jacobian(stretch, state)
    told = propagate_covariance(P, state[0], **stretch.preintegrated(state), imu=NOISELESS)
    np.testing.assert_allclose(told[:9, :9], (F @ P @ F.T)[:9, :9], rtol=1e-4, atol=1e-4)


def test_noise_is_that_of_a_thousand_flights(state: list[np.ndarray], rng: np.random.Generator) -> None:
    imu = EUROC_IMU
    stretch, runs = Stretch(), 1000
    white = 1.0 / np.sqrt(DT_S)
    ends = []
    gyro, accel = stretch.gyro, stretch.accel
    for _ in range(runs):
        stretch.gyro = gyro + imu.gyro_noise_density * white * rng.normal(size=gyro.shape)
        stretch.accel = accel + imu.accel_noise_density * white * rng.normal(size=accel.shape)
        ends.append(stretch.go(state))
    stretch.gyro, stretch.accel = gyro, accel
    clean = stretch.go(state)
    spread = np.std([difference(clean, end)[:9] for end in ends], axis=0)
    P = propagate_covariance(np.zeros((15, 15)), state[0], **stretch.preintegrated(state), imu=imu)
    np.testing.assert_allclose(np.sqrt(np.diag(P)[:9]), spread, rtol=0.15)
    walk = np.repeat([imu.gyro_random_walk, imu.accel_random_walk], 3) * np.sqrt(stretch.t_s)
    np.testing.assert_allclose(np.sqrt(np.diag(P)[9:]), walk)


def test_covariances_stay_proper_and_grow(rng: np.random.Generator) -> None:
    P, R = random_covariance(rng) * 1e-3, exp_so3(rng.normal(size=3))
    stretch = Stretch()
    moved = stretch.preintegrated([R, np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)])
    for _ in range(20):
        before = P
        P = propagate_covariance(P, R, **moved, imu=EUROC_IMU)
        assert_proper(P)
    assert np.all(np.diag(P)[9:] > np.diag(before)[9:])
