"""``dronevio estimate`` and the estimators of ``dronevio benchmark`` on a flight with two cameras."""

import json
import os
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import dronevio as dv
from dronevio.benchmark.jobs import scenario_flights
from dronevio.cli import main
from dronevio.cli.commands.estimate import EstimateCommand, check_places, numbered, result_files
from dronevio.cli.options import OutputOptions
from dronevio.estimator.backend.config import SmootherConfig
from dronevio.estimators.registry import ESTIMATORS, estimator_named
from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError, InputError
from dronevio.models.imu import ImuSamples
from dronevio.models.reconstructions import read_colmap, read_ply
from dronevio.models.recordings.calibration.exports import kalibr_files
from dronevio.models.recordings.open import open_recording
from dronevio.models.recordings.tum import read_tum
from dronevio.models.rig_presets import rig_named
from dronevio.models.rotation import inverse_pose
from dronevio.sim.cameras.imaging import VI_SENSOR
from dronevio.sim.scenario import Scenario

Result = Any  # the class of conftest, which cannot be imported
CommandRunner = Callable[..., Result]


SLAM_PAGE = Path(__file__).parents[2] / "docs" / "slam.md"
SHORT_WINDOW = "--set", "estimator.smoother.max-keyframes=5"
"""Options for keyframes that leave the window early, so that some of a short flight join the map."""
SIZE = 0.75
"""Width and height of the images relative to EuRoC's."""


def reduced(model: CameraModel) -> CameraModel:
    """Return a camera with the same field of view and fewer pixels."""
    width, height = round(SIZE * model.width), round(SIZE * model.height)
    cx, cy = SIZE * (model.cx + 0.5) - 0.5, SIZE * (model.cy + 0.5) - 0.5
    return replace(model, width=width, height=height, fx=SIZE * model.fx, fy=SIZE * model.fy, cx=cx, cy=cy)


@pytest.fixture(scope="module")
def stereo(tmp_path_factory: pytest.TempPathFactory, run_command: CommandRunner) -> Result:
    """A run of the short flight of seed 0 with the two cameras of EuRoC and fewer pixels, and its recording."""
    place = tmp_path_factory.mktemp("stereo")
    rig = rig_named("euroc-stereo")
    small = replace(rig, cameras=tuple(replace(camera, model=reduced(camera.model)) for camera in rig.cameras))
    nothing = ImuSamples(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)))
    for name, text in kalibr_files(small, nothing.t_ns, nothing).items():
        (place / name).write_text(text, encoding="utf-8")
    folder = place / "run"
    words = ("--scenario", "short", "--rig", place, "--out", folder, "--keep-recording", "--json")
    return run_command(folder, "run", *words)


@pytest.fixture(scope="module")
def odometry(stereo: Result, tmp_path_factory: pytest.TempPathFactory, run_command: CommandRunner) -> Path:
    """Trajectory by the odometry whose keyframes leave the window early, for a map of several of them."""
    place = tmp_path_factory.mktemp("odometry")
    run_command(place, "estimate", stereo.folder / "recording", *SHORT_WINDOW, "--out", place / "estimate.tum")
    return place / "estimate.tum"


@pytest.fixture(scope="module")
def rows(
    stereo: Result, tmp_path_factory: pytest.TempPathFactory, run_command: CommandRunner
) -> dict[str, dict[str, Any]]:
    """Benchmark rows of all estimators on this recording, by the name of the estimator."""
    out = tmp_path_factory.mktemp("benchmarks") / "stereo"
    names = ",".join(ESTIMATORS)
    words = ("--recordings", stereo.folder / "recording", "--estimators", names, "--out", out, "--json")
    return {row["estimator"]: row for row in run_command(out, "benchmark", *words).document["rows"]}


@pytest.mark.slow
def test_every_estimator_has_a_row(rows: dict[str, dict[str, Any]]) -> None:
    assert set(rows) == {"vio", "vio-stereo", "slam", "slam-stereo", "eqvio", "dead-reckoning"}
    assert {row["status"] for row in rows.values()} == {"ok"}, [row["reason"] for row in rows.values()]
    assert all(row["coverage_percent"] == 100.0 for row in rows.values())
    assert len({row["config_hash"] for row in rows.values()}) == 6
    for cameras in ("", "-stereo"):  # without loops, the map is the odometry
        assert rows[f"slam{cameras}"]["ate_m"] == pytest.approx(rows[f"vio{cameras}"]["ate_m"], abs=1e-6)
        odometry, mapped = rows[f"vio{cameras}"], rows[f"slam{cameras}"]
        assert odometry["rmse_after_revisit_m"] == pytest.approx(odometry["ate_m"])  # a flight without revisits
        assert mapped["odometry_after_revisit_m"] == odometry["rmse_after_revisit_m"]
        assert mapped["final_after_revisit_m"] == pytest.approx(mapped["final_ate_m"])
        assert (mapped["loops"], mapped["wrong_loops"], mapped["recall_percent"]) == (0, 0, None)
        assert mapped["worker_cpu_ms"] > 0.0 and 0 <= mapped["map_waits"] <= mapped["map_results"] > 0
        assert odometry["first_revisit_s"] is odometry["loops"] is odometry["worker_cpu_ms"] is None
    assert max(rows["vio"]["ate_m"], rows["vio-stereo"]["ate_m"]) < 0.03
    assert max(rows["vio"]["ate_m"], rows["vio-stereo"]["ate_m"]) < rows["eqvio"]["ate_m"] < 0.2


