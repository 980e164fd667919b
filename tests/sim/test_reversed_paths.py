"""Tours in the opposite direction, and the same world under different seeds."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from dronevio.sim.flight import fly, plant_of, reference_of
from dronevio.sim.paths.limits import LIMITS
from dronevio.sim.paths.path import Reference, plan_reference
from dronevio.sim.paths.plan import FlightPlan
from dronevio.sim.paths.space import FlightArea, Space
from dronevio.sim.scenario import Scenario
from dronevio.sim.scenarios import scenario_named
from dronevio.sim.world import collision_spec

NOTHING = np.zeros((0, 3))
ROUTE_M = np.array([[0.0, 0.0, 1.3], [6.0, -3.0, 2.0], [6.0, 3.0, 3.0], [-6.0, 3.0, 2.0], [-6.0, -3.0, 1.0]])
AREA = FlightArea(
    Space(np.array([-9.0, -6.0, 0.0]), np.array([9.0, 6.0, 5.0]), NOTHING, NOTHING, np.zeros((0, 3, 3))),
    np.array([[-5.0, -4.0, 0.0], [5.0, 4.0, 4.0]]),
    np.zeros(3),
    ROUTE_M,
)


def path(plan: FlightPlan, reverse: bool) -> Reference:
    return plan_reference(plan, AREA, 0.112, 5_000_000, np.random.default_rng(5), reverse=reverse)


def passed(reference: Reference, points: np.ndarray) -> list[int]:
    """Return the points (M, 3) in the order in which a reference comes closest to them."""
    distances = np.linalg.norm(reference.position_m[:, None] - points, axis=-1)
    assert distances.min(axis=0).max() < 0.05
    return [int(k) for k in np.argsort(distances.argmin(axis=0))]


def test_a_tour_passes_its_waypoints_in_reverse_order() -> None:
    plan = FlightPlan(shape="tour", limits=LIMITS["medium"])
    assert passed(path(plan, False), ROUTE_M[1:]) == [0, 1, 2, 3]
    assert passed(path(plan, True), ROUTE_M[1:]) == [3, 2, 1, 0]


def test_waypoints_in_metres_are_passed_in_reverse_order() -> None:
    points = ((3.0, 0.0, 1.5), (3.0, 3.0, 2.0), (-2.0, 3.0, 2.5))
    plan = FlightPlan(shape="via", waypoints=points, limits=LIMITS["medium"])
    assert passed(path(plan, False), np.array(points)) == [0, 1, 2]
    assert passed(path(plan, True), np.array(points)) == [2, 1, 0]


def test_timed_waypoints_are_passed_in_reverse_order() -> None:
    waypoints = ((0.6, -0.5, 0.1), (0.6, 0.5, 0.2), (-0.6, 0.4, 0.3))
    plan = FlightPlan(tour_s=12.0, waypoints=waypoints, waypoint_jitter=0.05)
    forward, backward = path(plan, False), path(plan, True)
    # The same displaced waypoints at mirrored times: the spline is symmetric in time.
    tour = (forward.t_ns > 4.0e9) & (forward.t_ns < 16.0e9)
    np.testing.assert_allclose(forward.position_m[tour][::-1], backward.position_m[tour], atol=1e-6)
    assert np.abs(forward.position_m[tour] - backward.position_m[tour]).max() > 1.0


def test_a_reversed_tour_looks_the_other_way() -> None:
    plan = FlightPlan(shape="tour", limits=LIMITS["easy"])
    for reference in (path(plan, False), path(plan, True)):
        speed = reference.velocity_m_s[:, :2]
        fast = np.linalg.norm(speed, axis=1) > 0.9
        course = np.arctan2(speed[fast, 1], speed[fast, 0])
        off = np.angle(np.exp(1j * (course - reference.yaw_rad[fast])))
        assert np.median(np.abs(off)) < 0.1


def test_rotations_on_the_spot_are_reversed() -> None:
    plan = FlightPlan(shape="rotation", limits=LIMITS["medium"])
    forward, backward = path(plan, False), path(plan, True)
    assert forward.yaw_rad.max() > 6.0
    np.testing.assert_allclose(forward.yaw_rad, -backward.yaw_rad, atol=1e-9)


@pytest.mark.parametrize("shape", ["square", "helix", "inspection", "aggressive", "hover", "race"])
def test_every_shape_can_be_reversed(shape: str) -> None:
    reference = path(FlightPlan(shape=shape, limits=LIMITS["medium"]), True)
    np.testing.assert_allclose(reference.position_m[-1], reference.position_m[0], atol=0.02)
    assert reference.peak_speed_m_s <= 2.4


@pytest.mark.slow
def test_world_seed_selects_the_world_and_nothing_else() -> None:
    base = replace(scenario_named("forest-medium", 4), plan=FlightPlan(shape="hover", initial_rest_s=0.2))
    other = replace(base, world_seed=9)
    assert (base.seed_of_world, other.seed_of_world) == (4, 9)
    stated, flown, moved = (fly(scenario) for scenario in (replace(base, world_seed=4), base, other))
    assert stated.imu.gyro_rad_s.tobytes() == flown.imu.gyro_rad_s.tobytes()
    np.testing.assert_array_equal(moved.imu_constants.gyro_matrix, flown.imu_constants.gyro_matrix)


def test_obstacles_are_those_of_the_world_seed(monkeypatch: pytest.MonkeyPatch) -> None:
    built: list[tuple[str, int]] = []

    def recorded(world: str, seed: int) -> mujoco.MjSpec:
        built.append((world, seed))
        return collision_spec(world, seed)

    monkeypatch.setattr("dronevio.sim.flight.collision_spec", recorded)
    plant_of(replace(scenario_named("room", 4), world_seed=9))
    assert built == [("room", 9)]


def tour(scenario: Scenario) -> np.ndarray:
    return reference_of(scenario, plant_of(scenario)).position_m


@pytest.mark.slow
def test_flights_of_one_world_seed_share_the_route() -> None:
    # The route of the forest is drawn with the world.
    one, other = (replace(scenario_named("forest-easy"), seed=seed, world_seed=3) for seed in (0, 1))
    np.testing.assert_array_equal(tour(one), tour(other))
    assert tour(replace(one, world_seed=None)).shape != tour(one).shape
