"""Output at the IMU's rate, against motion in closed form and against flights made of formulas."""

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from dronevio.estimator.imu.forward_propagation import ImuRatePropagator
from dronevio.estimator.vio import VisualInertialOdometry
from dronevio.eval.metrics.alignment import align
from dronevio.models.imu import EUROC_IMU, GRAVITY_M_S2, ImuSamples
from dronevio.models.protocols import measurements
from dronevio.models.rotation import exp_so3, log_so3, pose_matrix
from dronevio.models.state import Estimate, Health, NavState, Trajectory

Array = npt.NDArray[np.float64]

T0_NS, STEP_NS = 10**18, 5_000_000
GRAVITY = np.array([0.0, 0.0, -GRAVITY_M_S2])
BIASES = np.array([0.002, -0.003, 0.001]), np.array([-0.02, 0.03, 0.01])


def said(t_ns: int, T: Array, v: Array) -> Estimate:
    return Estimate(t_ns, Health.TRACKING, NavState(t_ns, T, v, *BIASES))


def circle(t_s: Array) -> tuple[Array, Array, Array, Array]:
    """Return poses, velocities, angular velocities and specific forces (N, …) on a horizontal circle."""
    radius_m, rate_rad_s = 2.0, 1.5
    turn = exp_so3(rate_rad_s * t_s[:, None] * [0.0, 0.0, 1.0])
    R = turn @ exp_so3(np.array([0.2, -0.4, 0.1]))
    out = turn[:, :, 0]
    v, a = radius_m * rate_rad_s * turn[:, :, 1], -radius_m * rate_rad_s**2 * out
    omega = np.swapaxes(R, 1, 2) @ [0.0, 0.0, rate_rad_s]
    force = np.einsum("nji,nj->ni", R, a - GRAVITY)
    return pose_matrix(R, radius_m * out), v, omega, force


def circling(n: int, sampling: str = "point") -> tuple[ImuSamples, Array, Array, Array]:
    """Return n samples of an IMU with biases on the circle, and its true poses, velocities and angular velocities."""
    t_ns = T0_NS + STEP_NS * np.arange(n)
    T, v, omega, force = circle((t_ns - T0_NS) * 1e-9)
    gyro, accel = omega, force
    if sampling == "increment":
        dt_s = STEP_NS * 1e-9
        T_before, v_before, *_ = circle((t_ns - T0_NS) * 1e-9 - dt_s)
        gyro = log_so3(np.swapaxes(T_before[:, :3, :3], 1, 2) @ T[:, :3, :3]) / dt_s
        accel = np.einsum("nji,nj->ni", T_before[:, :3, :3], (v - v_before) / dt_s - GRAVITY)
    return ImuSamples(t_ns, gyro + BIASES[0], accel + BIASES[1], sampling), T, v, omega  # type: ignore[arg-type]


@pytest.mark.parametrize("sampling", ["point", "increment"])
@pytest.mark.parametrize("batch", [1, 7, 200])
def test_circle_in_closed_form(sampling: str, batch: int) -> None:
    samples, T, v, omega = circling(201, sampling)
    propagator = ImuRatePropagator(EUROC_IMU)
    assert propagator.add_imu(samples[:1]) == []
    propagator.correct(said(T0_NS, T[0], v[0]))
    states = [s for k in range(1, 201, batch) for s in propagator.add_imu(samples[k : k + batch])]
    assert [s.t_ns for s in states] == samples.t_ns[1:].tolist()
    np.testing.assert_allclose([s.T_world_imu for s in states], T[1:], atol=2e-4)  # after a second, 3 m on
    np.testing.assert_allclose([s.velocity_m_s for s in states], v[1:], atol=2e-4)
    np.testing.assert_allclose([s.angular_velocity_rad_s for s in states], omega[1:], atol=1e-9)
    for name, bias in zip(("gyro_bias_rad_s", "accel_bias_m_s2"), BIASES, strict=True):
        np.testing.assert_array_equal(getattr(states[-1], name), bias)


def test_late_estimates_move_the_ground_and_take_nothing_back() -> None:
    """The estimate of a frame between two samples comes three samples later, and is 1 cm and 0.1 m/s off."""
    samples, T, v, _ = circling(40)
    frame_ns = T0_NS + 20 * STEP_NS + 2_000_000
    T_frame, v_frame, *_ = circle(np.array([(frame_ns - T0_NS) * 1e-9]))
    propagator = ImuRatePropagator(EUROC_IMU)
    propagator.add_imu(samples[:1])
    propagator.correct(said(T0_NS, T[0], v[0]))
    before = propagator.add_imu(samples[1:24])
    np.testing.assert_allclose(before[-1].T_world_imu, T[23], atol=1e-4)
    off, faster = np.array([0.01, 0.0, 0.0]), np.array([0.0, 0.0, 0.1])
    moved = T_frame[0].copy()
    moved[:3, 3] += off
    propagator.correct(said(frame_ns, moved, v_frame[0] + faster))
    after = propagator.add_imu(samples[24:])
    assert [s.t_ns for s in after] == samples.t_ns[24:].tolist()
    later_s = (samples.t_ns[24:] - frame_ns)[:, None] * 1e-9
    np.testing.assert_allclose([s.velocity_m_s for s in after], v[24:] + faster, atol=1e-4)
    found = np.array([s.T_world_imu for s in after])
    np.testing.assert_allclose(found[:, :3, 3], T[24:, :3, 3] + off + later_s * faster, atol=1e-4)
    np.testing.assert_allclose(found[:, :3, :3], T[24:, :3, :3], atol=1e-4)


