from dataclasses import replace

import numpy as np
import pytest

from dronevio.models.errors import ConfigError
from dronevio.models.rotation import exp_so3
from dronevio.sim.paths.path import Reference, attitude, plan_reference
from dronevio.sim.paths.plan import FlightPlan
from dronevio.sim.paths.space import FlightArea, Space
from dronevio.sim.scenarios import scenario_named

BOX = np.array([[-2.8, -1.9, 0.0], [2.8, 1.9, 2.4]])
STEP_NS = 5_000_000
STANDING_M = 0.112
PLANS = {name: scenario_named(name).plan for name in ("room-v0", "room-slow-v0", "hover-v0", "short-v0")}
ROOM, SHORT = scenario_named("room-v0").plan, scenario_named("short-v0").plan


def reference(plan: FlightPlan, seed: int = 0, box: np.ndarray = BOX) -> Reference:
    nothing = np.zeros((0, 3))
    space = Space(box[0], box[1] + [0.0, 0.0, 1.0], nothing, nothing, np.zeros((0, 3, 3)))
    place = FlightArea(space, box, np.zeros(3), nothing)
    return plan_reference(plan, place, STANDING_M, STEP_NS, np.random.default_rng(seed))


@pytest.mark.parametrize("name", PLANS)
def test_velocity_and_acceleration_are_derivatives(name: str) -> None:
    path = reference(PLANS[name])
    dt = STEP_NS * 1e-9
    velocity = (path.position_m[2:] - path.position_m[:-2]) / (2 * dt)
    acceleration = (path.velocity_m_s[2:] - path.velocity_m_s[:-2]) / (2 * dt)
    np.testing.assert_allclose(path.velocity_m_s[1:-1], velocity, atol=1e-3)
    np.testing.assert_allclose(path.acceleration_m_s2[1:-1], acceleration, atol=3e-2)


@pytest.mark.parametrize("name", PLANS)
def test_paths_are_smooth_up_to_the_jerk(name: str) -> None:
    path = reference(PLANS[name])
    jerk = np.diff(path.acceleration_m_s2, axis=0) / 5e-3
    assert np.abs(np.diff(jerk, axis=0)).max() < 0.2 * np.abs(jerk).max()  # a step would be as high as the jerk


@pytest.mark.parametrize("name", PLANS)
def test_starts_and_ends_standing_on_the_pad(name: str) -> None:
    plan = PLANS[name]
    path = reference(plan)
    t = path.t_ns * 1e-9
    assert path.t_ns[0] == 0 and path.duration_s == pytest.approx(
        plan.initial_rest_s + plan.takeoff_s + plan.tour_s + plan.landing_s + plan.final_rest_s
    )
    at_rest = t <= plan.initial_rest_s
    np.testing.assert_array_equal(path.position_m[at_rest], np.tile([0.0, 0.0, STANDING_M], (at_rest.sum(), 1)))
    assert not path.flying[t < plan.initial_rest_s].any()
    assert not path.flying[t > path.duration_s - plan.final_rest_s].any()
    np.testing.assert_allclose(path.position_m[-1], [0.0, 0.0, STANDING_M], atol=0.02)
    for derivative in (path.velocity_m_s, path.acceleration_m_s2, path.rate_rad_s):
        np.testing.assert_allclose(derivative[[0, -1]], 0.0, atol=1e-9)


@pytest.mark.parametrize("seed", range(20))
def test_the_tour_is_dynamic_and_within_bounds(seed: int) -> None:
    plan = ROOM
    path = reference(plan, seed)
    assert 2.2 <= path.peak_speed_m_s <= 3.5
    assert np.radians(98) <= path.peak_rate_rad_s <= np.radians(160)
    assert np.all(path.position_m[:, :2] >= BOX[0, :2] + plan.margin_m - 1e-3)
    assert np.all(path.position_m <= BOX[1] - plan.margin_m + 1e-3)
    tilt = path.acceleration_m_s2 + [0.0, 0.0, 9.81]
    assert np.degrees(np.arccos(tilt[:, 2] / np.linalg.norm(tilt, axis=1))).max() < 45.0