@pytest.mark.slow
def test_all_cameras_are_used_by_default(
    stereo: Result, rows: dict[str, dict[str, Any]], run_command: CommandRunner, tmp_path: Path
) -> None:
    recording = stereo.folder / "recording"
    poses = {}
    for cameras, estimator in ((), "vio-stereo"), (("--cameras", "0"), "vio"):
        out = tmp_path / f"{estimator}.tum"
        document = run_command(tmp_path, "estimate", recording, *cameras, "--out", out, "--json").document
        assert document["cameras"] == (1 if cameras else 2)
        scores = run_command(tmp_path, "evaluate", recording, out, "--json").document
        assert scores["ate_m"]["rmse"] == pytest.approx(rows[estimator]["ate_m"], rel=1e-4, abs=1e-6)
        poses[estimator] = read_tum(out)
    assert not np.array_equal(poses["vio"].p_world_imu[-100:], poses["vio-stereo"].p_world_imu[-100:])
    assert (tmp_path / "vio-stereo.tum").read_bytes() == (stereo.folder / "estimate.tum").read_bytes()


def test_map_leaves_the_odometry_as_it_is(
    stereo: Result,
    odometry: Path,
    run_command: CommandRunner,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    out = tmp_path / "slam.tum"
    shown = run_command(tmp_path, "estimate", stereo.folder / "recording", "--slam", *SHORT_WINDOW, "--out", out)
    assert out.read_bytes() == odometry.read_bytes()
    expected = read_tum(odometry)
    for suffix in ("map", "map_final"):
        corrected = read_tum(tmp_path / f"slam_{suffix}.tum")
        assert np.array_equal(corrected.t_ns, expected.t_ns)
        np.testing.assert_allclose(corrected.p_world_imu, expected.p_world_imu, atol=1e-6)  # there is no loop
    assert "keyframes of the map" in shown.out and "slam_map_final.tum" in shown.out
    assert re.search(r"frames that waited for the map .*\d+ of \d+ corrections", shown.out)
    same, folder, cloud = tmp_path / "same.tum", tmp_path / "colmap", tmp_path / "points.ply"
    exports = "--save-colmap", folder, "--save-ply", cloud, "--save-g2o", tmp_path / "graph.g2o"
    arguments = "--slam", *SHORT_WINDOW, "--map.no-worker", "--out", same, "--json", *exports
    document = run_command(tmp_path, "estimate", stereo.folder / "recording", *arguments).document
    assert document["map_cost"]["waits"] == document["map_cpu_ms_per_frame"] == 0
    assert document["map_cost"]["frames"] == document["frames"] and document["map_cost"]["results"] > 0
    for suffix in ("map", "map_final"):
        by_worker = (tmp_path / f"slam_{suffix}.tum").read_bytes()
        assert (tmp_path / f"same_{suffix}.tum").read_bytes() == by_worker
    assert (document["colmap"], document["ply"]) == (str(folder), str(cloud))
    check_exports(folder, cloud, stereo.folder / "recording", tmp_path / "same_map_final.tum", document)
    again = ["estimate", str(stereo.folder / "recording"), *map(str, arguments), "--overwrite"]
    assert main(again) == 2
    assert "it exists already; expected a new name for the folder of --save-colmap" in capsys.readouterr().err


def check_exports(folder: Path, cloud: Path, recording: Path, final: Path, document: dict[str, Any]) -> None:
    """Check a folder for COLMAP and a point cloud, by COLMAP's own reader and projection where it is installed."""
    r, trajectory, rig = read_colmap(folder / "sparse" / "0"), read_tum(final), open_recording(recording).rig
    assert len(r.image_names) == 2 * document["map"]["keyframes"] and len(r.points) > 100
    assert np.median(r.reprojection_errors_px()) < 0.3 and r.track_lengths().min() >= 3
    for i, name in enumerate(r.image_names):
        camera, file = name.split("/")
        original = recording / "mav0" / camera / "data" / file
        assert (folder / "images" / name).read_bytes() == original.read_bytes()
        row = int(np.searchsorted(trajectory.t_ns, int(original.stem)))  # a keyframe is a frame with a pose
        p = r.Ts_world_cam[i] @ inverse_pose(rig.cameras[int(camera[-1])].T_imu_cam)
        np.testing.assert_allclose(p[:3, 3], trajectory.p_world_imu[row], atol=0.01)
    gray = r.colours[:, 0].astype(float)
    assert gray.std() > 10.0 and np.array_equal(r.colours[:, 0], r.colours[:, 2])
    points = read_ply(cloud)
    np.testing.assert_allclose(points.points, r.points)
    np.testing.assert_array_equal(points.colours, r.colours)
    pycolmap = pytest.importorskip("pycolmap")
    theirs = pycolmap.Reconstruction(str(folder / "sparse" / "0"))
    errors_px = [
        np.linalg.norm(image.project_point(theirs.point3D(point.point3D_id).xyz) - point.xy)
        for image in theirs.images.values()
        for point in image.points2D
    ]
    np.testing.assert_allclose(np.median(errors_px), np.median(r.reprojection_errors_px()), atol=1e-6)


@pytest.mark.slow
def test_a_saved_map_is_continued(
    stereo: Result, run_command: CommandRunner, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording, saved, out = stereo.folder / "recording", tmp_path / "room.map", tmp_path / "second.tum"
    words: tuple[object, ...] = "--slam", *SHORT_WINDOW, "--map.no-worker", "--json"
    first = run_command(tmp_path, "estimate", recording, *words, "--save-map", saved, "--out", tmp_path / "first.tum")
    graph = tmp_path / "room.g2o"
    into_first = "--out", tmp_path / "first.tum", "--overwrite"
    run_command(tmp_path, "estimate", recording, *words, "--save-g2o", graph, *into_first)
    assert graph.read_text(encoding="utf-8").count("VERTEX") == first.document["map"]["keyframes"]
    assert first.document["saved_map"] == str(saved) and first.document["map"]["separate_tracks"] == 0
    before = saved.read_bytes()
    words = (*words, "--map", saved)
    only = run_command(tmp_path, "estimate", recording, *words, "--localize-only", "--out", out).document
    assert only["first_pose_s"] < only["first_map_pose_s"] < 4.0
    assert saved.read_bytes() == before and only["saved_map"] is None
    assert only["map"]["keyframes"] == 2 * first.document["map"]["keyframes"] and only["map"]["loops"] > 0
    # It is the same flight, so that the poses in the map are those of the first one.
    odometry, in_map = read_tum(tmp_path / "first_map_final.tum"), read_tum(tmp_path / "second_map.tum")
    assert len(in_map) < len(odometry)
    expected = odometry.p_world_imu[np.isin(odometry.t_ns, in_map.t_ns)]
    np.testing.assert_allclose(in_map.p_world_imu, expected, atol=0.01)

    monkeypatch.setattr("dronevio.estimator.slam.places.recognizer.PlaceRecognizer.add", lambda *_: ())
    monkeypatch.setattr("dronevio.estimator.slam.places.recognizer.PlaceRecognizer.locate", lambda *_: None)
    words = "--slam", "--map.no-worker", "--map", saved, "--out", out, "--overwrite"
    apart = run_command(tmp_path, "estimate", recording, *words)
    assert re.search(r"first pose in the loaded map after +never", apart.out)
    assert len(out.read_text().splitlines()) > 50
    assert all(line.startswith("#") for line in (tmp_path / "second_map.tum").read_text().splitlines())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--save-map", "x.map"), "--save-map without --slam"),
        (("--save-colmap", "x"), "--save-colmap without --slam"),
        (("--save-ply", "x.ply"), "--save-ply without --slam"),
        (("--map", "x.map"), "--map without --slam"),
        (("--slam", "--localize-only"), "--localize-only without --map"),
        (("--slam", "--map", "x.map", "--localize-only", "--save-map", "y"), "--localize-only with --save-map"),
        (("--slam", "--map", "x.map"), "x.map: no such file; expected a map that dronevio has saved"),
    ],
)
def test_wrong_options_of_maps_are_refused(
    stereo: Result, tmp_path: Path, capsys: Any, monkeypatch: pytest.MonkeyPatch, options: Any, message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["estimate", str(stereo.folder / "recording"), *options]) == 2
    assert message in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_lenses_that_colmap_lacks_are_refused_first(
    stereo: Result, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = open_recording(stereo.folder / "recording")
    model = replace(recording.rig.cameras[0].model, distortion=(0.1, 0.5), lens="ds")
    rig = replace(recording.rig, cameras=(replace(recording.rig.cameras[0], model=model),))
    nothing = ImuSamples(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)))
    for name, text in kalibr_files(rig, nothing.t_ns, nothing).items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    files = sorted(str(file) for file in tmp_path.iterdir())
    words = "--cameras", "0", "--calibration", *files, "--slam", "--save-colmap", str(tmp_path / "colmap")
    assert main(["estimate", str(stereo.folder / "recording"), *words, "--out", str(tmp_path / "e.tum")]) == 2
    assert "ds" in capsys.readouterr().err and sorted(str(file) for file in tmp_path.iterdir()) == files


