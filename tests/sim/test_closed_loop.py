"""Flights on the estimated state, where dead reckoning of a noise-free IMU stands for the odometry: exact and cheap."""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest

from dronevio.estimator.baselines.dead_reckoning import DeadReckoning
from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError
from dronevio.models.imu import ImuModel, ImuSamples
from dronevio.models.rig import Rig, euroc_rig
from dronevio.models.rotation import exp_so3, pose_matrix, rotation_z, yaw_rad_from_matrix
from dronevio.models.state import CameraFrame, Estimate, NavState, Trajectory
from dronevio.sim.closed_loop.estimated_state import transformed, world_from_odometry
from dronevio.sim.closed_loop.flight import ReferencePilot, fly_closed_loop
from dronevio.sim.closed_loop.settings import LoopSettings
from dronevio.sim.flight import Flight, fly
from dronevio.sim.scenario import Scenario
from dronevio.sim.scenarios import scenario_named

LATENCY = LoopSettings(frame_latency_s=0.03)


@dataclass
class NoImages:
    """Frames without images that record when they are rendered."""

    readout_ns: ClassVar[int] = 1_000_000

    def ready_ns(self, exposed_ns: int) -> int:
        return exposed_ns + self.readout_ns

    def frame(self, t_ns: int, exposed_ns: int, lit: bool, truth: Trajectory) -> CameraFrame:
        assert truth.t_ns[0] <= max(exposed_ns - self.readout_ns, 0)
        assert truth.t_ns[-1] >= exposed_ns
        return CameraFrame(t_ns, ())


class Odometry:
    """Dead reckoning in a frame of its own, which may publish its first state late and have an error later."""

    def __init__(self, rig: Rig, T: Array | None = None, ready_s: float = 0.0, error_m: Array | None = None) -> None:
        self._inner, self._T, self._ready_s = DeadReckoning(rig), np.eye(4) if T is None else T, ready_s
        self._error_m = np.zeros(3) if error_m is None else error_m
        self.newest_ns = 0
        self.arrivals_ns: list[tuple[int, int]] = []

    def add_imu(self, samples: ImuSamples) -> None:
        self.newest_ns = int(samples.t_ns[-1])
        self._inner.add_imu(samples)

    def add_frame(self, frame: CameraFrame) -> Estimate:
        self.arrivals_ns.append((frame.t_ns, self.newest_ns))
        return self._inner.add_frame(frame)

    def state_at(self, t_ns: int) -> NavState | None:
        assert t_ns == self.newest_ns
        state = self._inner.state_at(t_ns)
        if state is None or t_ns * 1e-9 < self._ready_s:
            return None
        state = transformed(self._T, state)
        T = state.T_world_imu.copy()
        T[:3, 3] += min(max(t_ns * 1e-9 - 2.6, 0.0), 1.0) * self._error_m  # grows for a second
        return replace(state, T_world_imu=T)


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    noiseless = ImuModel(
        gyro_noise_density=0.0,
        accel_noise_density=0.0,
        gyro_random_walk=0.0,
        accel_random_walk=0.0,
        gyro_turn_on_bias_rad_s=0.0,
        accel_turn_on_bias_m_s2=0.0,
    )
    return replace(scenario_named("short"), rig=replace(euroc_rig(), imu=noiseless))


def fly_with(scenario: Scenario, odometry: Odometry, settings: LoopSettings = LATENCY) -> Flight:
    return fly_closed_loop(scenario, odometry, NoImages(), settings)


@pytest.fixture(scope="module")
def flown(scenario: Scenario) -> tuple[Flight, Odometry]:
    odometry = Odometry(scenario.rig)
    return fly_with(scenario, odometry), odometry


def test_exact_estimate_gives_the_flight_on_the_truth(scenario: Scenario, flown: tuple[Flight, Odometry]) -> None:
    flight, on_truth = flown[0], fly(scenario)
    np.testing.assert_array_equal(flight.truth.t_ns, on_truth.truth.t_ns)
    np.testing.assert_allclose(flight.truth.p_world_imu, on_truth.truth.p_world_imu, atol=5e-3)
    np.testing.assert_array_equal(flight.reference.position_m, on_truth.reference.position_m)
    np.testing.assert_array_equal(flight.schedule.stamps_ns, on_truth.schedule.stamps_ns)
    assert flight.collision is None and on_truth.reference_distance_m.max() < 0.03


