"""Runs of ``dronevio benchmark``, ``compare`` and ``gate``, with programs that crash, hang or write nonsense."""

import json
import subprocess
import sys
import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import psutil
import pytest

from dronevio.benchmark.jobs import Workbench, recorded_flights, versions
from dronevio.cli import main
from dronevio.estimators.registry import ESTIMATORS, estimator_named
from dronevio.eval.benchmark.ray_engine import RayEngine
from dronevio.eval.benchmark.rows import Row, read_rows
from dronevio.eval.benchmark.runner import BenchmarkPlan, run_benchmark
from dronevio.eval.benchmark.store import ResultStore

pytestmark = pytest.mark.slow
Result = Any  # the class of conftest, which cannot be imported
CommandRunner = Callable[..., Result]

PROGRAM = '''
"""An external estimator: the truth with an error of scale; its file is named by the test, not by the benchmark."""
import os, pathlib, sys, time

how, notes, truth, recording, output = sys.argv[1:]
recording = pathlib.Path(recording)
with open(notes, "a") as stream:
    print(how, os.getpid(), *sorted(entry.name for entry in (recording / "mav0").iterdir()), file=stream, flush=True)
if how == "segfault":
    print("about to die", file=sys.stderr, flush=True)
    os.kill(os.getpid(), 11)
if how == "refuse":
    sys.exit("no licence")
if how == "hang" and not pathlib.Path(notes + ".free").exists():
    time.sleep(60)
assert (recording / "mav0" / "cam0" / "data.csv").read_text().startswith("#")
with open(output, "w") as stream:
    for line in pathlib.Path(truth, "mav0", "state_groundtruth_estimate0", "data.csv").read_text().splitlines()[1:]:
        t, x, y, z, qw, qx, qy, qz = line.split(",")[:8]
        scale = float(how) if how[0].isdigit() else 1.0
        print(int(t) * 1e-9, scale * float(x), scale * float(y), scale * float(z), qx, qy, qz, qw, file=stream)
if how == "lie":
    pathlib.Path(output).write_text("all is well")
'''


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the results of this module lie."""
    return tmp_path_factory.mktemp("benchmarks")


@pytest.fixture(scope="module")
def external(place: Path, flown: Result) -> Callable[[str, str], str]:
    """Makes an estimator of the program that behaves in a certain way, under a label."""
    program = place / "program.py"
    program.write_text(PROGRAM)

    def named(label: str, how: str) -> str:
        words = (sys.executable, str(program), how, str(place / "notes"), str(flown.folder))
        return f"{label}=external:{' '.join(words)} {{recording}} {{output}}"

    return named


@pytest.fixture(scope="module")
def many(place: Path, flown: Result, external: Callable[[str, str], str], run_command: CommandRunner) -> Result:
    """One flight and every kind of estimator; in two commands, as only one of them has to wait for the time to pass."""
    named = [external(how, how) for how in ("1.0", "segfault", "refuse", "lie")]
    common = ("--recordings", flown.folder, "--out", place / "many", "--workers", "2", "--json")
    first = run_command(place / "many", "benchmark", "--estimators", "vio,dead-reckoning", *named, *common)
    run_command(place / "many", "benchmark", "--estimators", external("hang", "hang"), *common, "--timeout-s", "3")
    return first


def by_estimator(folder: Path) -> dict[str, Row]:
    return {row.estimator: row for row in read_rows(folder)}


def notes(place: Path) -> list[list[str]]:
    """What the programs wrote when they were started: how they behave, their process, what they were shown."""
    written = place / "notes"
    return [line.split() for line in written.read_text().splitlines()] if written.exists() else []


def test_every_run_is_a_row_however_it_ended(many: Result) -> None:
    rows = by_estimator(many.folder)
    assert {name: row.status for name, row in rows.items()} == {
        "vio": "ok",
        "dead-reckoning": "ok",
        "1.0": "ok",
        "segfault": "crashed",
        "refuse": "failed",
        "hang": "timeout",
        "lie": "failed",
    }
    assert rows["segfault"].reason.endswith("killed by SIGSEGV: about to die")
    assert rows["refuse"].reason.endswith("ended with code 1: no licence")
    assert rows["hang"].reason == "not finished after 3 s"
    assert "estimate.tum:1: " in rows["lie"].reason
    for row in rows.values():
        assert (row.scenario, row.world, row.seed) == (rows["vio"].scenario, "", None)
        assert row.values["wall_s"] > 0.0
        assert len({row.recording_hash, row.config_hash, row.versions}) == 3
        assert row.status == "ok" or (row["ate_m"] is None and row["cpu_ms_mean"] is None)
    printed = json.loads(json.dumps([row.columns for row in read_rows(many.folder) if row.estimator != "hang"]))
    assert many.document["rows"] == printed


def test_the_numbers_are_those_of_the_other_commands(
    many: Result, flown: Result, place: Path, run_command: CommandRunner
) -> None:
    row = by_estimator(many.folder)["vio"]
    estimate = place / "estimate.tum"
    run_command(place, "estimate", flown.folder, "--out", estimate, "--json")
    scores = run_command(place, "evaluate", flown.folder, estimate, "--json").document
    for name in ("ate_m", "ate_deg", "rpe_m", "rpe_deg"):
        assert row[name] == pytest.approx(scores[name]["rmse"], rel=1e-4, abs=1e-6)
    assert row["coverage_percent"] == scores["coverage_percent"] == 100.0
    assert len(row.sub_trajectory_m) == len(row.sub_trajectory_rpe_m) == len(row.sub_trajectory_rpe_deg) == 5
    assert None not in (
        row["nees_position"],
        row["velocity_m_s"],
        row["cpu_ms_p99"],
        row["real_time_factor"],
        row["drift_percent"],
    )


def test_dead_reckoning_is_worse_than_vio_and_the_truth_is_exact(many: Result) -> None:
    rows = by_estimator(many.folder)
    exact = rows["1.0"]["ate_m"]
    assert exact is not None
    assert exact < 1e-6
    assert rows["1.0"]["cpu_ms_p99"] is None  # of a program only the whole is known
    assert 3.0 * (rows["vio"]["ate_m"] or 1.0) < (rows["dead-reckoning"]["ate_m"] or 0.0) < 1.0
    assert (rows["dead-reckoning"]["first_pose_s"] or 9.0) < 1.5


def test_programs_see_what_was_sensed_and_no_truth(many: Result, place: Path, flown: Result) -> None:
    assert (flown.folder / "mav0" / "state_groundtruth_estimate0").exists()
    for _, _, *shown in notes(place):
        assert shown == ["body.yaml", "cam0", "imu0"]


def test_nothing_that_hung_goes_on(many: Result, place: Path) -> None:
    assert wait_until(lambda: not any(alive(pid) for how, pid, *_ in notes(place) if how == "hang"))


def test_done_runs_are_not_done_again_and_failures_are_listed(
    many: Result, place: Path, flown: Result, external: Callable[[str, str], str], capsys: pytest.CaptureFixture[str]
) -> None:
    before, started = (many.folder / "results.parquet").read_bytes(), len(notes(place))
    named = [external(how, how) for how in ("1.0", "segfault")]
    assert (
        main(["benchmark", "--recordings", str(flown.folder), "--estimators", *named, "--out", str(many.folder)]) == 0
    )
    shown = capsys.readouterr().out
    assert "1 of 2 runs failed (--retry repeats them):" in shown
    assert "segfault: crashed" in shown
    assert len(notes(place)) == started
    assert (many.folder / "results.parquet").read_bytes() == before


def test_killed_in_the_middle_it_goes_on_with_what_is_missing(
    place: Path, flown: Result, external: Callable[[str, str], str]
) -> None:
    folder, first = place / "killed", len(notes(place))
    words = ["--recordings", str(flown.folder), "--estimators", external("a", "1.0"), external("b", "hang")]
    command = ["benchmark", *words, "--out", str(folder), "--workers", "1"]
    process = subprocess.Popen([sys.executable, "-m", "dronevio.cli", *command], stderr=subprocess.DEVNULL)
    wait_until(lambda: any(how == "hang" for how, *_ in notes(place)[first:]) and any(folder.glob("runs/*.parquet")))
    process.kill()
    process.wait()
    hung = [pid for how, pid, *_ in notes(place)[first:] if how == "hang"]
    assert wait_until(lambda: not any(alive(pid) for pid in hung))
    (place / "notes.free").touch()
    assert main(command) == 0
    (place / "notes.free").unlink()
    assert {name: row.status for name, row in by_estimator(folder).items()} == {"a": "ok", "b": "ok"}
    assert [how for how, *_ in notes(place)[first:]] == ["1.0", "hang", "hang"]


def test_scenarios_are_flown_once_and_kept(place: Path, flown: Result, run_command: CommandRunner) -> None:
    cache, common = place / "cache", ["--scenarios", "short", "--seeds", "1"]
    where = ["--cache", cache, "--out", place / "flown", "--json"]
    (first,) = run_command(place, "benchmark", *common, *where, "--estimators", "dead-reckoning").document["rows"]
    assert (first["scenario"], first["world"], first["seed"], first["status"]) == ("short-v0", "room", 0, "ok")
    (kept,) = [entry for entry in cache.iterdir() if entry.is_dir()]
    assert kept.name == first["recording_hash"]
    for file in flown.folder.rglob("*.png"):
        assert (kept / file.relative_to(flown.folder)).read_bytes() == file.read_bytes()
    drawn = {file: file.stat().st_mtime_ns for file in kept.rglob("*.png")}
    sized = run_command(place, "benchmark", *common, *where, "--sizing", "--estimators", "dead-reckoning").document
    assert {file: file.stat().st_mtime_ns for file in kept.rglob("*.png")} == drawn
    one = sized["measured"]["recording"]
    assert one["cpu_s"] > 1.0
    assert one["disk_mb"] == pytest.approx(sum(f.stat().st_size for f in kept.rglob("*") if f.is_file()) * 1e-6, 0.01)
    parts = {part["work"]: part for part in sized["scaled"]}
    assert parts["recordings"]["cpu_hours"] == pytest.approx(one["cpu_s"] * 1e4 / 3600)
    assert parts["all"]["cpu_hours"] > parts["recordings"]["cpu_hours"]


def test_compare_and_gate(
    place: Path,
    flown: Result,
    external: Callable[[str, str], str],
    run_command: CommandRunner,
    capsys: pytest.CaptureFixture[str],
) -> None:
    folders = [place / name for name in ("baseline", "same", "worse", "crash")]
    for folder, how in zip(folders, ("1.10", "1.1", "1.2", "segfault"), strict=True):
        estimators = ["--estimators", external("mine", how)]
        run_command(folder, "benchmark", "--recordings", flown.folder, *estimators, "--out", folder, "--json")
    baseline, same, worse, crash = map(str, folders)
    assert main(["gate", same, "--baseline", f"{baseline}/results.parquet", "--max-regression", "5%"]) == 0
    assert "gate passed" in capsys.readouterr().out
    assert main(["gate", worse, "--baseline", baseline]) == 1
    assert "failed: mine: ate_m" in capsys.readouterr().out
    assert main(["gate", crash, "--baseline", baseline, "--json"]) == 1
    result = json.loads(capsys.readouterr().out)
    assert result["violations"][-2:] == [
        "mine: 1 of 1 runs failed, 0 before",
        "mine: mean coverage 0.0 %, 100.0 % before",
    ]
    assert result["comparisons"][0]["ratios"][0]["median"] == "inf"
    assert main(["gate", baseline, "--baseline", crash]) == 0
    capsys.readouterr()
    assert main(["compare", baseline, worse]) == 0
    assert "pairs are too few for a test of significance" in capsys.readouterr().out


def test_ray_gives_the_same_rows_and_listens_on_localhost_only(place: Path, flown: Result, many: Result) -> None:
    if find_spec("ray") is None:  # not importorskip: where Ray listens is settled when it is imported, by the engine
        pytest.skip("Ray is not installed")
    named = tuple(estimator_named(name) for name in ("vio", "dead-reckoning"))
    work = BenchmarkPlan(
        recorded_flights([flown.folder]), tuple(ESTIMATORS), Workbench(named, versions()), place / "cache", 100.0
    )
    listening: set[str] = set()

    def heard(done: int, total: int, row: Row | None) -> None:
        for process in psutil.Process().children(recursive=True):
            listening.update(c.laddr.ip for c in process.net_connections() if c.status == psutil.CONN_LISTEN)

    there, here = (
        run_benchmark(work, ResultStore(place / "ray"), RayEngine(workers=2), heard),
        by_estimator(many.folder),
    )
    assert len(there) == 2
    for row in there:
        same = here[row.estimator]
        assert (row.status, row["ate_m"], row.dependencies) == ("ok", same["ate_m"], same.dependencies)
    assert listening
    assert {address.removeprefix("::ffff:") for address in listening} == {"127.0.0.1"}


def alive(pid: str) -> bool:
    """Whether a process runs; a zombie process does not."""
    try:
        return bool(psutil.Process(int(pid)).status() != psutil.STATUS_ZOMBIE)
    except psutil.NoSuchProcess:
        return False


def wait_until(condition: Callable[[], bool], within_s: float = 60.0) -> bool:
    deadline = time.perf_counter() + within_s
    while not condition() and time.perf_counter() < deadline:
        time.sleep(0.05)
    return condition()
