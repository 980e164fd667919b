"""The back end, fed with keyframes of which everything is known."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
import pytest

from dronevio.estimator.backend.landmarks import LandmarkConfig
from dronevio.estimator.backend.linalg import SingularError
from dronevio.estimator.backend.linear_system import LinearSystem
from dronevio.estimator.backend.smoother import KeyframeResult, KeyframeSmoother, SmootherConfig
from dronevio.estimator.imu.buffer import ImuBuffer
from dronevio.estimator.imu.preintegration import Preintegration, PreintegrationConfig, PreintegrationParams
from dronevio.estimator.initialization.static import InitialSigmas
from dronevio.estimator.types import Calibration
from dronevio.models.rotation import exp_so3, log_so3
from dronevio.models.state import NavState, Trajectory

INTERVAL_NS = 200_000_000


@dataclass
class KeyframeFeed:
    """Gives a smoother one keyframe of a flight after another."""

    flight: object
    truth: Trajectory
    smoother: KeyframeSmoother
    results: list[KeyframeResult]
    states: list[NavState]
    points: list[np.ndarray]

    def rows(self) -> Trajectory:
        """Return the truth at the keyframes."""
        return self.truth[1 : 1 + len(self.states)]


def keyframes(
    flight: object, config: SmootherConfig, start_off: np.ndarray, sigmas: InitialSigmas
) -> Iterator[KeyframeFeed]:
    """Yield after each keyframe; the first state is off by the given δθ, δv, δb_gyro, δb_accel (4, 3)."""
    times = np.arange(flight.frame_times_ns[0], flight.frame_times_ns[-1] + 1, INTERVAL_NS)
    truth = flight.truth_at(times)
    T = truth.Ts_world_imu[0].copy()
    T[:3, :3] = T[:3, :3] @ exp_so3(start_off[0])
    start = NavState(
        int(times[0]),
        T,
        truth.velocity_m_s[0] + start_off[1],
        truth.gyro_bias_rad_s[0] + start_off[2],
        truth.accel_bias_m_s2[0] + start_off[3],
    )
    front_end, buffer = flight.front_end(), ImuBuffer()
    buffer.add(flight.imu)
    buffer.take_until(int(times[0]))
    front_end.track(flight.frame(0), np.eye(3))
    smoother = KeyframeSmoother(
        Calibration(flight.rig),
        config,
        LandmarkConfig(),
        start,
        sigmas.covariance(T[:3, :3]),
        front_end.replenish(),
    )
    feed = KeyframeFeed(flight, truth, smoother, [], [], [])
    params = PreintegrationParams.of(flight.rig.imu, PreintegrationConfig())
    for k, t_ns in enumerate(times[1:].tolist(), 1):
        pim = Preintegration(params, smoother.gtsam_state[1])
        pim.integrate(buffer.take_until(t_ns))
        front_end.track(flight.frame(4 * k), np.eye(3))
        feed.results.append(smoother.add_keyframe(t_ns, pim.measurements, front_end.replenish(), stationary=False))
        front_end.discard(feed.results[-1].rejected)
        feed.states.append(smoother.state)
        feed.points.append(smoother.landmarks)
        yield feed


def feed_all(flight: object, config: SmootherConfig | None = None, start_off: np.ndarray | None = None) -> KeyframeFeed:
    off = np.zeros((4, 3)) if start_off is None else start_off
    *_, last = keyframes(flight, config or SmootherConfig(), off, InitialSigmas())
    return last


@pytest.fixture(scope="module")
def clean(make_flight: Callable) -> KeyframeFeed:
    return feed_all(make_flight(0, rest_s=-5.0, duration_s=10.0, noisy=False, sampling="increment"))


def errors(feed: KeyframeFeed) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the errors of orientation [rad], position [m] and velocity [m/s] at each keyframe."""
    found, truth = Trajectory.from_states(feed.states), feed.rows()
    turned = log_so3(np.swapaxes(truth.rotations, 1, 2) @ found.rotations)
    parts = turned, found.p_world_imu - truth.p_world_imu, found.velocity_m_s - truth.velocity_m_s
    return tuple(np.linalg.norm(part, axis=1) for part in parts)


