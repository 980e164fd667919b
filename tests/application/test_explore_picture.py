"""The moving picture of exploration: when it keeps a moment, and where it draws what."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

from dronevio.autonomy.exploration import exploration_scenario
from dronevio.models.occupancy import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from dronevio.models.rotation import pose_matrix, rotation_z
from dronevio.models.state import CameraFrame, Estimate, Health, NavState

T_WORLD_MAP = pose_matrix(rotation_z(0.5 * np.pi), np.array([-8.9, 0.0, 0.0]))
"""The map frame begins on the pad of the office, and is turned by a right angle."""


def grid() -> OccupancyGrid:
    """Return a map of 4 × 2 m in the map frame: free, but for an occupied half beyond x = 1 m."""
    states = np.full((40, 20, 20), FREE, np.uint8)
    states[30:] = OCCUPIED
    states[:5] = UNKNOWN
    return OccupancyGrid(np.array([-2.0, -1.0, 0.0]), 0.1, states, "map")


@pytest.fixture
def drawing(script: Any) -> Any:
    """Return the drawing of a flight that has one plan, from 2 s on."""
    plan = SimpleNamespace(
        t_ns=1_500_000_000,
        positions_m=np.array([[-8.0, 0.0, 1.2], [-6.0, 0.0, 1.2]]),
        route_m=np.array([[-8.0, 0.0, 1.2], [-2.0, 0.0, 1.2]]),
    )
    flight = SimpleNamespace(
        scenario=exploration_scenario("office", 2),
        T_world_map=T_WORLD_MAP,
        plans=[plan],
        waited_ns=500_000_000,
        goal_m=np.array([2.0, 3.0, 1.2]),
    )
    return script("explore_picture").Drawing(flight, [(0, np.eye(4))])


def moment(script: Any, t_ns: int) -> Any:
    """Return a moment of a vehicle on the pad with a grey image."""
    return script("explore_picture").Moment(t_ns, grid(), np.eye(4), 0.0, np.full((480, 752), 100, np.uint8))


def colour_at(drawing: Any, picture: Any, x: float, y: float) -> tuple[int, ...]:
    """Return the colour of a picture at a place of the world [m]."""
    [[u, v]] = drawing._px(np.array([[x, y]]))
    return tuple(picture[v, u].tolist())


def test_cells_are_drawn_where_they_are_in_the_world(script: Any, drawing: Any) -> None:
    """The map's x axis is the world's y axis, which points up in the picture."""
    tool, picture = script("explore_picture"), drawing.picture(moment(script, 0))
    assert picture.shape == (374, 800, 3)
    assert colour_at(drawing, picture, -8.9, 0.8) == (tool.FREE_GREY,) * 3
    assert colour_at(drawing, picture, -8.9, 1.5) == (tool.OCCUPIED_GREY,) * 3
    assert colour_at(drawing, picture, -8.9, -1.7) == (tool.UNKNOWN_GREY,) * 3
    assert colour_at(drawing, picture, 2.0, 3.0) == tool.ORANGE
    assert picture[100, 700].tolist() == [100] * 3


def test_plan_and_route_appear_when_they_are_flown(script: Any, drawing: Any) -> None:
    """A plan has times on the clock of the course, which the wait on the pad delays."""
    tool = script("explore_picture")
    for t_ns, plan, route in ((1_900_000_000, False, False), (2_000_000_000, True, True)):
        picture = drawing.picture(moment(script, t_ns))
        assert (colour_at(drawing, picture, -7.0, 0.0) == tool.ORANGE) is plan
        assert any(colour_at(drawing, picture, x, 0.0) == tool.BLUE for x in np.arange(-5.0, -3.0, 0.1)) is route


def test_a_moment_is_kept_every_four_tenths_of_a_second(script: Any) -> None:
    recorder, pilot = script("explore_picture").Recorder(), SimpleNamespace(mapper=SimpleNamespace(fused=grid))
    for k in range(11):
        t_ns = 100_000_000 * k
        state = NavState(t_ns, np.eye(4), np.array([3.0, 0.0, 4.0]), np.zeros(3), np.zeros(3))
        recorder.frame(CameraFrame(t_ns, (np.full((4, 6), k, np.uint8),)))
        recorder.depth(SimpleNamespace(t_ns=t_ns), Estimate(t_ns, Health.TRACKING, state, T_map_odom=np.eye(4)), pilot)
    assert [each.t_ns for each in recorder.moments] == [0, 400_000_000, 800_000_000]
    assert [int(each.image[0, 0]) for each in recorder.moments] == [0, 4, 8]
    assert recorder.moments[0].speed_m_s == 5.0
    assert len(recorder.path) == 11


def test_the_colours_of_lines_are_in_the_palette(script: Any, drawing: Any, tmp_path: Path) -> None:
    tool = script("explore_picture")
    tool.write_gif(tmp_path / "moving.gif", [drawing.picture(moment(script, t)) for t in (0, 2_000_000_000)])
    with Image.open(tmp_path / "moving.gif") as image:
        assert getattr(image, "n_frames", 1) == 2
        assert image.info["duration"] == tool.SHOWN_MS
        image.seek(1)
        shown = np.asarray(image.convert("RGB"))
    assert colour_at(drawing, shown, 2.0, 3.0) == tool.ORANGE
    assert colour_at(drawing, shown, -7.0, 0.0) == tool.ORANGE


def test_failures_are_titled_and_stacked(script: Any) -> None:
    tool = script("explore_failures")
    narrow, wide = np.full((50, 400, 3), 200, np.uint8), np.full((40, 600, 3), 100, np.uint8)
    titled = tool.titled(narrow, tool.FAILURES[0])
    assert titled.shape == (50 + tool.TITLE_PX, 400, 3)
    assert np.array_equal(titled[tool.TITLE_PX :], narrow) and titled[: tool.TITLE_PX].max() > 200
    stacked = tool.stacked([narrow, wide])
    assert stacked.shape == (90, 600, 3)
    assert np.array_equal(stacked[:50, :400], narrow) and np.array_equal(stacked[50:], wide)
