"""Benchmarks: isolated processes, cached recordings, tables of results, and resumed or failed runs."""

import fcntl
import math
import os
import platform
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import psutil
import pyarrow as pa
import pytest
from pyarrow import parquet

from dronevio.eval.benchmark.cache import RecordingCache, code_hash, content_hash, recording_hash
from dronevio.eval.benchmark.cache_limit import limit_bytes
from dronevio.eval.benchmark.engines import JobEnd, JobEvent, LocalEngine
from dronevio.eval.benchmark.isolation import Outcome, Status, call_in_process
from dronevio.eval.benchmark.jobs import Job, RecordingSpec
from dronevio.eval.benchmark.metrics import OwnMetric
from dronevio.eval.benchmark.rows import RESULTS_FILE, read_results, read_rows, schema, write_rows
from dronevio.eval.benchmark.runner import BenchmarkPlan, run_benchmark
from dronevio.eval.benchmark.store import ResultStore
from dronevio.eval.benchmark.summary import Quartiles, failed_runs, quartiles_of_errors, run_groups
from dronevio.models.errors import ConfigError, InputError
from tests.rows import changed, row_of

OK = row_of(
    "room-v0",
    "room",
    3,
    "vio",
    "config",
    "versions",
    "ok",
    ate_m=0.1,
    sub_trajectory_m=(1.0, 2.0),
    sub_trajectory_rpe_m=(0.1, 0.2),
    sub_trajectory_rpe_deg=(0.3, 0.4),
    wall_s=2.0,
    recording_hash="hash",
)
CRASHED = row_of("room-v0", "room", None, "a=b c", "config", "versions", "crashed", "killed by SIGSEGV", wall_s=1.0)


# --- processes


def test_an_isolated_call_returns_its_value_and_resources() -> None:
    outcome = call_in_process(math.hypot, 3.0, 4.0)
    assert (outcome.status, outcome.reason, outcome.value) == ("ok", "", 5.0)
    assert 0.0 < outcome.cpu_s < 10.0
    assert outcome.peak_mb is not None
    assert 5.0 < outcome.peak_mb < 300.0
    assert call_in_process(os.getpid).value != os.getpid()
    assert call_in_process(os.getenv, "COLOUR", environment={"COLOUR": "blue"}).value == "blue"


def test_exceptions_of_an_isolated_call_are_its_reason() -> None:
    outcome = call_in_process(math.sqrt, -1.0)
    assert (outcome.status, outcome.value) == ("failed", None)
    assert outcome.reason.startswith("a defect in dronevio: ValueError: ")  # no input should cause it
    full = call_in_process(os.listdir, "nowhere")
    assert (full.status, full.reason.split(":")[0]) == ("failed", "FileNotFoundError")
    missing = call_in_process(read_rows, Path("nowhere.parquet"))
    assert missing.status == "failed"
    assert missing.reason.startswith("nowhere.parquet: no such file; expected ")


def test_signals_and_exit_codes_are_reported_separately() -> None:
    killed = call_in_process(os.kill, 0, signal.SIGSEGV)  # 0 is the process group, of which it is the only member
    assert (killed.status, killed.reason.split(":")[:2]) == ("crashed", ["a defect in dronevio", " killed by SIGSEGV"])
    exited = call_in_process(os._exit, 7)
    assert (exited.status, exited.reason) == ("crashed", "a defect in dronevio: ended with code 7")


def test_a_timeout_kills_the_process_and_all_its_children(tmp_path: Path) -> None:
    pid_file = tmp_path / "pid"
    start_s = time.perf_counter()
    outcome = call_in_process(subprocess.check_call, ["sh", "-c", f"echo $$ > {pid_file}; sleep 60"], timeout_s=1.0)
    assert (outcome.status, outcome.reason) == ("timeout", "not finished after 1 s")
    assert time.perf_counter() - start_s < 20.0
    assert has_ended(int(pid_file.read_text()))


def test_printed_text_does_not_disturb_the_returned_value() -> None:
    assert call_in_process(subprocess.check_call, ["echo", "hello"]).value == 0


