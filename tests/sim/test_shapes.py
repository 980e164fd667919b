"""Every shape in every world is collision-free, within limits and closed at the pad; geometry of each shape."""

from dataclasses import replace

import numpy as np
import pytest

from dronevio.models.errors import ConfigError
from dronevio.models.imu import GRAVITY_M_S2
from dronevio.models.rotation import rotation_z
from dronevio.sim.paths.limits import LIMITS, Limits
from dronevio.sim.paths.path import Reference, attitude, plan_reference
from dronevio.sim.paths.plan import FlightPlan
from dronevio.sim.paths.shapes import SHAPES
from dronevio.sim.paths.space import FlightArea, Space
from dronevio.sim.world import WORLDS, flight_area

STEP_NS = 5_000_000
STANDING_M = 0.112
NAMED_SHAPES = tuple(name for name in SHAPES if name != "via")


def plan_path(plan: FlightPlan, place: FlightArea, seed: int = 0) -> Reference:
    return plan_reference(plan, place, STANDING_M, STEP_NS, np.random.default_rng(seed))


def hall(*boxes: tuple[list[float], list[float]]) -> FlightArea:
    """Return a space of 20 × 12 × 5 m around a pad, with boxes of given centres and half sizes."""
    space = Space(
        np.array([-10.0, -6.0, 0.0]),
        np.array([10.0, 6.0, 5.0]),
        np.array([middle for middle, _ in boxes]).reshape(-1, 3),
        np.array([half for _, half in boxes]).reshape(-1, 3),
        np.tile(rotation_z(0.0), (len(boxes), 1, 1)),
    )
    free_box = np.array([[-4.0, -4.0, 0.0], [4.0, 4.0, 4.0]])
    route = np.array([[0.0, 0.0, 1.3], [8.0, -4.0, 2.0], [8.0, 4.0, 3.0], [-8.0, 4.0, 2.0], [-8.0, -4.0, 1.0]])
    return FlightArea(space, free_box, np.zeros(3), route)


def on_tour(path: Reference, area: FlightArea) -> np.ndarray:
    """Return which rows (N,) belong to the tour: not on the vertical above the pad."""
    return np.asarray(np.linalg.norm(path.position_m[:, :2] - area.pad[:2], axis=1) > 1e-3)


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("shape", NAMED_SHAPES)
def test_every_shape_is_feasible_in_every_world(world: str, shape: str) -> None:
    place = flight_area(world, 1)
    level = sorted(LIMITS)[(NAMED_SHAPES.index(shape) + sorted(WORLDS).index(world)) % len(LIMITS)]
    plan = FlightPlan(shape=shape, limits=LIMITS[level], waypoint_jitter=0.1)
    path, limits = plan_path(plan, place), plan.limits
    # Clear of obstacles.
    in_flight = on_tour(path, place)
    if in_flight.any():
        assert place.space.clearance(path.position_m[in_flight]).min() >= plan.margin_m
    # Within its limits.
    thrust = path.acceleration_m_s2 + [0.0, 0.0, GRAVITY_M_S2]
    up = thrust / np.linalg.norm(thrust, axis=1, keepdims=True)
    assert path.peak_speed_m_s <= limits.speed_m_s
    assert np.linalg.norm(path.acceleration_m_s2, axis=1).max() <= limits.accel_m_s2
    assert np.linalg.norm(thrust, axis=1).max() <= limits.thrust_to_weight * GRAVITY_M_S2
    assert np.arccos(up[:, 2].min()) <= limits.tilt_rad
    assert np.abs(np.diff(path.yaw_rad)).max() / 5e-3 <= limits.yaw_rate_rad_s
    assert np.linalg.norm(np.diff(up, axis=0), axis=1).max() / 5e-3 <= limits.tilt_rate_rad_s
    # Standing at both ends, and continuous in between.
    pad = place.pad + [0.0, 0.0, STANDING_M]
    assert not path.flying[path.t_ns < 1_999_000_000].any() and not path.flying[-200:].any()
    np.testing.assert_allclose(path.position_m[:400], np.tile(pad, (400, 1)), atol=1e-12)
    np.testing.assert_allclose(path.position_m[-1], pad, atol=0.02)
    for derivative in (path.velocity_m_s, path.acceleration_m_s2, path.rate_rad_s):
        np.testing.assert_allclose(derivative[[0, -1]], 0.0, atol=1e-9)
    jerk = np.diff(path.acceleration_m_s2, axis=0) / 5e-3
    assert np.abs(np.diff(jerk, axis=0)).max() < 0.2 * max(np.abs(jerk).max(), 0.1)
    np.testing.assert_allclose(np.diff(path.velocity_m_s, axis=0), path.acceleration_m_s2[1:] * 5e-3, atol=0.02)
    assert path.duration_s == pytest.approx(round(path.duration_s, 1))


