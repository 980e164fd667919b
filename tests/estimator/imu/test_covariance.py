"""Covariances of the navigation state: conversion between two orders, and propagation by dead reckoning."""

from dataclasses import dataclass, replace

import gtsam
import numpy as np
import pytest

from dronevio.estimator.imu.covariance import covariance_from_gtsam, covariance_to_gtsam, propagate_covariance
from dronevio.models.arrays import Array
from dronevio.models.imu import EUROC_IMU, GRAVITY_M_S2, ImuModel
from dronevio.models.rotation import exp_so3, log_so3

State = tuple[Array, Array, Array, Array, Array]
"""Orientation (3, 3), position, velocity, and biases of gyroscope and accelerometer (3,)."""

NOISELESS = ImuModel("none", 200.0, 0.0, 0.0, 0.0, 0.0)
GRAVITY = np.array([0.0, 0.0, -GRAVITY_M_S2])
DT_S = 0.005


@dataclass(frozen=True, eq=False)
class Interval:
    """IMU increments over 0.2 s of changing motion."""

    gyro: Array
    accel: Array

    @property
    def dt_s(self) -> float:
        """Length of the interval [s]."""
        return len(self.gyro) * DT_S

    def integrated(self, start: State) -> State:
        """Return the state at the end of the interval."""
        R, p, v, gyro_bias, accel_bias = start
        for dR, accel in zip(exp_so3((self.gyro - gyro_bias) * DT_S), self.accel - accel_bias, strict=True):
            a = R @ accel + GRAVITY
            p, v, R = p + v * DT_S + 0.5 * a * DT_S**2, v + a * DT_S, R @ dR
        return R, p, v, gyro_bias, accel_bias

    def propagated(self, P: Array, start: State, imu: ImuModel) -> Array:
        """Return the covariance at the end of the interval, given that at the start."""
        R, p, v, *_ = start
        R_end, p_end, v_end, *_ = self.integrated(start)
        dp = R.T @ (p_end - p - v * self.dt_s - 0.5 * GRAVITY * self.dt_s**2)
        dv = R.T @ (v_end - v - GRAVITY * self.dt_s)
        return propagate_covariance(P, R, dR=R.T @ R_end, dp=dp, dv=dv, dt_s=self.dt_s, imu=imu)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(5)


@pytest.fixture
def interval() -> Interval:
    t = np.arange(40)[:, None] * DT_S
    gyro = np.array([0.8, -1.1, 0.5]) + 0.5 * np.sin(5.0 * t + [0.0, 1.0, 2.0])
    return Interval(gyro, np.array([2.0, -1.0, 9.0]) + 1.5 * np.sin(7.0 * t + [2.0, 0.0, 1.0]))


@pytest.fixture
def start(rng: np.random.Generator) -> State:
    R = exp_so3(np.array([0.4, -0.7, 1.5]))
    return R, rng.normal(size=3), rng.normal(size=3), np.zeros(3), np.zeros(3)


def random_covariance(rng: np.random.Generator) -> Array:
    A = rng.normal(size=(15, 15))
    return np.asarray(A @ A.T)


def assert_positive_semidefinite(P: Array) -> None:
    np.testing.assert_allclose(P, P.T, atol=1e-12 * np.abs(P).max())
    assert np.linalg.eigvalsh(P).min() > -1e-12 * np.abs(P).max()


def retracted(x: State, delta: Array) -> State:
    """Return the state at a tangent vector (15,), in the order of `NavState`."""
    R, p, v, gyro_bias, accel_bias = x
    return (
        R @ exp_so3(delta[:3]),
        p + delta[3:6],
        v + delta[6:9],
        gyro_bias + delta[9:12],
        accel_bias + delta[12:],
    )


def local_coordinates(x: State, y: State) -> Array:
    """Return the tangent vector (15,) from one state to another."""
    return np.concatenate([log_so3(x[0].T @ y[0]), *(b - a for a, b in zip(x[1:], y[1:], strict=True))])


@pytest.mark.parametrize("seed", range(5))
def test_conversions_are_inverse_to_each_other(seed: int) -> None:
    rng = np.random.default_rng(seed)
    P, R = random_covariance(rng), exp_so3(rng.normal(size=3))
    np.testing.assert_allclose(covariance_to_gtsam(covariance_from_gtsam(P, R), R), P, atol=1e-12)
    np.testing.assert_allclose(covariance_from_gtsam(covariance_to_gtsam(P, R), R), P, atol=1e-12)
    for converted in (covariance_from_gtsam(P, R), covariance_to_gtsam(P, R)):
        assert_positive_semidefinite(converted)
        np.testing.assert_allclose(np.linalg.eigvalsh(converted), np.linalg.eigvalsh(P), atol=1e-9)


