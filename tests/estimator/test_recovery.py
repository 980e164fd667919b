"""Loss and recovery: a failed estimate is discarded, and the odometry initializes again."""

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import pytest

from dronevio.estimator.imu.buffer import Increments
from dronevio.estimator.initialization.gauge import MIN_ACCEL_BIAS_SIGMA_M_S2, LastPublished, WorldOrigin
from dronevio.estimator.initialization.static import InitialSigmas
from dronevio.estimator.odometry import VisualInertialOdometry
from dronevio.eval.metrics.alignment import align
from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError
from dronevio.models.imu import ImuSamples
from dronevio.models.protocols import measurements
from dronevio.models.rotation import exp_so3, pose_matrix
from dronevio.models.state import Estimate, Health, NavState, Trajectory

if TYPE_CHECKING:
    from tests.estimator.conftest import SyntheticFlight

Times = npt.NDArray[np.int64]
MakeFlight = Callable[..., "SyntheticFlight"]

ZERO = np.zeros(3)
FRAME_NS = 50_000_000


def health_of(estimates: list[Estimate]) -> npt.NDArray[np.str_]:
    """Return the health (N,) of N estimates."""
    return np.array([e.health for e in estimates])


def recovery_index(estimates: list[Estimate]) -> int:
    """Return the index of the first estimate after a recovery."""
    return next(k for k, e in enumerate(estimates) if "recovered" in e.events)


def last_velocities(estimates: list[Estimate]) -> Array:
    """Return the velocities (N, 3) of the last 20 estimates that have a state, in the IMU frame [m/s]."""
    states = [e.state for e in estimates[-20:] if e.state is not None]
    return np.array([s.T_world_imu[:3, :3].T @ s.velocity_m_s for s in states])


def last_true_velocities(flight: "SyntheticFlight") -> Array:
    """Return the true velocities (20, 3) at the last 20 frames, in the IMU frame [m/s]."""
    truth = flight.truth_at(flight.frame_times_ns[-20:])
    assert truth.velocity_m_s is not None
    return np.asarray(np.einsum("nji,nj->ni", truth.rotations, truth.velocity_m_s))


def is_valid(estimates: list[Estimate]) -> bool:
    """Return whether every state is finite and every frame without a state has a reason."""
    finite = all(e.state is None or np.isfinite(e.state.T_world_imu).all() for e in estimates)
    return finite and all(e.health_report and e.health_report.reason for e in estimates if e.state is None)


def run_with_states(flight: "SyntheticFlight") -> tuple[list[Estimate], list[NavState | None]]:
    """Return the estimate for each frame, and the state after it at the IMU rate."""
    vio = VisualInertialOdometry(flight.rig, front_end=flight.front_end())
    estimates, states = [], []
    for measurement in measurements(flight):
        if isinstance(measurement, ImuSamples):
            vio.add_imu(measurement)
        else:
            estimates.append(vio.add_frame(measurement))
            states.append(vio.state_at(measurement.t_ns))
    return estimates, states


@pytest.mark.slow
def test_half_a_minute_of_darkness_is_a_loss(make_flight: MakeFlight) -> None:
    flight = make_flight(0, rest_s=1.5, dark_s=(5.0, 35.0), duration_s=42.0)
    estimates, states = run_with_states(flight)
    assert is_valid(estimates)
    first = next(k for k, e in enumerate(estimates) if e.state is not None)
    assert states[:first] == [None] * first
    assert [s.t_ns for s in states[first:] if s] == flight.frame_times_ns[first:].tolist()  # also while it is lost
    t_s = (flight.frame_times_ns - flight.frame_times_ns[0]) * 1e-9
    health = health_of(estimates)
    lost = int(np.flatnonzero(health == Health.LOST)[0])
    assert 8.0 < t_s[lost] < 35.0 and estimates[lost].events[0].startswith("lost: ")
    recovered = recovery_index(estimates)
    assert t_s[recovered] < 40.0
    assert np.all(health[lost:recovered] == Health.LOST)
    assert all(e.state is None for e in estimates[lost:recovered])
    assert np.all(health[recovered + 20 :] == Health.TRACKING)
    before, after = estimates[lost - 1].state, estimates[recovered].state
    assert before is not None and after is not None
    jump_m = np.linalg.norm(after.T_world_imu[:3, 3] - before.T_world_imu[:3, 3])
    assert jump_m < 4.0  # the distance flown during the new initialization
    truth = flight.truth_at(flight.frame_times_ns[[lost - 1, recovered]])
    rotation = truth.rotations[0].T @ truth.rotations[1]
    error = before.T_world_imu[:3, :3].T @ after.T_world_imu[:3, :3] @ rotation.T
    assert np.arccos((np.trace(error) - 1.0) / 2.0) < np.radians(6.0)  # the gyroscope propagates the yaw
    speeds, true_speeds = (
        np.linalg.norm(v, axis=1) for v in (last_velocities(estimates), last_true_velocities(flight))
    )
    assert np.abs(speeds - true_speeds).max() < 0.15


