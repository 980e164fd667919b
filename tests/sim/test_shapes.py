"""Every shape in every world: clear, within limits, from the pad and back to it; and each shape what its name says."""

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
EVERYWHERE = tuple(name for name in SHAPES if name != "via")


def planned(plan: FlightPlan, place: FlightArea, seed: int = 0) -> Reference:
    return plan_reference(plan, place, STANDING_M, STEP_NS, np.random.default_rng(seed))


def hall(*boxes: tuple[list[float], list[float]]) -> FlightArea:
    """A hall of 20 × 12 × 5 m around a pad, with boxes of given middles and half sizes in it."""
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


def aloft(path: Reference, area: FlightArea) -> np.ndarray:
    """Which rows belong to the tour: neither standing nor on the vertical above the pad."""
    return np.asarray(np.linalg.norm(path.position_m[:, :2] - area.pad[:2], axis=1) > 1e-3)


@pytest.mark.parametrize("world", WORLDS)
@pytest.mark.parametrize("shape", EVERYWHERE)
def test_every_shape_fits_every_world(world: str, shape: str) -> None:
    place = flight_area(world, 1)
    level = sorted(LIMITS)[(EVERYWHERE.index(shape) + sorted(WORLDS).index(world)) % len(LIMITS)]
    plan = FlightPlan(shape=shape, limits=LIMITS[level], waypoint_jitter=0.1)
    path, limits = planned(plan, place), plan.limits
    # Clear of everything.
    away = aloft(path, place)
    if away.any():
        assert place.space.clearance(path.position_m[away]).min() >= plan.margin_m
    # Within its limits.
    lift = path.acceleration_m_s2 + [0.0, 0.0, GRAVITY_M_S2]
    up = lift / np.linalg.norm(lift, axis=1, keepdims=True)
    assert path.peak_speed_m_s <= limits.speed_m_s
    assert np.linalg.norm(path.acceleration_m_s2, axis=1).max() <= limits.accel_m_s2
    assert np.linalg.norm(lift, axis=1).max() <= limits.thrust_to_weight * GRAVITY_M_S2
    assert np.arccos(up[:, 2].min()) <= limits.tilt_rad
    assert np.abs(np.diff(path.yaw_rad)).max() / 5e-3 <= limits.yaw_rate_rad_s
    assert np.linalg.norm(np.diff(up, axis=0), axis=1).max() / 5e-3 <= limits.tilt_rate_rad_s
    # Standing at both ends, and no jump in between.
    pad = place.pad + [0.0, 0.0, STANDING_M]
    assert not path.flying[path.t_ns < 1_999_000_000].any() and not path.flying[-200:].any()
    np.testing.assert_allclose(path.position_m[:400], np.tile(pad, (400, 1)), atol=1e-12)
    np.testing.assert_allclose(path.position_m[-1], pad, atol=0.02)
    for still in (path.velocity_m_s, path.acceleration_m_s2, path.rate_rad_s):
        np.testing.assert_allclose(still[[0, -1]], 0.0, atol=1e-9)
    jerk = np.diff(path.acceleration_m_s2, axis=0) / 5e-3
    assert np.abs(np.diff(jerk, axis=0)).max() < 0.2 * max(np.abs(jerk).max(), 0.1)
    np.testing.assert_allclose(np.diff(path.velocity_m_s, axis=0), path.acceleration_m_s2[1:] * 5e-3, atol=0.02)
    assert path.duration_s == pytest.approx(round(path.duration_s, 1))


def test_same_seed_same_path_and_without_jitter_always_the_same() -> None:
    place, plan = hall(), FlightPlan(shape="figure-8", waypoint_jitter=0.1)
    first, again, other = (planned(plan, place, seed) for seed in (3, 3, 4))
    assert first.position_m.tobytes() == again.position_m.tobytes()
    assert first.yaw_rad.tobytes() == again.yaw_rad.tobytes()
    assert len(first) != len(other) or not np.array_equal(first.position_m, other.position_m)
    exact = replace(plan, waypoint_jitter=0.0)
    np.testing.assert_array_equal(planned(exact, place, 3).position_m, planned(exact, place, 4).position_m)


def test_jitter_moves_waypoints_as_far_as_is_clear() -> None:
    place = hall(([8.0, -2.5, 2.0], [0.3, 0.3, 2.0]), ([8.0, -5.5, 2.0], [0.3, 0.3, 2.0]))  # a gate in the route
    for seed in range(2):
        path = planned(FlightPlan(shape="tour", waypoint_jitter=2.0), place, seed)
        assert place.space.clearance(path.position_m[aloft(path, place)]).min() >= 0.4


@pytest.mark.parametrize(("shape", "slow"), [("hover", 0.0), ("rotation", 0.0), ("square", 0.5)])
def test_laps_approximate_the_requested_time(shape: str, slow: float) -> None:
    place = hall()
    one, two = (planned(FlightPlan(shape=shape, laps=laps), place).duration_s for laps in (1, 2))
    many = planned(FlightPlan(shape=shape, tour_s=60.0), place)
    tour_s = many.duration_s - 8.0  # less standing, climb and descent
    assert abs(tour_s - 60.0) <= 0.5 * (two - one) + 0.1 + slow


