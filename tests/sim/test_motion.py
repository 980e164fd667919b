"""The ideal IMU against an independent dead reckoning with SciPy's rotations and against analytic motions."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dronevio.models.errors import ConfigError
from dronevio.models.imu import ImuSamples
from dronevio.models.quadrotor import Quadrotor
from dronevio.models.rig import euroc_rig
from dronevio.models.rotation import exp_so3, pose_matrix
from dronevio.models.state import Trajectory
from dronevio.sim.flight import reference_of
from dronevio.sim.paths.path import Reference, attitude
from dronevio.sim.physics.controller import SE3Controller
from dronevio.sim.physics.motion import Motion
from dronevio.sim.physics.plant import QuadrotorPlant
from dronevio.sim.scenarios import scenario_named

GRAVITY = np.array([0.0, 0.0, -9.81])
T_VEHICLE_IMU = euroc_rig().T_vehicle_imu


@pytest.fixture(scope="module")
def room_flight() -> Motion:
    """Return the motion of the scenario `room`, of 30 s."""
    room = scenario_named("room")
    plant = QuadrotorPlant(room.rig)
    reference = reference_of(room, plant)
    controller = SE3Controller(reference, room.rig.T_vehicle_imu)
    for t_ns in reference.t_ns[:-1]:
        plant.advance(int(t_ns) + plant.interval_ns, controller.command(plant.state(), int(t_ns)))
    return plant.motion()


@pytest.fixture(scope="module")
def aggressive() -> Motion:
    """Return 60 s of aggressive motion without ground effect: up to 10 rad/s and 20 m/s², 3 rad/s and 13 m/s² RMS."""
    rig, t = euroc_rig(), np.arange(12_001) * 5e-3
    rates, sizes, step = np.array([2.6, 3.4, 2.0]), np.array([1.6, 1.3, 1.0]), 1e-3
    before, position, after = (
        (1.0 - np.exp(-((s / 3.0) ** 4)))[:, None] * sizes * np.sin(np.outer(s, rates)) for s in (t - step, t, t + step)
    )
    acceleration = (after - 2.0 * position + before) / step**2
    yaw = 1.5 * (t - np.tanh(t))
    R = Rotation.from_matrix(attitude(acceleration - GRAVITY, yaw))
    rates_rad_s = np.vstack([np.zeros(3), (R[:-2].inv() * R[2:]).as_rotvec() / 10e-3, np.zeros(3)])
    reference = Reference(
        np.arange(12_001, dtype=np.int64) * 5_000_000,
        position + [0.0, 0.0, 50.0],
        (after - before) / (2.0 * step),
        acceleration,
        yaw,
        rates_rad_s,
        np.gradient(rates_rad_s, 5e-3, axis=0),
        np.ones(12_001, dtype=bool),
    )
    plant, controller = QuadrotorPlant(rig), SE3Controller(reference, rig.T_vehicle_imu)
    plant.reset(
        pose_matrix(np.eye(3), np.array([0.0, 0.0, 50.0])), rotor_speeds_rad_s=np.full(4, Quadrotor().hover_speed_rad_s)
    )
    for t_ns in reference.t_ns[:-1]:
        plant.advance(int(t_ns) + plant.interval_ns, controller.command(plant.state(), int(t_ns)))
    return plant.motion()


def dead_reckoned(increments: ImuSamples, truth: Trajectory) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return positions, velocities and attitudes (N, 3, 3) at the ends of the increments, from the true start."""
    assert truth.velocity_m_s is not None
    dt = 5e-3
    R = [Rotation.from_quat(np.roll(truth.quat_wxyz[0], -1)).as_matrix()]
    for rotation in Rotation.from_rotvec(increments.gyro_rad_s * dt).as_matrix():
        R.append(R[-1] @ rotation)
    a = np.einsum("nij,nj->ni", R[:-1], increments.accel_m_s2) + GRAVITY
    v = truth.velocity_m_s[0] + np.cumsum(a * dt, axis=0)
    p = truth.p_world_imu[0] + np.cumsum((v - 0.5 * a * dt) * dt, axis=0)
    return p, v, np.array(R[1:])