def test_paths_are_determined_by_seed_and_jitter() -> None:
    place, plan = hall(), FlightPlan(shape="figure-8", waypoint_jitter=0.1)
    first, again, other = (plan_path(plan, place, seed) for seed in (3, 3, 4))
    assert first.position_m.tobytes() == again.position_m.tobytes()
    assert first.yaw_rad.tobytes() == again.yaw_rad.tobytes()
    assert len(first) != len(other) or not np.array_equal(first.position_m, other.position_m)
    exact = replace(plan, waypoint_jitter=0.0)
    np.testing.assert_array_equal(plan_path(exact, place, 3).position_m, plan_path(exact, place, 4).position_m)


def test_jitter_keeps_the_clearance() -> None:
    place = hall(([8.0, -2.5, 2.0], [0.3, 0.3, 2.0]), ([8.0, -5.5, 2.0], [0.3, 0.3, 2.0]))  # a gate in the route
    for seed in range(2):
        path = plan_path(FlightPlan(shape="tour", waypoint_jitter=2.0), place, seed)
        assert place.space.clearance(path.position_m[on_tour(path, place)]).min() >= 0.4


@pytest.mark.parametrize(("shape", "tolerance_s"), [("hover", 0.0), ("rotation", 0.0), ("square", 0.5)])
def test_laps_approximate_the_requested_duration(shape: str, tolerance_s: float) -> None:
    place = hall()
    one, two = (plan_path(FlightPlan(shape=shape, laps=laps), place).duration_s for laps in (1, 2))
    many = plan_path(FlightPlan(shape=shape, tour_s=60.0), place)
    tour_s = many.duration_s - 8.0  # without standing, climb and descent
    assert abs(tour_s - 60.0) <= 0.5 * (two - one) + 0.1 + tolerance_s


def test_hover_is_constant() -> None:
    path = plan_path(FlightPlan(shape="hover"), hall())
    high = path.position_m[:, 2] > STANDING_M + 1.2 - 1e-6
    assert high.sum() * 5e-3 >= 10.0
    np.testing.assert_allclose(path.position_m[:, :2], 0.0, atol=1e-12)
    np.testing.assert_array_equal(path.yaw_rad, 0.0)


def test_rotation_yaws_by_a_full_turn_and_back() -> None:
    path = plan_path(FlightPlan(shape="rotation"), hall())
    assert np.ptp(path.yaw_rad) == pytest.approx(2.0 * np.pi, abs=0.5)
    assert path.yaw_rad[-1] == pytest.approx(0.0, abs=0.01)
    assert np.abs(path.position_m[:, :2]).max() < 1e-9


def heading_vector(path: Reference) -> np.ndarray:
    return np.stack([np.cos(path.yaw_rad), np.sin(path.yaw_rad)], axis=1)


def motion_direction(path: Reference) -> np.ndarray:
    velocity = path.velocity_m_s[:, :2]
    return np.asarray(velocity / np.maximum(np.linalg.norm(velocity, axis=1, keepdims=True), 1e-9))


@pytest.mark.parametrize("shape", ["tour", "figure-8", "helix", "square"])
def test_heading_follows_the_motion_of_most_shapes(shape: str) -> None:
    path = plan_path(FlightPlan(shape=shape, laps=2), hall())
    cruising = np.linalg.norm(path.velocity_m_s[:, :2], axis=1) > 0.8
    assert np.median(np.sum(heading_vector(path) * motion_direction(path), axis=1)[cruising]) > 0.95


def test_sideways_flies_to_the_right_of_its_heading() -> None:
    path = plan_path(FlightPlan(shape="sideways", laps=3), hall())
    cruising = (np.linalg.norm(path.velocity_m_s[:, :2], axis=1) > 0.8) & (path.t_ns > 12e9)
    leftward = np.stack([-heading_vector(path)[:, 1], heading_vector(path)[:, 0]], axis=1)
    assert np.median(np.sum(leftward * motion_direction(path), axis=1)[cruising]) < -0.9


