"""``dronevio map`` and ``dv.map`` on seconds of a simulated flight with a stereo pair."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import dronevio as dv
from dronevio.cli import main
from dronevio.estimator.mapping.keyframe_depths import KeyframeDepths
from dronevio.estimator.mapping.surfaces import surfaces
from dronevio.eval.report.map_pictures import dense_line, plot_from_above, vertical_slice
from dronevio.models.depth import DepthImage, Pinhole
from dronevio.models.occupancy import FREE, OCCUPIED, OccupancyGrid
from dronevio.models.occupancy_maps import read_occupancy, read_ros_map
from dronevio.models.reconstructions import read_reconstruction
from dronevio.models.recordings.tum import read_tum
from tests.browser import Browser

CAMERA = Pinhole(80, 60, np.array([[50.0, 0.0, 39.5], [0.0, 50.0, 29.5], [0.0, 0.0, 1.0]]))


def wall(x_m: float = 0.0, t_ns: int = 0, distance_m: float = 2.0) -> DepthImage:
    """Return the depth image of a wall at z = `distance_m` from a camera at (x, 0, 0) that looks along z."""
    depth_m = np.full((60, 80), distance_m, np.float32)
    T = np.eye(4)
    T[0, 3] = x_m
    return DepthImage(t_ns, CAMERA, T, depth_m, 0.01 * depth_m, np.full((60, 80), 77, np.uint8))


def test_images_are_kept_where_the_camera_moves() -> None:
    depths = KeyframeDepths()
    for k in range(100):
        depths.add(wall(0.01 * k, k), 4.0)
    assert [depth.t_ns for depth in depths.kept] == list(range(0, 100, 10)) or len(depths.kept) == 10
    assert depths.kept[0].inverse_depth.max() == 0.5 and not depths.kept[0].inverse_depth.min() < 0.5
    near = KeyframeDepths()
    near.add(wall(), 1.5)
    assert not near.kept[0].inverse_depth.any()


def test_the_memory_of_kept_images_is_bounded_over_the_whole_flight() -> None:
    depths = KeyframeDepths(max_pixels=20 * 80 * 60)
    for k in range(1000):
        depths.add(wall(0.2 * k, k), 4.0)
    t_ns = [depth.t_ns for depth in depths.kept]
    assert 10 <= len(t_ns) <= 20 and t_ns[0] == 0 and t_ns[-1] > 900
    assert max(np.diff(t_ns)) <= 2 * min(np.diff(t_ns))


def test_the_surface_of_a_wall_is_where_the_final_poses_put_it() -> None:
    depths = KeyframeDepths()
    for k in range(5):
        depths.add(wall(0.15 * k, k), 4.0)
    T_map_odom = np.eye(4)
    T_map_odom[:3, 3] = (10.0, 0.0, 1.0)
    cloud, mesh = surfaces(depths.kept, np.tile(T_map_odom, (5, 1, 1)), 0.05)
    assert len(mesh.triangles) > 500 and len(cloud) > 500
    assert np.abs(mesh.vertices[:, 2] - 3.0).max() < 0.01 and np.abs(cloud.points[:, 2] - 3.0).max() < 0.01
    assert mesh.vertices[:, 0].min() > 8.0 and np.all(mesh.normals[:, 2] < -0.99)
    assert np.all(mesh.colours == 77)


def test_what_one_image_shows_is_no_surface() -> None:
    depths = KeyframeDepths()
    depths.add(wall(), 4.0)
    cloud, mesh = surfaces(depths.kept, np.eye(4)[None], 0.05)
    assert not len(mesh.triangles) and not len(cloud)


def test_pictures_of_small_grids() -> None:
    path = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]])
    for states in (np.zeros((1, 1, 1), np.uint8), np.full((3, 4, 2), FREE, np.uint8), np.full((2, 2, 2), 2, np.uint8)):
        grid = OccupancyGrid(np.zeros(3), 0.1, states)
        assert plot_from_above(grid, path).startswith("<svg") and vertical_slice(grid, path).startswith("<svg")


def test_the_vertical_slice_is_not_within_a_wall() -> None:
    states = np.zeros((8, 6, 5), np.uint8)
    states[0], states[4, :, 1:4] = OCCUPIED, FREE
    grid = OccupancyGrid(np.zeros(3), 0.1, states)
    picture = vertical_slice(grid, np.array([[0.4, 0.1, 0.2], [0.4, 0.5, 0.2]]))
    assert re.search(r"Vertical slice at (x = 0.5|x = 0.4) m", picture)


def test_points_along_a_path_leave_out_its_rests() -> None:
    path = np.repeat([[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]], [50, 50], axis=0)
    along = dense_line(path, 0.25)
    np.testing.assert_allclose(along[:, 2], [0.0, 0.25, 0.5, 0.75])
    assert len(dense_line(path[:1], 0.25)) == len(dense_line(path[:50], 0.25)) == 1


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a short flight with a stereo pair of small images."""
    from dronevio.sim.scenarios import scenario_named

    flown = scenario_named("short", 0)
    stereo = scenario_named("short", 0).rig if len(flown.rig.cameras) > 1 else dv.rig_named("euroc-stereo")
    folder = tmp_path_factory.mktemp("flights") / "short"
    dv.fly(replace(flown, rig=stereo), folder, workers=1)
    return folder