@pytest.mark.slow
def test_position_covariance_after_a_loss_covers_the_error(make_flight: MakeFlight) -> None:
    flight = make_flight(1, rest_s=1.5, dark_s=(5.0, 35.0), duration_s=42.0)
    estimates = flight.run()
    recovered = estimates[recovery_index(estimates)].state
    assert recovered is not None and recovered.covariance is not None
    truth = flight.truth_at(flight.frame_times_ns)
    error_m = np.linalg.norm(
        recovered.T_world_imu[:3, 3] - (truth.p_world_imu[recovery_index(estimates)] - truth.p_world_imu[0])
    )
    sigma_m = np.sqrt(np.linalg.eigvalsh(recovered.covariance[3:6, 3:6])[0])
    assert error_m < 4.0 * sigma_m


@pytest.mark.slow
def test_imu_that_contradicts_the_camera_is_a_loss(make_flight: MakeFlight) -> None:
    """For three seconds, the angular velocity has a large constant error."""
    flight = make_flight(2, rest_s=1.5, duration_s=22.0)
    t_s = (flight.imu.t_ns - flight.imu.t_ns[0]) * 1e-9
    faulty = (t_s > 5.0) & (t_s < 8.0)
    gyro = flight.imu.gyro_rad_s + faulty[:, None] * np.array([1.5, -1.0, 2.0])
    faulty_flight = replace(flight)
    faulty_flight.__dict__.update(imu=ImuSamples(flight.imu.t_ns, gyro, flight.imu.accel_m_s2, flight.imu.sampling))
    estimates = faulty_flight.run()
    assert is_valid(estimates)
    health = health_of(estimates)
    assert Health.LOST in health
    assert np.all(np.isin(health[-40:], [Health.INERTIAL_ONLY, Health.TRACKING]))
    assert np.all(health[-10:] == Health.TRACKING)  # after it has been consistent for some seconds
    errors = last_velocities(estimates) - last_true_velocities(flight)
    assert np.linalg.norm(errors, axis=1).max() < 0.15


def test_an_imu_gap_is_bridged_and_reported(make_flight: MakeFlight) -> None:
    flight = make_flight(0, rest_s=1.5, duration_s=9.0)
    t_s = (flight.imu.t_ns - flight.imu.t_ns[0]) * 1e-9
    kept = (t_s < 5.0) | (t_s > 5.2)
    gap, imu = replace(flight), flight.imu
    gap.__dict__.update(imu=ImuSamples(imu.t_ns[kept], imu.gyro_rad_s[kept], imu.accel_m_s2[kept], imu.sampling))
    estimates = gap.run()
    assert is_valid(estimates) and all(e.state is not None for e in estimates[60:])
    events = [event for e in estimates for event in e.events if "no IMU" in event or "IMU again" in event]
    assert len(events) == 2 and events[1].startswith("IMU again after a gap of ")
    assert 0.15 < float(events[1].split()[6]) < 0.26
    assert all(any(event in e.events for e in estimates[98:108]) for event in events)
    estimated = Trajectory.from_states(e.state for e in estimates if e.state is not None)
    truth = flight.truth_at(estimated.t_ns)
    fit = align(truth.p_world_imu, estimated.p_world_imu, "yaw")
    assert np.linalg.norm(fit.positions(estimated.p_world_imu) - truth.p_world_imu, axis=1).max() < 0.15


