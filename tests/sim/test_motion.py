"""The perfect IMU, by an independent dead reckoning (scipy's rotations) and by motions with a formula."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dronevio.models.imu import ImuSamples
from dronevio.models.rig import euroc_rig
from dronevio.models.state import Trajectory
from dronevio.sim.controller import SE3Controller
from dronevio.sim.flight import reference_of
from dronevio.sim.motion import Motion
from dronevio.sim.plant import QuadrotorPlant
from dronevio.sim.scenario import scenario

GRAVITY = np.array([0.0, 0.0, -9.81])
T_VEHICLE_IMU = euroc_rig().T_vehicle_imu


@pytest.fixture(scope="module")
def flown() -> Motion:
    """The 30 s flight."""
    room = scenario("room")
    plant = QuadrotorPlant(room.rig)
    reference = reference_of(room, plant)
    controller = SE3Controller(reference, room.rig.T_vehicle_imu)
    for t_ns in reference.t_ns[:-1]:
        plant.advance(int(t_ns) + plant.interval_ns, controller.command(plant.state(), int(t_ns)))
    return plant.motion()


def dead_reckoned(increments: ImuSamples, truth: Trajectory) -> tuple[np.ndarray, np.ndarray, Rotation]:
    """Return positions, velocities and attitudes at the ends of the increments, from the true start."""
    assert truth.velocity_m_s is not None
    dt = 5e-3
    R = Rotation.from_quat(np.roll(truth.quat_wxyz[0], -1))
    turns = Rotation.from_rotvec(increments.gyro_rad_s * dt)
    attitudes = [R := R * turn for turn in turns]
    before = Rotation.concatenate([Rotation.from_quat(np.roll(truth.quat_wxyz[0], -1)), *attitudes[:-1]])
    a = before.apply(increments.accel_m_s2) + GRAVITY
    v = truth.velocity_m_s[0] + np.cumsum(a * dt, axis=0)
    p = truth.p_world_imu[0] + np.cumsum((v - 0.5 * a * dt) * dt, axis=0)
    return p, v, Rotation.concatenate(attitudes)


def test_increments_carry_the_whole_flight(flown: Motion) -> None:
    truth = flown.trajectory(T_VEHICLE_IMU)
    assert truth.velocity_m_s is not None
    p, v, R = dead_reckoned(flown.increments(T_VEHICLE_IMU), truth)
    true_R = Rotation.from_quat(np.roll(truth.quat_wxyz[1:], -1, axis=1))
    assert np.linalg.norm(v - truth.velocity_m_s[1:], axis=1).max() < 1e-9
    assert np.linalg.norm(p - truth.p_world_imu[1:], axis=1).max() < 1e-4
    assert (true_R.inv() * R).magnitude().max() < 1e-9


def test_points_carry_the_whole_flight_by_the_midpoint_rule(flown: Motion) -> None:
    truth = flown.trajectory(T_VEHICLE_IMU)
    assert truth.velocity_m_s is not None
    p, v, R = dead_reckoned(flown.points(T_VEHICLE_IMU, 5e-3).increments(), truth)
    true_R = Rotation.from_quat(np.roll(truth.quat_wxyz[1:], -1, axis=1))
    assert np.linalg.norm(p - truth.p_world_imu[1:], axis=1).max() < 0.02
    in_flight = truth.t_s[1:] < 27.5  # the landing's shock is shorter than the sampling
    assert np.linalg.norm(v - truth.velocity_m_s[1:], axis=1)[in_flight].max() < 2e-3
    assert (true_R.inv() * R).magnitude().max() < 1e-4


def test_true_velocity_is_the_slope_of_the_true_position(flown: Motion) -> None:
    truth = flown.trajectory(T_VEHICLE_IMU)
    assert truth.velocity_m_s is not None
    slope = (truth.p_world_imu[2:] - truth.p_world_imu[:-2]) / 10e-3
    in_flight = truth.t_s[1:-1] < 27.5
    np.testing.assert_allclose(truth.velocity_m_s[1:-1][in_flight], slope[in_flight], atol=2e-3)


def circling(offset_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Return pose (N, 7) and twist (N, 6) on a circle of 2 m at 1.5 rad/s, nose ahead, as leapfrog keeps them."""
    t, radius, rate, half = np.arange(200) * 5e-3 + offset_s, 2.0, 1.5, 0.5e-3
    ahead = t + half  # MuJoCo's poses are half a step later than its velocities
    position = radius * np.stack([np.sin(rate * ahead), -np.cos(rate * ahead), 0 * t], axis=1)
    quat_xyzw = Rotation.from_rotvec(np.outer(rate * ahead, [0, 0, 1])).as_quat()
    velocity = radius * rate * np.stack([np.cos(rate * t), np.sin(rate * t), 0 * t], axis=1)
    spin = np.tile([0.0, 0.0, rate], (len(t), 1))
    return np.hstack([position, np.roll(quat_xyzw, 1, axis=1)]), np.hstack([velocity, spin])


def test_a_circle_is_sensed_as_the_textbook_says() -> None:
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