@pytest.mark.slow
def test_map_command(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "map"
    assert main(["map", str(recording), "--out", str(out), "--range-m", "5", "--band-m", "0.5", "1.0", "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    names = {"map.pgm", "map.tum", "map.yaml", "mesh.jpg", "mesh.ply", "occupancy.npz", "points.ply"}
    assert {path.name for path in out.iterdir()} == names | {"report.html", "report.json", "run.rrd"}
    grid, plane = read_occupancy(out / "occupancy.npz"), read_ros_map(out / "map.yaml")
    assert grid.frame == "map" and plane.states.shape == grid.states.shape[:2]
    assert summary["free_m3"] == pytest.approx(np.count_nonzero(grid.states == FREE) * grid.cell_m**3)
    assert summary["occupied_m3"] > 0.1 and summary["depth_images"] > 10 and summary["band_m"] == [0.5, 1.0]
    assert len(read_reconstruction(out / "mesh.ply").points) > 100 and len(read_tum(out / "map.tum")) > 10
    assert len(read_reconstruction(out / "points.ply").points) == summary["points"]
    # Most of the points of the surfaces are beside occupied cells, and the drone was in none
    assert np.mean(grid.at(read_reconstruction(out / "points.ply").points) == OCCUPIED) > 0.5
    assert not np.any(grid.at(read_tum(out / "map.tum").p_world_imu) == OCCUPIED)
    assert main(["map", str(recording), "--out", str(out)]) == 2
    assert "--overwrite" in capsys.readouterr().err


@pytest.mark.slow
def test_the_page_s_examples_run(recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    page = (Path(__file__).resolve().parents[2] / "docs" / "map.md").read_text(encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    assert main(["map", str(recording), "--out", "maps/MH_01_easy", "--no-slam"]) == 0
    for code in re.findall(r"^```py\n(.*?)^```$", page, re.MULTILINE | re.DOTALL):
        exec(compile(code.replace('map("MH_01_easy"', f"map({str(recording)!r}"), "map.md", "exec"), {})
    assert read_ros_map(tmp_path / "slice.yaml").states.any()


@pytest.mark.slow
def test_map_from_python_without_slam(recording: Path) -> None:
    result = dv.map(recording, dv.DenseMapConfig(cell_m=0.2), slam=False)
    assert result.run.map is None and result.occupancy.cell_m == 0.2 and len(result.mesh.triangles) > 50
    assert result.volume_m3(FREE) > 1.0 and len(result.depth_cpu_ms) > 10


@pytest.fixture(scope="module")
def of_one_camera(flown: Any, tmp_path_factory: pytest.TempPathFactory, run_command: Callable[..., Any]) -> Any:
    """The result of the command on a flight with one camera."""
    out = tmp_path_factory.mktemp("one") / "map"
    words = ("--cameras", "0", "--no-slam", "--cell-m", "0.2", "--json")
    return run_command(out, "map", flown.folder, "--out", out, *words)


@pytest.mark.slow
def test_the_page_in_a_browser(of_one_camera: Any, browser: Browser) -> None:
    assert browser.faults((of_one_camera.folder / "report.html").as_uri()) == []


def test_one_camera(of_one_camera: Any) -> None:
    """The motion of one camera gives fewer depth images, which show free space and surfaces beside it."""
    out, summary = of_one_camera.folder, of_one_camera.document
    grid = read_occupancy(out / "occupancy.npz")
    assert 3 < summary["depth_images"] < summary["frames"] / 4
    assert summary["free_m3"] > 1.0 and summary["occupied_m3"] > 0.1
    assert not np.any(grid.at(read_tum(out / "map.tum").p_world_imu) == OCCUPIED)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["nowhere"], "nowhere"),
        (["nowhere", "--band-m", "2", "1"], "--band-m 2 1; expected the lower end first"),
        (["nowhere", "--cell-m", "0"], "cell-m"),
    ],
)
def test_wrong_words(words: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["map", *words]) == 2
    assert message in capsys.readouterr().err


def test_wrong_arguments() -> None:
    with pytest.raises(dv.DronevioError, match=r"map\(\) of int; expected a recording or its path"):
        dv.map(3)  # type: ignore[arg-type]
