import numpy as np
import pytest
from scipy.optimize import minimize

from dronevio.autonomy.planning.corridor import Corridor, corridor_along, passable
from dronevio.autonomy.planning.quadratic_program import bounded_minimum
from dronevio.autonomy.planning.trajectory import CorridorTrajectory, corridor_trajectory
from dronevio.estimator.mapping.distance import distance_field
from dronevio.models.arrays import Array, Mask
from dronevio.models.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from dronevio.sim.paths.limits import Limits
from dronevio.sim.paths.minimum_snap import minimum_time_knots

LIMITS = Limits(speed_m_s=2.5)
LOW_M = np.array([-3.0, 1.0, 0.5])
# Around a corner: along x, then along y.
CORNER = Corridor(np.array([[-1.0, -1, -1], [3, -1, -1]]), np.array([[4.0, 1, 1], [4, 6, 1]]))
CORNER_GOAL = np.array([3.5, 5.0, 0.0])


def at_rest(position: Array) -> Array:
    return np.vstack([position, np.zeros((3, 3))])


def cluttered(seed: int) -> OccupancyGrid:
    states = np.full((60, 50, 20), FREE, np.uint8)
    rng = np.random.default_rng(seed)
    for low in rng.integers(0, (55, 45, 10), (12, 3)):
        states[tuple(slice(k, k + n) for k, n in zip(low, rng.integers(2, 10, 3), strict=True))] = OCCUPIED
    return OccupancyGrid(LOW_M, 0.1, states)


def polyline_through(grid: OccupancyGrid, is_passable: Mask, rng: np.random.Generator) -> Array:
    """Return a random walk of four legs whose cells are passable with a cell to spare."""
    cells = np.argwhere(is_passable)
    points = [grid.centres(cells[rng.integers(len(cells))])]
    while len(points) < 5:
        end = grid.centres(cells[rng.integers(len(cells))])
        on_leg = grid.cells(np.linspace(points[-1], end, 400))
        if np.all(is_passable[tuple(on_leg.T)]):
            points.append(end)
        elif rng.uniform() < 0.01:
            points = [end]
    return np.array(points)


def assert_kept(trajectory: CorridorTrajectory, corridor: Corridor, start: Array, limits: Limits) -> None:
    low, high = (side[trajectory.boxes][:, None] for side in (corridor.low_m, corridor.high_m))
    assert np.all((trajectory.control_points >= low) & (trajectory.control_points <= high))
    t = np.linspace(0.0, trajectory.duration_s, 997)
    derivatives = [trajectory.path.derivative(order)(t) for order in (1, 2, 3)]
    assert limits.limit_ratio(*derivatives).max() < 1.005  # 1 / .99 is the limit itself
    np.testing.assert_allclose(trajectory.state(0.0), start, atol=1e-6)
    np.testing.assert_allclose(trajectory.state(np.inf)[1:], 0.0, atol=1e-6)
    for order in range(4):  # no step at a knot
        curve = trajectory.path.derivative(order)
        inner = trajectory.knots_s[1:-1]
        np.testing.assert_allclose(curve(inner - 1e-9), curve(inner + 1e-9), atol=1e-5)


@pytest.mark.parametrize("seed", range(6))
def test_boxes_are_free_overlap_and_follow_the_polyline(seed: int) -> None:
    grid, rng = cluttered(seed), np.random.default_rng(seed)
    distance = distance_field(grid, unknown_is_obstacle=True)
    spare = passable(grid, distance, 0.36)
    fine = passable(grid, distance, 0.2)
    polyline = polyline_through(grid, spare, rng)
    corridor = corridor_along(grid, fine, polyline, 1.0)
    assert corridor is not None
    points = rng.uniform(corridor.low_m + 1e-9, corridor.high_m - 1e-9, (500, len(corridor.low_m), 3)).reshape(-1, 3)
    assert np.all(fine[tuple(grid.cells(points).T)])
    low, high = corridor.portals
    assert np.all(high - low > 0.99 * grid.cell_m)
    for point, box in ((polyline[0], 0), (polyline[-1], -1)):
        assert np.all((point >= corridor.low_m[box]) & (point <= corridor.high_m[box]))
    start = at_rest(polyline[0])
    trajectory = corridor_trajectory(corridor, start, polyline[-1], LIMITS)
    assert trajectory is not None
    assert_kept(trajectory, corridor, start, LIMITS)
    np.testing.assert_allclose(trajectory.state(np.inf)[0], polyline[-1], atol=1e-9)


def test_boxes_end_at_cells_that_are_not_free() -> None:
    states = np.full((40, 20, 20), FREE, np.uint8)
    states[:, 13:] = UNKNOWN
    states[:, :, 4] = OCCUPIED
    grid = OccupancyGrid(LOW_M, 0.1, states)
    corridor = corridor_along(grid, states == FREE, LOW_M + [[1.05, 0.85, 0.95], [2.05, 0.85, 0.95]], 1.5)
    assert corridor is not None
    np.testing.assert_allclose(corridor.low_m - LOW_M, [[0.0, 0.0, 0.5]], atol=1e-9)
    np.testing.assert_allclose(corridor.high_m - LOW_M, [[3.6, 1.3, 2.0]], atol=1e-9)


