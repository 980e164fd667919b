"""``dronevio run``: its results are complete, and equal to those of the single steps."""

import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

from dronevio.cli import main
from dronevio.cli.commands.run import print_report
from dronevio.cli.commands.view import viewer_program
from dronevio.estimator.slam.files.map_file import read_map
from dronevio.eval.metrics import score
from dronevio.eval.provenance import RunInfo
from dronevio.eval.report.model import ControlResult, EstimatorSummary, FlightSummary, RunReport, Timing
from dronevio.models.recordings.euroc import EurocRecording
from dronevio.models.recordings.tum import read_tum
from dronevio.models.rig_presets import rig_named
from dronevio.models.state import Trajectory
from dronevio.sim.cameras.gl import INSTALL_COMMAND
from dronevio.sim.flight import fly
from dronevio.sim.scenarios import scenario_named

RESULTS = {
    "configuration.json",
    "estimate.tum",
    "groundtruth.tum",
    "imu.csv",
    "report.html",
    "report.json",
    "run.rrd",
    "trajectory.png",
}
CAMERA, IMU, TRUTH = (Path("mav0") / part for part in ("cam0", "imu0", "state_groundtruth_estimate0"))
SCENARIO = ["--scenario", "short"]
SMALL = ["--rig", "nano"]  # few pixels

