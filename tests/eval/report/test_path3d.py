"""The path of a run in three dimensions: projection, extent, and rotation in a browser."""

import re
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from dronevio.eval.provenance import RunInfo
from dronevio.eval.report.path3d import path_scene, projected
from dronevio.eval.report.run import write_report
from dronevio.models.state import Trajectory
from tests.browser import Browser

if TYPE_CHECKING:
    from tests.eval.conftest import SyntheticFlight

NOTHING = np.zeros((0, 2, 3))


def straight(*ends: tuple[float, float, float], poses: int = 2) -> Trajectory:
    """Return a trajectory along a line between two points."""
    start, end = ends
    p = np.linspace(start, end, poses)
    return Trajectory(np.arange(poses) * 10**9, p, np.tile([1.0, 0.0, 0.0, 0.0], (poses, 1)))


def numbers_of(shape: str) -> list[float]:
    """Return the coordinates of the value of ``d`` of an SVG path."""
    return [float(word) for word in re.findall(r"-?[\d.]+", shape)]


def test_the_projection_by_hand() -> None:
    # The viewer is at 60° to the right of the x axis and 30° above: x points half right, z points up by cos 30°.
    x, y, z = projected(np.eye(3)).tolist()
    assert x == pytest.approx([np.sqrt(0.75), 0.25])
    assert y == pytest.approx([0.5, -0.5 * np.sqrt(0.75)])
    assert z == pytest.approx([0.0, -np.sqrt(0.75)])


def test_the_scene_is_centred_and_holds_everything() -> None:
    scene = path_scene(straight((2.0, 2.0, 1.0), (6.0, 2.0, 1.0)), None, NOTHING)
    assert scene is not None
    estimate = scene.paths[-1]
    assert estimate.coordinates == "-2000 0 0 2000 0 0 2000 0 0"
    assert estimate.drawing == "M-1.732 -0.500L1.732 0.500L1.732 0.500"
    assert scene.half_width_m == pytest.approx(1.08 * 2.0)
    assert scene.half_height_m == pytest.approx(1.08 * 1.0)
    assert scene.axis_m == 0.5
    segments = np.array([[[0.0, 0.0, 0.0], [8.0, 0.0, 0.0]], [[0.0, 4.0, 2.0], [8.0, 4.0, 2.0]]])
    walled = path_scene(straight((2.0, 2.0, 1.0), (6.0, 2.0, 1.0)), None, segments)
    assert walled is not None
    assert walled.paths[0].pairs and walled.paths[0].drawing.count("M") == 2
    half = np.array([walled.half_width_m, walled.half_height_m])
    assert all(np.all(np.abs(projected(path.points)) <= half) for path in walled.paths)


def test_the_ends_have_one_mark_where_two_would_overlap() -> None:
    def ends(gap_m: float) -> list[tuple[str, list[float]]]:
        """Return the marks of the ends of a round flight of radius 5 m that lands beside its start."""
        angle = np.linspace(0.0, 2.0 * np.pi, 101)
        p = 5.0 * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
        p[-1, 2] = gap_m
        scene = path_scene(Trajectory(np.arange(101), p, np.tile([1.0, 0.0, 0.0, 0.0], (101, 1))), None, NOTHING)
        assert scene is not None and scene.font_m == pytest.approx(0.055 * scene.half_width_m)
        return [(mark.text, mark.point.round(3).tolist()) for mark in scene.marks[3:]]

    # A label is 2.2 times 5.5 % of half of the width of the picture, which is 1.08 times 5 m: 0.65 m.
    assert ends(0.5) == [("start, end", [5.0, 0.0, 0.0])]
    assert ends(0.8) == [("start", [5.0, 0.0, -0.4]), ("end", [5.0, 0.0, 0.4])]


def test_long_paths_are_thinned_and_empty_ones_omitted() -> None:
    scene = path_scene(straight((0.0, 0.0, 0.0), (9.0, 0.0, 0.0), poses=9000), None, NOTHING)
    assert scene is not None and 500 < len(scene.paths[-1].points) < 900
    assert scene.paths[-1].points[-1].tolist() == [4.5, 0.0, 0.0]
    nothing = straight((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), poses=0)
    assert path_scene(nothing, None, NOTHING) is None
    only_truth = path_scene(nothing, straight((0.0, 0.0, 0.0), (1.0, 0.0, 0.0)), NOTHING)
    assert only_truth is not None and [path.name for path in only_truth.paths if path.name] == ["truth"]


def test_keys_and_mouse_rotate_the_picture_and_home_restores_it(
    flight: "SyntheticFlight", tmp_path: Path, browser: Browser
) -> None:
    info = RunInfo("flight", "dronevio run", "dronevio view", 0, {})
    write_report(tmp_path, info, flight.recording, flight.run, None, outline=flight.outline)
    html = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert " hidden>Drag or use the arrow keys" in html  # the hint is shown by the script alone
    assert browser.faults((tmp_path / "report.html").as_uri()) == []
    assert browser.evaluate("document.querySelector('figcaption [hidden]') === null")

    def shapes() -> list[str]:
        found: list[str] = browser.evaluate(
            "[...document.querySelectorAll('.spatial path')].map(x => x.getAttribute('d'))"
        )
        return found

    def assert_rotated(shown: list[str]) -> None:
        assert all(a != b for a, b in zip(static, shown, strict=True))
        z_axis = numbers_of(shown[3])
        assert z_axis[0] == z_axis[2] and z_axis[1] > z_axis[3]  # it stays upright

    def restored() -> bool:
        browser.press("Home")
        pairs = zip(map(numbers_of, static), map(numbers_of, shapes()), strict=True)
        return all(after == pytest.approx(before, abs=0.0011) for before, after in pairs)  # rounded to millimetres

    static = shapes()
    assert len(static) == 6 and all(shape in html for shape in static)
    browser.evaluate("document.querySelector('.spatial').focus()")
    for key in ("ArrowLeft", "ArrowRight", "ArrowUp", "ArrowDown"):
        browser.press(key)
        assert_rotated(shapes())
        assert restored()
    browser.press("ArrowRight")  # by 5°; 0.5° a pixel
    by_key = shapes()
    browser.press("Home")
    browser.drag(".spatial", (-10, 0))
    assert_rotated(shapes())
    assert shapes() == by_key
    assert restored()
    browser.drag(".spatial", (0, 40))
    assert_rotated(shapes())
