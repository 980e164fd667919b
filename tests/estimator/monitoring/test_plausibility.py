"""No state is published that a vehicle cannot have: limits by hand, and measurements that are garbage."""

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from dronevio.estimator import odometry, transitions
from dronevio.estimator.imu.buffer import Increments
from dronevio.estimator.monitoring.plausibility import (
    LEAST_CORRECTIONS,
    MAX_SIGMAS,
    MAX_SPEED_M_S,
    MotionLimits,
    reason_against,
)
from dronevio.estimator.odometry import VisualInertialOdometry
from dronevio.models.imu import ImuSamples
from dronevio.models.protocols import measurements
from dronevio.models.rotation import exp_so3, log_so3, pose_matrix
from dronevio.models.state import Estimate, Health, NavState

if TYPE_CHECKING:
    from tests.estimator.conftest import SyntheticFlight

MakeFlight = Callable[..., "SyntheticFlight"]

GRAVITY = 9.81


def state(t_s: float, p: float = 0.0, v: float = 0.0, turn: float = 0.0, sigma: float | None = None) -> NavState:
    """Return a state on the x axis, turned about z."""
    covariance = None if sigma is None else sigma**2 * np.eye(15)
    T = pose_matrix(exp_so3(np.array([0.0, 0.0, turn])), np.array([p, 0.0, 0.0]))
    return NavState(round(t_s * 1e9), T, np.array([v, 0.0, 0.0]), np.zeros(3), np.zeros(3), covariance)


def after(last: NavState, rate_rad_s: float, force_m_s2: float, span_s: float = 0.1) -> MotionLimits:
    """Return the limits after ten samples about z and along z."""
    dt_s, z = np.full(10, span_s / 10), np.array([0.0, 0.0, 1.0])
    samples = Increments(dt_s, np.tile(rate_rad_s * z, (10, 1)), np.tile(force_m_s2 * z, (10, 1)))
    return MotionLimits(last).after(samples, GRAVITY)


def test_limits_are_what_the_imu_measured_and_a_correction() -> None:
    limits = after(state(0.0), 2.0, 9.81)
    assert limits.turned_rad == pytest.approx(0.2)
    assert limits.accelerated_m_s == pytest.approx(0.1 * 2 * 9.81)
    angle, length, speed = LEAST_CORRECTIONS
    assert reason_against(state(0.1, turn=0.19 + angle), limits) is None
    assert "gyroscope" in str(reason_against(state(0.1, turn=0.21 + angle), limits))
    assert reason_against(state(0.1, v=1.95 + speed), limits) is None
    assert "changes by" in str(reason_against(state(0.1, v=1.97 + speed), limits))
    assert reason_against(state(0.1, p=0.09 + length), limits) is None
    assert "jumps by" in str(reason_against(state(0.1, p=0.1 + length), limits))


def test_motion_by_the_velocity_is_no_jump() -> None:
    fast = MotionLimits(state(0.0, v=50.0))
    assert reason_against(state(0.1, p=5.0, v=50.0), fast) is None
    assert "jumps" in str(reason_against(state(0.1, v=50.0), fast))


def test_uncertain_states_may_be_corrected_by_more_up_to_a_limit() -> None:
    jumped = state(0.1, p=4.0)
    assert reason_against(jumped, MotionLimits(state(0.0))) is not None
    assert reason_against(jumped, MotionLimits(state(0.0, sigma=MAX_SIGMAS[1]))) is None
    assert reason_against(state(0.1, p=40.0), MotionLimits(state(0.0, sigma=100.0))) is not None


def test_speed_and_numbers_are_checked_without_an_earlier_state() -> None:
    assert reason_against(state(0.0, v=0.99 * MAX_SPEED_M_S), None) is None
    assert "speed" in str(reason_against(state(0.0, v=1.01 * MAX_SPEED_M_S), None))
    assert "finite" in str(reason_against(state(0.0, p=float("nan")), None))


def _noise(imu: ImuSamples, rng: np.random.Generator) -> ImuSamples:
    return replace(
        imu, gyro_rad_s=rng.normal(0.0, 20.0, (len(imu), 3)), accel_m_s2=rng.normal(0.0, 80.0, (len(imu), 3))
    )


def _huge(imu: ImuSamples, rng: np.random.Generator) -> ImuSamples:
    late = imu.t_ns > imu.t_ns[0] + 3_000_000_000
    return replace(imu, accel_m_s2=np.where(late[:, None], 1e5, imu.accel_m_s2))