@pytest.mark.parametrize(
    "disorder", [lambda t: t[::-1], lambda t: np.repeat(t, 2)[: len(t)]], ids=["order", "repeated"]
)
def test_disordered_stamps_raise_and_the_odometry_continues(
    make_flight: MakeFlight, disorder: Callable[[Times], Times]
) -> None:
    flight = make_flight(0, rest_s=1.5, duration_s=4.0)
    vio = VisualInertialOdometry(flight.rig, front_end=flight.front_end())
    for k, t_ns in enumerate(flight.frame_times_ns.tolist()):
        batch = flight.imu.after(t_ns - FRAME_NS if k else -1).up_to(t_ns)
        if k == 50:
            with pytest.raises(ConfigError, match="do not increase"):
                vio.add_imu(ImuSamples(disorder(batch.t_ns), batch.gyro_rad_s, batch.accel_m_s2, batch.sampling))
            with pytest.raises(ConfigError, match="do not increase"):
                vio.add_imu(flight.imu.up_to(t_ns - FRAME_NS))  # already added
        vio.add_imu(batch)
        estimate = vio.add_frame(flight.frame(k))
    assert estimate.health is Health.TRACKING and estimate.state is not None


def random_rotation(rng: np.random.Generator, n: int = 40) -> Increments:
    """Return n increments of 5 ms with random angular velocities."""
    return Increments(np.full(n, 0.005), rng.normal(size=(n, 3)), np.zeros((n, 3)))


@pytest.mark.parametrize("seed", range(5))
def test_recovery_keeps_last_position_and_gyroscope_yaw(seed: int) -> None:
    rng = np.random.default_rng(seed)
    R, bias = exp_so3(rng.normal(size=3)), 0.02 * rng.normal(size=3)
    published = NavState(0, pose_matrix(R, rng.normal(size=3)), rng.normal(size=3), bias, ZERO, np.eye(15) * 1e-4)
    lost, window = random_rotation(rng), random_rotation(rng)
    origin = LastPublished.of(published).propagated(lost).propagated(window)
    R_true = R @ lost.rotation(bias)  # at the start of the window
    yaw = exp_so3(np.array([0.0, 0.0, rng.uniform(-3.0, 3.0)]))
    start = NavState(10**9, pose_matrix(yaw @ R_true, ZERO), yaw @ np.array([0.3, 0.4, 0.5]), bias, ZERO)
    aligned = origin.align(start, window)
    np.testing.assert_allclose(aligned.T_world_imu[:3, :3], R_true, atol=1e-9)
    np.testing.assert_allclose(aligned.T_world_imu[:3, 3], published.T_world_imu[:3, 3])
    # In the IMU frame
    np.testing.assert_allclose(R_true.T @ aligned.velocity_m_s, (yaw @ R_true).T @ start.velocity_m_s)
    # The direction of gravity is that of the initialization
    np.testing.assert_allclose(aligned.T_world_imu[2, :3], start.T_world_imu[2, :3], atol=1e-9)
    P = origin.covariance(aligned, InitialSigmas())
    assert np.linalg.eigvalsh(P).min() > 0.0
    assert np.sqrt(P[3, 3]) > 0.9 * np.linalg.norm(published.velocity_m_s)  # it may have moved on for a second


def test_first_initialization_defines_the_world_frame() -> None:
    start = NavState(5, pose_matrix(exp_so3(np.ones(3)), ZERO), np.ones(3), ZERO, ZERO)
    origin = WorldOrigin(gyro_bias_sigma_rad_s=0.05, accel_bias_sigma_m_s2=0.1)
    assert origin.propagated(random_rotation(np.random.default_rng(0))) is origin
    assert origin.align(start, random_rotation(np.random.default_rng(0))) is start
    np.testing.assert_array_equal(
        origin.covariance(start, InitialSigmas()), InitialSigmas().covariance(start.T_world_imu[:3, :3])
    )


def test_biases_of_the_last_state_are_known_after_a_loss() -> None:
    """The standard deviation is that of the axis that is known least, and not below that of a bias after a flight."""
    P = np.zeros((15, 15))
    P[12:, 12:] = np.diag([0.01, 0.05, 0.02]) ** 2
    gyro, accel = np.array([0.01, 0.02, 0.03]), np.array([0.1, 0.2, 0.3])
    published = NavState(0, np.eye(4), ZERO, gyro, accel, P)
    known = LastPublished.of(published)
    np.testing.assert_array_equal(known.gyro_bias.mean, gyro)
    np.testing.assert_array_equal(known.accel_bias.mean, accel)
    assert known.accel_bias.sigma == pytest.approx(0.05)
    exact = LastPublished.of(replace(published, covariance=np.zeros((15, 15))))
    assert exact.accel_bias.sigma == MIN_ACCEL_BIAS_SIGMA_M_S2
    assert WorldOrigin(0.05, 0.1).accel_bias.sigma == 0.1