def test_without_noise_states_are_the_truth(clean: KeyframeFeed) -> None:
    for error in errors(clean):
        assert error.max() < 1e-3
    assert np.abs(Trajectory.from_states(clean.states).gyro_bias_rad_s).max() < 1e-4
    assert np.abs(Trajectory.from_states(clean.states).accel_bias_m_s2).max() < 1e-3
    assert not any(len(result.rejected) or result.events for result in clean.results)


def test_without_noise_landmarks_are_where_they_are(clean: KeyframeFeed) -> None:
    for points in clean.points[10:]:
        assert len(points) > 15
        distance = np.linalg.norm(points[:, None] - clean.flight.landmarks[None], axis=2).min(axis=1)
        assert distance.max() < 0.01


def test_wrong_start_is_mended(make_flight: Callable) -> None:
    """Tilt, velocity and both biases are off; position and yaw, which nothing observes, are right."""
    flight = make_flight(1, rest_s=-5.0, duration_s=8.0, noisy=False, sampling="increment")
    R = flight.truth_at(flight.frame_times_ns[:1]).rotations[0]
    tilt = R.T @ np.array([0.05, -0.04, 0.0])
    off = np.stack([tilt, [0.05, -0.04, 0.03], [0.004, -0.003, 0.005], [0.08, -0.05, 0.06]])
    feed = feed_all(flight, start_off=off)
    turned, place, velocity = errors(feed)
    assert velocity[0] > 0.03  # it was wrong
    assert turned[-5:].max() < 2e-3 and place[-5:].max() < 0.02 and velocity[-5:].max() < 0.01
    assert np.linalg.norm(feed.states[-1].gyro_bias_rad_s) < 5e-4
    assert np.linalg.norm(feed.states[-1].accel_bias_m_s2) < 0.02


def test_covariances_are_proper_and_vision_keeps_them_small(clean: KeyframeFeed) -> None:
    for state in clean.states:
        P = state.covariance
        np.testing.assert_allclose(P, P.T, atol=1e-12 + 1e-9 * np.abs(P).max())
        assert np.linalg.eigvalsh(P).min() > 0.0
    sigmas = np.sqrt([np.diag(state.covariance) for state in clean.states])
    assert sigmas[-1, 3:6].max() < 0.1 and sigmas[-1, 6:9].max() < 0.1
    assert np.all(sigmas[-1, 9:] < sigmas[0, 9:])  # biases become known


@pytest.mark.parametrize("persistent", [0, 20])
@pytest.mark.parametrize("size", [5, 15])
def test_window_stays_a_window(make_flight: Callable, size: int, persistent: int) -> None:
    flight = make_flight(0, rest_s=-5.0, duration_s=8.0, noisy=False)
    config, most_long_lived = SmootherConfig(max_keyframes=size, max_persistent=persistent), 0
    for feed in keyframes(flight, config, np.zeros((4, 3)), InitialSigmas()):
        window = feed.smoother._window
        assert len(window.states) <= size and len(window.persistent) <= persistent
        most_long_lived = max(most_long_lived, len(window.persistent))
        assert set(window.landmarks.observations.keyframe.tolist()) <= set(window.states)
        assert window.persistent <= set(window.landmarks.ids.tolist())
    assert len(feed.states) > size  # it had to forget
    assert (most_long_lived > 0) == (persistent > 0)
    assert errors(feed)[1].max() < 0.01  # and what is forgotten is not lost


def test_window_keeps_old_views_where_nothing_moves(make_flight: Callable) -> None:
    """Without parallax the last keyframe but one goes, and the oldest stays."""
    flight = make_flight(0, rest_s=-5.0, duration_s=6.0)
    config = SmootherConfig(max_keyframes=6, min_parallax_px=1e6)
    for feed in keyframes(flight, config, np.zeros((4, 3)), InitialSigmas()):
        k = len(feed.states)
        assert list(feed.smoother._window.states) == ([*range(k + 1)] if k < 6 else [0, 1, 2, 3, 4, k])
        assert np.isfinite(feed.states[-1].covariance).all()