def _gap(imu: ImuSamples, rng: np.random.Generator) -> ImuSamples:
    since = (imu.t_ns - imu.t_ns[0]) * 1e-9
    kept = (since < 3.0) | (since > 4.3)
    return ImuSamples(imu.t_ns[kept], imu.gyro_rad_s[kept], imu.accel_m_s2[kept])


def _exchanged(imu: ImuSamples, rng: np.random.Generator) -> ImuSamples:
    """Return samples whose order is another one in the second half: the IMU jumps to other parts of the flight."""
    n, half = len(imu), len(imu) // 2
    order = np.concatenate([np.arange(half), half + rng.permutation(np.arange(n - half) // 40).argsort(kind="stable")])
    return replace(imu, gyro_rad_s=imu.gyro_rad_s[order], accel_m_s2=imu.accel_m_s2[order])


@pytest.mark.parametrize("garbage", [_noise, _huge, _gap, _exchanged])
@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_garbage_yields_no_state_that_a_vehicle_cannot_have(
    make_flight: MakeFlight, garbage: Callable[[ImuSamples, np.random.Generator], ImuSamples], seed: int
) -> None:
    flight = make_flight(seed, rest_s=1.5, duration_s=5.5)
    flight.__dict__["imu"] = imu = garbage(flight.imu, np.random.default_rng(seed))
    estimates = flight.run()
    assert_plausible(estimates, imu)


def test_a_window_that_jumps_is_a_loss_and_not_a_pose(make_flight: MakeFlight, monkeypatch: pytest.MonkeyPatch) -> None:
    """The state of the newest keyframe is not checked by its prediction."""
    flight = make_flight(0, rest_s=1.5, duration_s=5.0)
    vio = VisualInertialOdometry(flight.rig, front_end=flight.front_end())
    publish, count = transitions.publish, 0

    def jumping(parts, state, tracking, packet, estimated, *rest):  # type: ignore[no-untyped-def]
        nonlocal count
        count += 1
        far = replace(estimated, velocity_m_s=estimated.velocity_m_s + 1e4) if count == 39 else estimated
        return publish(parts, state, tracking, packet, far, *rest)

    monkeypatch.setattr(odometry, "publish", jumping)
    estimates: list[Estimate] = []
    for measurement in measurements(flight):
        if isinstance(measurement, ImuSamples):
            vio.add_imu(measurement)
        else:
            estimates.append(vio.add_frame(measurement))
    lost = [text for e in estimates for text in e.events if text.startswith("lost")]
    assert len(lost) == 1 and lost[0].startswith("lost: a speed of 17")
    assert_plausible(estimates, flight.imu)
    assert estimates[-1].state is not None  # it has recovered


def assert_plausible(estimates: list[Estimate], imu: ImuSamples) -> None:
    """Assert that published states are finite, slow enough, and follow one another as the IMU has measured."""
    last: NavState | None = None
    for estimate in estimates:
        now = estimate.state
        if now is not None:
            assert np.isfinite(now.T_world_imu).all() and np.linalg.norm(now.velocity_m_s) <= MAX_SPEED_M_S
            assert estimate.health is not Health.LOST
        if now is not None and last is not None:
            first, end = np.searchsorted(imu.t_ns, [last.t_ns, now.t_ns]).tolist()
            near, dt_s = imu[max(first - 1, 0) : end + 1], (now.t_ns - last.t_ns) * 1e-9
            rate = np.linalg.norm(near.gyro_rad_s, axis=1).max(initial=0.0) + 1.0
            acceleration = np.linalg.norm(near.accel_m_s2, axis=1).max(initial=0.0) + GRAVITY + 5.0
            turned = np.linalg.norm(log_so3(last.T_world_imu[:3, :3].T @ now.T_world_imu[:3, :3]))
            assert turned <= rate * dt_s + 1.2
            assert np.linalg.norm(now.velocity_m_s - last.velocity_m_s) <= acceleration * dt_s + 11.0
            moved = now.T_world_imu[:3, 3] - last.T_world_imu[:3, 3]
            mean = 0.5 * (now.velocity_m_s + last.velocity_m_s)
            assert np.linalg.norm(moved - dt_s * mean) <= 0.5 * acceleration * dt_s**2 + 5.0
        last = now
