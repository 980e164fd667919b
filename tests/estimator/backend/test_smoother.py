"""The smoother on synthetic flights."""

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from dronevio.estimator.backend.config import SmootherConfig
from dronevio.estimator.backend.linear_system import LinearSystem
from dronevio.estimator.backend.marginal_prior import MarginalPrior
from dronevio.estimator.backend.marginalization import PendingMarginalization
from dronevio.estimator.backend.window_objective import WindowObjective
from dronevio.estimator.initialization.static import InitialSigmas
from dronevio.estimator.intrinsics import IntrinsicCorrections
from dronevio.estimator.optimization import gauss_newton
from dronevio.estimator.optimization.linalg import CholeskyFactor, SingularError
from dronevio.estimator.types import Calibration, Matches
from dronevio.models.arrays import Array
from dronevio.models.rig_presets import rig_named
from dronevio.models.rotation import exp_so3, log_so3
from dronevio.models.state import NavState, Trajectory

if TYPE_CHECKING:
    from tests.estimator.conftest import KeyframeFeed, SyntheticFlight

MakeFlight = Callable[..., "SyntheticFlight"]
MODELS = tuple(camera.model for camera in rig_named("euroc").cameras)


@pytest.fixture(scope="session")
def feed(keyframe_feed: "type[KeyframeFeed]") -> Callable[..., "KeyframeFeed"]:
    """Return a maker of feeds of a flight, whose first state has given errors (4, 3): δθ, δv, δb_gyro, δb_accel."""

    def make(
        flight: "SyntheticFlight", config: SmootherConfig | None = None, start_error: Array | None = None
    ) -> "KeyframeFeed":
        true, error = flight.state_at(int(flight.frame_times_ns[0])), np.zeros((4, 3))
        error = error if start_error is None else start_error
        T = true.T_world_imu.copy()
        T[:3, :3] = T[:3, :3] @ exp_so3(error[0])
        start = NavState(
            true.t_ns,
            T,
            true.velocity_m_s + error[1],
            true.gyro_bias_rad_s + error[2],
            true.accel_bias_m_s2 + error[3],
        )
        return keyframe_feed(flight, start, InitialSigmas().covariance(T[:3, :3]), config)

    return make


@pytest.fixture(scope="module")
def noiseless(make_flight: MakeFlight, feed: Callable[..., "KeyframeFeed"]) -> "KeyframeFeed":
    """The keyframes of a flight without noise."""
    return feed(make_flight(0, rest_s=-5.0, duration_s=10.0, noisy=False, sampling="increment")).finish()


def errors(feed: "KeyframeFeed") -> tuple[Array, Array, Array]:
    """Return the errors (K,) of orientation [rad], position [m] and velocity [m/s] of the keyframes."""
    found, truth = Trajectory.from_states(feed.states), feed.truth
    assert found.velocity_m_s is not None and truth.velocity_m_s is not None
    rotation = log_so3(np.swapaxes(truth.rotations, 1, 2) @ found.rotations)
    position, velocity = found.p_world_imu - truth.p_world_imu, found.velocity_m_s - truth.velocity_m_s
    return np.linalg.norm(rotation, axis=1), np.linalg.norm(position, axis=1), np.linalg.norm(velocity, axis=1)


def covariance_of(state: NavState) -> Array:
    """Return the covariance (15, 15) of a state that has one."""
    assert state.covariance is not None
    return state.covariance


