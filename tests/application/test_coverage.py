"""Views for coverage: where they are, what they are worth, and which one is flown to."""

from math import pi

import numpy as np
import pytest

from dronevio.autonomy.pilot.map_columns import Area
from dronevio.autonomy.pilot.moment import Moment
from dronevio.autonomy.pilot.tasks import Cover, Strategy
from dronevio.autonomy.pilot.viewpoints import frontier_views, viewpoints
from dronevio.autonomy.planning.body import Body
from dronevio.models.arrays import Array
from dronevio.models.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from dronevio.models.rotation import pose_matrix, rotation_z
from dronevio.models.state import Estimate, Health

BODY, HEIGHTS_M, START = Body(0.45, 0.35, 0.2), np.array([0.5, 2.0]), np.array([2.05, 4.05, 1.25])
WIDE = Area(np.array([[-50.0, -50.0, 0.0], [50.0, 50.0, 5.0]]), np.eye(4))
CELL_M = 0.1


def half_known(*, wall: bool = False) -> OccupancyGrid:
    """Return a map of 8 × 8 m between occupied borders, free in x < 4 m and unknown beyond, with a wall between."""
    states = np.full((80, 80, 25), OCCUPIED, np.uint8)
    states[1:40, 1:-1] = FREE
    states[40:-1, 1:-1] = UNKNOWN
    if wall:
        states[39] = OCCUPIED
    return OccupancyGrid(np.zeros(3), CELL_M, states, "map")


def expected_m3(to_border_m: float) -> float:
    """Return the volume of unknown space of 1.5 m height beyond a plane, in a sector of 85° and 4 m, by quadrature.

    What lies behind r of unknown space counts exp(−r / 1.5 m).
    """
    angle, r = np.meshgrid(np.radians(np.linspace(-42.5, 42.5, 401)), np.linspace(0.0, 4.0, 801), indexing="ij")
    hidden = r - to_border_m / np.cos(angle)
    density = np.where(hidden > 0.0, 1.5 * r * np.exp(-np.maximum(hidden, 0.0) / 1.5), 0.0)
    return float(np.radians(85.0) * 4.0 * density.mean())


def test_views_look_into_the_unknown_and_their_gain_is_its_volume() -> None:
    views = viewpoints(half_known(), START, 0.0, BODY, HEIGHTS_M, WIDE)
    middle = np.abs(views.positions_m[:, 1] - 4.0) < 0.5  # where the sector ends at no wall
    for (x, _, z), gain in zip(views.positions_m[middle], views.gain_m3[middle], strict=True):
        assert z == START[2] and gain == pytest.approx(expected_m3(4.0 - x), rel=0.16)
    assert np.ptp(views.positions_m[middle, 0]) > 2.0
    # Far from the border the heading is at right angles to it; close to it, many headings see as much.
    far = middle & (views.positions_m[:, 0] < 2.4)
    np.testing.assert_allclose(np.cos(views.yaw_rad[far]), 1.0, atol=1e-6)
    assert np.all(np.cos(views.yaw_rad[middle]) > 0.7)
    straight_m = np.linalg.norm(views.positions_m - START, axis=1)
    assert np.all(views.way_m > straight_m - 0.1) and np.all(views.way_m < 1.09 * straight_m + 0.1)


def test_nothing_is_seen_through_walls_or_outside_the_area() -> None:
    assert len(viewpoints(half_known(wall=True), START, 0.0, BODY, HEIGHTS_M, WIDE).gain_m3) == 0
    near = Area(np.array([[0.0, 0.0, 0.0], [4.0, 8.0, 2.0]]), np.eye(4))
    for find in (viewpoints, frontier_views):
        assert len(find(half_known(), START, 0.0, BODY, HEIGHTS_M, near).gain_m3) == 0
    # The same area in a frame that is turned by 90° and shifted: x of the map is y of the area.
    T_area_map = pose_matrix(rotation_z(pi / 2), np.array([10.0, 0.0, 0.0]))
    turned = Area(np.array([[0.0, 0.0, 0.0], [12.0, 4.0, 2.0]]), T_area_map)
    assert len(viewpoints(half_known(), START, 0.0, BODY, HEIGHTS_M, turned).gain_m3) == 0
    wider = Area(np.array([[0.0, 0.0, 0.0], [12.0, 8.0, 2.0]]), T_area_map)
    assert len(viewpoints(half_known(), START, 0.0, BODY, HEIGHTS_M, wider).gain_m3) > 0


def test_the_nearest_frontier_is_straight_ahead() -> None:
    views = frontier_views(half_known(), START, 0.0, BODY, HEIGHTS_M, WIDE)
    nearest = int(np.argmin(views.way_m))
    assert views.positions_m[nearest, 1] == pytest.approx(START[1], abs=0.3)
    assert np.all(views.positions_m[:, 0] > 3.0) and views.yaw_rad[nearest] == pytest.approx(0.0, abs=0.2)


def test_ways_lead_around_obstacles() -> None:
    grid = half_known()
    grid.states[20:39, 30:40] = OCCUPIED  # a block between the start and the upper border of the unknown
    views = frontier_views(grid, np.array([3.05, 4.75, 1.25]), 0.0, BODY, HEIGHTS_M, WIDE)
    below = views.positions_m[:, 1] < 2.5
    assert below.any() and views.way_m[below].min() > 3.5  # around the block, 2.2 m away in a straight line


def moment(grid: OccupancyGrid, position: Array = START) -> Moment:
    """Return a moment at rest in a map whose frame is that of odometry and world."""
    start = np.vstack([position, np.zeros((3, 3))])
    estimate = Estimate(0, Health.TRACKING, None)
    return Moment(0, 0, start, 0.0, 0.0, BODY, grid, np.eye(4), np.eye(4), estimate)


@pytest.mark.parametrize("strategy", ["gain", "nearest"])
def test_a_view_is_kept_until_it_is_left_and_does_not_return(strategy: Strategy) -> None:
    grid, task = half_known(), Cover(WIDE.corners_m, strategy)
    seen: list[Array] = []
    for _ in range(4):
        first = task.target(moment(grid), grid, HEIGHTS_M)
        assert first is not None and first.yaw_map_rad is not None
        again = task.target(moment(grid, START + [0.2, 0.0, 0.0]), grid, HEIGHTS_M)
        assert again is not None and again.yaw_map_rad is not None
        assert np.linalg.norm(again.position_map_m - first.position_map_m) < 1.0
        pose = np.append(again.position_map_m, again.yaw_map_rad)
        assert all(np.linalg.norm(pose[:3] - p[:3]) >= 0.6 or abs(pose[3] - p[3]) > 0.5 for p in seen)
        seen.append(pose)
        task.leave()


def test_coverage_ends_when_nothing_is_left() -> None:
    grid = half_known(wall=True)
    task = Cover(WIDE.corners_m)
    assert task.target(moment(grid), grid, HEIGHTS_M) is None
