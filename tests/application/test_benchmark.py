"""``dronevio benchmark``, ``compare`` and ``gate`` for real: programs that crash, hang and lie, kills and going on."""

import json
import re
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import psutil
import pytest

from dronevio.benchmark_jobs import Workbench, recorded_flights, scenario_flights, versions
from dronevio.cli import main
from dronevio.eval.benchmark.ray_engine import RayEngine
from dronevio.eval.benchmark.rows import Row, read_rows, write_rows
from dronevio.eval.benchmark.runner import BenchmarkPlan, run_benchmark
from dronevio.eval.benchmark.store import ResultStore
from dronevio.models.errors import ConfigError, EvaluationError, InputError
from dronevio.models.rig_presets import rig_named
from dronevio.registry import ESTIMATORS, estimator_named

Result = Any  # the class of conftest, which cannot be imported
CommandRunner = Callable[..., Result]

PROGRAM = '''
"""Stands in for somebody's estimator: a bit off the truth, which the test, not the benchmark, tells it."""
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


@pytest.mark.slow
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
        assert row.wall_s > 0.0
        assert len({row.recording_hash, row.config_hash, row.versions}) == 3
        assert row.status == "ok" or (row.ate_m is None and row.cpu_ms_mean is None)
    printed = json.loads(json.dumps([vars(row) for row in read_rows(many.folder) if row.estimator != "hang"]))
    assert many.document["rows"] == printed


@pytest.mark.slow
def test_the_numbers_are_those_of_the_other_commands(
    many: Result, flown: Result, place: Path, run_command: CommandRunner
) -> None:
    row = by_estimator(many.folder)["vio"]
    estimate = place / "estimate.tum"
    run_command(place, "estimate", flown.folder, "--out", estimate, "--json")
    scores = run_command(place, "evaluate", flown.folder, estimate, "--json").document
    for name in ("ate_m", "ate_deg", "rpe_m", "rpe_deg"):
        assert getattr(row, name) == pytest.approx(scores[name]["rmse"], rel=1e-4, abs=1e-6)
    assert row.coverage_percent == scores["coverage_percent"] == 100.0
    assert len(row.sub_trajectory_m) == len(row.sub_trajectory_rpe_m) == len(row.sub_trajectory_rpe_deg) == 5
    assert None not in (row.nees_position, row.velocity_m_s, row.cpu_ms_p99, row.real_time_factor, row.drift_percent)


@pytest.mark.slow
def test_dead_reckoning_is_worse_than_vio_and_the_truth_is_exact(many: Result) -> None:
    rows = by_estimator(many.folder)
    exact = rows["1.0"].ate_m
    assert exact is not None
    assert exact < 1e-6
    assert rows["1.0"].cpu_ms_p99 is None  # of a program only the whole is known
    assert 3.0 * (rows["vio"].ate_m or 1.0) < (rows["dead-reckoning"].ate_m or 0.0) < 1.0
    assert (rows["dead-reckoning"].first_pose_s or 9.0) < 1.5


@pytest.mark.slow
def test_programs_see_what_was_sensed_and_no_truth(many: Result, place: Path, flown: Result) -> None:
    assert (flown.folder / "mav0" / "state_groundtruth_estimate0").exists()
    for _, _, *shown in notes(place):
        assert shown == ["body.yaml", "cam0", "imu0"]


@pytest.mark.slow
def test_nothing_that_hung_goes_on(many: Result, place: Path) -> None:
    assert wait_until(lambda: not any(alive(pid) for how, pid, *_ in notes(place) if how == "hang"))


@pytest.mark.slow
def test_done_runs_are_not_done_again_and_failures_are_listed(
    many: Result, place: Path, flown: Result, external: Callable[[str, str], str], capsys: pytest.CaptureFixture[str]
) -> None:
    before, started = (many.folder / "results.parquet").read_bytes(), len(notes(place))
    named = [external(how, how) for how in ("1.0", "segfault")]
    assert (
        main(["benchmark", "--recordings", str(flown.folder), "--estimators", *named, "--out", str(many.folder)]) == 0
    )
    shown = capsys.readouterr().out
    assert "1 of 2 runs failed" in shown
    assert "segfault: crashed" in shown
    assert len(notes(place)) == started
    assert (many.folder / "results.parquet").read_bytes() == before


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
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


def test_gate_without_a_baseline_checks_expected_outcomes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    clean = Row("room-v0", "room", 0, "vio", "c", "v", "ok", ate_m=0.01, longest_loss_s=0.0, tracking_sigmas=2.0)
    drops = replace(clean, scenario="room-drops-v0", ate_m=0.039)
    results = tmp_path / "results.parquet"
    write_rows(results, [clean, drops])
    assert main(["gate", str(results)]) == 0
    assert "gate passed: 2 of 2 runs as expected" in capsys.readouterr().out
    write_rows(results, [clean, replace(drops, ate_m=0.041)])
    assert main(["gate", str(results), "--json"]) == 1
    (violation,) = json.loads(capsys.readouterr().out)["violations"]
    assert violation == "room-drops-v0, seed 0, vio: error 4.1 ×; expected: error ≤ 4 ×"
    assert main(["report", str(results), "--format", "markdown"]) == 0
    assert "not as expected" in capsys.readouterr().out
    write_rows(results, [clean])
    assert main(["gate", str(results)]) == 2
    assert "no run with an expected outcome" in capsys.readouterr().err


def test_gates_that_cannot_be_judged_are_bad_input(
    many: Result, place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    results = str(many.folder)
    assert main(["gate", results, "--baseline", str(place / "nowhere.parquet")]) == 2
    assert main(["gate", results, "--baseline", results, "--max-regression", "little"]) == 2
    assert main(["gate", results, "--baseline", results, "--metrics", "beauty"]) == 2
    assert main(["compare", results, results, "--estimators", "vio", "nobody"]) == 2
    errors = capsys.readouterr().err.splitlines()
    assert len(errors) == 4
    assert all(error.startswith("dronevio: ") and "; expected " in error for error in errors)
    assert main(["compare", results, results, "--estimators", "dead-reckoning", "vio"]) == 0
    assert "vio against dead-reckoning: ate_m" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "no flights; expected --suite, --scenarios or --recordings"),
        (["--suite", "moon"], "unknown suite 'moon'; expected one of room"),
        (["--scenarios", "moon"], "unknown scenario 'moon'"),
        (["--scenarios", "short", "--estimators", "oracle"], "unknown estimator 'oracle'; expected one of vio"),
        (["--scenarios", "short", "--estimators", "vio,vio"], "each name once"),
        (["--scenarios", "short", "--seeds", "0"], "--seeds 0; expected"),
        (["--scenarios", "short", "--workers", "0"], "--workers 0; expected"),
        (["--scenarios", "short", "--timeout-s", "nan"], "--timeout-s nan; expected"),
        (["--scenarios", "short", "--address", "auto"], "expected --engine ray"),
        (["--recordings", "nowhere"], "nowhere: no such file"),
        (
            ["--scenarios", "short", "--variants", "imu-1hz"],
            "unknown variant 'imu-1hz'; expected one of as-is, rig=…, imu-100",
        ),
        (["--scenarios", "short", "--variants", "reverse=1"], "unknown variant 'reverse=1'; expected one of as-is"),
        (["--scenarios", "short", "--variants", "as-is+reverse"], "unknown variant 'as-is'; expected one of as-is"),
        (["--scenarios", "short", "--variants", "world=-1"], "seed '-1' in a variant; expected a whole number from 0"),
        (["--scenarios", "short", "--variants", "light="], "seed '' in a variant; expected a whole number from 0"),
        (["--scenarios", "short", "--variants", "world=4294967296"], "from 0 to 4294967295"),
        (["--scenarios", "short", "--variants", "light=1+light=2"], "with light=1 and light=2; expected one of them"),
        (["--scenarios", "short", "--variants", "noise-2x+noise-half"], "with noise-2x and noise-half; expected one"),
        (["--scenarios", "short", "--variants", "reverse", "reverse"], "variant reverse twice; expected each once"),
        (["--scenarios", "short", "--variants", "light=1+world=2", "world=2+light=1"], "variant world=2+light=1 twice"),
        (["--scenarios", "short", "--variants", "rig=moon"], "moon"),
        (["--recordings", "nowhere", "--variants", "noise-2x"], "a recording has no variants"),
    ],
)
def test_nonsense_is_refused(
    arguments: Sequence[str], message: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert main(["benchmark", *arguments, "--out", str(tmp_path / "out")]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_estimators_are_named_or_commands() -> None:
    assert all(estimator_named(name).label == name for name in ESTIMATORS)
    mine = estimator_named("mine=external:run --in={recording} --out '{output} x'")
    assert mine.label == "mine"
    assert mine.settings() == {"command": ["run", "--in={recording}", "--out", "{output} x"]}
    with pytest.raises(ConfigError, match=r"without .output.; expected a command"):
        estimator_named("external:run {recording}")
    with pytest.raises(ConfigError, match="No closing quotation"):
        estimator_named("external:run '{recording} {output}")


def test_missing_programs_are_reported(flown: Result) -> None:
    with pytest.raises(ConfigError, match="no-such-program: No such file"):
        estimator_named("external:no-such-program {recording} {output}").run(flown.folder)
    with pytest.raises((EvaluationError, InputError), match=r"estimate\.tum: no such file"):
        estimator_named("external:true {recording} {output}").run(flown.folder)


def test_the_hash_depends_on_what_is_recorded_not_on_its_name(flown: Result, tmp_path: Path) -> None:
    flights = scenario_flights(["short", "short-v0", "hover"], range(2))
    assert [(flight.scenario, flight.seed) for flight in flights] == [
        ("short-v0", 0),
        ("hover-v0", 0),
        ("short-v0", 1),
        ("hover-v0", 1),
    ]
    assert len({flight.recording_hash for flight in flights}) == 4
    (one,) = recorded_flights([flown.folder])
    assert recorded_flights([flown.folder / "mav0"]) == (one,)
    link = tmp_path / "elsewhere" / flown.folder.name
    link.parent.mkdir()
    link.symlink_to(flown.folder)
    with pytest.raises(ConfigError, match="both named"):
        recorded_flights([flown.folder, link])


def test_variants_are_other_recordings_with_names_of_their_own() -> None:
    names = ("as-is", "imu-100hz", "imu-400hz", "noise-2x", "noise-half", "rig=fisheye")
    flights = scenario_flights(["short"], range(1), variants=names)
    assert [flight.scenario for flight in flights] == ["short-v0", *(f"short-v0+{name}" for name in names[1:])]
    assert flights[0] == scenario_flights(["short"], range(1))[0]
    assert len({flight.recording_hash for flight in flights}) == len(names)
    sources = [flight.source for flight in flights]
    assert [each.rig.imu.rate_hz for each in sources[:3]] == [200.0, 100.0, 400.0]  # type: ignore[attr-defined]
    assert [each.faults.imu_noise_factor for each in sources[3:5]] == [2.0, 0.5]  # type: ignore[attr-defined]
    for name in ("rig=fisheye", "reverse+rig=fisheye"):
        with pytest.raises(ConfigError, match=rf"--rig euroc-stereo with the variant {re.escape(name)}"):
            scenario_flights(["short"], range(1), "euroc-stereo", [name])


def test_a_world_is_flown_again_under_other_light_and_in_reverse() -> None:
    """The names of rows state world, light and direction, whatever the order on the command line, and so does the key
    of the cached recording."""
    names = ("world=3", "world=4", "world=3+light=3", "light=3", "world=3+light=4+reverse", "reverse")
    flights = scenario_flights(["short"], (0, 1), variants=[*names[:4], "reverse+light=4+world=3", "reverse"])
    assert [flight.scenario for flight in flights] == [f"short-v0+{name}" for name in names] * 2
    assert len({flight.recording_hash for flight in flights}) == len(flights)
    sources: list[Any] = [flight.source for flight in flights]
    found = [(each.seed_of_world, each.light_seed, each.reverse) for each in sources[6:]]
    assert found == [(3, None, False), (4, None, False), (3, 3, False), (1, 3, False), (3, 4, True), (1, None, True)]
    assert [each.seed for each in sources] == [0] * 6 + [1] * 6


def test_the_rate_of_the_imu_is_that_of_the_other_rig() -> None:
    (flight,) = scenario_flights(["short"], range(1), variants=["imu-400hz+rig=fisheye"])
    source: Any = flight.source
    assert flight.scenario == "short-v0+rig=fisheye+imu-400hz"
    assert source.rig.imu == replace(rig_named("fisheye").imu, rate_hz=400.0)
    assert source.rig.cameras[0].model == rig_named("fisheye").cameras[0].model


def test_a_missing_recording_is_named_as_it_was_given(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=r"^nowhere: no such file or folder"):
        recorded_flights([Path("nowhere")])
    (tmp_path / "empty" / "mav0").mkdir(parents=True)
    with pytest.raises(InputError, match=r"^empty\b"):
        recorded_flights([Path("empty/mav0")])


@pytest.mark.slow
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
        assert (row.status, row.ate_m, row.dependencies) == ("ok", same.ate_m, same.dependencies)
    assert listening
    assert {address.removeprefix("::ffff:") for address in listening} == {"127.0.0.1"}


def test_without_ray_its_engine_says_what_to_install(
    flown: Result, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    arguments = ["--recordings", str(flown.folder), "--engine", "ray", "--out", str(tmp_path)]
    assert main(["benchmark", *arguments]) == 2
    assert "pip install 'dronevio[ray]'" in capsys.readouterr().err


def alive(pid: str) -> bool:
    """Whether a process runs; a zombie that nobody has buried yet does not."""
    try:
        return bool(psutil.Process(int(pid)).status() != psutil.STATUS_ZOMBIE)
    except psutil.NoSuchProcess:
        return False


def wait_until(condition: Callable[[], bool], within_s: float = 60.0) -> bool:
    deadline = time.perf_counter() + within_s
    while not condition() and time.perf_counter() < deadline:
        time.sleep(0.05)
    return condition()