def test_batches_make_no_difference() -> None:
    samples, T, v, _ = circling(60)
    found = []
    for cuts in (range(0, 60), (0, 1, 60), (0, 25, 26, 47, 60)):
        propagator = ImuRatePropagator(EUROC_IMU)
        propagator.correct(said(T0_NS, T[0], v[0]))
        ends = [*cuts][1:] if cuts[-1] == 60 else [*cuts, 60][1:]
        starts = [0, *ends[:-1]]
        found.append([s for a, b in zip(starts, ends, strict=True) for s in propagator.add_imu(samples[a:b])])
    for states in found[1:]:
        np.testing.assert_array_equal([s.T_world_imu for s in states], [s.T_world_imu for s in found[0]])


def test_nothing_is_said_without_a_state() -> None:
    samples, T, v, _ = circling(30)
    propagator = ImuRatePropagator(EUROC_IMU)
    assert propagator.add_imu(samples[:10]) == []
    propagator.correct(said(int(samples.t_ns[9]), T[9], v[9]))
    assert len(propagator.add_imu(samples[10:20])) == 10
    propagator.correct(Estimate(int(samples.t_ns[19]), Health.LOST, None))
    assert propagator.add_imu(samples[20:25]) == []
    propagator.correct(said(int(samples.t_ns[24]), T[24], v[24]))
    np.testing.assert_allclose(propagator.add_imu(samples[25:])[-1].T_world_imu, T[29], atol=1e-5)


def test_a_sample_costs_little() -> None:
    """A state within 50 µs, one sample at a time; measured in units of what a plain numpy product costs."""
    samples, T, v, _ = circling(1001)
    one_by_one = [samples[k : k + 1] for k in range(1001)]

    def seconds() -> tuple[float, float]:
        propagator = ImuRatePropagator(EUROC_IMU)
        propagator.add_imu(one_by_one[0])
        propagator.correct(said(T0_NS, T[0], v[0]))
        start = time.process_time()
        for sample in one_by_one[1:]:
            propagator.add_imu(sample)
        middle = time.process_time()
        for _ in range(10_000):
            np.dot(T[0], T[1])
        return middle - start, (time.process_time() - middle) / 10.0

    spent, product = min(seconds() for _ in range(3))
    assert spent < 80.0 * product  # 1000 samples against 1000 products of some 0.7 µs


def test_samples_are_as_accurate_as_frames(make_flight: Callable) -> None:
    flight = make_flight(2, rest_s=1.5, duration_s=10.0)
    vio = VisualInertialOdometry(flight.rig, front_end=flight.front_end())
    propagator = ImuRatePropagator(flight.rig.imu)
    states, frames, jumps_m = [], [], []
    for measurement in measurements(flight):
        if isinstance(measurement, ImuSamples):
            vio.add_imu(measurement)
            states += propagator.add_imu(measurement)
        else:
            estimate = vio.add_frame(measurement)
            propagator.correct(estimate)
            frames.append(estimate)
            if states and estimate.state is not None:  # the sample at the frame's time has been predicted
                assert states[-1].t_ns == estimate.t_ns
                jumps_m.append(np.linalg.norm(states[-1].T_world_imu[:3, 3] - estimate.state.T_world_imu[:3, 3]))
                if "keyframe" not in estimate.events and estimate.t_ns > flight.frame_times_ns[60]:
                    # Nothing is corrected: the odometry has predicted the same.
                    np.testing.assert_allclose(states[-1].T_world_imu, estimate.state.T_world_imu, atol=1e-6)
    stamps = np.array([s.t_ns for s in states])
    assert np.all(np.diff(stamps) == STEP_NS) and len(stamps) > 1500
    assert max(jumps_m) < 0.05
    errors_m = []
    for found in (states, [e.state for e in frames if e.state is not None]):
        path = Trajectory.from_states(found)
        truth = flight.truth_at(path.t_ns)
        fit = align(truth.p_world_imu, path.p_world_imu, "yaw")
        away_m = np.linalg.norm(truth.p_world_imu - fit.positions(path.p_world_imu), axis=1)
        errors_m.append(float(np.sqrt(np.mean(away_m**2))))
        if found is states:
            rates = np.array([s.angular_velocity_rad_s for s in states])
            true = flight.motion.at((path.t_ns - flight.frame_times_ns[0]) * 1e-9)
            assert np.sqrt(np.mean((rates - true.omega) ** 2)) < 0.01
    assert errors_m[0] < 1.1 * errors_m[1] < 0.05


def test_states_can_be_replaced_by_any_estimator() -> None:
    """Only pose, velocity and biases count: an estimate without a covariance will do."""
    samples, T, v, _ = circling(20)
    propagator = ImuRatePropagator(EUROC_IMU)
    propagator.add_imu(samples[:10])
    estimate = said(int(samples.t_ns[9]), T[9], v[9])
    propagator.correct(replace(estimate, health=Health.INERTIAL_ONLY))
    assert len(propagator.add_imu(samples[10:])) == 10