def test_hover_stays() -> None:
    path = planned(FlightPlan(shape="hover"), hall())
    high = path.position_m[:, 2] > STANDING_M + 1.2 - 1e-6
    assert high.sum() * 5e-3 >= 10.0
    np.testing.assert_allclose(path.position_m[:, :2], 0.0, atol=1e-12)
    np.testing.assert_array_equal(path.yaw_rad, 0.0)


def test_rotation_turns_on_the_spot_once_around_and_back() -> None:
    path = planned(FlightPlan(shape="rotation"), hall())
    assert np.ptp(path.yaw_rad) == pytest.approx(2.0 * np.pi, abs=0.5)
    assert path.yaw_rad[-1] == pytest.approx(0.0, abs=0.01)
    assert np.abs(path.position_m[:, :2]).max() < 1e-9


def nose(path: Reference) -> np.ndarray:
    return np.stack([np.cos(path.yaw_rad), np.sin(path.yaw_rad)], axis=1)


def way(path: Reference) -> np.ndarray:
    velocity = path.velocity_m_s[:, :2]
    return np.asarray(velocity / np.maximum(np.linalg.norm(velocity, axis=1, keepdims=True), 1e-9))


@pytest.mark.parametrize("shape", ["tour", "figure-8", "helix", "square"])
def test_most_shapes_look_ahead(shape: str) -> None:
    path = planned(FlightPlan(shape=shape, laps=2), hall())
    cruising = np.linalg.norm(path.velocity_m_s[:, :2], axis=1) > 0.8
    assert np.median(np.sum(nose(path) * way(path), axis=1)[cruising]) > 0.95


def test_sideways_goes_to_the_right_of_where_it_looks() -> None:
    path = planned(FlightPlan(shape="sideways", laps=3), hall())
    cruising = (np.linalg.norm(path.velocity_m_s[:, :2], axis=1) > 0.8) & (path.t_ns > 12e9)
    left = np.stack([-nose(path)[:, 1], nose(path)[:, 0]], axis=1)
    assert np.median(np.sum(left * way(path), axis=1)[cruising]) < -0.9


def test_figure_eight_turns_both_ways_around_two_eyes() -> None:
    path = planned(FlightPlan(shape="figure-8", laps=2), hall())
    assert np.abs(path.position_m[:, 0]).max() > 2.5 and np.abs(path.position_m[:, 1]).max() > 2.5
    turning = np.cross(path.velocity_m_s, path.acceleration_m_s2)[aloft(path, hall()), 2]
    assert 0.3 < np.mean(turning > 0.0) < 0.7


def test_helix_winds_around_the_middle_at_all_heights() -> None:
    place = hall()
    path = planned(FlightPlan(shape="helix"), place)
    position = path.position_m[np.linalg.norm(path.position_m[:, :2], axis=1) > 1.5]
    turns = np.ptp(np.unwrap(np.arctan2(position[:, 1], position[:, 0]))) / (2.0 * np.pi)
    assert turns == pytest.approx(6.0, abs=0.3)
    assert np.ptp(position[:, 2]) > 2.0


def test_square_passes_its_corners_in_every_lap() -> None:
    place, laps = hall(), 3
    path = planned(FlightPlan(shape="square", laps=laps), place)
    for corner, times in (
        ([3.0, 3.0], laps),
        ([3.0, -3.0], laps + 1),
    ):  # it leads back to the first before it goes home
        near = np.linalg.norm(path.position_m[:, :2] - corner, axis=1) < 0.3
        assert np.count_nonzero(np.diff(near.astype(int)) == 1) == times
        assert np.ptp(path.position_m[near, 2]) < 0.2


@pytest.mark.parametrize("side", [[3.0, 0.0], [0.0, 3.0], [-3.0, 0.0], [0.0, -3.0]])
def test_inspection_scans_what_is_nearest_and_faces_it(side: list[float]) -> None:
    outward = np.array(side) / 3.0
    shelf = outward * 4.6
    place = hall(([*shelf, 2.0], [0.5 if outward[0] else 3.0, 0.5 if outward[1] else 3.0, 2.0]))
    path = planned(FlightPlan(shape="inspection"), place)
    scanning = path.position_m[:, :2] @ outward > 2.5
    along = path.position_m[scanning][:, :2] @ [outward[1], outward[0]]
    assert np.ptp(along) > 5.5 and np.ptp(path.position_m[scanning, 2]) > 1.8
    facing = nose(path)[scanning] @ outward
    assert np.median(facing) > 0.99


def test_aggressive_rolls_and_pitches_faster_than_3_rad_a_second() -> None:
    path = planned(FlightPlan(shape="aggressive", limits=LIMITS["race"]), hall())
    assert np.abs(path.rate_rad_s[:, 0]).max() > 3.0 and np.abs(path.rate_rad_s[:, 1]).max() > 3.0
    assert np.linalg.norm(path.acceleration_m_s2, axis=1).max() > 8.0
    np.testing.assert_array_equal(path.yaw_rad, 0.0)