def test_exports_of_segments_have_numbers(tmp_path: Path) -> None:
    command = EstimateCommand(
        tmp_path, tmp_path / "e.tum", slam=True, save_colmap=tmp_path / "colmap", save_ply=tmp_path / "points.ply"
    )
    assert numbered(command, 1) == command
    second = numbered(command, 2)
    files = result_files(second)
    assert (files["colmap"], files["ply"]) == (tmp_path / "colmap_2", tmp_path / "points_2.ply")
    (tmp_path / "colmap_2").mkdir()
    check_places(second)  # an empty folder is free
    (tmp_path / "colmap_2" / "notes.txt").touch()
    with pytest.raises(InputError, match="colmap_2: it exists already"):
        check_places(second)
    check_places(command)


def test_results_are_replaced_on_demand_only(tmp_path: Path) -> None:
    (tmp_path / "e_map.tum").touch()
    (tmp_path / "room.map").touch()
    command = EstimateCommand(tmp_path, tmp_path / "e.tum", slam=True)
    with pytest.raises(InputError, match=r"e_map.tum: it exists already; expected a new name, or --overwrite"):
        check_places(command)
    allowed = replace(command, output=OutputOptions(overwrite=True))
    check_places(allowed)
    check_places(replace(command, slam=False))  # writes no e_map.tum
    with pytest.raises(InputError, match=r"room\.map"):
        check_places(replace(command, out=tmp_path / "new.tum", save_map=tmp_path / "room.map"))
    continued = replace(command, out=tmp_path / "new.tum", saved_map=tmp_path / "room.map")
    check_places(replace(continued, save_map=tmp_path / "room.map"))


