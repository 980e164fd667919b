"""Output at the IMU rate, against motion in closed form and synthetic flights."""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from dronevio.estimator.imu.forward_propagation import ImuRatePropagator
from dronevio.estimator.imu.outliers import OutlierFilter
from dronevio.estimator.odometry import VisualInertialOdometry
from dronevio.eval.metrics.alignment import align
from dronevio.models.arrays import Array
from dronevio.models.imu import EUROC_IMU, GRAVITY_M_S2, ImuSamples, Sampling, Times
from dronevio.models.protocols import measurements
from dronevio.models.rotation import exp_so3, log_so3, pose_matrix
from dronevio.models.state import Estimate, Health, NavState, Trajectory

if TYPE_CHECKING:
    from tests.estimator.conftest import SyntheticFlight


T0_NS, STEP_NS = 10**18, 5_000_000
GRAVITY = np.array([0.0, 0.0, -GRAVITY_M_S2])
BIASES = np.array([0.002, -0.003, 0.001]), np.array([-0.02, 0.03, 0.01])


def estimate(t_ns: int, T: Array, v: Array) -> Estimate:
    """Return an estimate with the true biases."""
    return Estimate(t_ns, Health.TRACKING, NavState(t_ns, T, v, *BIASES))


def circle(t_s: Array) -> tuple[Array, Array, Array, Array]:
    """Return poses, velocities, angular velocities and specific forces (N, …) on a horizontal circle."""
    radius_m, rate_rad_s = 2.0, 1.5
    R_z = exp_so3(rate_rad_s * t_s[:, None] * [0.0, 0.0, 1.0])
    R = R_z @ exp_so3(np.array([0.2, -0.4, 0.1]))
    radial, tangential = R_z[:, :, 0], R_z[:, :, 1]
    v, a = radius_m * rate_rad_s * tangential, -radius_m * rate_rad_s**2 * radial
    omega = np.swapaxes(R, 1, 2) @ [0.0, 0.0, rate_rad_s]
    force = np.einsum("nji,nj->ni", R, a - GRAVITY)
    return pose_matrix(R, radius_m * radial), v, omega, force


def samples_on_circle(n: int, sampling: Sampling = "point") -> tuple[ImuSamples, Array, Array, Array]:
    """Return n samples of an IMU with biases on the circle, and its true poses, velocities and angular velocities."""
    t_ns: Times = T0_NS + STEP_NS * np.arange(n, dtype=np.int64)
    t_s = (t_ns - T0_NS).astype(np.float64) * 1e-9
    T, v, omega, force = circle(t_s)
    gyro, accel = omega, force
    if sampling == "increment":
        dt_s = STEP_NS * 1e-9
        T_before, v_before, *_ = circle(t_s - dt_s)
        gyro = log_so3(np.swapaxes(T_before[:, :3, :3], 1, 2) @ T[:, :3, :3]) / dt_s
        accel = np.einsum("nji,nj->ni", T_before[:, :3, :3], (v - v_before) / dt_s - GRAVITY)
    return ImuSamples(t_ns, gyro + BIASES[0], accel + BIASES[1], sampling), T, v, omega


@pytest.mark.parametrize("sampling", ["point", "increment"])
@pytest.mark.parametrize("batch", [1, 7, 200])
def test_circle_in_closed_form(sampling: Sampling, batch: int) -> None:
    samples, T, v, omega = samples_on_circle(201, sampling)
    propagator = ImuRatePropagator(EUROC_IMU)
    assert propagator.add_imu(samples[:1]) == []
    propagator.correct(estimate(T0_NS, T[0], v[0]))
    states = [s for k in range(1, 201, batch) for s in propagator.add_imu(samples[k : k + batch])]
    assert [s.t_ns for s in states] == samples.t_ns[1:].tolist()
    np.testing.assert_allclose([s.T_world_imu for s in states], T[1:], atol=2e-4)  # after one second and 3 m
    np.testing.assert_allclose([s.velocity_m_s for s in states], v[1:], atol=2e-4)
    rates = [s.angular_velocity_rad_s for s in states if s.angular_velocity_rad_s is not None]
    np.testing.assert_allclose(rates, omega[1:], atol=1e-9)
    for name, bias in zip(("gyro_bias_rad_s", "accel_bias_m_s2"), BIASES, strict=True):
        np.testing.assert_array_equal(getattr(states[-1], name), bias)