def test_a_race_is_fast_and_flies_the_whole_route_each_lap() -> None:
    place = hall()
    path = planned(FlightPlan(shape="race", limits=LIMITS["race"], laps=3), place)
    assert path.peak_speed_m_s > 7.0
    for point in place.route[1:]:
        near = np.linalg.norm(path.position_m - point, axis=1) < 0.2
        assert np.count_nonzero(np.diff(near.astype(int)) == 1) == 3


def test_levels_differ_as_their_names_say() -> None:
    place = hall()
    speeds, rates = [], []
    for level in ("easy", "medium", "difficult", "race"):
        path = planned(FlightPlan(shape="tour", limits=LIMITS[level]), place)
        speeds.append(np.linalg.norm(path.velocity_m_s[aloft(path, place)], axis=1).mean())
        rates.append(path.peak_rate_rad_s)
    assert np.all(np.diff(speeds) > 0.2) and np.all(np.diff(rates) > 0.1)


def test_headings_can_be_chosen() -> None:
    place, plan = hall(), FlightPlan(shape="square", laps=2)
    away = slice(2000, None)
    fixed = planned(replace(plan, heading="fixed"), place)
    np.testing.assert_array_equal(fixed.yaw_rad, 0.0)
    toward = planned(replace(plan, heading="toward", heading_target_m=(0.5, 0.0)), place)
    tour = aloft(toward, place)
    ahead = np.array([0.5, 0.0]) - toward.position_m[:, :2]
    ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
    assert np.median(np.sum(ahead * nose(toward), axis=1)[away][tour[away]]) > 0.98
    across = planned(replace(plan, heading="across"), place)
    assert np.median(np.abs(np.sum(nose(across) * way(across), axis=1))[away][aloft(across, place)[away]]) < 0.3


def test_rates_belong_to_the_attitude() -> None:
    path = planned(FlightPlan(shape="aggressive", limits=LIMITS["difficult"]), hall())
    R = attitude(path.acceleration_m_s2 + [0.0, 0.0, GRAVITY_M_S2], path.yaw_rad)
    turn = np.swapaxes(R[:-2], 1, 2) @ R[2:]
    off = np.stack(
        [turn[:, 2, 1] - turn[:, 1, 2], turn[:, 0, 2] - turn[:, 2, 0], turn[:, 1, 0] - turn[:, 0, 1]], axis=1
    )
    np.testing.assert_allclose(0.5 * off / 1e-2, path.rate_rad_s[1:-1], atol=2e-2)


def test_ones_own_waypoints_are_flown_through_and_around_things() -> None:
    place = hall(([3.0, 0.0, 2.5], [0.2, 3.0, 2.5]))  # a wall across half of the hall
    points = ((6.0, 0.0, 1.5), (6.0, 4.0, 2.0))
    path = planned(FlightPlan(shape="via", waypoints=points), place)
    for point in points:
        assert np.linalg.norm(path.position_m - point, axis=1).min() < 0.02
    assert place.space.clearance(path.position_m[aloft(path, place)]).min() >= 0.4


@pytest.mark.parametrize(
    ("waypoint", "told"),
    [
        ((3.0, 0.0, 1.5), r"waypoint 1 of the via at \[3.0, 0.0, 1.5\] m has -0.20 m"),
        ((6.0, 0.0, 1.5), r"no route from waypoint 0 of the via .* to waypoint 1 of the via"),
        ((60.0, 0.0, 1.5), r"waypoint 1 of the via at \[60.0"),
    ],
)
def test_a_path_through_a_wall_is_refused_with_the_waypoint(waypoint: tuple[float, float, float], told: str) -> None:
    place = hall(([3.0, 0.0, 2.5], [0.2, 6.0, 2.5]))  # a wall across all of the hall
    with pytest.raises(ConfigError, match=told):
        planned(FlightPlan(shape="via", waypoints=((1.5, 1.0, 1.0), waypoint)), place)


def test_a_pad_with_something_above_it_is_refused() -> None:
    place = hall(([0.5, 0.0, 0.8], [0.3, 0.3, 0.1]))
    with pytest.raises(ConfigError, match="the climb from the pad"):
        planned(FlightPlan(shape="hover"), place)


@pytest.mark.parametrize(
    ("settings", "told"),
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
def test_plans_that_make_no_sense_are_refused(settings: dict[str, object], told: str) -> None:
    with pytest.raises(ConfigError, match=told):
        FlightPlan(**settings)  # type: ignore[arg-type]


def test_via_without_waypoints_is_refused() -> None:
    with pytest.raises(ConfigError, match="'via' without waypoints"):
        planned(FlightPlan(shape="via"), hall())


def test_a_margin_wider_than_the_place_is_refused() -> None:
    with pytest.raises(ConfigError, match="free space"):
        planned(FlightPlan(shape="helix", margin_m=4.5), hall())


def test_slow_limits_stretch_the_climb_and_the_descent() -> None:
    slow = planned(FlightPlan(shape="hover", limits=Limits(speed_m_s=0.2)), hall())
    assert slow.peak_speed_m_s == pytest.approx(0.2, rel=0.02)
