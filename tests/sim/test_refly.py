"""Simulation along a recorded path: time stamps and poses are kept, and the IMU agrees with the path."""

import numpy as np
import pytest

from dronevio.models.errors import ConfigError
from dronevio.models.imu import ImuSamples
from dronevio.models.rig_presets import rig_named
from dronevio.models.state import Trajectory
from dronevio.sim.flight import Flight, fly
from dronevio.sim.refly import cut, frame_stamps, refly
from dronevio.sim.scenarios import scenario_named
from dronevio.sim.world import flight_area

START_NS = 1_403_715_273_262_142_976


@pytest.fixture(scope="module")
def recorded() -> Flight:
    return fly(scenario_named("short"))


def _shifted(flight: Flight) -> tuple[Trajectory, ImuSamples]:
    """Return the trajectory and the IMU of a flight with another clock and another origin."""
    truth, imu = flight.truth, flight.imu
    p = truth.p_world_imu + [40.0, -3.0, 12.0]
    samples = ImuSamples(imu.t_ns + START_NS - 250_000_000, imu.gyro_rad_s, imu.accel_m_s2)
    return Trajectory(truth.t_ns + START_NS, p, truth.quat_wxyz), samples


def test_a_recorded_imu_is_not_changed(recorded: Flight) -> None:
    path, imu = _shifted(recorded)
    simulated = refly(path, imu, rig_named("euroc"), "room")
    assert simulated.real_imu
    first = int(np.searchsorted(imu.t_ns, START_NS))
    assert np.array_equal(simulated.imu.gyro_rad_s, imu.gyro_rad_s[first:])
    assert np.array_equal(simulated.imu.t_ns, imu.t_ns[first:])
    assert np.array_equal(simulated.truth.p_world_imu, path.p_world_imu[: len(simulated.truth)])
    assert np.all(np.isin(simulated.schedule.stamps_ns, imu.t_ns))
    assert np.unique(np.diff(simulated.schedule.stamps_ns)).tolist() == [50_000_000]


def test_the_path_is_placed_clear_of_obstacles(recorded: Flight) -> None:
    path, _ = _shifted(recorded)
    simulated = refly(path, None, rig_named("euroc"), "room", seed=3)
    T = simulated.T_simworld_world
    placed = simulated.truth.p_world_imu @ T[:3, :3].T + T[:3, 3]
    assert flight_area("room", 3).space.clearance(placed).min() >= 0.3


def test_a_synthesized_imu_agrees_with_the_path(recorded: Flight) -> None:
    path, _ = _shifted(recorded)
    simulated = refly(path, None, rig_named("euroc"), "room")
    assert not simulated.real_imu
    assert np.array_equal(simulated.imu.t_ns, path.t_ns)  # the recording's own stamps
    assert np.abs(simulated.truth.p_world_imu - path.p_world_imu).max() < 2e-3
    truth = simulated.truth
    assert truth.gyro_bias_rad_s is not None and truth.accel_bias_m_s2 is not None
    flying = (path.t_s > 2.0) & (path.t_s < 5.0)
    gyro = simulated.imu.gyro_rad_s - truth.gyro_bias_rad_s - recorded.perfect_imu.gyro_rad_s
    accel = simulated.imu.accel_m_s2 - truth.accel_bias_m_s2 - recorded.perfect_imu.accel_m_s2
    assert np.sqrt(np.mean(gyro[flying] ** 2)) < 0.02
    assert np.sqrt(np.mean(accel[flying] ** 2)) < 0.2


def test_same_seed_same_imu(recorded: Flight) -> None:
    path, _ = _shifted(recorded)
    first, again, other = (refly(path, None, rig_named("euroc"), "room", seed).imu for seed in (1, 1, 2))
    assert np.array_equal(first.gyro_rad_s, again.gyro_rad_s)
    assert not np.array_equal(first.gyro_rad_s, other.gyro_rad_s)


def test_frames_have_the_nearest_stamps_of_the_imu() -> None:
    imu_ns = START_NS + np.cumsum(np.random.default_rng(0).integers(4_990_000, 5_010_000, 400))
    stamps = frame_stamps(imu_ns, 20.0)
    nominal_ns = imu_ns[0] + 50_000_000 * np.arange(len(stamps))
    assert np.all(np.isin(stamps, imu_ns))
    assert np.abs(stamps - nominal_ns).max() < 5_010_000


def test_unusable_paths_are_refused(recorded: Flight) -> None:
    path, imu = _shifted(recorded)
    late = ImuSamples(imu.t_ns + 10**12, imu.gyro_rad_s, imu.accel_m_s2)
    with pytest.raises(ConfigError, match="overlapping times"):
        refly(path, late, rig_named("euroc"), "room")
    with pytest.raises(ConfigError, match="larger world"):
        wide = Trajectory(path.t_ns, 40.0 * path.p_world_imu, path.quat_wxyz)
        refly(wide, None, rig_named("euroc"), "room")
    with pytest.raises(ConfigError, match="of a path of 6"):
        cut(path, 7.0, 2.0)
    assert cut(path, 1.0, 2.0).t_s[-1] == pytest.approx(2.0)
