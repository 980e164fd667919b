"""The start in motion, on windows of which the truth is known."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from dronevio.estimator.imu.buffer import ImuBuffer
from dronevio.estimator.initialization.dynamic import DynamicInitializationConfig, initialize_dynamic
from dronevio.estimator.initialization.static import NotObservable
from dronevio.estimator.types import FramePacket
from dronevio.models.state import NavState, Trajectory

CONFIG = DynamicInitializationConfig()
ZERO = np.zeros(3)


def window_of(flight: object, seconds: float = 1.5) -> list[FramePacket]:
    """Return a flight's first sightings."""
    front_end, buffer = flight.front_end(), ImuBuffer()
    buffer.add(flight.imu)
    sightings = []
    for k in range(round(seconds * 20) + 1):
        t_ns = int(flight.frame_times_ns[k])
        increments = buffer.take_until(t_ns)
        front_end.track(flight.frame(k), np.eye(3))
        sightings.append(FramePacket(t_ns, increments, front_end.replenish()))
    return sightings


def start_of(
    flight: object, config: DynamicInitializationConfig = CONFIG, seconds: float = 1.5
) -> NavState | NotObservable:
    cameras = flight.rig.cameras
    return initialize_dynamic(
        window_of(flight, seconds), np.stack([camera.T_imu_cam for camera in cameras]), cameras[0].model.fx, config
    )


def errors(state: NavState, truth: Trajectory) -> tuple[float, float, float]:
    """Return the errors of velocity in the IMU frame [m/s], of tilt [rad] and of the gyroscope's bias [rad/s]."""
    R, R_true = state.T_world_imu[:3, :3], truth.rotations[0]
    velocity = R.T @ state.velocity_m_s - R_true.T @ truth.velocity_m_s[0]
    tilt = np.linalg.norm(np.cross(R[2], R_true[2]))
    return (
        float(np.linalg.norm(velocity)),
        float(tilt),
        float(np.linalg.norm(state.gyro_bias_rad_s - truth.gyro_bias_rad_s[0])),
    )


@pytest.mark.parametrize("seed", range(5))
def test_without_noise_it_is_exact(make_flight: Callable, seed: int) -> None:
    bias = np.array([0.03, -0.02, 0.05])
    flight = make_flight(seed, rest_s=-5.0, duration_s=2.0, noisy=False, sampling="increment", gyro_bias=bias)
    state = start_of(flight)
    assert isinstance(state, NavState) and state.t_ns == flight.frame_times_ns[0]
    velocity, tilt, gyro_bias = errors(state, flight.truth_at(flight.frame_times_ns[:1]))
    assert velocity < 1e-3 and tilt < 1e-4 and gyro_bias < 1e-5
    np.testing.assert_array_equal(state.T_world_imu[:3, 3], ZERO)
    np.testing.assert_array_equal(state.accel_bias_m_s2, ZERO)


@pytest.mark.parametrize("seed", range(6))
def test_with_noise_it_is_near(make_flight: Callable, seed: int) -> None:
    """0.3 px, and the IMU's own noise and accelerometer bias."""
    flight = make_flight(seed, rest_s=-5.0, duration_s=2.0, pixel_noise=0.3, max_features=120)
    state = start_of(flight)
    assert isinstance(state, NavState)
    truth = flight.truth_at(flight.frame_times_ns[:1])
    velocity, tilt, gyro_bias = errors(state, truth)
    speed = float(np.linalg.norm(truth.velocity_m_s[0]))
    assert velocity < 0.1 + 0.25 * speed  # noise in the bearings draws everything nearer
    assert tilt < np.radians(2.5) and gyro_bias < 3e-3


def test_turning_on_the_spot_tells_nothing(make_flight: Callable) -> None:
    still = {"positions_m": np.zeros((3, 2))}
    assert isinstance(start_of(make_flight(0, rest_s=-5.0, duration_s=2.0, motion=still)), NotObservable)
    assert isinstance(start_of(make_flight(0, rest_s=-5.0, duration_s=2.0, motion=still, noisy=False)), NotObservable)


def test_rest_tells_nothing(make_flight: Callable) -> None:
    assert isinstance(start_of(make_flight(0, rest_s=10.0, duration_s=2.0)), NotObservable)
    assert isinstance(start_of(make_flight(0, rest_s=10.0, duration_s=2.0, noisy=False)), NotObservable)