def test_read_only_folder_is_noticed_before_the_estimation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "disc"
    folder.mkdir()
    folder.chmod(0o555)
    if os.access(folder, os.W_OK):  # as the superuser
        monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != folder)
    with pytest.raises(InputError, match=r"the folder .*disc is read-only; expected a folder to write to"):
        check_places(EstimateCommand(tmp_path, folder / "results" / "e.tum"))


def test_dead_mapping_process_is_reported_as_a_defect(
    stereo: Result, tmp_path: Path, capsys: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dronevio.estimator.slam.worker.map_process._WORKER", "import os; os._exit(3)")
    out = tmp_path / "x.tum"
    assert main(["estimate", str(stereo.folder / "recording"), "--slam", "--out", str(out)]) == 70
    assert "the mapping process ended with code 3" in capsys.readouterr().err
    assert not out.exists()


def test_function_estimates_with_a_map(stereo: Result, odometry: Path) -> None:
    config = dv.VioConfig(smoother=SmootherConfig(max_keyframes=5))  # `SHORT_WINDOW`
    run = dv.estimate(stereo.folder / "recording", config, slam=True)
    expected = read_tum(odometry)
    keyframes_ns = [estimate.t_ns for estimate in run.estimates if "keyframe" in estimate.events]
    assert run.map is not None and len(run.map.loops) == 0
    assert len(run.map.t_ns) >= 5  # the four keyframes of the initialization leave the window first, and have no images
    assert np.isin(run.map.t_ns, keyframes_ns).all() and np.all(np.diff(run.map.t_ns) > 0)
    for path in (run.trajectory, run.map_trajectory, run.final_trajectory):
        np.testing.assert_allclose(path.p_world_imu, expected.p_world_imu, atol=1e-6)


@pytest.mark.skipif(not SLAM_PAGE.is_file(), reason="the documentation is not part of the wheel")
def test_example_of_visual_slam_runs(stereo: Result) -> None:
    text = SLAM_PAGE.read_text(encoding="utf-8")
    _, code = text.split("```py\n")
    code = code[: code.index("```")].replace("recordings/room", str(stereo.folder / "recording"))
    names: dict[str, Any] = {}
    exec(compile(code, "slam.md", "exec"), names)
    assert names["final"].Ts_map_odom.shape[1:] == (4, 4)
    np.testing.assert_allclose(names["estimate"].T_map_imu, names["estimate"].state.T_world_imu, atol=1e-6)


@pytest.mark.slow
def test_poses_at_imu_rate_are_as_accurate_as_at_frames(
    stereo: Result, run_command: CommandRunner, tmp_path: Path
) -> None:
    recording, files = stereo.folder / "recording", (tmp_path / "frames.tum", tmp_path / "imu.tum")
    shown = run_command(tmp_path, "estimate", recording, "--cameras", "0", "--out", files[0], "--imu-rate", files[1])
    assert f"wrote {files[0]} and {files[1]}" in shown.out
    frames, samples = (read_tum(path) for path in files)
    assert len(samples) > 9 * len(frames) and frames.t_ns[0] < samples.t_ns[0] < frames.t_ns[1]
    scores = [run_command(tmp_path, "evaluate", recording, path, "--json").document["ate_m"]["rmse"] for path in files]
    assert scores[1] < 1.2 * scores[0]
    document = run_command(
        tmp_path, "estimate", recording, "--out", files[0], "--imu-rate", files[1], "--json", "--overwrite"
    ).document
    assert document["imu_rate"] == str(files[1]) and document["imu_rate_poses"] == len(samples)
    assert sum(document["health"].values()) == document["frames"] and document["health"]["tracking"] > 80


def test_error_states_why_there_is_no_pose(stereo: Result, tmp_path: Path, capsys: Any) -> None:
    """The first frames alone, in which the drone is not stationary for long enough."""
    beginning = tmp_path / "beginning"
    shutil.copytree(stereo.folder / "recording", beginning, ignore=shutil.ignore_patterns("cam1"))
    table = beginning / "mav0" / "cam0" / "data.csv"
    table.write_text("".join(table.read_text(encoding="utf-8").splitlines(keepends=True)[:9]))
    assert main(["estimate", str(beginning), "--cameras", "0", "--out", str(tmp_path / "x.tum")]) != 0
    error = capsys.readouterr().err
    assert "no pose after 8 frames (" in error and "s are needed" in error


def test_cameras_are_checked(stereo: Result, flown: Result, capsys: Any, tmp_path: Path) -> None:
    for recording, cameras, found in (
        (stereo.folder / "recording", "2", "cameras 2; expected different ones of cam0 to cam1, by index or name"),
        (flown.folder, "left", "cameras left; expected cam0"),
    ):
        assert main(["estimate", str(recording), "--cameras", cameras, "--out", str(tmp_path / "x.tum")]) == 2
        assert found in capsys.readouterr().err
    with pytest.raises(ConfigError, match="one camera; expected two or more for vio-stereo"):
        estimator_named("vio-stereo").run(flown.folder)
    assert list(tmp_path.iterdir()) == []


def test_benchmark_simulates_other_rigs(capsys: Any) -> None:
    (mono,), (both,) = (scenario_flights(["short"], [0], rig) for rig in (None, "euroc-stereo"))
    assert mono.recording_hash != both.recording_hash and mono.scenario == both.scenario
    assert isinstance(both.source, Scenario) and len(both.source.rig.cameras) == 2
    with pytest.raises(ConfigError, match="no-such-rig"):
        scenario_flights(["short"], [0], "no-such-rig")
    assert main(["benchmark", "--recordings", "here", "--rig", "euroc-stereo"]) == 2
    assert "a recording has its own rig" in capsys.readouterr().err


def test_benchmark_simulates_other_image_sensors(capsys: Any) -> None:
    flights = [scenario_flights(["short"], [0], image_sensor=sensor)[0] for sensor in (None, "standard", "vi-sensor")]
    assert flights[0].recording_hash == flights[1].recording_hash != flights[2].recording_hash
    assert isinstance(flights[2].source, Scenario) and flights[2].source.imaging == VI_SENSOR
    with pytest.raises(ConfigError, match="no image sensor 'no-such-sensor'"):
        scenario_flights(["short"], [0], image_sensor="no-such-sensor")
    assert main(["benchmark", "--recordings", "here", "--image-sensor", "vi-sensor"]) == 2
    assert "a recording has its own images" in capsys.readouterr().err


def test_configuration_of_a_run_has_its_rig(stereo: Result) -> None:
    configuration = json.loads((stereo.folder / "configuration.json").read_text(encoding="utf-8"))
    assert len(configuration["scenario"]["rig"]["cameras"]) == 2
    assert stereo.document["scores"]["ate_m"]["rmse"] < 0.03