def test_there_is_no_corridor_through_what_is_not_passable() -> None:
    states = np.full((40, 20, 20), FREE, np.uint8)
    states[20] = UNKNOWN
    grid = OccupancyGrid(LOW_M, 0.1, states)
    line = LOW_M + [[1.0, 1.0, 1.0], [3.0, 1.0, 1.0]]
    assert corridor_along(grid, states == FREE, line, 1.0) is None
    assert corridor_along(grid, states == FREE, line - [2.0, 0.0, 0.0], 1.0) is None  # leaves the grid
    diagonal = np.zeros((40, 20, 20), dtype=bool)
    diagonal[:20, 5, 5] = diagonal[20:, 6, 5] = True  # cells that touch at an edge
    assert corridor_along(grid, diagonal, LOW_M + [[1.95, 0.55, 0.55], [2.05, 0.65, 0.55]], 1.0) is None


@pytest.mark.parametrize("length_m", [0.5, 2.0, 7.0])
def test_a_straight_line_takes_the_time_of_the_minimum_snap_curve(length_m: float) -> None:
    corridor = Corridor(np.array([[-1.0, -1.0, -1.0]]), np.array([[9.0, 1.0, 1.0]]))
    goal = np.array([length_m, 0.0, 0.0])
    trajectory = corridor_trajectory(corridor, at_rest(np.zeros(3)), goal, LIMITS)
    assert trajectory is not None
    best_s = minimum_time_knots(np.array([np.zeros(3), goal]), LIMITS)[-1]
    assert trajectory.duration_s < 1.05 * best_s
    middle = trajectory.path(0.5 * trajectory.duration_s)
    np.testing.assert_allclose(middle[1:], 0.0, atol=1e-6)


def test_a_trajectory_turns_the_corner_inside_its_boxes() -> None:
    start = at_rest(np.zeros(3))
    trajectory = corridor_trajectory(CORNER, start, CORNER_GOAL, LIMITS)
    assert trajectory is not None
    assert_kept(trajectory, CORNER, start, LIMITS)
    slow = Limits(speed_m_s=0.5)
    slower = corridor_trajectory(CORNER, start, CORNER_GOAL, slow)
    assert slower is not None and slower.duration_s > 2.0 * trajectory.duration_s
    assert_kept(slower, CORNER, start, slow)


@pytest.mark.parametrize("share", [0.15, 0.3])
def test_a_plan_from_motion_continues_the_state_and_a_stop_is_sooner(share: float) -> None:
    first = corridor_trajectory(CORNER, at_rest(np.zeros(3)), CORNER_GOAL, LIMITS)
    assert first is not None
    now_s = share * first.duration_s
    state = first.state(now_s)
    assert np.linalg.norm(state[1]) > 0.4
    again = corridor_trajectory(CORNER, state, CORNER_GOAL, LIMITS)
    stop = corridor_trajectory(CORNER, state, None, LIMITS)
    assert again is not None and stop is not None
    assert_kept(again, CORNER, state, LIMITS)
    assert_kept(stop, CORNER, state, LIMITS)
    assert again.duration_s < 1.1 * (first.duration_s - now_s)
    assert stop.duration_s < again.duration_s


def test_a_state_that_cannot_be_kept_inside_has_no_trajectory() -> None:
    fast = at_rest(np.zeros(3))
    fast[1] = [0.0, 2.4, 0.0]  # stops in 1 m at 3 m/s² at the earliest
    walls = Corridor(np.array([[-1.0, -1.0, -1.0]]), np.array([[1.0, 0.5, 1.0]]))
    assert corridor_trajectory(walls, fast, None, LIMITS) is None
    assert corridor_trajectory(CORNER, at_rest(np.array([0.0, 3.0, 0.0])), CORNER_GOAL, LIMITS) is None
    assert corridor_trajectory(CORNER, at_rest(np.zeros(3)), np.array([0.0, 3.0, 0.0]), LIMITS) is None


@pytest.mark.parametrize("seed", range(4))
def test_bounded_minimum_agrees_with_scipy(seed: int) -> None:
    rng = np.random.default_rng(seed)
    root, rows, gradient = rng.normal(size=(5, 5)), rng.normal(size=(8, 5)), rng.normal(size=(5, 3))
    hessian = root @ root.T + 0.1 * np.eye(5)
    low, high = -rng.uniform(0.05, 0.3, (8, 3)), rng.uniform(0.05, 0.3, (8, 3))
    found = bounded_minimum(hessian, gradient, rows, low, high, 1e-9)
    assert found is not None
    for axis in range(3):
        g, bounds = gradient[:, axis], (low[:, axis], high[:, axis])
        constraints = [
            {"type": "ineq", "fun": lambda x, b=bounds: rows @ x - b[0]},
            {"type": "ineq", "fun": lambda x, b=bounds: b[1] - rows @ x},
        ]
        best = minimize(lambda x, g=g: 0.5 * x @ hessian @ x + g @ x, np.zeros(5), constraints=constraints, tol=1e-12)
        np.testing.assert_allclose(found[:, axis], best.x, atol=1e-5)


def test_bounds_that_contradict_each_other_have_no_minimum() -> None:
    rows = np.array([[1.0, 0.0], [1.0, 0.0]])
    low, high = np.array([[1.0], [-2.0]]), np.array([[2.0], [-1.0]])
    assert bounded_minimum(np.eye(2), np.zeros((2, 1)), rows, low, high, 1e-9) is None