def test_a_late_estimate_corrects_later_states_only() -> None:
    """The estimate of a frame between two samples comes three samples later, and is off by 1 cm and 0.1 m/s."""
    samples, T, v, _ = samples_on_circle(40)
    frame_ns = T0_NS + 20 * STEP_NS + 2_000_000
    T_frame, v_frame, *_ = circle(np.array([(frame_ns - T0_NS) * 1e-9]))
    propagator = ImuRatePropagator(EUROC_IMU)
    propagator.add_imu(samples[:1])
    propagator.correct(estimate(T0_NS, T[0], v[0]))
    before = propagator.add_imu(samples[1:24])
    np.testing.assert_allclose(before[-1].T_world_imu, T[23], atol=1e-4)
    dp, dv = np.array([0.01, 0.0, 0.0]), np.array([0.0, 0.0, 0.1])
    corrected = T_frame[0].copy()
    corrected[:3, 3] += dp
    propagator.correct(estimate(frame_ns, corrected, v_frame[0] + dv))
    after = propagator.add_imu(samples[24:])
    assert [s.t_ns for s in after] == samples.t_ns[24:].tolist()
    elapsed_s = (samples.t_ns[24:] - frame_ns)[:, None] * 1e-9
    np.testing.assert_allclose([s.velocity_m_s for s in after], v[24:] + dv, atol=1e-4)
    found = np.array([s.T_world_imu for s in after])
    np.testing.assert_allclose(found[:, :3, 3], T[24:, :3, 3] + dp + elapsed_s * dv, atol=1e-4)
    np.testing.assert_allclose(found[:, :3, :3], T[24:, :3, :3], atol=1e-4)


@pytest.mark.parametrize("ends", [[1, 60], [25, 26, 47, 60]])
def test_states_do_not_depend_on_batches(ends: list[int]) -> None:
    samples, T, v, _ = samples_on_circle(60)

    def states(ends: Sequence[int]) -> list[Array]:
        propagator = ImuRatePropagator(EUROC_IMU)
        propagator.correct(estimate(T0_NS, T[0], v[0]))
        batches = [samples[a:b] for a, b in zip([0, *ends[:-1]], ends, strict=True)]
        return [s.T_world_imu for batch in batches for s in propagator.add_imu(batch)]

    np.testing.assert_array_equal(states(ends), states(range(1, 61)))


def test_no_states_without_an_estimate() -> None:
    samples, T, v, _ = samples_on_circle(30)
    propagator = ImuRatePropagator(EUROC_IMU)
    assert propagator.add_imu(samples[:10]) == []
    propagator.correct(estimate(int(samples.t_ns[9]), T[9], v[9]))
    assert len(propagator.add_imu(samples[10:20])) == 10
    propagator.correct(Estimate(int(samples.t_ns[19]), Health.LOST, None))
    assert propagator.add_imu(samples[20:25]) == []
    propagator.correct(estimate(int(samples.t_ns[24]), T[24], v[24]))
    np.testing.assert_allclose(propagator.add_imu(samples[25:])[-1].T_world_imu, T[29], atol=1e-5)


