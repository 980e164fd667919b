from dataclasses import replace

import numpy as np
import pytest

from dronevio.models.errors import ConfigError
from dronevio.models.rig import euroc_rig
from dronevio.sim.flight import Flight, fly
from dronevio.sim.props.room import FREE_BOX_M
from dronevio.sim.scenario import Scenario
from dronevio.sim.scenarios import SCENARIOS, scenario_named


@pytest.fixture(scope="module", params=[0, 13])
def room(request: pytest.FixtureRequest) -> Flight:
    return fly(scenario_named("room", request.param))


def vehicle_positions(flight: Flight) -> np.ndarray:
    T = flight.scenario.rig.T_vehicle_imu
    R = flight.truth.rotations @ T[:3, :3].T
    return flight.truth.p_world_imu - R @ T[:3, 3]


def test_the_default_flight_is_dynamic(room: Flight) -> None:
    assert room.truth.velocity_m_s is not None
    speed = np.linalg.norm(room.truth.velocity_m_s, axis=1)
    rate = np.linalg.norm(room.perfect_imu.gyro_rad_s, axis=1)
    assert speed.max() >= 2.0
    assert np.degrees(rate.max()) >= 90.0
    assert room.truth.length_m > 30.0


def test_flight_follows_its_reference(room: Flight) -> None:
    error = np.linalg.norm(vehicle_positions(room) - room.reference.position_m, axis=1)
    assert np.sqrt(np.mean(error**2)) < 0.015
    assert error.max() < 0.04


def test_flight_stays_in_the_free_space(room: Flight) -> None:
    position, radius = vehicle_positions(room), 0.33  # arm and propeller
    assert np.all(position[:, :2] - radius > FREE_BOX_M[0, :2])
    assert np.all(position + radius < FREE_BOX_M[1])
    assert position[:, 2].min() > 0.10


def test_drone_is_stationary_before_and_after(room: Flight) -> None:
    t = room.truth.t_s
    for stationary in (t < 2.0, t > 29.0):
        accel = room.perfect_imu.accel_m_s2[stationary]
        np.testing.assert_allclose(accel, np.tile([9.81, 0.0, 0.0], (len(accel), 1)), atol=2e-3)
        np.testing.assert_allclose(room.perfect_imu.gyro_rad_s[stationary], 0.0, atol=1e-4)
    np.testing.assert_allclose(vehicle_positions(room)[-1, :2], 0.0, atol=0.02)


def test_landing_is_gentle(room: Flight) -> None:
    landing = room.truth.t_s > 25.0
    assert np.linalg.norm(room.perfect_imu.accel_m_s2[landing], axis=1).max() < 2.5 * 9.81


def test_time_stamps_are_regular_and_complete(room: Flight) -> None:
    np.testing.assert_array_equal(room.imu.t_ns, np.arange(6001) * 5_000_000)
    np.testing.assert_array_equal(room.truth.t_ns, room.imu.t_ns)
    np.testing.assert_array_equal(room.frame_times_ns, np.arange(600) * 50_000_000)
    assert room.Ts_world_cam.shape == (600, 4, 4)


def test_camera_poses_follow_from_the_imu_poses(room: Flight) -> None:
    expected = room.truth.Ts_world_imu[:-1:10] @ room.scenario.rig.cameras[0].T_imu_cam
    np.testing.assert_allclose(room.Ts_world_cam, expected, atol=1e-9)
    assert room.Ts_world_cam[0, 0, 2] > 0.99  # initially, the optical axis is the world's x


def test_imu_is_the_ideal_one_plus_noise_and_biases(room: Flight) -> None:
    assert room.truth.gyro_bias_rad_s is not None and room.truth.accel_bias_m_s2 is not None
    model = room.scenario.rig.imu
    gyro = room.imu.gyro_rad_s - room.perfect_imu.gyro_rad_s - room.truth.gyro_bias_rad_s
    accel = room.imu.accel_m_s2 - room.perfect_imu.accel_m_s2 - room.truth.accel_bias_m_s2
    np.testing.assert_allclose(gyro.std(), model.gyro_noise_density * np.sqrt(200.0), rtol=0.05)
    np.testing.assert_allclose(accel.std(), model.accel_noise_density * np.sqrt(200.0), rtol=0.05)


def sensor_bytes(flight: Flight) -> bytes:
    return b"".join(
        values.tobytes()
        for values in (
            flight.imu.gyro_rad_s,
            flight.imu.accel_m_s2,
            flight.truth.p_world_imu,
            flight.truth.quat_wxyz,
            flight.Ts_world_cam,
        )
    )


def test_same_seed_same_bytes() -> None:
    first, again, other = (fly(scenario_named("short", seed)) for seed in (5, 5, 6))
    assert sensor_bytes(first) == sensor_bytes(again)
    assert not np.array_equal(first.imu.gyro_rad_s, other.imu.gyro_rad_s)
    assert np.abs(first.truth.p_world_imu - other.truth.p_world_imu).max() > 1e-3


