"""What notebooks show: summaries of results as HTML instead of all values, and plots."""

import re
from collections.abc import Callable
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.axes import Axes

import dronevio as dv
from dronevio.dense_mapping import DenseMap
from dronevio.models.errors import ConfigError, EvaluationError
from dronevio.models.occupancy import FREE, OCCUPIED, OccupancyGrid
from dronevio.models.slam_map import SlamMap
from dronevio.models.surfaces import Mesh, PointCloud

FRAMES = 41
INTERVAL_NS = 100_000_000
HOSTILE = 'lost: <img src=x onerror="alert(1)"> & <script>'


class Tables(HTMLParser):
    """The cells of all tables, after a check that every element ends where it has to."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.seen: set[str] = set()
        self.rows: list[list[str]] = []
        self.feed(html)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        assert {name for name, _ in attrs} <= {"style"}
        self.open.append(tag)
        self.seen.add(tag)
        if tag == "tr":
            self.rows.append([])
        elif tag in ("td", "th"):
            self.rows[-1].append("")

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if self.open[-1] in ("td", "th"):
            self.rows[-1][-1] += data

    @property
    def values(self) -> dict[str, str]:
        """The second cells of the rows of two cells, by the first."""
        return {row[0]: row[1] for row in self.rows if len(row) == 2}


def shown(result: Any) -> Tables:
    """Return the tables that a notebook shows; they neither fetch anything nor set a colour of text or background."""
    html = result._repr_html_()
    tables = Tables(html)
    assert tables.seen <= {"div", "table", "caption", "thead", "tbody", "tr", "th", "td"}
    assert not re.search(r"url\(|https?:|background|#[0-9a-f]{3}", html)
    return tables


@pytest.fixture
def truth() -> dv.Trajectory:
    """Four seconds straight ahead at 0.5 m/s, then a step of 1 m to the left and up: 2 m and √2 m."""
    positions = np.zeros((FRAMES + 1, 3))
    positions[:FRAMES, 0] = 0.05 * np.arange(FRAMES)
    positions[FRAMES] = [2.0, 1.0, 1.0]
    quat_wxyz = np.tile([1.0, 0.0, 0.0, 0.0], (FRAMES + 1, 1))
    return dv.Trajectory(INTERVAL_NS * np.arange(FRAMES + 1, dtype=np.int64), positions, quat_wxyz)


@pytest.fixture
def run(truth: dv.Trajectory) -> dv.EstimatorRun:
    """No pose in the first second; then poses that are alternately 2 cm too high and too low."""
    estimates = []
    for row, t_ns in enumerate(truth.t_ns):
        T = truth.Ts_world_imu[row].copy()
        T[2, 3] += 0.02 * (-1) ** row
        state = dv.NavState(int(t_ns), T, np.zeros(3), np.zeros(3), np.zeros(3))
        known = row >= 10
        health = dv.Health.TRACKING if known else dv.Health.INITIALIZING
        estimates.append(dv.Estimate(int(t_ns), health, state if known else None))
    estimates[20] = replace(estimates[20], events=(HOSTILE,))
    return dv.EstimatorRun(tuple(estimates), np.full(FRAMES + 1, 20.0), np.full(FRAMES + 1, 25.0))


@pytest.fixture
def slam_map() -> SlamMap:
    """Three keyframes in two seconds, with one of two loops rejected."""
    T = np.tile(np.eye(4), (3, 1, 1))
    T[:, 0, 3] = [0.0, 1.5, 3.0]
    return SlamMap(
        t_ns=np.array([0, 10**9, 2 * 10**9]),
        Ts_map_imu=T,
        Ts_odom_imu=T,
        loops=np.array([[0, 1], [0, 2]]),
        Ts_then_now=T[1:],
        rejected=np.array([False, True]),
        points=np.zeros((7, 3)),
        track=np.zeros(3, np.int64),
        starts_ns=np.array([0]),
        adjustment="<b>scale</b>",
    )


def test_trajectory(truth: dv.Trajectory) -> None:
    values = shown(truth).values
    assert values["poses"] == "42" and values["duration"] == "4.10 s"
    assert values["length of the path"] == "3.41 m"
    assert values["size in x, y, z"] == "2.00 × 1.00 × 1.00 m"
    assert values["also has"] == "–"
    moving = replace(truth, velocity_m_s=np.zeros((len(truth), 3)))
    assert shown(moving).values["also has"] == "velocities"
    assert shown(truth[:0]).values["poses"] == "0"


def test_run(run: dv.EstimatorRun, slam_map: SlamMap) -> None:
    values = shown(run).values
    assert values["frames"] == "42 in 4.10 s" and values["poses"] == "32"
    assert values["first pose"] == "1.00 s after the first frame"
    assert values["length of the path"] == "3.31 m"  # 30 steps of 50 by 40 mm, one of 1 by 0.96 m
    assert values["processor time per frame"] == "mean 20.0 ms, 99 % below 20.0 ms"
    assert values["real-time factor on one core"] == "4.9"  # 4.1 s in 42 times 20 ms
    assert values["warnings"] == "1" and values["warning at 2.00 s"] == HOSTILE
    assert "map" not in values and "defects" not in values
    assert shown(replace(run, map=slam_map)).values["map"] == "keyframes 3, loops 1, points 7"
    begun = dv.EstimatorRun((), np.zeros(0), np.zeros(0))
    assert shown(begun).values == {"frames": "0 in 0.00 s", "poses": "0"}


def test_scores(truth: dv.Trajectory, run: dv.EstimatorRun) -> None:
    scored = dv.evaluate(truth, run, "none")
    tables = shown(scored)
    assert ["error", "rmse", "mean", "median", "max", "unit"] in tables.rows
    assert ["ATE, position", "0.0200", "0.0200", "0.0200", "0.0200", "m"] in tables.rows
    assert tables.values["length of the path"] == "2.91 m"  # of the poses after the first second
    assert tables.values["poses compared"] == "32 of 32"
    assert scored.scores._repr_html_() == scored._repr_html_()


def test_maps(truth: dv.Trajectory, run: dv.EstimatorRun, slam_map: SlamMap) -> None:
    values = shown(slam_map).values
    assert (values["keyframes"], values["loops"], values["rejected loops"], values["points"]) == ("3", "1", "1", "7")
    assert values["size in x, y, z of the keyframes"] == "3.00 × 0.00 × 0.00 m"
    assert values["bundle adjustment"] == "<b>scale</b>"
    states = np.zeros((4, 2, 2), np.uint8)
    states[:3], states[3, 0, 0] = FREE, OCCUPIED
    vectors, colours = np.zeros((3, 3)), np.zeros((3, 3), np.uint8)
    dense = DenseMap(
        run=run,
        trajectory=truth,
        occupancy=OccupancyGrid(np.zeros(3), 0.5, states),
        submaps=(),
        cloud=PointCloud(vectors, vectors, colours),
        mesh=Mesh(vectors, vectors, colours, np.array([[0, 1, 2]])),
        depth_cpu_ms=np.array([10.0, 30.0]),
    )
    values = shown(dense).values
    assert (values["side of a cell"], values["size in x, y, z"]) == ("0.5 m", "2.00 × 1.00 × 1.00 m")
    assert (values["free"], values["occupied"]) == ("1.50 m³", "0.12 m³")  # 12 cells and one of 0.125 m³
    assert (values["points of the surfaces"], values["triangles"]) == ("3", "1")
    assert values["depth images"] == "2, 20.0 ms of processor time each"


def test_results_are_a_line_of_text(truth: dv.Trajectory, run: dv.EstimatorRun, slam_map: SlamMap) -> None:
    """Notebooks store the text of a result beside its HTML: in full, that of a run would have megabytes."""
    assert repr(truth).startswith("<Trajectory, poses: 42; duration: 4.10 s; length of the path: 3.41 m; ")
    for result in (truth, run, slam_map, dv.evaluate(truth, run)):
        assert len(repr(result)) < 400 and "\n" not in repr(result) and "array(" not in repr(result)


# --- plots


def lines_of(ax: Axes) -> dict[str, np.ndarray]:
    """Return the points (N, 2) of the lines of axes by their names in the legend."""
    return {str(line.get_label()): np.asarray(line.get_xydata()) for line in ax.get_lines()}


def test_plot_of_a_trajectory_and_of_several(truth: dv.Trajectory) -> None:
    above, side = dv.plot(truth).axes
    assert (above.get_xlabel(), above.get_ylabel(), side.get_ylabel()) == ("x [m]", "y [m]", "z [m]")
    np.testing.assert_array_equal(lines_of(above)["trajectory"][:-1], truth.p_world_imu[:, [0, 1]])
    np.testing.assert_array_equal(lines_of(side)["end"], [[2.0, 1.0]])
    moved = replace(truth, p_world_imu=truth.p_world_imu + 1.0)
    figure = dv.plot({"a": truth, "<b> $x$": moved})
    np.testing.assert_array_equal(lines_of(figure.axes[1])["<b> $x$"][:-1], moved.p_world_imu[:, [0, 2]])
    np.testing.assert_array_equal(lines_of(figure.axes[1])["start"], [[0.0, 0.0]])  # of the first
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["a", "<b> $x$", "start", "end"]
    colours = {line.get_color() for line in figure.axes[0].get_lines()[:2]}
    assert len(colours) == 2


def test_plot_of_a_run_shows_the_map(run: dv.EstimatorRun, slam_map: SlamMap) -> None:
    assert {"estimate"} == set(lines_of(dv.plot(run).axes[0])) - {"start", "end"}
    raised = slam_map.Ts_map_imu.copy()
    raised[:, 2, 3] += 5.0
    with_map = replace(run, map=replace(slam_map, Ts_map_imu=raised))
    drawn = lines_of(dv.plot(with_map).axes[1])
    np.testing.assert_allclose(drawn["map"], drawn["estimate"] + [0.0, 5.0])


def test_plot_of_a_scored_trajectory_shows_its_errors(truth: dv.Trajectory, run: dv.EstimatorRun) -> None:
    figure = dv.plot(dv.evaluate(truth, run, "none"))
    above, _, position, orientation = figure.axes
    assert {"truth", "estimate"} <= set(lines_of(above))
    assert (position.get_ylabel(), orientation.get_ylabel()) == ("position error [m]", "orientation error [°]")
    seconds_and_errors = lines_of(position)["aligned"]
    np.testing.assert_allclose(seconds_and_errors[:, 0], 0.1 * np.arange(32), atol=1e-9)
    np.testing.assert_allclose(seconds_and_errors[:, 1], 0.02)
    picture: Any = figure
    assert picture._repr_png_().startswith(b"\x89PNG")


def test_what_cannot_be_drawn_is_refused(truth: dv.Trajectory) -> None:
    wrong: Any
    for wrong, kind in (("estimate.tum", "str"), ({"a": 1, "b": "c"}, "dict of int, str")):
        with pytest.raises(ConfigError, match=rf"plot\(\) of {kind}; expected a trajectory"):
            dv.plot(wrong)
    with pytest.raises(ConfigError, match="of no trajectory"):
        dv.plot({})
    with pytest.raises(EvaluationError, match=r"plot\(\) of b without poses"):
        dv.plot({"a": truth, "b": truth[:0]})


# --- the example of the documentation


def example(recording: Path) -> str:
    """Return the example for notebooks, on another recording."""
    page = Path(__file__).resolve().parents[2] / "docs" / "evaluation.md"
    if not page.is_file():
        pytest.skip("not a checkout")
    [code] = re.findall(r"^```py\n(.*?)^```$", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    assert code.count('"MH_01_easy"') == 2
    return str(code).replace('"MH_01_easy"', repr(str(recording)))


def test_the_documented_example_runs(flown: Any) -> None:
    displayed: list[Any] = []
    exec(compile(example(flown.folder), "evaluation.md", "exec"), {"display": lambda *shown: displayed.extend(shown)})
    run, scored, figure = displayed
    assert int(shown(run).values["poses"]) > 90 and shown(run).values["map"].startswith("keyframes ")
    assert [row for row in shown(scored).rows if row[0] == "ATE, position"] and len(figure.axes) == 4


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of the client that starts the kernel
def test_a_notebook_shows_tables_and_plot(flown: Any, executed: Callable[..., Any]) -> None:
    [outputs] = executed(example(flown.folder))
    shown_as = [set(output["data"]) for output in outputs if output["data"] != {"text/plain": ""}]  # of the progress
    assert shown_as == [{"text/plain", "text/html"}, {"text/plain", "text/html"}, {"text/plain", "image/png"}]