def fail_to_linearize(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the next linearization of a window fail."""
    linearize = WindowObjective.linearize

    def fail(*_: Any) -> LinearSystem:
        monkeypatch.setattr(WindowObjective, "linearize", linearize)
        raise SingularError("the linear system is indefinite")

    monkeypatch.setattr(WindowObjective, "linearize", fail)


def test_states_are_exact_without_noise(noiseless: "KeyframeFeed") -> None:
    for error in errors(noiseless):
        assert error.max() < 1e-3
    assert np.abs([state.gyro_bias_rad_s for state in noiseless.states]).max() < 1e-4
    assert np.abs([state.accel_bias_m_s2 for state in noiseless.states]).max() < 1e-3
    assert not any(len(result.rejected) or result.events for result in noiseless.results)


def test_landmarks_are_exact_without_noise(noiseless: "KeyframeFeed") -> None:
    for points in noiseless.points[10:]:
        assert len(points) > 15
        distance_m = np.linalg.norm(points[:, None] - noiseless.flight.landmarks[None], axis=2).min(axis=1)
        assert distance_m.max() < 0.01


@pytest.mark.parametrize(("max_decrement", "steps"), [(0.0, 2), (20.0, 1)])
def test_a_second_step_follows_only_a_long_first_step(
    make_flight: MakeFlight,
    feed: Callable[..., "KeyframeFeed"],
    monkeypatch: pytest.MonkeyPatch,
    max_decrement: float,
    steps: int,
) -> None:
    """Without noise and errors, the first step is short; an error of the first state makes it long."""
    made = make_flight(0, rest_s=-5.0, duration_s=4.0, noisy=False, sampling="increment")
    step, calls = gauss_newton.gauss_newton_step, list[int]()

    def counted(equations: LinearSystem, factorize: Callable[[Array], CholeskyFactor]) -> Any:
        calls.append(max(equations.x.states))
        return step(equations, factorize)

    monkeypatch.setattr(gauss_newton, "gauss_newton_step", counted)
    feed(made, SmootherConfig(max_decrement=max_decrement)).finish()
    per_keyframe = np.bincount(calls)[1:]
    assert set(per_keyframe[3:].tolist()) == {steps}
    calls.clear()
    error = np.zeros((4, 3))
    error[1] = 0.3  # velocity [m/s]
    feed(made, SmootherConfig(max_decrement=max_decrement), error).finish()
    assert 2 in np.bincount(calls)[1:].tolist()


def test_errors_of_the_first_state_are_corrected(make_flight: MakeFlight, feed: Callable[..., "KeyframeFeed"]) -> None:
    """Roll, pitch, velocity and both biases have errors; position and yaw, which are unobservable, have none."""
    flight = make_flight(1, rest_s=-5.0, duration_s=8.0, noisy=False, sampling="increment")
    R = flight.state_at(int(flight.frame_times_ns[0])).T_world_imu[:3, :3]
    tilt = R.T @ np.array([0.05, -0.04, 0.0])
    start_error = np.stack([tilt, [0.05, -0.04, 0.03], [0.004, -0.003, 0.005], [0.08, -0.05, 0.06]])
    found = feed(flight, start_error=start_error).finish()
    rotation, position, velocity = errors(found)
    assert velocity[0] > 0.03
    assert rotation[-5:].max() < 2e-3 and position[-5:].max() < 0.02 and velocity[-5:].max() < 0.01
    assert np.linalg.norm(found.states[-1].gyro_bias_rad_s) < 5e-4
    assert np.linalg.norm(found.states[-1].accel_bias_m_s2) < 0.02


def test_covariances_are_positive_and_bounded(noiseless: "KeyframeFeed") -> None:
    for P in map(covariance_of, noiseless.states):
        np.testing.assert_allclose(P, P.T, atol=1e-12 + 1e-9 * np.abs(P).max())
        assert np.linalg.eigvalsh(P).min() > 0.0
    sigmas = np.sqrt([np.diag(covariance_of(state)) for state in noiseless.states])
    assert sigmas[-1, 3:6].max() < 0.1 and sigmas[-1, 6:9].max() < 0.1
    assert np.all(sigmas[-1, 9:] < sigmas[0, 9:])  # biases are observable


@pytest.mark.parametrize("persistent", [0, 20])
@pytest.mark.parametrize("size", [5, 15])
def test_window_and_prior_keep_their_sizes(
    make_flight: MakeFlight, feed: Callable[..., "KeyframeFeed"], size: int, persistent: int
) -> None:
    flight = make_flight(0, rest_s=-5.0, duration_s=8.0, noisy=False)
    found, most_persistent = feed(flight, SmootherConfig(max_keyframes=size, max_persistent=persistent)), 0
    for _ in found:
        window = found.smoother._window
        assert len(window.states) <= size and len(window.persistent) <= persistent
        most_persistent = max(most_persistent, len(window.persistent))
        assert set(window.landmarks.observations.keyframe.tolist()) <= set(window.states)
        assert window.persistent <= set(window.landmarks.ids.tolist())
    assert len(found.states) > size
    assert (most_persistent > 0) == (persistent > 0)
    assert errors(found)[1].max() < 0.01


def test_without_parallax_the_oldest_keyframes_stay(
    make_flight: MakeFlight, feed: Callable[..., "KeyframeFeed"]
) -> None:
    """The second-newest keyframe is dropped instead of the oldest."""
    flight = make_flight(0, rest_s=-5.0, duration_s=6.0)
    found = feed(flight, SmootherConfig(max_keyframes=6, min_parallax_px=1e6))
    for _ in found:
        k = len(found.states)
        assert list(found.smoother._window.states) == ([*range(k + 1)] if k < 6 else [0, 1, 2, 3, 4, k])
        assert np.isfinite(covariance_of(found.states[-1])).all()


def test_smoother_restarts_after_a_failure_of_the_solver(
    make_flight: MakeFlight, feed: Callable[..., "KeyframeFeed"], monkeypatch: pytest.MonkeyPatch
) -> None:
    found = feed(make_flight(2, rest_s=-5.0, duration_s=8.0))
    for _ in found:
        if len(found.states) == 15:
            fail_to_linearize(monkeypatch)
    events = [result.events for result in found.results]
    assert events[15] == ("solver restored: the linear system is indefinite",)
    assert not any(events[:15]) and not any(events[16:])
    assert errors(found)[1].max() < 0.1
    assert len(found.points[-1]) > 15
    assert np.isfinite([state.T_world_imu for state in found.states]).all()


def test_the_prior_waits_for_a_later_frame(
    make_flight: MakeFlight, feed: Callable[..., "KeyframeFeed"], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The keyframe that marginalizes another does not compute the prior, and estimates do not depend on when it is."""
    flight, config = make_flight(0, rest_s=-5.0, duration_s=4.0), SmootherConfig(max_keyframes=6)
    waiting, counts = feed(flight, config), [0]
    marginal_prior = PendingMarginalization.prior

    def counted(*arguments: Any) -> MarginalPrior:
        counts[-1] += 1
        return marginal_prior(*arguments)

    monkeypatch.setattr(PendingMarginalization, "prior", counted)
    for _ in waiting:
        counts.append(0)
        waiting.smoother.complete()
    assert counts == [0] * 6 + [1] * (len(counts) - 6) and len(counts) > 10
    direct = feed(flight, config).finish()
    for one, other in zip(waiting.states, direct.states, strict=True):
        np.testing.assert_array_equal(one.T_world_imu, other.T_world_imu)
        np.testing.assert_array_equal(covariance_of(one), covariance_of(other))


@pytest.mark.parametrize(
    ("correction", "is_kept"),
    [
        ({"gravity_correction_m_s2": 0.03}, True),
        ({"time_offset_correction_s": 0.01}, False),
        (
            {"intrinsics": IntrinsicCorrections(np.full(1, 0.01), np.zeros((1, 2)), np.zeros(1), MODELS)},
            False,
        ),
    ],
)
def test_a_restart_keeps_observations_of_the_same_time_and_lens(
    noiseless: "KeyframeFeed", correction: dict[str, Any], is_kept: bool
) -> None:
    calibration = Calibration(noiseless.flight.rig, **correction)
    restarted = noiseless.smoother.restarted(calibration, np.zeros((15, 15)))
    window, last = restarted._window, noiseless.smoother._last_observed[1]
    assert len(window.landmarks.all_observations) == (len(last) if is_kept else 0)
    assert len(last) > 50 and len(restarted.landmarks) == 0


def test_a_restart_keeps_no_matches_of_cameras_that_determine_no_depth(noiseless: "KeyframeFeed") -> None:
    smoother, given = noiseless.smoother, Calibration(noiseless.flight.rig)
    before, last = smoother._last_observed
    matches = Matches(last.ids[:9], np.ones(9, np.int64), last.xy[:9])
    smoother._last_observed = before, replace(last, matches=matches)
    for without, count in ((frozenset[int](), 9), (frozenset({1}), 0)):
        restarted = smoother.restarted(replace(given, without_depth=without), np.zeros((15, 15)))
        assert len(restarted._window.landmarks.all_observations) == len(last) + count


def test_a_restart_after_a_failed_correction_keeps_nothing(
    make_flight: MakeFlight, feed: Callable[..., "KeyframeFeed"], monkeypatch: pytest.MonkeyPatch
) -> None:
    smoother = feed(make_flight(0, rest_s=-5.0, duration_s=3.0)).finish().smoother

    fail_to_linearize(monkeypatch)
    calibration = Calibration(smoother._calibration.rig, time_offset_correction_s=0.01)
    assert not smoother.recalibrate(calibration, np.zeros((15, 15)))
    assert len(smoother.restarted(calibration, np.zeros((15, 15)))._window.landmarks.all_observations) == 0


def test_the_next_keyframe_reports_a_singular_prior(
    make_flight: MakeFlight, feed: Callable[..., "KeyframeFeed"], monkeypatch: pytest.MonkeyPatch
) -> None:
    found = feed(make_flight(2, rest_s=-5.0, duration_s=8.0), SmootherConfig(max_keyframes=6))

    def fail(*_: Any) -> MarginalPrior:
        raise SingularError("the marginalized variables are indefinite")

    for _ in found:
        if len(found.states) == 10:
            monkeypatch.setattr(PendingMarginalization, "prior", fail)
            found.smoother.complete()  # this failure is not reported
        elif len(found.states) == 11:
            monkeypatch.undo()
    events = [result.events for result in found.results]
    assert events[10] == ("solver restored: the marginalized variables are indefinite",)
    assert not any(events[:10]) and not any(events[11:])
    assert errors(found)[1].max() < 0.1


@pytest.mark.parametrize("position_sigma_m", [1.0, 10.0, 1000.0])
def test_smoother_restarts_at_any_position_covariance(
    make_flight: MakeFlight,
    feed: Callable[..., "KeyframeFeed"],
    monkeypatch: pytest.MonkeyPatch,
    position_sigma_m: float,
) -> None:
    """The position is unobservable: its standard deviation may be metres after a long flight, and stays as it was."""
    found = feed(make_flight(2, rest_s=-5.0, duration_s=4.0))
    for _ in found:
        if len(found.states) == 8:
            solution = found.smoother._solution
            covariance = solution.covariance.copy()
            covariance[3:6, 3:6] = position_sigma_m**2 * np.eye(3)
            found.smoother._solution = replace(solution, covariance=covariance)
            fail_to_linearize(monkeypatch)
    assert [bool(result.events) for result in found.results] == [k == 8 for k in range(len(found.results))]
    assert errors(found)[1].max() < 0.1
    sigma_m = np.sqrt(np.diag(covariance_of(found.states[-1]))[3:6])
    np.testing.assert_allclose(sigma_m, position_sigma_m, rtol=0.05)


def test_zero_velocity_updates_prevent_drift(make_flight: MakeFlight, keyframe_feed: "type[KeyframeFeed]") -> None:
    """A stationary drone does not drift, although the bias of the accelerometer is not known."""
    flight = make_flight(4, rest_s=20.0, duration_s=6.0)
    true, zero = flight.state_at(int(flight.frame_times_ns[0])), np.zeros(3)
    start = replace(true, velocity_m_s=zero, gyro_bias_rad_s=zero, accel_bias_m_s2=zero)
    covariance = InitialSigmas(gyro_bias_rad_s=0.05).covariance(start.T_world_imu[:3, :3])
    found = keyframe_feed(flight, start, covariance, frames_per_keyframe=10, stationary=True).finish()
    assert not any(result.events for result in found.results)
    state = found.states[-1]
    assert np.linalg.norm(state.velocity_m_s) < 0.01
    assert np.linalg.norm(state.T_world_imu[:3, 3] - true.T_world_imu[:3, 3]) < 0.01
    np.testing.assert_allclose(state.gyro_bias_rad_s, true.gyro_bias_rad_s, atol=1e-3)