def test_processes_end_when_their_parent_is_killed(tmp_path: Path) -> None:
    pid_file = tmp_path / "pid"
    command = ["sh", "-c", f"echo $$ > {pid_file}; sleep 60"]
    script = (
        "import subprocess; from dronevio.eval.benchmark.isolation import call_in_process;"
        f" call_in_process(subprocess.check_call, {command!r})"
    )
    parent = subprocess.Popen([sys.executable, "-c", script])
    assert wait_until(lambda: pid_file.exists() and pid_file.read_text().endswith("\n"))
    parent.kill()
    parent.wait()
    assert has_ended(int(pid_file.read_text()))


def has_ended(pid: int, within_s: float = 20.0) -> bool:
    """Return whether a process ends in time; a zombie has ended."""

    def is_zombie_or_gone() -> bool:
        try:
            return bool(psutil.Process(pid).status() == psutil.STATUS_ZOMBIE)
        except psutil.NoSuchProcess:
            return True

    return wait_until(is_zombie_or_gone, within_s)


def wait_until(condition: Callable[[], bool], within_s: float = 20.0) -> bool:
    """Wait for a condition and return whether it holds in time."""
    deadline_s = time.perf_counter() + within_s
    while not condition() and time.perf_counter() < deadline_s:
        time.sleep(0.02)
    return condition()


# --- rows


def test_rows_are_read_as_they_were_written(tmp_path: Path) -> None:
    write_rows(tmp_path / RESULTS_FILE, [OK, CRASHED])
    assert read_rows(tmp_path) == (OK, CRASHED)
    assert read_rows(tmp_path / RESULTS_FILE) == read_results(tmp_path) == (OK, CRASHED)
    table = parquet.read_table(tmp_path / RESULTS_FILE)
    assert table.column_names == list(OK.columns) == schema().names
    assert table.column("ate_m").null_count == 1
    assert [entry.name for entry in tmp_path.iterdir()] == [RESULTS_FILE]


def test_metrics_of_the_user_are_stored_with_their_titles_and_units(tmp_path: Path) -> None:
    path = tmp_path / RESULTS_FILE
    metric = OwnMetric("Share of bends", "%", 1, "high", "python:mine:BENDS", counts_failed=False, code_hash="a")
    bends = replace(OK, own_metrics=(metric,), values={**OK.values, metric.name: 40.0})
    crashed = replace(CRASHED, own_metrics=(metric,))
    write_rows(path, [bends, crashed])
    assert read_rows(path) == (bends, crashed)
    assert [row[metric.name] for row in read_rows(path)] == [40.0, None]
    write_rows(path, [bends, CRASHED])  # of a run without the metric, it is not known
    assert read_rows(path) == (bends, crashed)
    table = parquet.read_table(path)
    damaged = table.schema.field(metric.name).with_metadata({"dronevio.metric": '{"colour": 1}'})
    parquet.write_table(table.cast(table.schema.set(len(table.schema) - 1, damaged)), path)
    with pytest.raises(InputError, match="columns of other types"):
        read_rows(path)


def test_files_that_are_no_results_are_refused(tmp_path: Path) -> None:
    path = tmp_path / RESULTS_FILE
    with pytest.raises(InputError, match=r"results\.parquet: no such file; expected the results of `dronevio bench"):
        read_rows(tmp_path)
    path.write_bytes(b"PAR1 and then nothing")
    with pytest.raises(InputError, match="cannot be read"):
        read_rows(path)
    parquet.write_table(pa.table({"a": [1]}), path)
    with pytest.raises(InputError, match="no column scenario, world"):
        read_rows(path)
    write_rows(path, [OK, OK])
    with pytest.raises(InputError, match="two rows of room-v0, seed 3, vio"):
        read_rows(path)
    write_rows(path, [changed(OK, status="fine")])
    with pytest.raises(InputError, match="row 1 with status 'fine'"):
        read_rows(path)
    write_rows(path, [OK])
    table = parquet.read_table(path)
    text = pa.array(["much"], pa.string())
    parquet.write_table(table.set_column(table.column_names.index("ate_m"), "ate_m", text), path)
    with pytest.raises(InputError, match="columns of other types"):
        read_rows(path)


def test_a_store_keeps_the_latest_row_and_ignores_damaged_files(tmp_path: Path) -> None:
    store = ResultStore(tmp_path / "new" / "bench")
    store.add(OK)
    store.add(CRASHED)
    store.add(changed(OK, ate_m=0.2))
    (store.folder / "runs" / "half.parquet").write_bytes(b"PAR1")
    again = ResultStore(store.folder)
    assert again.find(OK.identity) == changed(OK, ate_m=0.2)
    assert again.rows == (CRASHED, changed(OK, ate_m=0.2))
    assert read_rows(again.write_table()) == again.rows