def fail() -> LinearSystem:
    raise SingularError("the linear system is indefinite")


def test_solver_that_fails_ends_no_flight(make_flight: Callable) -> None:
    flight = make_flight(2, rest_s=-5.0, duration_s=8.0)
    for feed in keyframes(flight, SmootherConfig(), np.zeros((4, 3)), InitialSigmas()):
        if len(feed.states) == 15:
            feed.smoother._window.linearize = fail
    events = [result.events for result in feed.results]
    assert events[15] == ("solver restored: the linear system is indefinite",)
    assert not any(events[:15]) and not any(events[16:])
    assert errors(feed)[1].max() < 0.1
    assert len(feed.points[-1]) > 15
    assert np.isfinite([state.T_world_imu for state in feed.states]).all()


@pytest.mark.parametrize("position_sigma_m", [1.0, 10.0, 1000.0])
def test_solver_starts_again_however_unsure_the_position(make_flight: Callable, position_sigma_m: float) -> None:
    """Nothing observes the position: after a long flight, metres of uncertainty are its due, and no reason to fail."""
    flight = make_flight(2, rest_s=-5.0, duration_s=4.0)
    before = None
    for feed in keyframes(flight, SmootherConfig(), np.zeros((4, 3)), InitialSigmas()):
        if len(feed.states) == 8:
            solution = feed.smoother._solution
            before = solution.covariance.copy()
            before[3:6, 3:6] = position_sigma_m**2 * np.eye(3)
            feed.smoother._solution = replace(solution, covariance=before)
            feed.smoother._window.linearize = fail
    assert [bool(result.events) for result in feed.results] == [k == 8 for k in range(len(feed.results))]
    assert errors(feed)[1].max() < 0.1
    sigma_m = np.sqrt(np.diag(feed.states[-1].covariance)[3:6])
    np.testing.assert_allclose(sigma_m, position_sigma_m, rtol=0.05)  # and it stays as unsure as it was


def test_rest_is_held(make_flight: Callable) -> None:
    """At rest, with the drone said to be still, nothing drifts, though the accelerometer's bias is not known."""
    flight = make_flight(4, rest_s=20.0, duration_s=6.0)
    truth = flight.truth_at(flight.frame_times_ns[:1])
    start = NavState(int(truth.t_ns[0]), truth.Ts_world_imu[0], np.zeros(3), np.zeros(3), np.zeros(3))
    front_end, buffer = flight.front_end(), ImuBuffer()
    buffer.add(flight.imu)
    buffer.take_until(start.t_ns)
    front_end.track(flight.frame(0), np.eye(3))
    P = InitialSigmas(gyro_bias_rad_s=0.05).covariance(start.T_world_imu[:3, :3])
    smoother = KeyframeSmoother(
        Calibration(flight.rig), SmootherConfig(), LandmarkConfig(), start, P, front_end.replenish()
    )
    params = PreintegrationParams.of(flight.rig.imu, PreintegrationConfig())
    for k in range(10, len(flight.frame_times_ns), 10):
        t_ns = int(flight.frame_times_ns[k])
        pim = Preintegration(params, smoother.gtsam_state[1])
        pim.integrate(buffer.take_until(t_ns))
        assert not smoother.add_keyframe(
            t_ns, pim.measurements, front_end.track(flight.frame(k), np.eye(3)), stationary=True
        ).events
    assert np.linalg.norm(smoother.state.velocity_m_s) < 0.01
    assert np.linalg.norm(smoother.state.T_world_imu[:3, 3] - truth.p_world_imu[0]) < 0.01
    np.testing.assert_allclose(smoother.state.gyro_bias_rad_s, truth.gyro_bias_rad_s[0], atol=1e-3)