def test_tours_are_determined_by_the_seed() -> None:
    plan = ROOM
    first, again, other = reference(plan, 3), reference(plan, 3), reference(plan, 4)
    assert first.position_m.tobytes() == again.position_m.tobytes()
    distance = np.linalg.norm(first.position_m - other.position_m, axis=1)
    assert 0.1 < distance.max() < 2.0


def test_rates_are_the_derivative_of_the_attitude() -> None:
    path = reference(ROOM)
    R = attitude(path.acceleration_m_s2 + [0.0, 0.0, 9.81], path.yaw_rad)
    rotated = R[:-1] @ exp_so3(0.5 * (path.rate_rad_s[:-1] + path.rate_rad_s[1:]) * 5e-3)
    np.testing.assert_allclose(rotated, R[1:], atol=1e-4)


def test_attitude_aligns_thrust_and_heading() -> None:
    rng = np.random.default_rng(0)
    thrust, yaw = rng.normal(size=(50, 3)) + [0, 0, 4], rng.uniform(-3, 3, 50)
    R = attitude(thrust, yaw)
    np.testing.assert_allclose(np.swapaxes(R, 1, 2) @ R, np.tile(np.eye(3), (50, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(R), 1.0)
    np.testing.assert_allclose(R[:, :, 2], thrust / np.linalg.norm(thrust, axis=1, keepdims=True))
    heading = np.stack([np.cos(yaw), np.sin(yaw), 0 * yaw], axis=1)
    assert np.all(np.einsum("ni,ni->n", R[:, :, 0], heading) > 0.0)
    np.testing.assert_allclose(np.einsum("ni,ni->n", R[:, :, 1], heading), 0.0, atol=1e-12)


def test_heading_follows_the_direction_of_motion() -> None:
    path = reference(ROOM)
    cruising = np.linalg.norm(path.velocity_m_s[:, :2], axis=1) > 1.0
    direction = path.velocity_m_s[cruising, :2]
    nose = np.stack([np.cos(path.yaw_rad[cruising]), np.sin(path.yaw_rad[cruising])], axis=1)
    cosine = np.sum(direction * nose, axis=1) / np.linalg.norm(direction, axis=1)
    assert np.degrees(np.arccos(np.mean(cosine))) < 30.0


def test_a_tour_is_scaled_to_a_small_room() -> None:
    box = np.array([[-1.5, -1.0, 0.0], [1.5, 1.0, 2.2]])
    path = reference(ROOM, box=box)
    assert np.all(np.abs(path.position_m[:, :2]) <= box[1, :2] - 0.4 + 1e-3)


def test_a_plan_that_does_not_fit_is_refused() -> None:
    with pytest.raises(ConfigError, match="free space"):
        reference(replace(ROOM, height_m=2.5))


def test_times_beyond_the_reference_are_refused() -> None:
    path = reference(SHORT)
    assert path.row(5_000_000) == 1
    assert path.row(9_999_999) == 1
    for t_ns in (-1, 6_000_000_001):
        with pytest.raises(ConfigError, match=str(t_ns)):
            path.row(t_ns)


def test_a_flight_may_start_in_motion() -> None:
    whole, part = reference(ROOM), reference(replace(ROOM, skip_s=6.0))
    assert part.t_ns[0] == 0 and part.flying[0] and len(part) == len(whole) - 1200
    np.testing.assert_array_equal(part.position_m, whole.position_m[1200:])
    assert np.linalg.norm(part.velocity_m_s[0]) > 0.5
    with pytest.raises(ConfigError, match=r"skip_s = 30 of a flight of 30 s"):
        reference(replace(ROOM, skip_s=30.0))