def drift(increments: ImuSamples, truth: Trajectory) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the errors (N,) of attitude [rad], velocity [m/s] and position [m] of dead reckoning."""
    assert truth.velocity_m_s is not None
    p, v, R = dead_reckoned(increments, truth)
    true_R = Rotation.from_quat(np.roll(truth.quat_wxyz[1:], -1, axis=1))
    return (
        (true_R.inv() * Rotation.from_matrix(R)).magnitude(),
        np.linalg.norm(v - truth.velocity_m_s[1:], axis=1),
        np.linalg.norm(p - truth.p_world_imu[1:], axis=1),
    )


MOUNTS = pytest.mark.parametrize(
    "T_vehicle_imu",
    [np.eye(4), T_VEHICLE_IMU, pose_matrix(exp_so3(np.array([0.3, -1.0, 2.0])), np.array([0.2, -0.15, 0.2]))],
    ids=["centre", "7 cm", "32 cm"],
)


@MOUNTS
def test_increments_integrate_aggressive_motion_exactly(aggressive: Motion, T_vehicle_imu: np.ndarray) -> None:
    truth = aggressive.trajectory(T_vehicle_imu)
    assert truth.velocity_m_s is not None and truth.t_ns[-1] == 60_000_000_000
    assert np.linalg.norm(aggressive.twist[:, 3:], axis=1).max() > 5.0  # the motion is aggressive
    assert np.sqrt(np.square(np.diff(truth.velocity_m_s, axis=0) / 5e-3).sum(axis=1).mean()) > 10.0
    attitude_rad, velocity_m_s, position_m = drift(aggressive.increments(T_vehicle_imu), truth)
    assert attitude_rad.max() < 1e-9
    assert velocity_m_s.max() < 1e-6
    assert position_m.max() < 3e-3


@MOUNTS
def test_points_integrate_within_the_sampling_error(aggressive: Motion, T_vehicle_imu: np.ndarray) -> None:
    """The error of the midpoint rule is the one that `Motion.points` documents; without it, the error is small."""
    truth, points, dt = aggressive.trajectory(T_vehicle_imu), aggressive.points(T_vehicle_imu, 5e-3), 5e-3
    assert truth.velocity_m_s is not None
    attitude_rad, velocity_m_s, position_m = drift(points.increments(), truth)

    before, after = points.gyro_rad_s[:-1], points.gyro_rad_s[1:]
    middle = aggressive.twist_between[1:-1, 3:] @ T_vehicle_imu[:3, :3]
    sampling_error = dt**2 / 12.0 * np.cross(before, after) + dt * 2.0 / 3.0 * (middle - 0.5 * (before + after))
    allowed_rad = np.cumsum(np.linalg.norm(sampling_error, axis=1)) + 1e-9  # for rounding
    jumps = np.linalg.norm(np.diff(truth.velocity_m_s, n=2, axis=0) / dt, axis=1).max()
    force = np.linalg.norm(points.accel_m_s2, axis=1)[1:]
    allowed_m_s = np.cumsum(force * allowed_rad * dt) + 0.5 * dt * jumps
    assert np.all(attitude_rad <= allowed_rad)
    assert np.all(velocity_m_s <= allowed_m_s)
    assert np.all(position_m <= np.cumsum(allowed_m_s * dt))
    assert attitude_rad.max() > 1e-3  # points are not equivalent to increments

    turn = dt * 0.5 * (before + after) + sampling_error
    rotated = np.einsum("nij,nj->ni", Rotation.from_rotvec(turn).as_matrix(), points.accel_m_s2[1:])
    corrected = ImuSamples(points.t_ns[1:], turn / dt, 0.5 * (points.accel_m_s2[:-1] + rotated), "increment")
    attitude_rad, velocity_m_s, position_m = drift(corrected, truth)
    assert attitude_rad.max() < 1e-4
    assert velocity_m_s.max() < 0.5 * dt * jumps + 1e-3
    assert position_m.max() < 0.05


def test_samples_at_half_the_rate_are_means_over_two_intervals(room_flight: Motion) -> None:
    truth, own = room_flight.trajectory(T_VEHICLE_IMU), room_flight.points(T_VEHICLE_IMU, 5e-3)
    slower = room_flight.at_interval(10_000_000)
    points = slower.points(T_VEHICLE_IMU, 10e-3)
    np.testing.assert_array_equal(points.t_ns, own.t_ns[::2])
    np.testing.assert_allclose(points.gyro_rad_s, own.gyro_rad_s[::2], atol=1e-12)
    np.testing.assert_allclose(slower.trajectory(T_VEHICLE_IMU).p_world_imu, truth.p_world_imu[::2], atol=1e-12)
    v, R = truth.velocity_m_s, truth.rotations
    assert v is not None
    force = (v[3:-1:2] - v[1:-3:2]) / 10e-3 - GRAVITY
    np.testing.assert_allclose(points.accel_m_s2[1:-1], np.einsum("nji,nj->ni", R[2:-2:2], force), atol=1e-8)


def test_samples_at_the_double_rate_are_those_between_too(room_flight: Motion) -> None:
    """Every second sample is as before; between them, the accelerometer has the mean of the interval.

    It agrees up to the velocity by rotation at the lever arm, which is interpolated.
    """
    truth, own = room_flight.trajectory(T_VEHICLE_IMU), room_flight.points(T_VEHICLE_IMU, 5e-3)
    faster = room_flight.at_interval(2_500_000)
    points, R = faster.points(T_VEHICLE_IMU, 2.5e-3), faster.trajectory(T_VEHICLE_IMU).rotations
    np.testing.assert_array_equal(points.t_ns, np.arange(len(points)) * 2_500_000)
    np.testing.assert_array_equal(points.t_ns[::2], own.t_ns)
    np.testing.assert_allclose(R @ np.swapaxes(R, 1, 2), np.tile(np.eye(3), (len(R), 1, 1)), atol=1e-12)
    np.testing.assert_allclose(points.gyro_rad_s[::2], own.gyro_rad_s, atol=1e-12)
    np.testing.assert_allclose(points.accel_m_s2[::2], own.accel_m_s2, atol=1e-5)
    assert truth.velocity_m_s is not None
    force = np.diff(truth.velocity_m_s, axis=0) / 5e-3 - GRAVITY
    np.testing.assert_allclose(np.einsum("nij,nj->ni", R[1::2], points.accel_m_s2[1::2]), force, atol=2e-3)
    gyro_rad_s = room_flight.twist_between[1:-1, 3:] @ T_VEHICLE_IMU[:3, :3]
    np.testing.assert_allclose(points.gyro_rad_s[1::2], gyro_rad_s, atol=1e-12)


def test_other_intervals_are_refused(room_flight: Motion) -> None:
    assert room_flight.at_interval(5_000_000) is room_flight
    for interval_ns in (1_000_000, 7_500_000):
        with pytest.raises(ConfigError, match="expected a multiple of the latter, or half of it"):
            room_flight.at_interval(interval_ns)


def test_points_integrate_a_flight_by_the_midpoint_rule(room_flight: Motion) -> None:
    truth = room_flight.trajectory(T_VEHICLE_IMU)
    attitude_rad, velocity_m_s, position_m = drift(room_flight.points(T_VEHICLE_IMU, 5e-3).increments(), truth)
    in_flight = truth.t_s[1:] < 27.5  # the impact of the landing is shorter than the sampling interval
    assert attitude_rad.max() < 1e-4
    assert velocity_m_s[in_flight].max() < 2e-3
    assert position_m.max() < 0.02


def test_increments_integrate_a_flight_with_its_landing(room_flight: Motion) -> None:
    attitude_rad, velocity_m_s, position_m = drift(
        room_flight.increments(T_VEHICLE_IMU), room_flight.trajectory(T_VEHICLE_IMU)
    )
    assert attitude_rad.max() < 1e-9
    assert velocity_m_s.max() < 1e-9
    assert position_m.max() < 3e-4


def test_rotor_speeds_belong_to_the_interval_after_their_stamp() -> None:
    """At a low speed the thrust alone determines the specific force, and it changes between intervals."""
    quadrotor, start = Quadrotor(), pose_matrix(np.eye(3), np.array([0.0, 0.0, 50.0]))
    plant = QuadrotorPlant(euroc_rig(), quadrotor)
    hover = np.full(4, quadrotor.hover_speed_rad_s)
    plant.reset(start, rotor_speeds_rad_s=hover)
    plant.advance(50_000_000, 1.2 * hover)
    motion = plant.motion()
    assert motion.rotor_speeds_rad_s.shape == (11, 4)
    thrust = quadrotor.thrust_n_per_rad2_s2 * np.square(motion.rotor_speeds_rad_s[:-1]).sum(axis=1)
    assert np.all(np.diff(thrust) > 0.01 * thrust[:-1])
    np.testing.assert_allclose(motion.increments(np.eye(4)).accel_m_s2[:, 2] * quadrotor.mass_kg, thrust, rtol=0.01)


def test_velocity_is_the_derivative_of_the_position(room_flight: Motion) -> None:
    truth = room_flight.trajectory(T_VEHICLE_IMU)
    assert truth.velocity_m_s is not None
    derivative = (truth.p_world_imu[2:] - truth.p_world_imu[:-2]) / 10e-3
    in_flight = truth.t_s[1:-1] < 27.5
    np.testing.assert_allclose(truth.velocity_m_s[1:-1][in_flight], derivative[in_flight], atol=2e-3)


def circling(offset_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Return pose (N, 7) and twist (N, 6) on a circle of 2 m at 1.5 rad/s, at the times of a leapfrog integrator."""
    t, radius, rate, half = np.arange(200) * 5e-3 + offset_s, 2.0, 1.5, 0.5e-3
    t_pose = t + half  # MuJoCo's poses are half a step later than its velocities
    position = radius * np.stack([np.sin(rate * t_pose), -np.cos(rate * t_pose), 0 * t], axis=1)
    quat_xyzw = Rotation.from_rotvec(np.outer(rate * t_pose, [0, 0, 1])).as_quat()
    velocity = radius * rate * np.stack([np.cos(rate * t), np.sin(rate * t), 0 * t], axis=1)
    spin = np.tile([0.0, 0.0, rate], (len(t), 1))
    return np.hstack([position, np.roll(quat_xyzw, 1, axis=1)]), np.hstack([velocity, spin])