def test_recording_is_that_of_the_path_that_was_flown(flown: tuple[Flight, Odometry]) -> None:
    flight = flown[0]
    np.testing.assert_array_equal(flight.imu.t_ns, flight.truth.t_ns)
    np.testing.assert_array_equal(flight.imu.gyro_rad_s, flight.perfect_imu.gyro_rad_s)  # without noise
    assert len(flight.reference) == len(flight.truth)


@pytest.mark.slow
@pytest.mark.parametrize("yaw_rad", [1.0, -3.0])
def test_frame_of_the_odometry_is_arbitrary(scenario: Scenario, flown: tuple[Flight, Odometry], yaw_rad: float) -> None:
    T = pose_matrix(rotation_z(yaw_rad), np.array([30.0, -5.0, 2.0]))
    flight = fly_with(scenario, Odometry(scenario.rig, T))
    np.testing.assert_allclose(flight.truth.p_world_imu, flown[0].truth.p_world_imu, atol=1e-6)


def test_drone_waits_on_its_pad_for_the_first_state(scenario: Scenario, flown: tuple[Flight, Odometry]) -> None:
    """The take-off is planned at 1.5 s, and the first state comes at 2.0 s."""
    flight = fly_with(scenario, Odometry(scenario.rig, ready_s=2.0))
    assert len(flight.truth) == len(flown[0].truth) + 100
    waiting = flight.truth.t_s < 2.0
    assert np.ptp(flight.truth.p_world_imu[waiting], axis=0).max() < 1e-6
    later = flight.truth.p_world_imu[100:]
    np.testing.assert_allclose(later, flown[0].truth.p_world_imu, atol=5e-3)
    assert flight.reference_distance_m.max() < 0.03


def test_flight_without_a_state_ends_on_the_pad(scenario: Scenario) -> None:
    flight = fly_with(scenario, Odometry(scenario.rig, ready_s=np.inf), replace(LATENCY, max_wait_s=0.5))
    assert flight.truth.t_s[-1] == pytest.approx(2.0, abs=0.02)
    assert np.ptp(flight.truth.p_world_imu, axis=0).max() < 1e-4
    assert len(flight.reference_distance_m) == 0


def test_error_of_the_estimate_becomes_an_error_of_the_path(scenario: Scenario) -> None:
    """The controller holds the estimate on the reference; the error is horizontal in a frame of unknown yaw."""
    flight = fly_with(scenario, Odometry(scenario.rig, error_m=np.array([0.2, -0.1, 0.0])))
    offset = (flight.truth.p_world_imu - fly(scenario).truth.p_world_imu)[flight.truth.t_s > 4.5]
    np.testing.assert_allclose(np.linalg.norm(offset, axis=1), np.hypot(0.2, 0.1), atol=0.02)


@pytest.mark.parametrize("latency_s", [0.0, 0.03, 0.11])
def test_frames_reach_the_estimator_after_their_latency(scenario: Scenario, latency_s: float) -> None:
    odometry = Odometry(scenario.rig, ready_s=np.inf)
    fly_with(scenario, odometry, LoopSettings(latency_s, max_wait_s=0.0))
    stamps, arrivals = np.array(odometry.arrivals_ns[:-3]).T
    delay_s = (arrivals - stamps) * 1e-9
    assert delay_s.min() >= max(latency_s, 0.001) - 1e-9
    assert delay_s.max() < max(latency_s, 0.001) + 0.005
    assert len(stamps) > 20


class Watching(ReferencePilot):
    """Pilot that records when frames and their estimates come."""

    def __init__(self) -> None:
        self.newest_ns = 0
        self.seen: list[tuple[int, int, int]] = []

    def add_imu(self, samples: ImuSamples) -> None:
        self.newest_ns = int(samples.t_ns[-1])

    def add_frame(self, frame: CameraFrame, estimate: Estimate, T_world_odom: Array | None) -> None:
        self.seen.append((frame.t_ns, estimate.t_ns, self.newest_ns))


class Comparing(ReferencePilot):
    """Pilot that keeps the estimates of frames in the world."""

    def __init__(self) -> None:
        self.poses: dict[int, Array] = {}

    def add_frame(self, frame: CameraFrame, estimate: Estimate, T_world_odom: Array | None) -> None:
        if estimate.T_odom_imu is not None and T_world_odom is not None:
            self.poses[frame.t_ns] = T_world_odom @ estimate.T_odom_imu