def test_conversion_agrees_with_gtsams_retractions(rng: np.random.Generator) -> None:
    """The covariance of one small step, in GTSAM's order, becomes that of the change which GTSAM makes of the step."""
    R, p, step = exp_so3(rng.normal(size=3)), rng.normal(size=3), 1e-5 * rng.normal(size=15)
    pose = gtsam.Pose3(gtsam.Rot3(R), p).retract(step[:6])
    bias = gtsam.imuBias.ConstantBias(np.zeros(3), np.zeros(3)).retract(step[9:])
    rotation, translation = log_so3(R.T @ pose.rotation().matrix()), pose.translation() - p
    expected = np.concatenate([rotation, translation, step[6:9], bias.gyroscope(), bias.accelerometer()])
    found = covariance_from_gtsam(np.outer(step, step), R)
    np.testing.assert_allclose(found, np.outer(expected, expected), atol=1e-14)


def test_correlations_are_propagated(interval: Interval, start: State, rng: np.random.Generator) -> None:
    """A full covariance of orientation, position and velocity, against derivatives of the integration."""
    P, h, end = np.zeros((15, 15)), 1e-6, interval.integrated(start)
    P[:9, :9] = random_covariance(rng)[:9, :9]
    columns = [local_coordinates(end, interval.integrated(retracted(start, h * e))) / h for e in np.eye(15)]
    F = np.stack(columns, axis=1)
    found = interval.propagated(P, start, NOISELESS)
    np.testing.assert_allclose(found[:9, :9], (F @ P @ F.T)[:9, :9], rtol=1e-4, atol=1e-4)


def test_noise_agrees_with_monte_carlo_runs(interval: Interval, start: State, rng: np.random.Generator) -> None:
    imu, exact = EUROC_IMU, interval.integrated(start)
    gyro_sigma, accel_sigma = imu.gyro_noise_density / np.sqrt(DT_S), imu.accel_noise_density / np.sqrt(DT_S)
    errors = []
    for _ in range(1000):
        gyro = interval.gyro + gyro_sigma * rng.normal(size=interval.gyro.shape)
        accel = interval.accel + accel_sigma * rng.normal(size=interval.accel.shape)
        errors.append(local_coordinates(exact, replace(interval, gyro=gyro, accel=accel).integrated(start))[:9])
    sigmas = np.sqrt(np.diag(interval.propagated(np.zeros((15, 15)), start, imu)))
    np.testing.assert_allclose(sigmas[:9], np.std(errors, axis=0), rtol=0.15)
    random_walk = np.repeat([imu.gyro_random_walk, imu.accel_random_walk], 3) * np.sqrt(interval.dt_s)
    np.testing.assert_allclose(sigmas[9:], random_walk)


def test_a_gyro_bias_tilts_gravity(rng: np.random.Generator) -> None:
    """Level for 5 s with a bias of 3e-3 rad/s on each axis: the velocity errs by .52 m/s, by Monte Carlo runs."""
    steps, sigma = 1000, 3e-3
    level = Interval(np.zeros((steps, 3)), np.tile([0.0, 0.0, GRAVITY_M_S2], (steps, 1)))
    start = np.eye(3), np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3)
    exact, biases = level.integrated(start), sigma * rng.normal(size=(400, 3))
    errors = [local_coordinates(exact, level.integrated((*start[:3], bias, start[4])))[:9] for bias in biases]
    P = np.zeros((15, 15))
    P[range(9, 12), range(9, 12)] = sigma**2
    found = level.propagated(P, start, NOISELESS)[:9, :9]
    assert np.sqrt(np.trace(found[6:9, 6:9])) == pytest.approx(0.52, abs=0.005)
    tilting = np.ix_([0, 1, 3, 4, 6, 7], [0, 1, 3, 4, 6, 7])  # neither yaw nor height errs, to the first order
    expected = np.mean([np.outer(e, e) for e in errors], axis=0)[tilting]
    scale = np.sqrt(np.outer(np.diag(found[tilting]), np.diag(found[tilting])))
    np.testing.assert_allclose(found[tilting] / scale, expected / scale, atol=0.2)


def test_covariances_stay_positive_and_grow(interval: Interval, rng: np.random.Generator) -> None:
    P, zero = random_covariance(rng) * 1e-3, np.zeros(3)
    start = exp_so3(rng.normal(size=3)), zero, zero, zero, zero
    for _ in range(20):
        before, P = P, interval.propagated(P, start, EUROC_IMU)
        assert_positive_semidefinite(P)
        assert np.all(np.diag(P)[9:] > np.diag(before)[9:])