def test_figure_eight_turns_left_and_right_equally() -> None:
    path = plan_path(FlightPlan(shape="figure-8", laps=2), hall())
    assert np.abs(path.position_m[:, 0]).max() > 2.5 and np.abs(path.position_m[:, 1]).max() > 2.5
    turn_rate = np.cross(path.velocity_m_s, path.acceleration_m_s2)[on_tour(path, hall()), 2]
    assert 0.3 < np.mean(turn_rate > 0.0) < 0.7


def test_helix_has_six_turns_over_the_height() -> None:
    place = hall()
    path = plan_path(FlightPlan(shape="helix"), place)
    position = path.position_m[np.linalg.norm(path.position_m[:, :2], axis=1) > 1.5]
    turns = np.ptp(np.unwrap(np.arctan2(position[:, 1], position[:, 0]))) / (2.0 * np.pi)
    assert turns == pytest.approx(6.0, abs=0.3)
    assert np.ptp(position[:, 2]) > 2.0


def test_square_passes_its_corners_in_every_lap() -> None:
    place, laps = hall(), 3
    path = plan_path(FlightPlan(shape="square", laps=laps), place)
    for corner, times in (
        ([3.0, 3.0], laps),
        ([3.0, -3.0], laps + 1),
    ):  # the tour closes at its first corner
        near = np.linalg.norm(path.position_m[:, :2] - corner, axis=1) < 0.3
        assert np.count_nonzero(np.diff(near.astype(int)) == 1) == times
        assert np.ptp(path.position_m[near, 2]) < 0.2


@pytest.mark.parametrize("side", [[3.0, 0.0], [0.0, 3.0], [-3.0, 0.0], [0.0, -3.0]])
def test_inspection_scans_and_faces_the_nearest_obstacle(side: list[float]) -> None:
    outward = np.array(side) / 3.0
    shelf = outward * 4.6
    place = hall(([*shelf, 2.0], [0.5 if outward[0] else 3.0, 0.5 if outward[1] else 3.0, 2.0]))
    path = plan_path(FlightPlan(shape="inspection"), place)
    scanning = path.position_m[:, :2] @ outward > 2.5
    along = path.position_m[scanning][:, :2] @ [outward[1], outward[0]]
    assert np.ptp(along) > 5.5 and np.ptp(path.position_m[scanning, 2]) > 1.8
    facing = heading_vector(path)[scanning] @ outward
    assert np.median(facing) > 0.99


def test_aggressive_rolls_and_pitches_faster_than_3_rad_a_second() -> None:
    path = plan_path(FlightPlan(shape="aggressive", limits=LIMITS["race"]), hall())
    assert np.abs(path.rate_rad_s[:, 0]).max() > 3.0 and np.abs(path.rate_rad_s[:, 1]).max() > 3.0
    assert np.linalg.norm(path.acceleration_m_s2, axis=1).max() > 8.0
    np.testing.assert_array_equal(path.yaw_rad, 0.0)


def test_a_race_is_fast_and_passes_the_route_in_each_lap() -> None:
    place = hall()
    path = plan_path(FlightPlan(shape="race", limits=LIMITS["race"], laps=3), place)
    assert path.peak_speed_m_s > 7.0
    for point in place.route[1:]:
        near = np.linalg.norm(path.position_m - point, axis=1) < 0.2
        assert np.count_nonzero(np.diff(near.astype(int)) == 1) == 3


def test_levels_increase_speed_and_rates() -> None:
    place = hall()
    speeds, rates = [], []
    for level in ("easy", "medium", "difficult", "race"):
        path = plan_path(FlightPlan(shape="tour", limits=LIMITS[level]), place)
        speeds.append(np.linalg.norm(path.velocity_m_s[on_tour(path, place)], axis=1).mean())
        rates.append(path.peak_rate_rad_s)
    assert np.all(np.diff(speeds) > 0.2) and np.all(np.diff(rates) > 0.1)


def test_headings_can_be_chosen() -> None:
    place, plan = hall(), FlightPlan(shape="square", laps=2)
    in_flight = slice(2000, None)
    fixed = plan_path(replace(plan, heading="fixed"), place)
    np.testing.assert_array_equal(fixed.yaw_rad, 0.0)
    toward = plan_path(replace(plan, heading="toward", heading_target_m=(0.5, 0.0)), place)
    tour = on_tour(toward, place)
    to_target = np.array([0.5, 0.0]) - toward.position_m[:, :2]
    to_target /= np.linalg.norm(to_target, axis=1, keepdims=True)
    assert np.median(np.sum(to_target * heading_vector(toward), axis=1)[in_flight][tour[in_flight]]) > 0.98
    across = plan_path(replace(plan, heading="across"), place)
    cosine = np.sum(heading_vector(across) * motion_direction(across), axis=1)
    assert np.median(np.abs(cosine)[in_flight][on_tour(across, place)[in_flight]]) < 0.3


