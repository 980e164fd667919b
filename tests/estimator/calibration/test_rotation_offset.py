"""The time offset by rotation: exact rotations of a known motion, and measurements that must not yield an offset."""

from dataclasses import replace

import numpy as np
import pytest

from dronevio.estimator.calibration.image_rotation import (
    MAX_SPAN_S,
    MIN_FEATURES,
    NO_ROTATIONS,
    RelativeRotations,
    image_rotations,
    relative_rotations,
)
from dronevio.estimator.calibration.rotation_offset import MIN_PAIRS, rotation_offset
from dronevio.estimator.types import Observations
from dronevio.models.arrays import Array
from dronevio.models.imu import ImuSamples
from dronevio.models.rotation import exp_so3, integrated_rotations, log_so3, pose_matrix

RANGE_S = 0.25
STEP_NS = 1_000_000
BIAS = np.array([0.05, -0.08, 0.03])


def rates(t_s: Array, seed: int = 0) -> Array:
    """Return the angular velocities (N, 3) of a vehicle at times (N,) [rad/s]: three sines about each axis."""
    rng = np.random.default_rng(seed)
    amplitude, frequency, phase = (rng.uniform(*range_, (3, 3)) for range_ in ((0.2, 0.6), (0.3, 1.8), (0.0, 6.0)))
    return np.asarray((amplitude * np.sin(2.0 * np.pi * frequency * t_s[:, None, None] + phase)).sum(axis=-1))


def gyroscope(seed: int = 0, begin_ns: int = 0) -> ImuSamples:
    """Return four seconds of a gyroscope with a bias, every 5 ms."""
    t_ns = 5 * STEP_NS * np.arange(800)
    return ImuSamples(t_ns + begin_ns, rates(np.asarray(t_ns, np.float64) * 1e-9, seed) + BIAS, np.zeros((800, 3)))


def seen(offset_s: float, period_s: float = 0.05, sigma_rad: float = 2e-4, begin_ns: int = 0) -> RelativeRotations:
    """Return the rotations between frames whose stamps differ from the gyroscope's clock by an offset."""
    fine_ns = STEP_NS * np.arange(4001)
    middle = rates(np.asarray(fine_ns[:-1] + STEP_NS / 2, np.float64) * 1e-9)
    R = integrated_rotations(middle * STEP_NS * 1e-9)
    rows = np.arange(300, 3700, round(period_s * 1e3))
    rotation = log_so3(np.swapaxes(R[rows[:-1]], 1, 2) @ R[rows[1:]])
    rotation = rotation + sigma_rad * np.random.default_rng(1).normal(size=rotation.shape)
    t_ns = fine_ns[rows] - round(offset_s * 1e9) + begin_ns
    return RelativeRotations(t_ns[:-1], t_ns[1:], rotation, np.full(len(rotation), sigma_rad))


@pytest.mark.parametrize("offset_s", [0.0, 0.02, -0.0513, 0.1, -0.2])
@pytest.mark.parametrize("period_s", [0.034, 0.1])
def test_offset_of_a_known_motion_is_found(offset_s: float, period_s: float) -> None:
    found = rotation_offset(seen(offset_s, period_s), gyroscope(), RANGE_S)
    assert found is not None and found.is_significant
    assert abs(found.offset_s - offset_s) < max(4.0 * found.sigma_s, 2e-4)
    assert found.sigma_s < 1e-3 and found.explained > 0.9


def test_the_origin_of_the_clock_is_arbitrary() -> None:
    begin_ns = -(2**61)
    found, shifted = rotation_offset(seen(0.05), gyroscope(), RANGE_S), None
    shifted = rotation_offset(seen(0.05, begin_ns=begin_ns), gyroscope(begin_ns=begin_ns), RANGE_S)
    assert found == shifted


def test_wrong_rotations_of_a_tenth_of_the_frames_change_little() -> None:
    pairs = seen(0.05)
    wrong = np.arange(len(pairs)) % 10 == 0
    rotation = np.where(wrong[:, None], pairs.rotation_rad + 0.03, pairs.rotation_rad)
    found = rotation_offset(replace(pairs, rotation_rad=rotation), gyroscope(), RANGE_S)
    assert found is not None and found.is_significant
    assert found.offset_s == pytest.approx(0.05, abs=1e-3)


@pytest.mark.parametrize("seed", range(1, 6))
def test_another_flight_yields_no_offset(seed: int) -> None:
    found = rotation_offset(seen(0.0), gyroscope(seed), RANGE_S)
    assert found is not None and not found.is_significant


def test_images_in_reverse_order_yield_no_offset() -> None:
    pairs = seen(0.0)
    found = rotation_offset(replace(pairs, rotation_rad=-pairs.rotation_rad[::-1]), gyroscope(), RANGE_S)
    assert found is not None and not found.is_significant


def test_an_offset_beyond_the_range_is_not_significant() -> None:
    found = rotation_offset(seen(0.0), gyroscope(), 0.1)
    late = rotation_offset(seen(0.3), gyroscope(), 0.1)
    assert found is not None and found.is_significant
    assert late is None or not late.is_significant