Result = Any  # the class of conftest, which cannot be imported
CommandRunner = Callable[..., Result]


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the runs of this module."""
    return tmp_path_factory.mktemp("flights")


@pytest.fixture(scope="module")
def run(place: Path, run_command: CommandRunner) -> Result:
    """A run of the short flight of seed 0 that replaces an earlier result and keeps its recording."""
    folder = place / "run"
    folder.mkdir()
    (folder / "report.json").write_text("{}")
    (folder / "stale").write_text("from an earlier run")
    return run_command(folder, "run", *SCENARIO, "--out", folder, "--overwrite", "--keep-recording")


@pytest.fixture(scope="module")
def another_run(place: Path, run_command: CommandRunner) -> Result:
    """A run of the short flight of seed 1 with a small camera, whose default name is taken, with JSON as output."""
    here = place / "elsewhere"
    taken = here / "runs" / "short-v0-1"
    taken.mkdir(parents=True)
    (taken / "report.json").write_text("{}")
    with contextlib.chdir(here):
        return run_command(here / "runs" / "short-v0-1-2", "run", *SCENARIO, "--seed", "1", *SMALL, "--json")


def names(folder: Path) -> set[str]:
    return {entry.name for entry in folder.iterdir()}


def values_of_table(text: str) -> dict[str, str]:
    """Return the values of the first table of a text by their names."""
    rows = text.split("\n\n", maxsplit=1)[0].splitlines()[3:]
    cells = [re.split(r"\s{2,}", row) for row in rows]
    return {name: value for name, value, *_ in cells}


def files(folder: Path) -> dict[str, bytes]:
    return {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*") if file.is_file()}


def test_run_writes_its_results_and_nothing_else(run: Result, another_run: Result, place: Path) -> None:
    assert names(another_run.folder) == RESULTS
    assert names(run.folder) == {*RESULTS, "recording"}  # without the files of the earlier result
    assert all(file.stat().st_size > 0 for file in run.folder.rglob("*") if file.is_file())
    assert names(place) == {"run", "elsewhere"}  # no hidden folders
    assert names(another_run.folder.parent) == {"short-v0-1", "short-v0-1-2"}
    assert names(another_run.folder.parent / "short-v0-1") == {"report.json"}


def test_table_has_the_numbers_of_the_report(run: Result) -> None:
    report = json.loads((run.folder / "report.json").read_text(encoding="utf-8"))
    scores, timing = report["scores"], report["timing"]
    shown = values_of_table(run.out)
    assert shown["length of the path"] == f"{report['flight']['path_m']:.1f}"
    assert shown["ATE, position"] == f"{scores['ate_m']['rmse']:.4f}"
    assert shown["RPE over 1 s, position"] == f"{scores['rpe_m']['rmse']:.4f}"
    assert shown["RPE over 1 s, orientation"] == f"{scores['rpe_deg']['rmse']:.3f}"
    assert shown["scale error"] == f"{scores['scale_error_percent']:+.2f}".replace("-", "−")
    assert shown["coverage"] == f"{scores['coverage_percent']:.1f}"
    innovations = report["estimator"]["innovations"]
    assert shown["innovation, median over frames"] == f"{innovations['median_px']:.2f}"
    assert shown["NIS of innovations, 95th percentile"] == f"{innovations['p95_nis']:.2f}"
    assert report["estimator"]["warnings"] == []
    assert shown["processor time per frame, mean"] == f"{timing['cpu_ms_mean']:.1f}"
    assert shown["duration of the flight / processor time"] == f"{timing['real_time_factor']:.1f}"
    assert f"dronevio view {run.folder}" in run.out
    for work in ("simulating", "rendering", "estimating"):
        assert work in run.err


def test_unknown_values_are_dashes(capsys: pytest.CaptureFixture[str]) -> None:
    p = np.outer(np.arange(3.0), [1.0, 0.0, 0.0])
    truth = Trajectory(10**8 * np.arange(3), p, np.tile([1.0, 0, 0, 0], (3, 1)))
    report = RunReport(
        RunInfo("title", "dronevio run", "dronevio view"),
        FlightSummary("short", 0.2, 3, 12.34, None, None),
        score(truth, replace(truth, p_world_imu=p + [[0, 0, 0], [0, 0, 0], [0.1, 0, 0]])),
        Timing(4.0, 9.0, 5.0, 10.0),
        ControlResult("truth", None, None, None),
        policy=None,
        estimator=EstimatorSummary(3, 0.0, None, 0, {}, None, ()),
        map=None,
        defects={},
    )
    print_report("A run too short for a relative error", report)
    shown = values_of_table(capsys.readouterr().out)
    assert list(shown.values()) == ["12.3", "0.0471", "–", "–", "–", "–", "–", "–", "–", "–", "4.0", "9.0", "–", "–"]


def test_json_is_the_report(another_run: Result) -> None:
    document = dict(another_run.document)
    assert another_run.err == ""
    assert document.pop("run") == "runs/short-v0-1-2"
    assert document == json.loads((another_run.folder / "report.json").read_text(encoding="utf-8"))
    assert document["seed"] == 1
    assert document["command"] == "dronevio run --scenario=short-v0 --seed=1 --rig nano"


@pytest.mark.parametrize("which", ["run", "another_run"])
def test_errors_are_small(which: str, request: pytest.FixtureRequest) -> None:
    scores = json.loads((request.getfixturevalue(which).folder / "report.json").read_text(encoding="utf-8"))["scores"]
    assert scores["ate_m"]["rmse"] < 0.03
    assert scores["rpe_m"]["rmse"] < 0.02
    assert abs(scores["scale_error_percent"]) < 2.0
    assert scores["coverage_percent"] == 100.0


def test_evaluating_the_files_gives_the_same_scores(run: Result, run_command: CommandRunner) -> None:
    report = json.loads((run.folder / "report.json").read_text(encoding="utf-8"))
    estimate = run.folder / "estimate.tum"
    printed = [
        run_command(run.folder, "evaluate", truth, estimate, "--json").document
        for truth in (run.folder / "groundtruth.tum", run.folder / "recording")
    ]
    assert printed[0]["coverage_percent"] is None  # a TUM file has no frames
    assert printed[1]["coverage_percent"] == report["scores"]["coverage_percent"]
    for document in printed:
        for name in ("ate_m", "ate_deg", "rpe_m", "rpe_deg"):
            assert document[name] == pytest.approx(report["scores"][name], rel=1e-4, abs=1e-6)  # files round to 1e-9
        for name in ("n_poses", "first_pose_s", "last_pose_s", "rpe_pairs"):
            assert document[name] == report["scores"][name]


def test_independent_computation_gives_the_same_error(run: Result) -> None:
    """Alignment by a search over yaw angles; frames have the time stamps of IMU samples."""
    scores = json.loads((run.folder / "report.json").read_text(encoding="utf-8"))["scores"]
    truth, estimate = read_tum(run.folder / "groundtruth.tum"), read_tum(run.folder / "estimate.tum")
    rows = np.searchsorted(truth.t_ns, estimate.t_ns)
    np.testing.assert_array_equal(truth.t_ns[rows], estimate.t_ns)
    true_m, estimated_m = (p - p.mean(axis=0) for p in (truth.p_world_imu[rows], estimate.p_world_imu))

    def rmse_m(yaw: float) -> float:
        c, s = np.cos(yaw), np.sin(yaw)
        rotated = estimated_m @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]).T
        return float(np.sqrt(np.mean(np.sum((true_m - rotated) ** 2, axis=1))))

    best = min(np.linspace(-np.pi, np.pi, 361), key=rmse_m)
    best = min(np.linspace(best - 0.02, best + 0.02, 2001), key=rmse_m)
    assert scores["ate_m"]["rmse"] == pytest.approx(rmse_m(best), rel=1e-3)


def test_every_frame_since_initialization_has_a_pose(run: Result) -> None:
    frames = EurocRecording.open(run.folder / "recording").frame_times_ns
    poses = read_tum(run.folder / "estimate.tum").t_ns
    first = int(np.searchsorted(frames, poses[0]))
    np.testing.assert_array_equal(poses, frames[first:])
    assert poses[0] - frames[0] <= 1.5e9  # the drone is stationary for this time


def test_single_steps_give_the_same_bytes(
    run: Result, flown: Result, run_command: CommandRunner, tmp_path: Path
) -> None:
    recording = flown.folder
    assert files(recording) == files(run.folder / "recording")
    assert len(files(recording / CAMERA / "data")) == 120
    assert (run.folder / "imu.csv").read_bytes() == (recording / IMU / "data.csv").read_bytes()
    run_command(tmp_path, "estimate", recording, "--out", tmp_path / "estimate.tum", "--json")
    assert (tmp_path / "estimate.tum").read_bytes() == (run.folder / "estimate.tum").read_bytes()
    truth, written = EurocRecording.open(recording).ground_truth, read_tum(run.folder / "groundtruth.tum")
    assert truth is not None
    np.testing.assert_array_equal(written.t_ns, truth.t_ns)
    np.testing.assert_allclose(written.p_world_imu, truth.p_world_imu, rtol=0, atol=1e-9)


def test_another_seed_gives_another_flight(run: Result, another_run: Result) -> None:
    for name in ("imu.csv", "groundtruth.tum", "estimate.tum"):
        assert (run.folder / name).read_bytes() != (another_run.folder / name).read_bytes()
    # The rigs of the two runs differ, too: the flight is that of seed 1 with its rig, and not that of seed 0.
    gyro_rad_s = np.loadtxt(another_run.folder / "imu.csv", delimiter=",")[:, 1:4]
    truth = read_tum(another_run.folder / "groundtruth.tum")
    for seed in (0, 1):
        flight = fly(replace(scenario_named("short", seed), rig=rig_named("nano")))
        same = [
            len(ours) == len(theirs) and np.allclose(ours, theirs, rtol=0.0, atol=1e-6)
            for ours, theirs in ((gyro_rad_s, flight.imu.gyro_rad_s), (truth.p_world_imu, flight.truth.p_world_imu))
        ]
        assert same == [seed == 1, seed == 1]


def test_estimates_depend_on_neither_truth_nor_future(
    run: Result, flown: Result, run_command: CommandRunner, tmp_path: Path
) -> None:
    """A recording without ground truth that ends in mid-flight gives the same poses up to its end."""
    kept = 80
    beginning = tmp_path / "beginning"
    shutil.copytree(flown.folder, beginning, ignore=shutil.ignore_patterns(TRUTH.name))
    times_ns = EurocRecording.open(flown.folder).frame_times_ns
    for t_ns in times_ns[kept:]:
        (beginning / CAMERA / "data" / f"{t_ns}.png").unlink()
    keep_rows(beginning / CAMERA / "data.csv", kept)
    imu_rows = int(np.searchsorted(EurocRecording.open(flown.folder).imu.t_ns, times_ns[kept - 1])) + 1
    keep_rows(beginning / IMU / "data.csv", imu_rows)  # no sample after the last frame
    run_command(tmp_path, "estimate", beginning, "--out", tmp_path / "estimate.tum", "--json")
    poses = (tmp_path / "estimate.tum").read_text().splitlines()
    whole = (run.folder / "estimate.tum").read_text().splitlines()
    assert len(poses) > kept // 2
    assert poses == whole[: len(poses)]


def keep_rows(table: Path, rows: int) -> None:
    """Keep the heading and the first rows of a CSV file."""
    lines = table.read_bytes().splitlines(keepends=True)
    assert lines[0].startswith(b"#") and len(lines) > rows + 1
    table.write_bytes(b"".join(lines[: rows + 1]))


def test_rerun_file_is_complete_and_small(run: Result) -> None:
    rrd = run.folder / "run.rrd"
    verified = subprocess.run(
        [*viewer_program(), "rrd", "verify", str(rrd)], capture_output=True, text=True, check=False
    )
    assert verified.returncode == 0, verified.stderr
    assert rrd.stat().st_size * 1e-6 < 30.0 * 120 / 600  # 30 MB for half a minute


def test_configuration_has_all_settings(another_run: Result) -> None:
    configuration = json.loads((another_run.folder / "configuration.json").read_text(encoding="utf-8"))
    assert configuration["scenario"]["name"] == "short-v0" and configuration["scenario"]["seed"] == 1
    assert configuration["scenario"]["rig"]["cameras"][0]["model"]["width"] == 324
    assert configuration["estimator"]["keyframe"]["interval_s"] > 0.0
    assert configuration == another_run.document["configuration"]


@pytest.mark.parametrize("what", ["run", "fly"])
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--scenario", "moon"], "unknown scenario 'moon'; expected one that `dronevio scenarios` lists"),
        ([*SCENARIO, "--seed", "-1"], r"--seed -1; expected a whole number, 0 to 4294967295"),
        ([*SCENARIO, "--out", "taken"], r"taken: it exists already; expected a new name, or --overwrite"),
        ([*SCENARIO, "--out", "taken", "--overwrite"], r"taken: it holds no \S+, so it is no earlier result; expected"),
        ([*SCENARIO, "--out", "taken/thesis.tex"], r"taken/thesis.tex: it is a file; expected the name of a folder"),
        ([*SCENARIO, "--out", "taken/thesis.tex/x"], r"taken/thesis.tex/x: it cannot be made .*; expected"),
    ],
)
def test_bad_input_is_refused_before_the_simulation(
    what: str,
    arguments: Sequence[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("dronevio.sim.cameras.gl.require_gl", lambda: None)  # tested elsewhere, and it takes a second
    Path("taken").mkdir()
    Path("taken/thesis.tex").write_text("years of work")
    assert main([what, *arguments]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert re.search(message, err)
    assert files(tmp_path) == {"taken/thesis.tex": b"years of work"}


@pytest.mark.slow
@pytest.mark.parametrize("what", ["run", "fly"])
def test_missing_opengl_is_one_line_and_leaves_no_folder(what: str, tmp_path: Path) -> None:
    # This is the state of a machine that has the libraries and no driver.
    no_driver = {"__EGL_VENDOR_LIBRARY_DIRS": str(tmp_path), "__EGL_VENDOR_LIBRARY_FILENAMES": str(tmp_path / "none")}
    command = [sys.executable, "-m", "dronevio.cli", what, *SCENARIO, "--out", str(tmp_path / "out")]
    ended = subprocess.run(
        command, capture_output=True, text=True, check=False, env={**os.environ, "MUJOCO_GL": "egl", **no_driver}
    )
    assert ended.returncode == 2
    assert ended.stdout == ""
    assert ended.stderr.startswith("dronevio: no off-screen OpenGL") and ended.stderr.count("\n") == 1
    assert INSTALL_COMMAND in ended.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "stop",
    [lambda pid: os.killpg(pid, signal.SIGINT), lambda pid: os.kill(pid, signal.SIGTERM)],
    ids=["Ctrl-C", "kill"],
)
@pytest.mark.slow
def test_interrupted_run_leaves_no_folder(tmp_path: Path, stop: Callable[[int], None]) -> None:
    """While images are rendered: a terminal signals all processes of the group, ``kill`` the command alone."""
    # A shell that runs the tests in the background makes their children ignore SIGINT. The command itself restores the
    # handler: a `preexec_fn` may deadlock, since the tests have threads at the time of the fork.
    restored = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"
    code = f"{restored}; from dronevio.cli import main; raise SystemExit(main())"
    flight = [*SCENARIO, "--world", "repetitive"]  # few textures, so that rendering begins soon
    command = [sys.executable, "-c", code, "run", *flight, "--out", str(tmp_path / "out")]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True) as process:
        try:
            wait_until(lambda: sum(1 for _ in tmp_path.rglob("*.png")) > 5 or process.poll() is not None)
            workers = psutil.Process(process.pid).children(recursive=True)
            assert workers  # they render
            stop(process.pid)
            errors = process.communicate(timeout=30)[1]
        finally:
            process.kill()
    assert process.returncode == 130
    assert errors.rstrip().endswith("dronevio: interrupted")
    assert "Traceback" not in errors
    assert list(tmp_path.iterdir()) == []
    assert not any(worker.is_running() for worker in workers)


def wait_until(condition: Callable[[], bool], timeout_s: float = 60.0) -> None:
    """Wait until a condition holds, and fail after the timeout."""
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.mark.slow
def test_flight_on_the_estimate(place: Path, run_command: CommandRunner) -> None:
    """The estimates of the flight are those of its recording, to the byte, and depend on no other information."""
    folder = place / "on-estimate"
    options = ["--rig", "nano", "--plan.tour-s", "1.0", "--keep-recording"]
    result = run_command(folder, "run", *SCENARIO, *options, "--fly-on", "estimate", "--out", folder)
    run_command(folder, "estimate", folder / "recording", "--out", folder / "again.tum")
    assert (folder / "again.tum").read_bytes() == (folder / "estimate.tum").read_bytes()
    assert names(folder) == {*RESULTS, "recording", "again.tum"}
    report = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    control = report["control"]
    assert control["flown_on"] == "estimate" and control["collision"] is None
    assert 0.0 < control["reference_rmse_m"] < control["reference_max_m"] < 0.25
    shown = values_of_table(result.out)
    assert shown["distance from the reference, flown on the estimate"] == f"{control['reference_rmse_m']:.3f}"
    assert report["configuration"]["loop"]["frame_latency_s"] == 0.03
    assert "--fly-on" in report["command"]


@pytest.mark.slow
def test_run_with_a_map_scores_the_corrected_paths_apart(
    another_run: Result, place: Path, run_command: CommandRunner
) -> None:
    folder = place / "slam"
    saved = place / "short.map"
    words = "--seed", "1", *SMALL, "--slam", "--out", folder, "--save-map", saved
    result = run_command(folder, "run", *SCENARIO, *words)
    assert names(folder) == {*RESULTS, "estimate_map.tum", "map_final.tum"}
    assert "short.map" in result.out and len(read_map(saved).t_ns) > 5
    assert (folder / "estimate.tum").read_bytes() == (another_run.folder / "estimate.tum").read_bytes()
    odometry = read_tum(folder / "estimate.tum")
    for name in ("estimate_map.tum", "map_final.tum"):
        corrected = read_tum(folder / name)
        assert np.array_equal(corrected.t_ns, odometry.t_ns)
        np.testing.assert_allclose(corrected.p_world_imu, odometry.p_world_imu, atol=1e-6)  # there is no loop
    report = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    assert report["map"]["loops"] == 0 and report["map"]["keyframes"] >= 5
    for path in ("online", "final"):
        assert report["map"][path]["ate_m"]["rmse"] == pytest.approx(report["scores"]["ate_m"]["rmse"], abs=1e-6)
    assert report["configuration"]["slam"]["mapping"]["min_age_s"] == 10.0 and "--slam" in report["command"]
    assert "--save-map" not in report["command"]
    shown = values_of_table(result.out)
    ate_m = report["map"]["final"]["ate_m"]["rmse"]
    assert shown["map, final: ATE, position"] == f"{ate_m:.4f}" and shown["loops"] == "0"
    assert another_run.document["map"] is None and another_run.document["configuration"]["slam"] is None


def test_live_view_of_a_flight_on_the_estimate(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = place / "no-live"
    assert main(["run", *SCENARIO, "--fly-on", "estimate", "--live", "--out", str(out)]) == 2
    assert "--live with --fly-on estimate" in capsys.readouterr().err
    assert not out.exists()