@pytest.mark.parametrize("noisy", [True, False])
@pytest.mark.parametrize("seed", range(4))
def test_constant_velocity_does_not_tell_the_scale(make_flight: Callable, seed: int, noisy: bool) -> None:
    """A sine so slow that it is a line: 1.1 m/s, and plenty of parallax, yet every scale explains what is seen."""
    slow = 1e-4
    line = {
        "positions_m": np.array([[0.9, 0.0], [0.5, 0.0], [0.2, 0.0]]) / slow,
        "position_rates": np.full((3, 2), slow),
        "phases": np.zeros((2, 3, 2)),
    }
    flight = make_flight(seed, rest_s=-1.5, duration_s=2.0, noisy=noisy, motion=line)
    assert isinstance(start_of(flight), NotObservable)


@pytest.mark.parametrize("seed", range(12))
def test_gentle_flights_are_told_well_or_not_at_all(make_flight: Callable, seed: int) -> None:
    """A few tenths of a m/s² that the accelerometer's bias may well be."""
    gentle = {"positions_m": 0.25 * np.array([[1.5, 0.3], [1.3, 0.35], [0.5, 0.2]])}
    flight = make_flight(seed, rest_s=-5.0, duration_s=2.0, pixel_noise=0.3, motion=gentle)
    state = start_of(flight)
    if isinstance(state, NavState):
        speeds = [
            np.linalg.norm(s) for s in (state.velocity_m_s, flight.truth_at(flight.frame_times_ns[:1]).velocity_m_s)
        ]
        assert 0.7 < speeds[0] / speeds[1] < 1.4


def test_more_is_asked_for_than_was_seen(make_flight: Callable) -> None:
    flight = make_flight(0, rest_s=-5.0, duration_s=2.0)
    assert isinstance(start_of(flight), NavState)
    for config in (
        replace(CONFIG, min_landmarks=1000),
        replace(CONFIG, min_parallax_px=1e4),
        replace(CONFIG, max_residual_px=0.01),
        replace(CONFIG, max_velocity_sigma_m_s=1e-6),
        replace(CONFIG, max_gyro_bias_rad_s=1e-9),
        replace(CONFIG, min_in_front=1.0),
        replace(CONFIG, min_excitation=100.0),
    ):
        assert isinstance(start_of(flight, config), NotObservable), config


def test_wrong_tracks_are_not_believed(make_flight: Callable) -> None:
    """Half of the landmarks swing by half a metre."""
    assert isinstance(start_of(make_flight(0, rest_s=-5.0, duration_s=2.0, moving_share=0.5)), NotObservable)


@pytest.mark.parametrize("seconds", [0.05, 0.1, 0.3])
def test_windows_that_are_too_short_tell_nothing(make_flight: Callable, seconds: float) -> None:
    assert isinstance(start_of(make_flight(0, rest_s=-5.0, duration_s=2.0), seconds=seconds), NotObservable)


def test_gravity_has_its_magnitude_despite_accelerometer_bias(make_flight: Callable) -> None:
    flight = make_flight(1, rest_s=-5.0, duration_s=2.0, noisy=False, accel_bias=np.array([0.05, -0.05, 0.05]))
    state = start_of(flight)
    assert isinstance(state, NavState)
    velocity, tilt, gyro_bias = errors(state, flight.truth_at(flight.frame_times_ns[:1]))
    assert velocity < 0.15 and tilt < np.radians(1.5) and gyro_bias < 1e-3


def test_what_it_is_told_stays_unchanged(make_flight: Callable) -> None:
    flight = make_flight(0, rest_s=-5.0, duration_s=2.0)
    window = window_of(flight)
    before = [(s.observations.xy.copy(), s.increments.gyro_rad_s.copy()) for s in window]
    cameras = flight.rig.cameras
    initialize_dynamic(window, np.stack([camera.T_imu_cam for camera in cameras]), cameras[0].model.fx, CONFIG)
    for packet, (xy, gyro) in zip(window, before, strict=True):
        np.testing.assert_array_equal(packet.observations.xy, xy)
        np.testing.assert_array_equal(packet.increments.gyro_rad_s, gyro)
