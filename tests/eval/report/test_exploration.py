"""The report of a flight through an unknown world, by hand: layers of a turned map, labels, rows and the page."""

import json
import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from dronevio.eval.exploration import ExploredFlight, FlownPlan, StageCost, TimedDecision
from dronevio.eval.provenance import RunInfo
from dronevio.eval.report.exploration import cost_rows, score_rows, write_exploration_report
from dronevio.eval.report.exploration_plots import decision_labels, layer_in_world, plot_map
from dronevio.models.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from dronevio.models.rotation import pose_matrix, rotation_z
from dronevio.models.state import Trajectory

CELL_M = 0.1
S = 1_000_000_000


@dataclass(frozen=True)
class Scores:
    """Scores of a flight."""

    distance_to_goal_m: float | None = 0.25
    path_m: float = 7.0
    shortest_m: float | None = 5.0
    time_s: float = 4.0
    covered_share: float = 0.125
    ate_m: float | None = 0.5
    median_speed_m_s: float = 1.75


def trajectory(*positions: tuple[float, float, float]) -> Trajectory:
    """Return poses without rotation, one a second."""
    p = np.array(positions, np.float64).reshape(-1, 3)
    quat = np.tile([1.0, 0.0, 0.0, 0.0], (len(p), 1))
    return Trajectory(np.arange(len(p)) * S, p, quat, velocity_m_s=np.ones((len(p), 3)))


def flight(grid: OccupancyGrid | None = None, T_world_map: np.ndarray | None = None) -> ExploredFlight:
    """Return a flight along x at a height of 1 m, with a plan and two decisions."""
    truth = trajectory((0.0, 0.0, 1.0), (1.0, 0.0, 1.0), (2.0, 0.0, 1.0))
    positions = np.array([[1.0, 0.0, 1.0], [2.0, 0.0, 1.0]])
    return ExploredFlight(
        name="by hand",
        outcome="reached the goal",
        collision=None,
        scores=Scores(),
        pad_m=np.zeros(3),
        goal_m=np.array([2.0, 0.0, 1.0]),
        truth=truth,
        estimate=truth,
        occupancy=grid,
        T_world_map=np.eye(4) if T_world_map is None else T_world_map,
        decisions=(TimedDecision(S, "fly", (1.0, 0.0, 1.0)), TimedDecision(2 * S, "a < b", (2.0, 0.0, 1.0))),
        plans=(FlownPlan(S, positions, positions),),
        coverage=np.array([[0.0, 0.0], [1.0, 0.125]]),
        stages=(
            StageCost("depth", 40.0, np.arange(1.0, 102.0)),
            StageCost("plan", 100.0, np.zeros(0)),
        ),
        cpu_per_s=0.75,
        speed_limit_m_s=2.0,
        heights_m=(0.5, 2.0),
        true_map=OccupancyGrid(np.zeros(3), CELL_M, np.full((30, 20, 20), FREE, np.uint8), "map"),
    )


def grid_with(*cells: tuple[int, int, int]) -> OccupancyGrid:
    """Return a free grid of 3 × 2 × 2 m from the origin in which some cells are occupied."""
    states = np.full((30, 20, 20), FREE, np.uint8)
    for cell in cells:
        states[cell] = OCCUPIED
    return OccupancyGrid(np.zeros(3), CELL_M, states, "map")


def test_the_layer_of_a_turned_map_is_along_the_axes_of_the_world() -> None:
    """A quarter turn takes the cell at x = 2.55, y = 0.45 of the map to x = -0.45, y = 2.55 of the world."""
    grid = grid_with((25, 4, 10))
    turned = flight(grid, pose_matrix(rotation_z(np.pi / 2), np.zeros(3)))
    layer, low_m = layer_in_world(turned, grid, 1.05)
    i, j = np.floor((np.array([-0.45, 2.55]) - low_m) / CELL_M + 1e-9).astype(int)
    assert layer[i, j] == OCCUPIED and (layer == OCCUPIED).sum() == 1
    assert (layer == FREE).sum() == 30 * 20 - 1
    # It contains the path and the goal, which are outside of what is known.
    high_m = low_m + CELL_M * np.array(layer.shape)
    assert low_m[0] <= -2.0 and high_m[0] >= 2.0 and low_m[1] <= 0.0 and high_m[1] >= 3.0