def test_specific_force_on_a_circle_is_centripetal() -> None:
    pose, twist = circling(0.0)
    pose_before, twist_before = circling(-2.5e-3)
    pose_after, twist_after = circling(2.5e-3)
    motion = Motion(
        np.arange(200, dtype=np.int64) * 5_000_000,
        1e-3,
        pose,
        twist,
        np.vstack([pose_before, pose_after[-1:]]),
        np.vstack([twist_before, twist_after[-1:]]),
        np.zeros((200, 4)),
    )
    samples = motion.points(T_VEHICLE_IMU, 5e-3)
    R, lever = T_VEHICLE_IMU[:3, :3], T_VEHICLE_IMU[:3, 3]
    centripetal = np.array([0.0, 2.0 * 1.5**2, 0.0]) + np.cross([0, 0, 1.5], np.cross([0, 0, 1.5], lever))
    np.testing.assert_allclose(samples.accel_m_s2 @ R.T, np.tile(centripetal - GRAVITY, (200, 1)), atol=1e-4)
    np.testing.assert_allclose(samples.gyro_rad_s @ R.T, np.tile([0, 0, 1.5], (200, 1)), atol=1e-12)
    truth = motion.trajectory(np.eye(4))
    np.testing.assert_allclose(np.linalg.norm(truth.p_world_imu, axis=1), 2.0, atol=1e-5)