def test_a_sample_costs_little() -> None:
    """A state within 50 µs, one sample at a time; measured in units of the cost of a small matrix product."""
    samples, T, v, _ = samples_on_circle(1001)
    batches = [samples[k : k + 1] for k in range(1001)]

    def seconds() -> tuple[float, float]:
        propagator = ImuRatePropagator(EUROC_IMU)
        propagator.add_imu(batches[0])
        propagator.correct(estimate(T0_NS, T[0], v[0]))
        start = time.process_time()
        for batch in batches[1:]:
            propagator.add_imu(batch)
        middle = time.process_time()
        for _ in range(10_000):
            np.dot(T[0], T[1])
        return middle - start, (time.process_time() - middle) / 10.0

    of_states, of_products = min(seconds() for _ in range(3))
    assert of_states < 80.0 * of_products  # 1000 of each; a product takes about 0.7 µs


def test_samples_are_as_accurate_as_frames(make_flight: Callable[..., "SyntheticFlight"]) -> None:
    flight = make_flight(2, rest_s=1.5, duration_s=10.0)
    vio = VisualInertialOdometry(flight.rig, front_end=flight.front_end())
    propagator = ImuRatePropagator(flight.rig.imu)
    states: list[NavState] = []
    frames: list[NavState] = []
    jumps_m = []
    for measurement in measurements(flight):
        if isinstance(measurement, ImuSamples):
            vio.add_imu(measurement)
            states += propagator.add_imu(measurement)
            continue
        found = vio.add_frame(measurement)
        propagator.correct(found)
        frames += [] if found.state is None else [found.state]
        if states and found.state is not None:  # the state at the time of the frame is predicted
            assert states[-1].t_ns == found.t_ns
            jumps_m.append(np.linalg.norm(states[-1].T_world_imu[:3, 3] - found.state.T_world_imu[:3, 3]))
            if "keyframe" not in found.events and found.t_ns > flight.frame_times_ns[60]:
                # Nothing is corrected: the odometry has the same prediction
                np.testing.assert_allclose(states[-1].T_world_imu, found.state.T_world_imu, atol=1e-6)
    stamps = np.array([s.t_ns for s in states])
    assert np.all(np.diff(stamps) == STEP_NS) and len(stamps) > 1500
    assert max(jumps_m) < 0.05
    assert rms_error_m(flight, states) < 1.1 * rms_error_m(flight, frames) < 0.05
    rates = np.array([s.angular_velocity_rad_s for s in states])
    true_rates = flight.motion.at((stamps - flight.frame_times_ns[0]) * 1e-9).omega
    assert np.sqrt(np.mean((rates - true_rates) ** 2)) < 0.01


def rms_error_m(flight: "SyntheticFlight", states: Sequence[NavState]) -> float:
    """Return the root mean square position error after alignment of yaw and position [m]."""
    path = Trajectory.from_states(states)
    truth = flight.truth_at(path.t_ns)
    fit = align(truth.p_world_imu, path.p_world_imu, "yaw")
    error_m = np.linalg.norm(truth.p_world_imu - fit.positions(path.p_world_imu), axis=1)
    return float(np.sqrt(np.mean(error_m**2)))


def test_estimates_need_no_covariance_or_tracking() -> None:
    samples, T, v, _ = samples_on_circle(20)
    propagator = ImuRatePropagator(EUROC_IMU)
    propagator.add_imu(samples[:10])
    propagator.correct(replace(estimate(int(samples.t_ns[9]), T[9], v[9]), health=Health.INERTIAL_ONLY))
    assert len(propagator.add_imu(samples[10:])) == 10