def test_path_does_not_depend_on_the_sensor_noise() -> None:
    short = scenario_named("short")
    noiseless = replace(short, rig=replace(short.rig, imu=replace(short.rig.imu, gyro_noise_density=0.0)))
    np.testing.assert_array_equal(fly(short).truth.p_world_imu, fly(noiseless).truth.p_world_imu)


@pytest.mark.parametrize("name", ["hover", "short", "room-slow"])
def test_other_scenarios_follow_their_references(name: str) -> None:
    flight = fly(scenario_named(name))
    error = np.linalg.norm(vehicle_positions(flight) - flight.reference.position_m, axis=1)
    assert error.max() < 0.10
    assert flight.truth.t_s[-1] == pytest.approx(flight.reference.duration_s)
    assert vehicle_positions(flight)[:, 2].max() > 0.5
    np.testing.assert_allclose(flight.perfect_imu.gyro_rad_s[-20:], 0.0, atol=1e-3)


def test_exposures_follow_the_stamps_by_the_time_offset() -> None:
    short = scenario_named("short")
    late = fly(replace(short, rig=replace(euroc_rig(), time_offset_s=0.0125)))
    on_time = fly(short)
    np.testing.assert_array_equal(late.frame_times_ns, on_time.frame_times_ns)
    between = 0.5 * (on_time.truth.p_world_imu[2:1200:10] + on_time.truth.p_world_imu[3:1200:10])
    offset = late.Ts_world_cam[:, :3, 3] - between
    lever = np.linalg.norm(late.scenario.rig.cameras[0].T_imu_cam[:3, 3])
    np.testing.assert_allclose(np.linalg.norm(offset, axis=1), lever, atol=1e-3)


def test_progress_is_reported_from_start_to_end() -> None:
    reported: list[tuple[int, int]] = []
    fly(scenario_named("short"), lambda done, total: reported.append((done, total)))
    assert reported[0] == (0, 1200) and reported[-1] == (1200, 1200)
    assert reported == sorted(reported)


def test_unknown_names_and_seeds_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"'moon'.*room"):
        scenario_named("moon")
    with pytest.raises(ConfigError, match="-1"):
        scenario_named("room", -1)
    with pytest.raises(ConfigError, match="'moon'"):
        fly(replace(scenario_named("short"), world="moon"))


def test_subsystems_have_independent_random_streams() -> None:
    one: Scenario = SCENARIOS["room-v0"]
    assert one.generator("path").random() != one.generator("imu").random()
    assert one.generator("path").random() == one.generator("path").random()
    assert one.generator("path").random() != replace(one, seed=1).generator("path").random()


@pytest.mark.slow
def test_a_recording_may_start_in_motion() -> None:
    whole = fly(scenario_named("room"))
    started_in_motion = fly(scenario_named("room-motion"))
    assert started_in_motion.truth.t_ns[0] == 0 and started_in_motion.truth.velocity_m_s is not None
    assert np.linalg.norm(started_in_motion.truth.velocity_m_s[0]) > 0.5
    assert started_in_motion.collision is None
    later = whole.truth.p_world_imu[1200:]
    assert np.abs(started_in_motion.truth.p_world_imu[: len(later)] - later).max() < 0.1


@pytest.mark.parametrize("name", ["corridor-difficult", "forest-medium", "gates-race", "room-aggressive", "nano"])
@pytest.mark.slow
def test_flights_in_other_worlds_do_not_collide(name: str) -> None:
    flight = fly(scenario_named(name, 2))
    assert flight.collision is None
    error = np.linalg.norm(vehicle_positions(flight) - flight.reference.position_m, axis=1)
    assert np.sqrt(np.mean(error**2)) < 0.10 and error.max() < 0.3


@pytest.mark.parametrize("rate_hz", [100.0, 400.0])
def test_the_path_does_not_depend_on_the_rate_of_the_imu(rate_hz: float) -> None:
    """With a controller at 200 Hz, IMUs at 100 and 400 Hz fly the path of the one at 200 Hz."""
    own = scenario_named("short", 4)
    imu = replace(own.rig.imu, rate_hz=rate_hz)
    here, there = fly(own), fly(replace(own, rig=replace(own.rig, imu=imu), control_rate_hz=200.0))
    assert np.all(np.diff(there.imu.t_ns) == round(1e9 / rate_hz)) and there.imu.t_ns[-1] == here.imu.t_ns[-1]
    np.testing.assert_allclose(there.Ts_world_cam, here.Ts_world_cam, atol=1e-12)
    np.testing.assert_array_equal(there.schedule.exposed_ns, here.schedule.exposed_ns)
    both, rows, rows_there = np.intersect1d(here.truth.t_ns, there.truth.t_ns, return_indices=True)
    assert len(both) == min(len(here.truth.t_ns), len(there.truth.t_ns))
    np.testing.assert_allclose(there.truth.p_world_imu[rows_there], here.truth.p_world_imu[rows], atol=1e-12)
    assert there.reference_distance_m.max() == pytest.approx(here.reference_distance_m.max(), rel=1e-2)


def test_a_rate_of_the_controller_must_fit_that_of_the_imu() -> None:
    with pytest.raises(ConfigError, match="an IMU interval of 5 ms with a control interval of 2 ms"):
        fly(replace(scenario_named("short"), control_rate_hz=500.0))