def test_rates_are_the_derivative_of_the_attitude() -> None:
    path = plan_path(FlightPlan(shape="aggressive", limits=LIMITS["difficult"]), hall())
    R = attitude(path.acceleration_m_s2 + [0.0, 0.0, GRAVITY_M_S2], path.yaw_rad)
    rotation = np.swapaxes(R[:-2], 1, 2) @ R[2:]
    skew_part = np.stack(
        [
            rotation[:, 2, 1] - rotation[:, 1, 2],
            rotation[:, 0, 2] - rotation[:, 2, 0],
            rotation[:, 1, 0] - rotation[:, 0, 1],
        ],
        axis=1,
    )
    np.testing.assert_allclose(0.5 * skew_part / 1e-2, path.rate_rad_s[1:-1], atol=2e-2)


def test_given_waypoints_are_passed_clear_of_obstacles() -> None:
    place = hall(([3.0, 0.0, 2.5], [0.2, 3.0, 2.5]))  # a wall across half of the hall
    points = ((6.0, 0.0, 1.5), (6.0, 4.0, 2.0))
    path = plan_path(FlightPlan(shape="via", waypoints=points), place)
    for point in points:
        assert np.linalg.norm(path.position_m - point, axis=1).min() < 0.02
    assert place.space.clearance(path.position_m[on_tour(path, place)]).min() >= 0.4


@pytest.mark.parametrize(
    ("waypoint", "message"),
    [
        ((3.0, 0.0, 1.5), r"waypoint 1 of the via at \[3.0, 0.0, 1.5\] m has -0.20 m"),
        ((6.0, 0.0, 1.5), r"no route from waypoint 0 of the via .* to waypoint 1 of the via"),
        ((60.0, 0.0, 1.5), r"waypoint 1 of the via at \[60.0"),
    ],
)
def test_a_path_through_a_wall_is_refused_with_the_waypoint(waypoint: tuple[float, float, float], message: str) -> None:
    place = hall(([3.0, 0.0, 2.5], [0.2, 6.0, 2.5]))  # a wall across all of the hall
    with pytest.raises(ConfigError, match=message):
        plan_path(FlightPlan(shape="via", waypoints=((1.5, 1.0, 1.0), waypoint)), place)


def test_a_pad_below_an_obstacle_is_refused() -> None:
    place = hall(([0.5, 0.0, 0.8], [0.3, 0.3, 0.1]))
    with pytest.raises(ConfigError, match="the climb from the pad"):
        plan_path(FlightPlan(shape="hover"), place)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"shape": "triangle"}, "unknown shape 'triangle'; expected waypoints or one of hover"),
        ({"shape": "tour", "laps": 0}, "laps = 0"),
        ({"shape": "tour", "margin_m": -0.1}, "margin_m = -0.1"),
        ({"shape": "tour", "initial_rest_s": float("nan")}, "initial_rest_s = nan"),
        ({"shape": "tour", "takeoff_s": 0.0}, "takeoff_s = 0"),
        ({"shape": "tour", "heading_target_m": (float("inf"), 0.0)}, "heading_target_m"),
        ({"tour_s": 0.0}, "tour_s = 0"),
        ({"shape": "via", "waypoints": ((0.0, float("nan"), 1.0),)}, "waypoints"),
    ],
)
def test_invalid_plans_are_refused(settings: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        FlightPlan(**settings)  # type: ignore[arg-type]


def test_via_without_waypoints_is_refused() -> None:
    with pytest.raises(ConfigError, match="'via' without waypoints"):
        plan_path(FlightPlan(shape="via"), hall())


def test_a_margin_wider_than_the_space_is_refused() -> None:
    with pytest.raises(ConfigError, match="free space"):
        plan_path(FlightPlan(shape="helix", margin_m=4.5), hall())


def test_a_low_speed_limit_holds_for_climb_and_descent() -> None:
    slow = plan_path(FlightPlan(shape="hover", limits=Limits(speed_m_s=0.2)), hall())
    assert slow.peak_speed_m_s == pytest.approx(0.2, rel=0.02)