def test_states_at_times_are_those_of_the_samples() -> None:
    """Samples are pushed ahead of the times; states between two samples are those of the earlier one."""
    samples, T, v, omega = samples_on_circle(40)
    one_by_one, ahead = ImuRatePropagator(EUROC_IMU), ImuRatePropagator(EUROC_IMU)
    for propagator in (one_by_one, ahead):
        propagator.push(samples[:5])
        propagator.correct(estimate(int(samples.t_ns[4]), T[4], v[4]))
    expected = one_by_one.add_imu(samples[5:])
    ahead.push(samples[5:])
    start = ahead.state_at(int(samples.t_ns[4]))
    assert start is not None and start.angular_velocity_rad_s is not None
    np.testing.assert_array_equal(start.T_world_imu, T[4])
    np.testing.assert_allclose(start.angular_velocity_rad_s, omega[4], atol=0.05)
    for k in (5, 6, 20, 39):
        state = ahead.state_at(int(samples.t_ns[k]) + STEP_NS // 2)
        assert state is not None and state.t_ns == samples.t_ns[k]
        np.testing.assert_array_equal(state.T_world_imu, expected[k - 5].T_world_imu)


def test_outliers_do_not_depend_on_when_states_are_requested() -> None:
    """They are removed from many samples at once until a state is requested."""
    samples, T, v, _ = samples_on_circle(401)
    samples.gyro_rad_s[100::50] += 5.0
    requested, waiting = (ImuRatePropagator(EUROC_IMU, outliers=OutlierFilter(EUROC_IMU)) for _ in range(2))
    without = ImuRatePropagator(EUROC_IMU)
    without.push(OutlierFilter(EUROC_IMU).add(samples))
    for first in range(0, 401, 5):
        for propagator in (requested, waiting):
            propagator.push(samples[first : first + 5])
        requested.state_at(int(samples.t_ns[first]))
    for propagator in (requested, waiting, without):
        propagator.correct(estimate(int(samples.t_ns[300]), T[300], v[300]))
    last_ns = int(samples.t_ns[395])
    found, other, expected = (propagator.state_at(last_ns) for propagator in (requested, waiting, without))
    assert found is not None and other is not None and expected is not None
    assert found.t_ns == other.t_ns == expected.t_ns == last_ns
    np.testing.assert_array_equal(found.T_world_imu, expected.T_world_imu)
    np.testing.assert_array_equal(other.T_world_imu, expected.T_world_imu)


def test_gravity_can_be_corrected() -> None:
    """From the next estimate on, a difference of 0.1 m/s² moves the velocity by 0.1 m/s per second."""
    samples, T, v, _ = samples_on_circle(201)
    propagator = ImuRatePropagator(EUROC_IMU)
    propagator.set_gravity(GRAVITY_M_S2 + 0.1)
    propagator.correct(estimate(T0_NS, T[0], v[0]))
    velocity = propagator.add_imu(samples)[-1].velocity_m_s
    np.testing.assert_allclose(velocity - v[-1], [0.0, 0.0, -0.1], atol=2e-4)


def test_frames_without_a_state_change_no_later_state() -> None:
    """At such frames, the propagator removes what it has integrated, and no later output needs it."""
    samples, T, v, _ = samples_on_circle(401)
    forgetting, keeping = ImuRatePropagator(EUROC_IMU), ImuRatePropagator(EUROC_IMU)
    for propagator in (forgetting, keeping):
        propagator.push(samples[:21])
        propagator.correct(estimate(int(samples.t_ns[20]), T[20], v[20]))
    for first in range(21, 401, 20):
        # The newest samples are later than the frame, as those of a live system are.
        frame_ns = int(samples.t_ns[first]) + STEP_NS // 3
        states = []
        for propagator in (forgetting, keeping):
            propagator.push(samples[first : first + 20])
            states.append(propagator.state_at(int(samples.t_ns[first + 10])))
        forgetting.skip(frame_ns)
        states += [propagator.state_at(int(samples.t_ns[first + 19])) for propagator in (forgetting, keeping)]
        for found, expected in (states[:2], states[2:]):
            assert found is not None and expected is not None
            np.testing.assert_array_equal(found.T_world_imu, expected.T_world_imu)
    recovered_ns = int(samples.t_ns[395]) + STEP_NS // 2
    for propagator in (forgetting, keeping):
        propagator.correct(estimate(recovered_ns, T[395], v[395]))
    found, expected = (propagator.state_at(int(samples.t_ns[400])) for propagator in (forgetting, keeping))
    assert found is not None and expected is not None
    np.testing.assert_array_equal(found.T_world_imu, expected.T_world_imu)