@pytest.mark.parametrize(("k", "state"), [(10, OCCUPIED), (12, OCCUPIED), (8, OCCUPIED), (14, FREE), (6, FREE)])
def test_the_layer_has_the_height_of_the_body(k: int, state: int) -> None:
    """At z = 1.05 m, the cells from 0.8 to 1.3 m count."""
    grid = grid_with((5, 5, k))
    layer, low_m = layer_in_world(flight(grid), grid, 1.05)
    i, j = np.floor((np.array([0.55, 0.55]) - low_m) / CELL_M + 1e-9).astype(int)
    assert layer[i, j] == state


def test_one_unknown_cell_of_the_band_makes_a_place_unknown() -> None:
    grid = grid_with()
    grid.states[7, 5, 11] = UNKNOWN
    layer, low_m = layer_in_world(flight(grid), grid, 1.05)
    i, j = np.floor((np.array([0.75, 0.55]) - low_m) / CELL_M + 1e-9).astype(int)
    assert layer[i, j] == UNKNOWN and layer[i + 1, j] == FREE


def test_decisions_at_one_place_have_one_label() -> None:
    places = [(0.0, 0.0, 1.0), (0.1, 0.0, 1.0), (0.0, 0.2, 1.5), (2.0, 0.0, 1.0), (0.0, 0.0, 1.0)]
    labels = decision_labels([TimedDecision(i, "x", place) for i, place in enumerate(places)])
    assert labels == [("1–3", places[0]), ("4", places[3]), ("5", places[4])]


def test_rows_have_values_with_units() -> None:
    rows = {name: (value, unit) for name, value, unit in score_rows(Scores())}
    assert rows["distance to the goal at the end"] == ("0.25", "m")
    assert rows["share of the reachable places that is known to be free"] == ("12.5", "%")
    assert rows["shortest path on the true map"] == ("5.0", "m") and rows["ATE of the odometry"] == ("0.500", "m")
    without = {name: value for name, value, _ in score_rows(Scores(shortest_m=np.inf, ate_m=None))}
    assert without["shortest path on the true map"] == without["ATE of the odometry"] == "–"


def test_costs_of_a_stage_that_did_not_run_are_dashes() -> None:
    """Of 1, 2, …, 101 ms, the mean is 51 ms and the 99th percentile 100 ms."""
    assert cost_rows(flight()) == (("depth", "40", "101", "51.0", "100.0"), ("plan", "100", "0", "–", "–"))


def test_the_page_escapes_names_and_has_no_map_without_depth(tmp_path: Path) -> None:
    info = RunInfo("<title>", "dronevio explore", "dronevio view x", 0)
    write_exploration_report(tmp_path, info, flight(), {"outcome": "reached"})
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "a &lt; b" in page and "&lt;title&gt;" in page and "The drone reached the goal." in page
    assert "There is no map" in page and "The map at the height" not in page
    assert json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))["outcome"] == "reached"
    crashed = replace(flight(grid_with()), collision="crashed at t = 1.00 s", estimate=trajectory())
    write_exploration_report(tmp_path, info, crashed, {})
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "The drone crashed at t = 1.00 s." in page and "The map at the height" in page


def test_the_map_shows_paths_plans_and_states() -> None:
    grid = grid_with((25, 4, 10))
    picture = str(plot_map(flight(grid), grid))
    shown = {"true path", "estimated path", "plans", "last route", "pad", "goal", "free", "occupied", "unknown"}
    assert all(re.search(f">{name}<", picture) for name in shown)
