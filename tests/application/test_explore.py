"""``dronevio explore`` and ``dv.explore``: files, figures, exit codes, and that the same seed gives the same bytes."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from rerun.chunk import RrdReader

import dronevio as dv
from dronevio.autonomy.explored_flight import OUTCOMES, document, explored_flight
from dronevio.autonomy.pilot.explorer import Outcome
from dronevio.autonomy.ray_sensing import RaySensing
from dronevio.cli import main
from dronevio.cli.commands.explore import repeating_command
from dronevio.cli.flight_options import COLLIDED
from dronevio.eval.rerun.exploration import DECISIONS, GOAL, PLAN, ROUTE, TRUE_PATH_SO_FAR, TRUTH
from dronevio.models.occupancy import FREE, OCCUPIED
from dronevio.models.occupancy_maps import read_occupancy
from dronevio.models.recordings.tum import read_tum
from tests.browser import Browser

Result = Any  # the class of conftest, which cannot be imported
PAGE = Path(__file__).resolve().parents[2] / "docs" / "explore.md"
GOAL_M = (1.0, -2.0, 1.0)
SPEED_M_S = 1.5
WORDS = ("--scenario", "room", "--no-images", "--time-s", "20", "--goal", *map(str, GOAL_M))
FILES = {
    "report.html",
    "report.json",
    "groundtruth.tum",
    "estimate.tum",
    "occupancy.npz",
    "run.rrd",
    "configuration.json",
}


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory, run_command: Callable[..., Result]) -> Result:
    """The result of a flight through the room without images."""
    out = tmp_path_factory.mktemp("explore") / "room"
    return run_command(out, "explore", *WORDS, "--pilot.limits.speed-m-s", SPEED_M_S, "--out", out, "--json")


def entities(path: Path) -> set[str]:
    """Return the paths of the entities of a rerun file."""
    return {chunk.entity_path.strip("/") for chunk in RrdReader(path).stream()}


def test_the_folder_has_the_files_of_a_run(flown: Result) -> None:
    assert {path.name for path in flown.folder.iterdir()} == FILES
    assert flown.document["run"] == str(flown.folder)
    report = json.loads((flown.folder / "report.json").read_text(encoding="utf-8"))
    assert report["format"] == "dronevio-exploration-report/1"
    assert {name: report[name] for name in flown.document if name != "run"} == {
        name: value for name, value in flown.document.items() if name != "run"
    }


def test_figures_agree_with_the_true_path(flown: Result) -> None:
    """The IMU is within 0.1 m of the centre of mass, to which the figures refer."""
    d, truth = flown.document, read_tum(flown.folder / "groundtruth.tum")
    assert d["outcome"] == "reached" and d["collided"] is False and d["outcome_text"] == "reached the goal"
    assert d["goal_m"] == list(GOAL_M) and d["distance_to_goal_m"] < 0.5
    assert d["distance_to_goal_m"] == pytest.approx(np.linalg.norm(truth.p_world_imu[-1] - GOAL_M), abs=0.1)
    assert d["time_s"] == pytest.approx(float(truth.t_ns[-1]) * 1e-9)
    above_pad = np.array(d["pad_m"]) + [0.0, 0.0, 1.2]
    assert np.linalg.norm(np.subtract(GOAL_M, above_pad)) - 0.5 <= d["shortest_m"] <= d["path_m"] + 0.5
    assert d["path_m"] < truth.length_m and 0.05 < d["covered_share"] < 1.0 and 0.0 < d["ate_m"] < 0.1
    assert truth.p_world_imu[0, :2] == pytest.approx(d["pad_m"][:2], abs=0.15)


def test_decisions_are_in_the_order_of_time_and_on_the_path(flown: Result) -> None:
    truth, decisions = read_tum(flown.folder / "groundtruth.tum"), flown.document["decisions"]
    times = [each["t_s"] for each in decisions]
    assert times == sorted(times) and decisions[-1]["what"] == "reached" and len(decisions) > 1
    for each in decisions:
        row = np.searchsorted(truth.t_ns, each["t_s"] * 1e9)
        assert np.linalg.norm(truth.p_world_imu[row] - each["position_m"]) < 0.4


def test_costs_stand_beside_the_declared_latencies(flown: Result) -> None:
    costs = flown.document["costs"]
    assert [costs[name]["latency_ms"] for name in ("depth", "map", "plan")] == [40.0, 10.0, 200.0]
    stages = [costs[name] for name in ("depth", "map", "plan")]
    assert all(0.0 < cost["cpu_ms_mean"] < cost["cpu_ms_p99"] for cost in stages)
    stages_s = 1e-3 * flown.document["plans"] * costs["plan"]["cpu_ms_mean"]
    assert costs["flight"]["cpu_per_s"] > stages_s / flown.document["time_s"]


def test_settings_arrive_and_are_stored(flown: Result) -> None:
    configuration = json.loads((flown.folder / "configuration.json").read_text(encoding="utf-8"))
    assert configuration["pilot"]["limits"]["speed_m_s"] == SPEED_M_S and configuration["images"] is False
    truth = read_tum(flown.folder / "groundtruth.tum")
    step_s = np.diff(truth.t_ns[::20]) * 1e-9
    speed = np.linalg.norm(np.diff(truth.p_world_imu[::20], axis=0), axis=1) / step_s
    assert 0.5 < speed.max() < 1.1 * SPEED_M_S


def test_what_was_flown_through_is_free_in_the_map(flown: Result) -> None:
    grid, truth = read_occupancy(flown.folder / "occupancy.npz"), read_tum(flown.folder / "groundtruth.tum")
    # The column of the take-off is declared free, and the cameras see nothing within half a metre.
    away = np.linalg.norm((truth.p_world_imu - flown.document["pad_m"])[:, :2], axis=1) > 1.2
    states = grid.at(truth.p_world_imu[away])
    assert len(states) > 100 and np.mean(states == FREE) > 0.95 and not np.any(states == OCCUPIED)


def test_the_report_shows_what_was_flown(flown: Result) -> None:
    page = (flown.folder / "report.html").read_text(encoding="utf-8")
    for title in (
        "The map at the height of the flight",
        "Height over time",
        "Speed over time",
        "Distance to the goal over time",
        "Error of the estimated position over time",
    ):
        assert f'aria-label="{title}' in page
    assert "The drone reached the goal." in page and "declared latency [ms]" in page
    assert f"dronevio view {flown.folder}" in page
    assert f"dronevio explore {' '.join(WORDS)} --pilot.limits.speed-m-s {SPEED_M_S}" in page
    assert all(f"{each['t_s']:.2f}" in page for each in flown.document["decisions"])


def test_the_rerun_file_can_be_read_back(flown: Result) -> None:
    rows: dict[str, int] = {}
    for chunk in RrdReader(flown.folder / "run.rrd").stream():
        name = chunk.entity_path.strip("/")
        if "time" in chunk.timeline_names:
            rows[name] = rows.get(name, 0) + chunk.to_record_batch().num_rows
    assert rows[PLAN] == rows[ROUTE] == flown.document["plans"]
    assert rows[DECISIONS] == len(flown.document["decisions"])
    assert rows["depth"] == pytest.approx(10.0 * flown.document["time_s"], abs=3) and rows[TRUE_PATH_SO_FAR] > 500
    found = entities(flown.folder / "run.rrd")
    assert {TRUTH, GOAL, "world/camera", "world/path_so_far", "world/submaps/0/cells"} <= found
    assert any(name.startswith(f"{TRUTH}/surroundings/surface") for name in found)


@pytest.fixture(scope="module")
def again() -> dv.Exploration:
    """The same flight from Python."""
    default = dv.ExploreSettings()
    settings = replace(default, limits=replace(default.limits, speed_m_s=SPEED_M_S))
    return dv.explore("room", GOAL_M, longest_s=20.0, settings=settings, without_images=RaySensing())


def test_the_same_arguments_give_the_same_flight(flown: Result, again: dv.Exploration) -> None:
    assert again.settings.limits.speed_m_s == SPEED_M_S and not again.true_pose and again.waited_ns == 0
    truth = read_tum(flown.folder / "groundtruth.tum")
    assert truth.p_world_imu.tobytes() == again.flight.truth.p_world_imu.tobytes()
    estimate = read_tum(flown.folder / "estimate.tum")
    assert estimate.p_world_imu.tobytes() == again.run.trajectory.p_world_imu.tobytes()
    flight = explored_flight(again)
    now, before = document(again, flight), flown.document
    assert all(now[name] == before[name] for name in now if name != "costs")
    assert flight.speed_limit_m_s == SPEED_M_S and flight.heights_m == (0.5, 2.0)
    # Plans begin on the path that was flown, and their times are those of the flight.
    for plan in flight.plans:
        row = np.searchsorted(flight.truth.t_ns, plan.t_ns)
        assert np.linalg.norm(flight.truth.p_world_imu[row] - plan.positions_m[0]) < 0.4


@pytest.mark.skipif(not PAGE.is_file(), reason="not a checkout")
def test_the_example_of_the_page_prints_what_happened(
    again: dv.Exploration, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(dv, "explore", lambda world, seed: again)
    [code] = re.findall(r"^```py\n(.*?)^```$", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    exec(compile(code, PAGE.name, "exec"), {})
    shown = capsys.readouterr().out.splitlines()
    assert shown[0].startswith("reached 0.") and len(shown) == 1 + len(again.decisions)


def test_a_collision_has_an_exit_code_of_its_own(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "crash"
    assert main(["explore", *WORDS, "--faults.rotor-fails-at-s", "4", "--out", str(out)]) == COLLIDED == 3
    shown = capsys.readouterr().out
    assert "the flight ended early: the drone crashed at t = 4." in shown and f"report:   {out}/report.html" in shown
    report = json.loads((out / "report.json").read_text(encoding="utf-8"))
    assert report["outcome"] == "collision" and report["collided"] and report["outcome_text"].startswith("crashed")
    assert report["plans"] == 0 and report["costs"]["plan"]["cpu_ms_p99"] is None
    # The result stays unless it may be replaced.
    assert main(["explore", *WORDS, "--out", str(out)]) == 2
    assert "--overwrite" in capsys.readouterr().err and (out / "report.json").is_file()


def test_a_path_that_does_not_exist_is_null(tmp_path: Path, run_command: Callable[..., Result]) -> None:
    out = tmp_path / "outside"
    goal = ("--goal", "500", "0", "1")
    words = ("--scenario", "room", "--no-images", "--time-s", "1", *goal)
    found = run_command(out, "explore", *words, "--out", out, "--json").document
    assert found["outcome"] == "timeout" and found["shortest_m"] is None and found["time_s"] == 1.0
    assert "no path on the true map" in (out / "report.html").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--scenario", "nowhere"], "'nowhere' to explore; expected a scenario or one of the worlds room"),
        (["--goal", "nan", "0", "1"], "--goal"),
        (["--goal", "1", "2"], "--goal 1.0 2.0; expected three numbers, x, y and z"),
        (["--time-s", "0"], "--time-s 0.0; expected a number, 1 to 3600"),
        (["--rig", "nothing"], "unknown rig 'nothing'"),
        (["--pilot.limits.speed-m-s", "-1"], "--pilot.limits.speed-m-s -1.0; expected a number"),
        (["--set", "pilot.nothing=1"], "--set pilot.nothing: no such setting"),
    ],
)
def test_wrong_words_are_one_line(words: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["explore", "--no-images", *words]) == 2
    captured = capsys.readouterr()
    assert captured.out == "" and captured.err.count("\n") == 1 and captured.err.startswith(f"dronevio: {message}")


def test_every_outcome_has_words() -> None:
    assert set(OUTCOMES) == set(get_args(Outcome))


def test_the_repeating_command_has_no_options_of_output() -> None:
    words = ["--seed", "3", "--out", "a b", "--json", "--live", "--out=c", "--goal", "1", "2", "3", "--overwrite"]
    assert repeating_command(words) == "dronevio explore --seed 3 --goal 1 2 3"


@pytest.mark.slow
def test_the_page_in_a_browser(flown: Result, browser: Browser) -> None:
    assert browser.faults((flown.folder / "report.html").as_uri()) == []


@pytest.mark.slow
def test_a_flight_with_images(tmp_path: Path, run_command: Callable[..., Result]) -> None:
    """On the estimate of visual SLAM, whose published poses in the map are a file of their own."""
    out, words = tmp_path / "images", [word for word in WORDS if word != "--no-images"]
    d = run_command(out, "explore", *words, "--out", out, "--json").document
    assert d["outcome"] == "reached" and d["distance_to_goal_m"] < 0.5 and d["ate_m"] < 0.05
    assert {path.name for path in out.iterdir()} == FILES | {"estimate_map.tum"}
    assert len(read_tum(out / "estimate_map.tum")) > 200
    assert "world/camera/image" in entities(out / "run.rrd")


def test_coverage_has_no_goal_and_grows(tmp_path: Path, run_command: Callable[..., Result]) -> None:
    out = tmp_path / "room"
    words = (
        "explore",
        "--scenario",
        "room",
        "--task",
        "cover",
        "--no-images",
        "--time-s",
        "24",
        "--out",
        out,
        "--json",
    )
    d = run_command(out, *words).document
    assert d["goal_m"] is None and d["distance_to_goal_m"] is None and d["shortest_m"] is None
    assert d["outcome"] in ("covered", "timeout") and not d["collided"]
    times, shares = np.array(d["coverage"]).T
    assert np.all(np.diff(times) >= 0.99) and shares[-1] > shares[np.searchsorted(times, 14.0)] > 0.0
    assert d["covered_share"] == pytest.approx(shares[-1], abs=0.05)
    assert "turn to the view" not in [each["what"] for each in d["decisions"]]  # views are taken in passing
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "Coverage over time" in page and "Distance to the goal" not in page


def test_a_goal_is_refused_for_coverage(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["explore", "--task", "cover", "--goal", "1", "2", "3"]) == 2
    assert "--goal with --task cover" in capsys.readouterr().err
