"""Smooth motion through poses: analytic derivatives of a circle, and dead reckoning of the synthesized IMU."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dronevio.models.errors import ConfigError
from dronevio.models.imu import GRAVITY_M_S2
from dronevio.models.rotation import exp_so3, quat_wxyz_from_matrix, rotation_z
from dronevio.models.state import Trajectory
from dronevio.sim.paths.spline import SmoothMotion

RADIUS_M, TURN_RAD_S = 2.0, 1.5


def _circle(t_ns: np.ndarray) -> Trajectory:
    """Return poses on a horizontal circle with the x axis along the path."""
    angle = TURN_RAD_S * (t_ns - t_ns[0]) * 1e-9
    p = np.column_stack([RADIUS_M * np.cos(angle), RADIUS_M * np.sin(angle), np.full(len(t_ns), 1.0)])
    R = np.stack([rotation_z(a + 0.5 * np.pi) for a in angle])
    return Trajectory(t_ns, p, quat_wxyz_from_matrix(R))


def _stamps(seconds: float, rate_hz: float = 200.0, origin_ns: int = 1_403_715_273_262_142_976) -> np.ndarray:
    return origin_ns + np.arange(round(seconds * rate_hz) + 1, dtype=np.int64) * round(1e9 / rate_hz)


def test_velocity_and_specific_force_on_a_circle() -> None:
    t_ns = _stamps(6.0)
    motion = SmoothMotion.through(_circle(t_ns))
    inner = t_ns[20:-20]
    points = motion.points(inner)
    velocity = motion.trajectory(inner).velocity_m_s
    assert velocity is not None
    assert np.linalg.norm(velocity, axis=1) == pytest.approx(RADIUS_M * TURN_RAD_S, abs=1e-6)
    assert points.gyro_rad_s == pytest.approx(np.tile([0.0, 0.0, TURN_RAD_S], (len(inner), 1)), abs=1e-6)
    centripetal = [0.0, RADIUS_M * TURN_RAD_S**2, GRAVITY_M_S2]  # towards the centre, and against gravity
    assert points.accel_m_s2 == pytest.approx(np.tile(centripetal, (len(inner), 1)), abs=1e-4)


def test_dead_reckoning_of_the_increments_follows_the_path() -> None:
    rng = np.random.default_rng(3)
    t_ns = _stamps(5.0)
    smooth = np.cumsum(np.cumsum(rng.standard_normal((len(t_ns), 6)), axis=0), axis=0) * 2e-6
    start = Trajectory(t_ns, smooth[:, :3] * 100.0, quat_wxyz_from_matrix(exp_so3(smooth[:, 3:] * 100.0)))
    motion = SmoothMotion.through(start)
    truth, imu = motion.trajectory(t_ns), motion.increments(t_ns)
    assert truth.velocity_m_s is not None
    R, v, p = truth.rotations[0], truth.velocity_m_s[0], truth.p_world_imu[0]
    for gyro, accel in zip(imu.gyro_rad_s, imu.accel_m_s2, strict=True):
        dv = (R @ accel - [0.0, 0.0, GRAVITY_M_S2]) * 5e-3
        p = p + v * 5e-3 + 0.5 * dv * 5e-3
        R, v = R @ exp_so3(gyro * 5e-3), v + dv
    assert v == pytest.approx(truth.velocity_m_s[-1], abs=1e-9)
    assert truth.rotations[-1] == pytest.approx(R, abs=1e-9)
    assert p == pytest.approx(truth.p_world_imu[-1], abs=1e-3)


def test_noise_of_the_poses_is_averaged() -> None:
    t_ns = _stamps(6.0)
    circle = _circle(t_ns)
    noise = 1e-3 * np.random.default_rng(0).standard_normal(circle.p_world_imu.shape)
    motion = SmoothMotion.through(Trajectory(t_ns, circle.p_world_imu + noise, circle.quat_wxyz))
    error = motion.trajectory(t_ns).p_world_imu - circle.p_world_imu
    assert np.sqrt(np.mean(error**2)) < 0.5e-3


@settings(max_examples=20, deadline=None)
@given(flips=st.lists(st.booleans(), min_size=50, max_size=50))
def test_signs_of_the_quaternions_do_not_matter(flips: list[bool]) -> None:
    t_ns = _stamps(49 / 50, rate_hz=50.0)
    circle = _circle(t_ns)
    flipped = Trajectory(t_ns, circle.p_world_imu, circle.quat_wxyz * np.where(flips, -1.0, 1.0)[:, None])
    with_flips, without_flips = (SmoothMotion.through(path).points(t_ns) for path in (flipped, circle))
    assert with_flips.gyro_rad_s == pytest.approx(without_flips.gyro_rad_s, abs=1e-9)


def test_gaps_and_short_paths_are_refused() -> None:
    t_ns = _stamps(3.0)
    with pytest.raises(ConfigError, match="gap of 2"):
        SmoothMotion.through(_circle(np.concatenate([t_ns[:50], t_ns[450:]])))
    with pytest.raises(ConfigError, match="4 poses"):
        SmoothMotion.through(_circle(t_ns[:4]))
    with pytest.raises(ConfigError, match="expected 0 to 3"):
        SmoothMotion.through(_circle(t_ns)).points(t_ns + 1_000_000_000)
