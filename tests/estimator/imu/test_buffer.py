"""The IMU buffer and the preintegration of its increments."""

from collections.abc import Callable
from typing import TYPE_CHECKING

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dronevio.estimator.imu.buffer import ImuBuffer, Increments
from dronevio.estimator.imu.preintegration import Preintegration, PreintegrationConfig, PreintegrationParams
from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError
from dronevio.models.imu import EUROC_IMU, GRAVITY_M_S2, ImuSamples, Sampling
from dronevio.models.rotation import exp_so3

if TYPE_CHECKING:
    from tests.estimator.conftest import SyntheticFlight

MakeFlight = Callable[..., "SyntheticFlight"]

STEP_NS = 5_000_000
START_NS = 1_403_715_273_262_142_976
SAMPLINGS: tuple[Sampling, ...] = ("point", "increment")


def stream(n: int, sampling: Sampling, seed: int = 0) -> ImuSamples:
    """Return random samples at irregular times."""
    rng = np.random.default_rng(seed)
    t_ns = START_NS + np.cumsum(rng.integers(STEP_NS // 2, 2 * STEP_NS, n))
    return ImuSamples(t_ns, rng.normal(size=(n, 3)), rng.normal(size=(n, 3)), sampling)


def totals(parts: list[Increments]) -> tuple[float, Array, Array]:
    """Return the time [s], the sum of ω dt [rad] and the sum of a dt [m/s]."""
    dt_s = np.concatenate([part.dt_s for part in parts])
    gyro = np.concatenate([part.gyro_rad_s for part in parts])
    accel = np.concatenate([part.accel_m_s2 for part in parts])
    assert np.all(dt_s > 0.0) and len(dt_s) == len(gyro) == len(accel)
    return float(dt_s.sum()), dt_s @ gyro, dt_s @ accel


@pytest.mark.parametrize("sampling", SAMPLINGS)
@given(data=st.data())
@settings(max_examples=60, deadline=None)
def test_increments_do_not_depend_on_how_the_stream_is_cut(sampling: Sampling, data: st.DataObject) -> None:
    n = data.draw(st.integers(2, 30))
    samples = stream(n, sampling, seed=n)
    first, last = int(samples.t_ns[0]), int(samples.t_ns[-1])
    frames = sorted({*data.draw(st.lists(st.integers(first, last), max_size=12)), last})

    whole = ImuBuffer()
    whole.add(samples)
    at_once = totals([whole.take_until(last)])

    buffer, parts, sent = ImuBuffer(), [], 0
    for t_ns in frames:
        due = min(int(np.searchsorted(samples.t_ns, t_ns, side="left")) + 1, n)  # the first beyond the frame included
        while sent < due:
            end = data.draw(st.integers(sent + 1, n))
            buffer.add(samples[sent:end])
            sent = end
        parts.append(buffer.take_until(t_ns))
    piecewise = totals(parts)
    assert at_once[0] == pytest.approx((last - first) * 1e-9, abs=1e-12)
    assert piecewise[0] == pytest.approx(at_once[0], abs=1e-12)
    for found, expected in zip(piecewise[1:], at_once[1:], strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-12)


def test_whole_intervals_are_the_increments_of_the_samples() -> None:
    samples = stream(20, "point")
    buffer = ImuBuffer()
    buffer.add(samples)
    taken = buffer.take_until(int(samples.t_ns[-1]))
    expected = samples.increments()
    np.testing.assert_array_equal(taken.gyro_rad_s, expected.gyro_rad_s)
    np.testing.assert_array_equal(taken.accel_m_s2, expected.accel_m_s2)
    np.testing.assert_allclose(taken.dt_s, np.diff(samples.t_ns) * 1e-9, atol=1e-15)


def test_increments_cover_time_before_stamps_points_both_sides() -> None:
    """Of three samples 5 ms apart, only the second has an angular velocity, of 1 rad/s."""
    rates = np.outer([0.0, 1.0, 0.0], [1.0, 0.0, 0.0])
    t_ns = START_NS + STEP_NS * np.arange(3)
    angles = {}
    for sampling in SAMPLINGS:
        buffer = ImuBuffer()
        buffer.add(ImuSamples(t_ns, rates, np.zeros((3, 3)), sampling))
        angles[sampling] = [totals([buffer.take_until(int(t))])[1][0] for t in t_ns[1:]]
    np.testing.assert_allclose(angles["increment"], [0.005, 0.0], atol=1e-15)
    np.testing.assert_allclose(angles["point"], [0.0025, 0.0025], atol=1e-15)


@pytest.mark.parametrize("sampling", SAMPLINGS)
def test_the_last_sample_is_held_up_to_the_frame(sampling: Sampling) -> None:
    samples = stream(5, sampling)
    buffer = ImuBuffer()
    buffer.add(samples)
    buffer.take_until(int(samples.t_ns[-1]))
    held = buffer.take_until(int(samples.t_ns[-1]) + 20_000_000)
    np.testing.assert_allclose(held.dt_s, [0.02])
    np.testing.assert_array_equal(held.gyro_rad_s, samples.gyro_rad_s[-1:])
    np.testing.assert_array_equal(held.accel_m_s2, samples.accel_m_s2[-1:])


def test_late_samples_count_once() -> None:
    samples = stream(30, "point")
    buffer, parts = ImuBuffer(), []
    buffer.add(samples[:10])
    parts.append(buffer.take_until(int(samples.t_ns[14])))  # five samples are missing
    buffer.add(samples[10:])
    parts.append(buffer.take_until(int(samples.t_ns[-1])))
    assert totals(parts)[0] == pytest.approx(float(samples.t_ns[-1] - samples.t_ns[0]) * 1e-9, abs=1e-12)


def test_no_increments_before_the_first_sample() -> None:
    buffer = ImuBuffer()
    assert len(buffer.take_until(START_NS).dt_s) == 0
    samples = stream(5, "point")
    buffer.add(samples)
    assert len(buffer.take_until(int(samples.t_ns[0]) - 1).dt_s) == 0


def test_increments_are_returned_once() -> None:
    samples = stream(10, "point")
    buffer = ImuBuffer()
    buffer.add(samples)
    t_ns = int(samples.t_ns[6]) + 1_000_000
    assert len(buffer.take_until(t_ns).dt_s) == 7
    assert len(buffer.take_until(t_ns).dt_s) == 0


@pytest.mark.parametrize("rows", [1, 4])
def test_some_of_the_increments(rows: int) -> None:
    """A single row of standard deviations holds for all intervals."""
    values = np.arange(12.0).reshape(4, 3)
    part = Increments(np.arange(1.0, 5.0), values, values + 12.0, np.arange(6.0 * rows).reshape(rows, 6))[1:3]
    np.testing.assert_array_equal(part.dt_s, [2.0, 3.0])
    np.testing.assert_array_equal(part.gyro_rad_s, [[3.0, 4.0, 5.0], [6.0, 7.0, 8.0]])
    np.testing.assert_array_equal(part.accel_m_s2, [[15.0, 16.0, 17.0], [18.0, 19.0, 20.0]])
    np.testing.assert_array_equal(part.excess_sigma[:, 0], [0.0] if rows == 1 else [6.0, 12.0])


def test_points_and_increments_do_not_mix() -> None:
    buffer = ImuBuffer()
    samples, others = stream(10, "point"), stream(10, "increment")
    buffer.add(samples[:5])
    with pytest.raises(ConfigError):
        buffer.add(others[5:])


def test_memory_does_not_grow_with_the_flight() -> None:
    samples = stream(4000, "point")
    buffer = ImuBuffer()
    for k in range(0, 4000, 10):
        buffer.add(samples[k : k + 10])
        buffer.take_until(int(samples.t_ns[k + 8]))
    assert 0 < sum(map(len, buffer._received)) < 5


@given(st.lists(st.integers(1, 199 * STEP_NS), min_size=1, max_size=8), st.integers(0, 100))
@settings(max_examples=40, deadline=None)
def test_constant_rates_give_the_exact_rotation(cuts_ns: list[int], seed: int) -> None:
    rng = np.random.default_rng(seed)
    omega, bias = rng.normal(size=3), 0.05 * rng.normal(size=3)
    buffer = ImuBuffer()
    buffer.add(ImuSamples(START_NS + STEP_NS * np.arange(200), np.tile(omega + bias, (200, 1)), np.zeros((200, 3))))
    R, before = np.eye(3), 0
    for cut_ns in sorted(set(cuts_ns)):
        part = buffer.take_until(START_NS + cut_ns)
        np.testing.assert_allclose(part.rotation(bias), exp_so3(omega * (cut_ns - before) * 1e-9), atol=1e-12)
        R, before = R @ part.rotation(bias), cut_ns
    np.testing.assert_allclose(R, exp_so3(omega * before * 1e-9), atol=1e-12)


def preintegrated(parts: list[Increments], config: PreintegrationConfig | None = None) -> gtsam.NavState:
    """Return the state that GTSAM's preintegration predicts from rest at the origin."""
    params = PreintegrationParams.of(EUROC_IMU, config or PreintegrationConfig())
    pim = Preintegration(params, gtsam.imuBias.ConstantBias())
    for part in parts:
        pim.integrate(part)
    return pim.measurements.predict(gtsam.NavState(), gtsam.imuBias.ConstantBias())


@pytest.mark.parametrize("sampling", SAMPLINGS)
@pytest.mark.parametrize("frame_offset_ns", [0, 1_300_000, 2_500_000])
def test_preintegration_follows_an_analytic_path(
    make_flight: MakeFlight, sampling: Sampling, frame_offset_ns: int
) -> None:
    """Two seconds of motion, with the stream cut at every frame, on a sample or between two of them.

    Preintegration restarts every 0.2 s, as at keyframes, because GTSAM's is not exact over long rotations.
    """
    flight = make_flight(0, rest_s=-5.0, duration_s=3.0, noisy=False, sampling=sampling)
    buffer = ImuBuffer()
    buffer.add(flight.imu)
    times = flight.frame_times_ns[:41] + frame_offset_ns
    buffer.take_until(int(times[0]))
    truth = flight.truth_at(times)
    params, bias = PreintegrationParams.of(EUROC_IMU, PreintegrationConfig()), gtsam.imuBias.ConstantBias()
    assert truth.velocity_m_s is not None
    state = gtsam.NavState(gtsam.Pose3(truth.Ts_world_imu[0]), truth.velocity_m_s[0])
    for k in range(1, 41, 4):
        pim = Preintegration(params, bias)
        for t_ns in times[k : k + 4].tolist():
            pim.integrate(buffer.take_until(t_ns))
        assert pim.duration_s == pytest.approx(0.2)
        state = pim.measurements.predict(state, bias)
    np.testing.assert_allclose(state.pose().matrix()[:3, :3], truth.rotations[-1], atol=1e-5)
    np.testing.assert_allclose(state.velocity(), truth.velocity_m_s[-1], atol=5e-4)
    np.testing.assert_allclose(state.position(), truth.p_world_imu[-1], atol=5e-4)


def test_rotations_are_multiplied_in_order(make_flight: MakeFlight) -> None:
    """One second of rotation about all axes, of which the increments are exact."""
    flight = make_flight(0, rest_s=-5.0, duration_s=2.0, noisy=False, sampling="increment")
    buffer = ImuBuffer()
    buffer.add(flight.imu)
    times = flight.frame_times_ns[[5, 25]]
    buffer.take_until(int(times[0]))
    R0, R1 = flight.truth_at(times).rotations
    np.testing.assert_allclose(buffer.take_until(int(times[1])).rotation(np.zeros(3)), R0.T @ R1, atol=1e-12)


def test_gravity_cancels_at_rest() -> None:
    n = 200
    rest = Increments(np.full(n, 0.005), np.zeros((n, 3)), np.tile([0.0, 0.0, GRAVITY_M_S2], (n, 1)))
    end = preintegrated([rest])
    np.testing.assert_allclose(end.velocity(), 0.0, atol=1e-12)
    np.testing.assert_allclose(end.position(), 0.0, atol=1e-12)


def test_noise_settings_reach_gtsam() -> None:
    config = PreintegrationConfig(
        gyro_noise_inflation=3.0, accel_noise_inflation=4.0, walk_inflation=7.0, integration_sigma=1e-3
    )
    params = PreintegrationParams.of(EUROC_IMU, config).to_gtsam()
    imu, eye = EUROC_IMU, np.eye(3)
    np.testing.assert_allclose(params.getGyroscopeCovariance(), eye * (3.0 * imu.gyro_noise_density) ** 2)
    np.testing.assert_allclose(params.getAccelerometerCovariance(), eye * (4.0 * imu.accel_noise_density) ** 2)
    np.testing.assert_allclose(params.getIntegrationCovariance(), eye * 1e-6)
    np.testing.assert_allclose(params.getBiasOmegaCovariance(), eye * (7.0 * imu.gyro_random_walk) ** 2)
    np.testing.assert_allclose(params.getBiasAccCovariance(), eye * (7.0 * imu.accel_random_walk) ** 2)


def test_cost_of_a_sample_does_not_grow_while_no_frame_comes(monkeypatch: pytest.MonkeyPatch) -> None:
    """As where a camera has failed: the samples that wait are not copied with each new one."""
    copied, concatenated = [], ImuSamples.concatenated

    def counted(batches: list[ImuSamples]) -> ImuSamples:
        copied.append(sum(map(len, batches)))
        return concatenated(batches)

    monkeypatch.setattr(ImuSamples, "concatenated", staticmethod(counted))
    count = 1000
    samples = ImuSamples(5_000_000 * np.arange(count), np.zeros((count, 3)), np.zeros((count, 3)))
    buffer = ImuBuffer()
    for i in range(count):
        buffer.add(samples[i : i + 1])
    assert sum(copied) <= 3 * count
    assert buffer.take_until(int(samples.t_ns[-1])).duration_s == pytest.approx(0.005 * (count - 1))
