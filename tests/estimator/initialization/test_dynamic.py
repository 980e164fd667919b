"""Dynamic initialization, on windows of synthetic flights with known truth."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from dronevio.estimator.backend import smoother
from dronevio.estimator.imu.buffer import ImuBuffer
from dronevio.estimator.initialization.dynamic import (
    DynamicInitializationConfig,
    DynamicStart,
    dynamic_start,
    observed_rotation,
)
from dronevio.estimator.initialization.gauge import BiasPrior
from dronevio.estimator.initialization.not_observable import NotObservable
from dronevio.estimator.optimization.levenberg_marquardt import Minimum, levenberg_marquardt
from dronevio.estimator.types import FramePacket
from dronevio.models.arrays import Array
from dronevio.models.state import NavState, Trajectory

if TYPE_CHECKING:
    from tests.estimator.conftest import SyntheticFlight

MakeFlight = Callable[..., "SyntheticFlight"]

CONFIG = DynamicInitializationConfig()
ZERO = np.zeros(3)
PRIOR, ACCEL_PRIOR = BiasPrior(ZERO, 0.05), BiasPrior(ZERO, CONFIG.accel_bias_sigma_m_s2)


def window_of(flight: "SyntheticFlight", seconds: float = 1.5) -> list[FramePacket]:
    """Return the frame packets of the first seconds of a flight."""
    front_end, buffer = flight.front_end(), ImuBuffer()
    buffer.add(flight.imu)
    packets = []
    for k in range(round(seconds * 20) + 1):
        t_ns = int(flight.frame_times_ns[k])
        increments = buffer.take_until(t_ns)
        front_end.track(flight.frame(k), np.eye(3))
        packets.append(FramePacket(t_ns, increments, front_end.replenish()))
    return packets


def initialized(
    flight: "SyntheticFlight",
    config: DynamicInitializationConfig = CONFIG,
    seconds: float = 1.5,
    gyro_bias: BiasPrior = PRIOR,
    accel_bias: BiasPrior = ACCEL_PRIOR,
) -> NavState | NotObservable:
    """Return the state of the dynamic initialization over the first seconds of a flight."""
    start = started(window_of(flight, seconds), flight, config, gyro_bias, accel_bias)
    return start.state if isinstance(start, DynamicStart) else start


def initialize_dynamic(
    window: Sequence[FramePacket],
    Ts_imu_cam: Array,
    focal_px: float,
    config: DynamicInitializationConfig,
    gyro_bias: BiasPrior,
    accel_bias: BiasPrior,
) -> DynamicStart | NotObservable:
    """Return the result of both halves of a dynamic initialization."""
    rotation = observed_rotation(window, Ts_imu_cam, focal_px, config, gyro_bias)
    if isinstance(rotation, NotObservable):
        return rotation
    return dynamic_start(rotation, focal_px, config, gyro_bias, accel_bias)


def started(
    window: list[FramePacket],
    flight: "SyntheticFlight",
    config: DynamicInitializationConfig = CONFIG,
    gyro_bias: BiasPrior = PRIOR,
    accel_bias: BiasPrior = ACCEL_PRIOR,
) -> DynamicStart | NotObservable:
    """Return the dynamic initialization over a window."""
    cameras = flight.rig.cameras
    Ts_imu_cam = np.stack([camera.T_imu_cam for camera in cameras])
    return initialize_dynamic(window, Ts_imu_cam, cameras[0].model.fx, config, gyro_bias, accel_bias)


def errors(state: NavState, truth: Trajectory) -> tuple[float, float, float]:
    """Return the errors of velocity in the IMU frame [m/s], tilt [rad] and gyroscope bias [rad/s]."""
    assert truth.velocity_m_s is not None and truth.gyro_bias_rad_s is not None
    R, R_true = state.T_world_imu[:3, :3], truth.rotations[0]
    velocity = R.T @ state.velocity_m_s - R_true.T @ truth.velocity_m_s[0]
    tilt = np.linalg.norm(np.cross(R[2], R_true[2]))
    return (
        float(np.linalg.norm(velocity)),
        float(tilt),
        float(np.linalg.norm(state.gyro_bias_rad_s - truth.gyro_bias_rad_s[0])),
    )


@pytest.mark.parametrize("seed", range(5))
def test_without_noise_it_is_exact(make_flight: MakeFlight, seed: int) -> None:
    bias = np.array([0.03, -0.02, 0.05])
    flight = make_flight(seed, rest_s=-5.0, duration_s=2.0, noisy=False, sampling="increment", gyro_bias=bias)
    state = initialized(flight, gyro_bias=BiasPrior(ZERO, 10.0))  # without a prior, which would attract it
    assert isinstance(state, NavState) and state.t_ns == flight.frame_times_ns[0]
    velocity, tilt, gyro_bias = errors(state, flight.truth_at(flight.frame_times_ns[:1]))
    assert velocity < 1e-3 and tilt < 1e-4 and gyro_bias < 1e-5
    np.testing.assert_array_equal(state.T_world_imu[:3, 3], ZERO)
    np.testing.assert_allclose(state.accel_bias_m_s2, ZERO, atol=1e-4)


@pytest.mark.parametrize("seed", range(6))
def test_with_noise_it_is_near(make_flight: MakeFlight, seed: int) -> None:
    """The noise is 0.3 px in the image, with the noise and the accelerometer bias of the IMU model."""
    flight = make_flight(seed, rest_s=-5.0, duration_s=2.0, pixel_noise=0.3, max_features=120)
    state = initialized(flight)
    assert isinstance(state, NavState)
    truth = flight.truth_at(flight.frame_times_ns[:1])
    assert truth.velocity_m_s is not None
    velocity, tilt, gyro_bias = errors(state, truth)
    speed = float(np.linalg.norm(truth.velocity_m_s[0]))
    assert velocity < 0.1 + 0.25 * speed  # noise of the bearings biases the depths towards smaller values
    assert tilt < np.radians(2.5) and gyro_bias < 3e-3


def test_pure_rotation_is_not_observable(make_flight: MakeFlight) -> None:
    rotation = {"positions_m": np.zeros((3, 2))}
    assert isinstance(initialized(make_flight(0, rest_s=-5.0, duration_s=2.0, motion=rotation)), NotObservable)
    assert isinstance(
        initialized(make_flight(0, rest_s=-5.0, duration_s=2.0, motion=rotation, noisy=False)), NotObservable
    )


def test_a_stationary_window_is_not_observable(make_flight: MakeFlight) -> None:
    assert isinstance(initialized(make_flight(0, rest_s=10.0, duration_s=2.0)), NotObservable)
    assert isinstance(initialized(make_flight(0, rest_s=10.0, duration_s=2.0, noisy=False)), NotObservable)


@pytest.mark.parametrize("noisy", [True, False])
@pytest.mark.parametrize("seed", range(4))
def test_scale_is_not_observable_at_constant_velocity(make_flight: MakeFlight, seed: int, noisy: bool) -> None:
    """A slow sine approximates a line at 1.1 m/s: the parallax is large, but any scale explains the observations."""
    slow = 1e-4
    line = {
        "positions_m": np.array([[0.9, 0.0], [0.5, 0.0], [0.2, 0.0]]) / slow,
        "position_rates": np.full((3, 2), slow),
        "phases": np.zeros((2, 3, 2)),
    }
    flight = make_flight(seed, rest_s=-1.5, duration_s=2.0, noisy=noisy, motion=line)
    assert isinstance(initialized(flight), NotObservable)


@pytest.mark.parametrize("seed", range(12))
def test_weak_excitation_gives_a_good_scale_or_no_state(make_flight: MakeFlight, seed: int) -> None:
    """The acceleration is a few tenths of a m/s², as large as an accelerometer bias may be."""
    gentle = {"positions_m": 0.25 * np.array([[1.5, 0.3], [1.3, 0.35], [0.5, 0.2]])}
    flight = make_flight(seed, rest_s=-5.0, duration_s=2.0, pixel_noise=0.3, motion=gentle)
    state = initialized(flight)
    if isinstance(state, NavState):
        true_velocity_m_s = flight.state_at(int(flight.frame_times_ns[0])).velocity_m_s
        assert 0.7 < np.linalg.norm(state.velocity_m_s) / np.linalg.norm(true_velocity_m_s) < 1.4


DISTANT = {
    "positions_m": np.array([[6.0, 1.2], [5.2, 1.4], [2.0, 0.8]]),
    "position_rates": np.array([[0.28, 0.76], [0.36, 0.68], [0.32, 0.92]]),
}
"""A motion with up to 3 m/s and an acceleration of some tenths of a m/s²."""


@pytest.mark.parametrize("seed", range(8))
def test_distant_landmarks_do_not_collapse(make_flight: MakeFlight, seed: int) -> None:
    """At distances of some 10 m, an accelerometer bias must not move the cameras and all landmarks to one point."""
    flight = make_flight(seed, rest_s=-5.0, duration_s=3.5, pixel_noise=0.15, max_features=150, motion=DISTANT)
    flight = replace(flight, landmarks=3.0 * flight.landmarks)
    truth = flight.truth_at(flight.frame_times_ns[:1])
    assert truth.velocity_m_s is not None
    speed = float(np.linalg.norm(truth.velocity_m_s[0]))
    short, long = (initialized(flight, seconds=seconds) for seconds in (CONFIG.window_s, CONFIG.max_window_s))
    assert isinstance(long, NavState)
    for state in (short, long):
        if isinstance(state, NavState):
            velocity, tilt, _ = errors(state, truth)
            assert velocity < 0.02 + 0.08 * speed and tilt < np.radians(1.0)


def test_every_threshold_can_reject_the_state(make_flight: MakeFlight) -> None:
    flight = make_flight(0, rest_s=-5.0, duration_s=2.0)
    assert isinstance(initialized(flight), NavState)
    for config in (
        replace(CONFIG, min_landmarks=1000),
        replace(CONFIG, min_parallax_sigmas=1e4),
        replace(CONFIG, max_residual_sigmas=0.01),
        replace(CONFIG, max_velocity_sigma=0.0, max_velocity_sigma_m_s=1e-6),
        replace(CONFIG, max_gyro_bias_rad_s=1e-9),
        replace(CONFIG, max_accel_bias_m_s2=1e-9),
        replace(CONFIG, min_inliers=1.1),
        replace(CONFIG, min_in_front=1.0),
        replace(CONFIG, min_excitation=100.0),
    ):
        assert isinstance(initialized(flight, config), NotObservable), config


@pytest.mark.parametrize("share", [0.3, 0.45, 0.6, 0.7])
@pytest.mark.parametrize("seed", range(3))
def test_moving_landmarks_are_rejected(make_flight: MakeFlight, seed: int, share: float) -> None:
    """A share of the landmarks oscillates with an amplitude of 0.5 m; if it is most of them, there is no state."""
    flight = make_flight(seed, rest_s=-5.0, duration_s=2.0, moving_share=share)
    state = initialized(flight)
    assert isinstance(state, NavState) == (share < 0.5)
    if isinstance(state, NavState):
        truth = flight.truth_at(flight.frame_times_ns[:1])
        assert truth.velocity_m_s is not None
        velocity, tilt, gyro_bias = errors(state, truth)
        speed = float(np.linalg.norm(truth.velocity_m_s[0]))
        assert velocity < 0.05 + 0.05 * speed and tilt < np.radians(1.5) and gyro_bias < 3e-3


@pytest.mark.parametrize("seconds", [0.05, 0.1, 0.3])
def test_short_windows_are_not_observable(make_flight: MakeFlight, seconds: float) -> None:
    assert isinstance(initialized(make_flight(0, rest_s=-5.0, duration_s=2.0), seconds=seconds), NotObservable)


def test_gravity_has_its_magnitude_despite_accelerometer_bias(make_flight: MakeFlight) -> None:
    flight = make_flight(1, rest_s=-5.0, duration_s=2.0, noisy=False, accel_bias=np.array([0.05, -0.05, 0.05]))
    state = initialized(flight)
    assert isinstance(state, NavState)
    velocity, tilt, gyro_bias = errors(state, flight.truth_at(flight.frame_times_ns[:1]))
    assert velocity < 0.15 and tilt < np.radians(1.5) and gyro_bias < 1e-3


def test_the_window_is_not_modified(make_flight: MakeFlight) -> None:
    flight = make_flight(0, rest_s=-5.0, duration_s=2.0)
    window = window_of(flight)
    before = [(packet.observations.xy.copy(), packet.increments.gyro_rad_s.copy()) for packet in window]
    started(window, flight)
    for packet, (xy, gyro) in zip(window, before, strict=True):
        np.testing.assert_array_equal(packet.observations.xy, xy)
        np.testing.assert_array_equal(packet.increments.gyro_rad_s, gyro)


@pytest.mark.parametrize("seed", range(4))
def test_the_adjustment_of_a_start_converges(
    make_flight: MakeFlight, monkeypatch: pytest.MonkeyPatch, seed: int
) -> None:
    """Every step decreases the cost, because costs are compared at the same scales."""
    found = list[Minimum[Any, Any]]()

    def recorded(*arguments: Any) -> Minimum[Any, Any]:
        found.append(levenberg_marquardt(*arguments))
        return found[-1]

    monkeypatch.setattr(smoother, "levenberg_marquardt", recorded)
    make_flight(seed, rest_s=-5.0, duration_s=2.0).run()
    assert len(found) == 2  # rounds
    assert all(minimum.converged and minimum.rejected == 0 for minimum in found)
