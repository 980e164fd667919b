"""Batches of IMU samples: selection, concatenation, and conversion to increments."""

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError
from dronevio.models.imu import GRAVITY_M_S2, ImuSamples, Sampling
from dronevio.models.rotation import exp_so3

STEP_NS = 5_000_000


def batch(n: int = 20, sampling: Sampling = "point") -> ImuSamples:
    rng = np.random.default_rng(n)
    t_ns = 10**18 + np.cumsum(rng.integers(1, 10**7, n))
    return ImuSamples(t_ns, rng.normal(size=(n, 3)), rng.normal(size=(n, 3)), sampling)


def is_same(a: ImuSamples, b: ImuSamples) -> bool:
    return a.sampling == b.sampling and all(
        np.array_equal(getattr(a, k), getattr(b, k)) for k in ("t_ns", "gyro_rad_s", "accel_m_s2")
    )


@given(st.integers(0, 20), st.integers(-1, 1))
@settings(max_examples=60, deadline=None)
def test_parts_extend_to_the_whole_batch(k: int, off_ns: int) -> None:
    samples = batch()
    t_ns = int(samples.t_ns[min(k, 19)]) + off_ns
    before, after = samples.up_to(t_ns), samples.after(t_ns)
    assert np.all(before.t_ns <= t_ns) and np.all(after.t_ns > t_ns)
    assert is_same(before.extended(after), samples)


def test_empty_batches_are_neutral() -> None:
    samples = batch(5, "increment")
    assert is_same(ImuSamples.empty("increment").extended(samples), samples)
    assert is_same(ImuSamples.empty("point").extended(samples), samples)
    assert len(ImuSamples.empty()) == 0 and len(ImuSamples.empty().increments()) == 0


def test_different_sampling_is_refused() -> None:
    first, second = batch(), batch()
    with pytest.raises(ConfigError, match="with sampling 'point' and 'increment'"):
        first[:5].extended(ImuSamples(second.t_ns[5:], second.gyro_rad_s[5:], second.accel_m_s2[5:], "increment"))


@pytest.mark.parametrize(
    ("t_ns", "gyro", "accel"),
    [
        (np.arange(4), np.zeros((3, 3)), np.zeros((4, 3))),
        (np.arange(4), np.zeros((4, 3)), np.zeros((4, 2))),
        (np.arange(4).reshape(2, 2), np.zeros((4, 3)), np.zeros((4, 3))),
    ],
)
def test_wrong_shapes_are_refused(t_ns: npt.NDArray[np.int64], gyro: Array, accel: Array) -> None:
    with pytest.raises(ConfigError, match="shapes"):
        ImuSamples(t_ns, gyro, accel)


@pytest.mark.parametrize("t_ns", [[0, 1, 1], [0, 2, 1]])
def test_time_stamps_have_to_increase(t_ns: list[int]) -> None:
    with pytest.raises(ConfigError, match="do not increase"):
        ImuSamples(np.array(t_ns), np.zeros((3, 3)), np.zeros((3, 3)))


def test_increments_are_returned_unchanged() -> None:
    samples = batch(sampling="increment")
    assert samples.increments() is samples


def test_n_points_yield_n_minus_1_increments() -> None:
    samples = batch()
    increments = samples.increments()
    assert increments.sampling == "increment"
    np.testing.assert_array_equal(increments.t_ns, samples.t_ns[1:])
    assert len(batch(1).increments()) == 0


def test_linear_angular_velocity_gives_exact_angles() -> None:
    t_ns = STEP_NS * np.arange(11)
    rate = np.outer(0.3 + 40.0 * t_ns * 1e-9, [0.0, 0.0, 1.0])
    increments = ImuSamples(t_ns, rate, np.zeros((11, 3))).increments()
    t_s = t_ns[-1] * 1e-9
    angle_rad = (increments.gyro_rad_s * STEP_NS * 1e-9).sum(axis=0)
    np.testing.assert_allclose(angle_rad, [0.0, 0.0, 0.3 * t_s + 20.0 * t_s**2], rtol=1e-12)


def rotating_samples(omega: Array, n: int) -> tuple[ImuSamples, Array]:
    """Return point samples of an IMU that rotates in place at a constant rate, and its orientations (n, 3, 3)."""
    t_ns = STEP_NS * np.arange(n)
    R = exp_so3(np.outer(t_ns * 1e-9, omega))
    return ImuSamples(t_ns, np.tile(omega, (n, 1)), R[:, 2] * GRAVITY_M_S2), R


def test_acceleration_is_in_the_frame_at_the_interval_start() -> None:
    """In place, the specific force in the world frame is 9.81 m/s² upwards at any angular velocity."""
    samples, R = rotating_samples(np.array([1.0, 0.5, -0.3]), 201)
    increments = samples.increments()
    world = np.einsum("nij,nj->ni", R[:-1], increments.accel_m_s2)
    np.testing.assert_allclose(world, np.tile([0.0, 0.0, GRAVITY_M_S2], (200, 1)), atol=1e-9)


def test_the_documented_error_without_rotation() -> None:
    samples, R = rotating_samples(np.radians([50.0, 0.0, 0.0]), 3)
    unrotated = 0.5 * (samples.accel_m_s2[:-1] + samples.accel_m_s2[1:])
    error = np.linalg.norm(np.einsum("nij,nj->ni", R[:-1], unrotated) - [0.0, 0.0, GRAVITY_M_S2], axis=1)
    half_step = 0.5 * np.radians(50.0) * STEP_NS * 1e-9 * GRAVITY_M_S2
    np.testing.assert_allclose(error, half_step, rtol=0.01)