def test_a_periodic_rotation_is_ambiguous() -> None:
    """Of a swing with a period of 0.2 s, three offsets of the range are equally good."""
    imu, pairs = gyroscope(), seen(0.0)
    swing = np.sin(2.0 * np.pi * imu.t_ns * 1e-9 / 0.2)[:, None] * np.array([1.0, 0.0, 0.0])
    R = integrated_rotations(swing[:-1] * 5e-3)
    rows = [np.searchsorted(imu.t_ns, t_ns) for t_ns in (pairs.start_ns, pairs.end_ns)]
    rotation = log_so3(np.swapaxes(R[rows[0]], 1, 2) @ R[rows[1]])
    found = rotation_offset(replace(pairs, rotation_rad=rotation), replace(imu, gyro_rad_s=swing), RANGE_S)
    assert found is not None and not found.is_significant and found.ambiguity > 0.8


@pytest.mark.parametrize(("sigma_rad", "excludes_zero"), [(2e-4, True), (4e-3, False)])
def test_inaccurate_rotations_do_not_exclude_zero(sigma_rad: float, excludes_zero: bool) -> None:
    """An offset of 12 ms turns these pairs by 3 mrad; rotations with larger errors agree with equal clocks, too."""
    found = rotation_offset(seen(0.012, 0.1, sigma_rad), gyroscope(), RANGE_S)
    assert found is not None and found.is_significant and found.excludes_zero is excludes_zero


def test_without_rotation_there_is_no_offset() -> None:
    pairs, imu = seen(0.0), gyroscope()
    noise = 2e-4 * np.random.default_rng(2).normal(size=pairs.rotation_rad.shape)
    found = rotation_offset(replace(pairs, rotation_rad=noise), replace(imu, gyro_rad_s=0.0 * imu.gyro_rad_s), RANGE_S)
    assert found is None or not found.is_significant


def test_pairs_without_imu_samples_are_left_out() -> None:
    pairs, imu = seen(0.0), gyroscope()
    assert rotation_offset(pairs, imu[: MIN_PAIRS * 5], RANGE_S) is None
    assert rotation_offset(NO_ROTATIONS, imu, RANGE_S) is None


def views(R: Array, t: Array, n: int = 80, outliers: int = 0, seed: int = 0) -> tuple[Array, Array]:
    """Return normalized coordinates of points in two views, the second at R and t in the first."""
    rng = np.random.default_rng(seed)
    points = np.column_stack([rng.uniform(-2.0, 2.0, (n, 2)), rng.uniform(3.0, 8.0, n)])
    moved = (points - t) @ R
    moved[:outliers] += rng.normal(size=(outliers, 3))
    return points[:, :2] / points[:, 2:], moved[:, :2] / moved[:, 2:]


@pytest.mark.parametrize("t_m", [(0.0, 0.0, 0.0), (0.1, 0.0, 0.02), (0.0, -0.05, 0.2)])
@pytest.mark.parametrize("outliers", [0, 15])
def test_rotation_of_two_views_does_not_depend_on_translation(t_m: tuple[float, ...], outliers: int) -> None:
    rotation = np.array([0.03, -0.05, 0.02])
    found, sigma_rad = relative_rotations([views(exp_so3(rotation), np.array(t_m), outliers=outliers)])
    np.testing.assert_allclose(found[0], rotation, atol=1e-4)
    assert 0.0 < sigma_rad[0] < 1e-3


def test_pairs_do_not_depend_on_each_other() -> None:
    """With different numbers of features."""
    pairs = [views(exp_so3(np.array([0.03, y, 0.02])), np.array([0.1, y, 0.0]), n) for y, n in ((0.1, 80), (-0.2, 31))]
    together, alone = relative_rotations(pairs), [relative_rotations([pair]) for pair in pairs]
    np.testing.assert_allclose(together[0], np.concatenate([one[0] for one in alone]), atol=1e-9)
    np.testing.assert_allclose(together[1], np.concatenate([one[1] for one in alone]), rtol=1e-4)


def test_rotations_are_those_of_the_imu_over_long_intervals() -> None:
    """Frames every 25 ms: each second one ends a pair of 0.1 s, and none across a gap."""
    T_imu_cam = pose_matrix(exp_so3(np.array([0.4, 1.0, -0.3])), np.zeros(3))[None]
    R_imu_cam, rate = T_imu_cam[0, :3, :3], np.array([0.2, -0.1, 0.4])
    points = np.column_stack([np.random.default_rng(0).uniform(-2.0, 2.0, (60, 2)), np.full(60, 5.0)])
    t_ns = [*range(0, 200_000_000, 25_000_000), 200_000_000 + round((MAX_SPAN_S + 0.1) * 1e9)]
    ids = np.arange(60)
    frames = []
    for t in t_ns:
        p = points @ (R_imu_cam.T @ exp_so3(rate * t * 1e-9) @ R_imu_cam)
        frames.append(Observations(ids, p[:, :2], p[:, :2] / p[:, 2:], ids))
    found = image_rotations(t_ns, frames, T_imu_cam)
    np.testing.assert_allclose(found.span_s, [0.1, 0.1])
    assert len(image_rotations(t_ns, frames, T_imu_cam, after_ns=100_000_000)) == 1
    np.testing.assert_allclose(found.rotation_rad, rate * found.span_s[:, None], atol=1e-6)
    few = [replace(o, **{name: getattr(o, name)[: MIN_FEATURES - 1] for name in NAMES}) for o in frames]
    assert len(image_rotations(t_ns, few, T_imu_cam)) == 0


NAMES = ("ids", "pixels", "xy", "ages", "camera", "zncc", "scale")