# --- recordings


def test_hashes_depend_on_contents_only(tmp_path: Path) -> None:
    assert content_hash({"a": 1, "b": [1.5, None]}) == content_hash({"b": [1.5, None], "a": 1})
    assert content_hash({"a": 1}) != content_hash({"a": 2})
    folder = tmp_path / "flight"
    (folder / "mav0").mkdir(parents=True)
    table = folder / "mav0" / "data.csv"
    table.write_text("1,2\n")
    before = recording_hash(folder)
    os.utime(table, (0, 0))
    assert recording_hash(folder) == before
    table.write_text("1,3\n")
    assert recording_hash(folder) != before
    with pytest.raises(InputError, match="no such file or folder"):
        recording_hash(tmp_path / "nothing")
    (tmp_path / "code.py").write_text("a = 1")
    assert code_hash(tmp_path / "code.py") != code_hash(folder)
    with pytest.raises(FileNotFoundError):
        code_hash(tmp_path / "moved.py")


def test_a_recording_that_many_threads_acquire_is_made_once(tmp_path: Path) -> None:
    cache = RecordingCache(tmp_path)
    made: list[Path] = []
    contents: list[str] = []

    def make(folder: Path) -> None:
        made.append(folder)
        time.sleep(0.2)
        (folder / "frame").write_text("grey")

    def acquire() -> None:
        with cache.acquire("abc", make) as folder:
            contents.append((folder / "frame").read_text())

    threads = [threading.Thread(target=acquire) for _ in range(5)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(made) == 1
    assert contents == ["grey"] * 5
    assert made[0] != cache.find("abc")  # an unfinished recording is in another folder


def test_partial_recordings_are_removed(tmp_path: Path) -> None:
    cache = RecordingCache(tmp_path)
    (tmp_path / ".abc.partial-left").mkdir()

    def fail(folder: Path) -> None:
        (folder / "half").write_text("")
        raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"), cache.acquire("abc", fail):
        pass
    assert not list(tmp_path.iterdir())


def test_lock_files_go_with_their_recordings(tmp_path: Path) -> None:
    cache = RecordingCache(tmp_path)

    def make(folder: Path) -> None:
        (folder / "whole").write_text("")

    with cache.acquire("abc", make):
        cache.remove("abc")  # in use
        cache.remove_abandoned()
        assert sorted(entry.name for entry in tmp_path.iterdir()) == [".abc.lock", "abc"]
    (tmp_path / ".left.lock").touch()
    cache.remove_abandoned()
    assert sorted(entry.name for entry in tmp_path.iterdir()) == [".abc.lock", "abc"]
    cache.remove("abc")
    assert not list(tmp_path.iterdir())


def test_a_lock_file_that_was_replaced_is_locked_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Between the exclusive and the shared lock, another process removes the recording and makes it again."""
    flock, replaced = fcntl.flock, 0
    cache, other = RecordingCache(tmp_path), RecordingCache(tmp_path)

    def make(folder: Path) -> None:
        (folder / "whole").write_text("")

    def interrupted(lock: Any, operation: int) -> None:
        nonlocal replaced
        replaced += operation == fcntl.LOCK_SH
        if operation == fcntl.LOCK_SH and replaced == 1:
            flock(lock, fcntl.LOCK_UN)
            other.remove("abc")
            with other.acquire("abc", make):
                pass
        flock(lock, operation)

    monkeypatch.setattr(fcntl, "flock", interrupted)
    with cache.acquire("abc", make) as folder:
        assert replaced == 3
        other.remove("abc")  # in use
        assert (folder / "whole").exists()


def test_a_deleted_lock_is_not_waited_for_in_vain(tmp_path: Path) -> None:
    """Threads that acquire and remove one recording never find it removed while they use it."""
    seen: list[bool] = []

    def make(folder: Path) -> None:
        (folder / "whole").write_text("")

    def use() -> None:
        cache = RecordingCache(tmp_path)
        for _ in range(100):
            with cache.acquire("abc", make) as folder:
                time.sleep(0.0)
                seen.append((folder / "whole").exists())
            cache.remove("abc")

    threads = [threading.Thread(target=use) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60.0)
    assert seen == [True] * 400
    assert not list(tmp_path.iterdir())


def test_a_recording_in_use_is_not_removed(tmp_path: Path) -> None:
    cache = RecordingCache(tmp_path)
    with cache.acquire("abc", lambda folder: None):
        cache.remove("abc")
        assert cache.find("abc") is not None
    cache.remove("abc")
    assert cache.find("abc") is None


def write_100_bytes(folder: Path) -> None:
    (folder / "frame").write_bytes(bytes(100))


def test_least_recently_used_recordings_are_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DRONEVIO_RECORDINGS_GB", "250e-9")
    cache = RecordingCache(tmp_path)

    def use(digest: str) -> None:
        with cache.acquire(digest, write_100_bytes):
            time.sleep(0.01)

    for digest in ("a", "b", "a", "c"):
        use(digest)
    assert [folder.name for folder in cache.recordings()] == ["a", "c"]
    with cache.acquire("a", write_100_bytes), cache.acquire("c", write_100_bytes):
        use("d")  # all others are in use
        assert [folder.name for folder in cache.recordings()] == ["a", "c", "d"]
    use("c")
    cache.trim()
    assert [folder.name for folder in cache.recordings()] == ["d", "c"]
    assert not list(tmp_path.glob(".*.partial-*"))


def test_limit_of_the_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DRONEVIO_RECORDINGS_GB", raising=False)
    monkeypatch.setattr("shutil.disk_usage", lambda folder: SimpleNamespace(free=8e9))
    assert limit_bytes(tmp_path / "missing", 2e9) == 5e9
    monkeypatch.setattr("shutil.disk_usage", lambda folder: SimpleNamespace(free=1e12))
    assert limit_bytes(tmp_path, 0.0) == 50e9
    monkeypatch.setenv("DRONEVIO_RECORDINGS_GB", "7")
    assert limit_bytes(tmp_path, 0.0) == 7e9
    for wrong in ("much", "-1", "nan"):
        monkeypatch.setenv("DRONEVIO_RECORDINGS_GB", wrong)
        with pytest.raises(ConfigError, match=f"DRONEVIO_RECORDINGS_GB={wrong}; expected a size in GB"):
            limit_bytes(tmp_path, 0.0)


# --- running


@dataclass(frozen=True)
class NoPipeline:
    """A pipeline for engines that do not call it."""

    versions: str = "1"
    own_metrics: tuple[OwnMetric, ...] = ()

    def config_hash(self, estimator: str) -> str:
        """Return a text that differs between estimators."""
        return f"settings of {estimator}"

    def record(self, spec: RecordingSpec, folder: Path, images: Path | None = None) -> None:
        """Fail."""
        raise NotImplementedError

    def estimate(self, spec: RecordingSpec, recording: Path, estimator: str) -> dict[str, Any]:
        """Fail."""
        raise NotImplementedError


@dataclass
class FakeEngine:
    """An engine that yields rows without running anything, and counts them."""

    lost_estimator: str = ""
    """Estimator at whose runs the machine of the job is lost."""
    stop_after: int = 1000
    """Number of rows after which the engine is interrupted."""
    status: Status = "ok"
    """Status of all rows."""
    runs: int = 0
    """Number of rows up to now."""

    def run(self, jobs: Sequence[Job]) -> Iterator[JobEvent]:
        """Yield the rows of all jobs."""
        for number, job in enumerate(jobs):
            for estimator in job.estimators:
                if estimator == self.lost_estimator:
                    break
                if self.runs == self.stop_after:
                    raise KeyboardInterrupt
                self.runs += 1
                row = row_of(
                    job.spec.scenario,
                    "room",
                    job.spec.seed,
                    estimator,
                    job.pipeline.config_hash(estimator),
                    job.pipeline.versions,
                    self.status,
                    recording_hash=job.spec.recording_hash,
                )
                yield number, replace(row, own_metrics=job.pipeline.own_metrics)
            yield number, JobEnd("node lost" if self.lost_estimator else "")


def benchmark(tmp_path: Path, seeds: int = 3, **others: Any) -> BenchmarkPlan:
    """Return the plan of a benchmark of two estimators with the given fields replaced."""
    recordings = tuple(RecordingSpec("room-v0", "room", seed, f"hash-{seed}", None) for seed in range(seeds))
    return replace(BenchmarkPlan(recordings, ("a", "b"), NoPipeline(), tmp_path / "cache", 60.0), **others)


def test_an_interrupted_benchmark_resumes_with_missing_runs(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        run_benchmark(benchmark(tmp_path), ResultStore(tmp_path), FakeEngine(stop_after=3))
    assert len(read_rows(tmp_path)) == 3
    engine = FakeEngine()
    progress: list[tuple[int, int]] = []
    rows = run_benchmark(
        benchmark(tmp_path), ResultStore(tmp_path), engine, lambda done, total, row: progress.append((done, total))
    )
    assert engine.runs == 3
    assert progress == [(0, 3), (1, 3), (2, 3), (3, 3)]
    assert len(rows) == len(read_rows(tmp_path)) == 6


def test_only_runs_whose_inputs_changed_are_repeated(tmp_path: Path) -> None:
    def runs(**others: Any) -> int:
        engine = FakeEngine()
        run_benchmark(benchmark(tmp_path, **others), ResultStore(tmp_path), engine)
        return engine.runs

    assert runs() == 6
    assert runs() == 0
    assert runs(seeds=4) == 2
    assert runs(estimators=("a", "b", "c")) == 3
    assert runs(pipeline=NoPipeline("2")) == 6
    assert runs(pipeline=NoPipeline("2"), recordings=(RecordingSpec("room-v0", "room", 0, "another", None),)) == 2
    assert len(read_rows(tmp_path)) == 4 * 2 + 3  # rows that are not in the plan are kept


def test_runs_without_a_metric_of_the_user_are_repeated(tmp_path: Path) -> None:
    def runs(*metrics: OwnMetric) -> int:
        engine = FakeEngine()
        run_benchmark(benchmark(tmp_path, pipeline=NoPipeline(own_metrics=metrics)), ResultStore(tmp_path), engine)
        return engine.runs

    one, other = (OwnMetric(name, "m", 3, name=f"python:mine:{name}", code_hash="a") for name in ("ONE", "OTHER"))
    assert runs() == 6
    assert runs(one, other) == 6
    assert runs(one) == runs() == 0  # those that are stored stay
    assert {row.own_metrics for row in read_rows(tmp_path)} == {(one, other)}
    assert runs(replace(one, code_hash="b")) == 6


def test_runs_of_another_kind_of_processor_are_repeated(tmp_path: Path) -> None:
    def runs(processor: str | None) -> int:
        engine = FakeEngine()
        run_benchmark(benchmark(tmp_path, seeds=1, processor=processor), ResultStore(tmp_path), engine)
        return engine.runs

    assert runs(None) == 2
    assert runs("") == 0  # the engine's rows have no processor
    assert runs(None) == 0  # of several machines, all kinds count
    assert runs("Zen 4") == 2


def test_rows_name_the_processor(tmp_path: Path) -> None:
    [job] = benchmark(tmp_path, seeds=1).missing_jobs(ResultStore(tmp_path))
    row = job.row("a", Outcome("ok", "", {}, 1.0, 1.0, None))
    assert row.processor and row.machine.startswith(f"{row.processor}, ")


def test_a_recording_is_deleted_after_all_its_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[int] = []

    def write(job: Job, folder: Path) -> None:
        (folder / "image.png").write_bytes(b"grey")

    def count(job: Job, recording: Path, estimator: str) -> Outcome:
        seen.append(len(list(recording.iterdir())))
        return Outcome("ok", "", {"ate_m": 0.1}, 1.0, 1.0, None)

    monkeypatch.setattr(Job, "_record", write)
    monkeypatch.setattr(Job, "estimate", count)
    for keep, left in ((False, []), (True, ["one"])):
        spec = RecordingSpec("room-v0", "room", 0, "one", None)
        rows = list(Job(spec, ("a", "b"), NoPipeline(), tmp_path, 60.0, keep).run())
        assert [row.status for row in rows] == ["ok", "ok"] and seen == [1, 1]
        assert [folder.name for folder in RecordingCache(tmp_path).recordings()] == left
        seen.clear()


def test_failed_runs_are_repeated_on_request(tmp_path: Path) -> None:
    run_benchmark(benchmark(tmp_path), ResultStore(tmp_path), FakeEngine(status="failed"))
    again, retry = FakeEngine(), FakeEngine()
    run_benchmark(benchmark(tmp_path), ResultStore(tmp_path), again)
    run_benchmark(benchmark(tmp_path), ResultStore(tmp_path), retry, retry=True)
    assert (again.runs, retry.runs) == (0, 6)


def test_runs_lost_with_their_machine_are_crashed_rows(tmp_path: Path) -> None:
    rows = run_benchmark(benchmark(tmp_path), ResultStore(tmp_path), FakeEngine(lost_estimator="b"))
    assert [(row.estimator, row.status, row.reason) for row in rows] == [
        ("a", "ok", ""),
        ("b", "crashed", "node lost"),
    ] * 3


def test_a_recording_that_cannot_be_made_fails_all_its_runs(tmp_path: Path) -> None:
    rows = run_benchmark(benchmark(tmp_path, seeds=1), ResultStore(tmp_path), LocalEngine(2))
    assert len(rows) == 2
    assert all(row.status != "ok" and row.reason.startswith("the recording cannot be made: ") for row in rows)
    assert not list((tmp_path / "cache").iterdir())


def test_the_local_engine_reports_exceptions_of_jobs_as_crashes(tmp_path: Path) -> None:
    (tmp_path / "cache").write_text("a file instead of the folder of recordings")
    rows = run_benchmark(benchmark(tmp_path), ResultStore(tmp_path), LocalEngine(2))
    assert [(row.status, row.reason.split(":")[0]) for row in rows] == [("crashed", "FileExistsError")] * 6


# --- tables


def test_failed_runs_rank_last_in_the_quartiles() -> None:
    rows = [changed(OK, seed=seed, ate_m=0.1 * (seed + 1)) for seed in range(4)]
    quartiles = quartiles_of_errors(rows, "ate_m")
    assert quartiles is not None
    assert quartiles.median == pytest.approx(0.25)
    failed = [*rows[:2], changed(CRASHED, seed=8), changed(CRASHED, seed=9)]
    found = quartiles_of_errors(failed, "ate_m")
    assert found is not None
    assert found.lower == pytest.approx(0.2)
    assert found == Quartiles(found.lower, math.inf, math.inf, runs=4, failed=2)
    assert quartiles_of_errors(rows, "rpe_m") is None
    assert failed_runs(failed)[0] == ("room-v0, seed 8, a=b c", "crashed", "killed by SIGSEGV")
    assert [(group.estimator, group.ok) for group in run_groups(failed)] == [("vio", 2), ("a=b c", 0)]


@pytest.mark.skipif(platform.system() != "Linux", reason="peak memory is read from /proc")
def test_peak_memory_excludes_the_parent_process() -> None:
    ballast = b"x" * 300_000_000
    peak_mb = call_in_process(math.sqrt, 4.0).peak_mb
    assert peak_mb is not None
    assert peak_mb * 1e6 < len(ballast)


def test_results_without_the_column_of_defects_are_read(tmp_path: Path) -> None:
    path = tmp_path / "results.parquet"
    write_rows(path, [OK])
    parquet.write_table(parquet.read_table(path).drop_columns(["defects"]), path)
    assert read_rows(path) == (OK,) and OK.defects == ""


def test_scratch_folders_of_dead_processes_are_removed(tmp_path: Path) -> None:
    cache = RecordingCache(tmp_path)
    (tmp_path / ".run-dead" / "mav0").mkdir(parents=True)
    with cache.scratch() as alive:
        (alive / "file").touch()
        cache.remove_abandoned()
        assert list(tmp_path.iterdir()) == [alive] and (alive / "file").exists()
    assert list(tmp_path.iterdir()) == []


def test_partial_recordings_of_dead_processes_are_removed(tmp_path: Path) -> None:
    (tmp_path / ".dead.partial-x" / "mav0").mkdir(parents=True)
    cache, being_made = RecordingCache(tmp_path), []

    def make(folder: Path) -> None:
        being_made.append(folder)
        cache.remove_abandoned()
        assert folder.exists()  # it is locked

    with cache.acquire("alive", make) as recording:
        cache.remove_abandoned()
        assert recording.exists()
    assert len(being_made) == 1
    assert not list(tmp_path.glob(".*.partial-*"))