@pytest.mark.parametrize("true_state", [False, True])
def test_estimates_of_frames_are_placed_in_the_world(scenario: Scenario, true_state: bool) -> None:
    """With the true state, the pilot sees where it was, however wrong the estimate is."""
    pilot = Comparing()
    elsewhere = pose_matrix(rotation_z(1.0), np.array([3.0, -5.0, 2.0])) if true_state else np.eye(4)
    odometry = Odometry(scenario.rig, elsewhere, error_m=np.full(3, 0.4 if true_state else 0.0))
    flight = fly_closed_loop(scenario, odometry, NoImages(), LATENCY, pilot=pilot, true_state=true_state)
    seen = np.array(sorted(pilot.poses))
    true = flight.truth.p_world_imu[np.searchsorted(flight.truth.t_ns, seen)]
    moving = seen < flight.truth.t_ns[-1] - 100_000_000
    estimated = np.stack([pilot.poses[t][:3, 3] for t in seen.tolist()])
    assert len(seen) > 50 and np.ptp(true, axis=0).max() > 0.5
    np.testing.assert_allclose(estimated[moving], true[moving], atol=0.02)


@pytest.mark.parametrize("latency_s", [0.03, 0.11])
def test_pilot_sees_each_frame_with_its_estimate_when_the_estimator_does(scenario: Scenario, latency_s: float) -> None:
    odometry, pilot = Odometry(scenario.rig, ready_s=np.inf), Watching()
    fly_closed_loop(scenario, odometry, NoImages(), LoopSettings(latency_s, max_wait_s=0.0), pilot=pilot)
    assert [(frame_ns, now_ns) for frame_ns, _, now_ns in pilot.seen] == odometry.arrivals_ns
    assert all(frame_ns == estimate_ns for frame_ns, estimate_ns, _ in pilot.seen)
    assert len(pilot.seen) > 20


def test_latency_of_commands(scenario: Scenario) -> None:
    """The rotors of a drone whose commands are 0.1 s late start to turn 0.1 s later."""

    def first_motion_s(latency_s: float) -> float:
        settings = replace(LATENCY, command_latency_s=latency_s)
        flight = fly_with(scenario, Odometry(scenario.rig, error_m=None), settings)
        height = flight.truth.p_world_imu[:, 2]
        return float(flight.truth.t_s[np.argmax(height > height[0] + 0.01)])

    assert first_motion_s(0.1) - first_motion_s(0.0) == pytest.approx(0.1, abs=0.03)


def test_frames_arrive_after_their_readout(scenario: Scenario) -> None:
    """Half of a readout of 40 ms follows the middle of the exposure, and the motion during it has to be known."""
    camera = replace(scenario.rig.cameras[0], readout_s=0.04)
    rolling = replace(scenario, rig=replace(scenario.rig, cameras=(camera,)))
    odometry = Odometry(rolling.rig, ready_s=np.inf)
    fly_with(rolling, odometry, LoopSettings(0.0, max_wait_s=0.0))
    stamps, arrivals = np.array(odometry.arrivals_ns[:-3]).T
    assert (arrivals - stamps).min() == 20_000_000


def test_the_controller_has_the_rate_of_the_imu(scenario: Scenario) -> None:
    """Every command follows a sample, so that a flight on the estimate has no other rate of the controller."""
    with pytest.raises(ConfigError, match="a controller at 100 Hz with an IMU at 200 Hz; expected the same rate"):
        fly_with(replace(scenario, control_rate_hz=100.0), Odometry(scenario.rig), LoopSettings(0.0, max_wait_s=0.0))


@pytest.mark.parametrize("value", [-0.1, np.nan, np.inf])
def test_latencies_are_checked(value: float) -> None:
    with pytest.raises(ConfigError, match="frame_latency_s"):
        LoopSettings(frame_latency_s=value)


def test_odometry_frame_is_placed_by_yaw_and_position() -> None:
    rng = np.random.default_rng(0)
    T_world_imu = pose_matrix(exp_so3(rng.normal(size=3)), rng.normal(size=3))
    T_odom_world = pose_matrix(rotation_z(2.0), rng.normal(size=3))
    T_world_odom = world_from_odometry(T_world_imu, T_odom_world @ T_world_imu)
    np.testing.assert_allclose(T_world_odom @ T_odom_world, np.eye(4), atol=1e-12)
    tilted = T_odom_world @ T_world_imu
    tilted[:3, :3] = tilted[:3, :3] @ exp_so3(np.array([0.02, -0.01, 0.0]))
    placed = world_from_odometry(T_world_imu, tilted)
    assert placed[2, 2] == 1.0  # the vertical is that of the odometry
    np.testing.assert_allclose((placed @ tilted)[:3, 3], T_world_imu[:3, 3], atol=1e-12)
    assert abs(float(yaw_rad_from_matrix((placed @ tilted)[:3, :3] @ T_world_imu[:3, :3].T))) < 1e-9
