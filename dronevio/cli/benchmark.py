"""``dronevio benchmark``: many flights, several estimators, a table."""

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.progress import Progress as RichProgress

from dronevio.cli.terminal import parse, print_json, print_table
from dronevio.models.errors import ConfigError

if TYPE_CHECKING:
    from dronevio.eval.benchmark.engines import Engine
    from dronevio.eval.benchmark.rows import Row
    from dronevio.eval.benchmark.runner import Benchmark, Listener

_MANY = 10_000  # flights that the sizing speaks of


@dataclass(frozen=True)
class BenchmarkCommand:
    """Run estimators on many flights, and make a table of it: one row a run, in results.parquet.

    Flights are scenarios with seeds, or recordings from elsewhere that have a ground truth. Each recording is made once
    and kept for all estimators and later benchmarks. A run that crashes or times out is a row that says so. Whatever
    stops the benchmark, the same command goes on where it was: only what is missing, or has changed, is done.

    An estimator is vio (one camera), vio-stereo (all cameras, two at least), eqvio (GTSAM's equivariant filter on our
    features), dead-reckoning (no camera), or any program that reads an EuRoC folder and writes a TUM file: give it as
    LABEL=external:COMMAND, with {recording} and {output} in the command. It is shown no ground truth.

    Examples:
      dronevio benchmark --suite room --estimators vio,dead-reckoning --seeds 10
      dronevio benchmark --scenarios hover short --seeds 3 --out benchmarks/quick
      dronevio benchmark --suite hall --rig euroc-stereo --estimators vio,vio-stereo,eqvio,dead-reckoning
      dronevio benchmark --recordings V1_01_easy V1_02_medium --out benchmarks/euroc
      dronevio benchmark --suite easy --estimators vio 'mine=external:./mine --in {recording} --out {output}'
      dronevio benchmark --suite room --seeds 1000 --engine ray --address auto
      dronevio benchmark --suite room --sizing
    """

    suite: str | None = None
    """Scenarios that belong together: a world such as room, or a level such as easy."""
    scenarios: tuple[str, ...] = ()
    """Scenarios by name; `dronevio scenarios` lists them."""
    rig: str | None = None
    """Other sensors for scenarios: a name such as euroc-stereo or fisheye, a Kalibr camchain.yaml, or a recording."""
    recordings: tuple[Path, ...] = ()
    """Recordings from elsewhere: EuRoC folders or bags, with ground truth."""
    estimators: tuple[str, ...] = ("vio",)
    """Who estimates; names may be joined by commas."""
    seeds: int = 10
    """How many seeds of each scenario."""
    first_seed: int = 0
    """The first of them."""
    out: Path | None = None
    """Folder of the results; benchmarks/SUITE by default. An earlier benchmark in it goes on."""
    engine: Literal["local", "ray"] = "local"
    """Processes of this machine, or Ray."""
    workers: int | None = None
    """How many runs at a time; as many as there are cores by default. A cluster decides for itself."""
    address: str | None = None
    """Of a Ray cluster, auto for the one that this machine belongs to; without it, Ray is started here."""
    timeout_s: float = 1800.0
    """How long one run may take, and the making of one recording [s]."""
    retry: bool = False
    """Do failed runs again."""
    cache: Path | None = None
    """Folder of the recordings, on every machine; ~/.cache/dronevio/recordings by default."""
    keep_recordings: bool = True
    """Keep recordings for later; without, each is deleted when its estimators are done."""
    sizing: bool = False
    """Do only one flight, and tell what 10 000 like it would take."""
    json: bool = False
    """Print one JSON document instead of tables."""


def main(arguments: Sequence[str]) -> int:
    """Run the command."""
    command = parse(BenchmarkCommand, arguments, "benchmark")
    benchmark = _planned(command)
    if command.sizing:
        return _size(command, benchmark)

    from dronevio.eval.benchmark.rows import RESULTS_FILE
    from dronevio.eval.benchmark.runner import run_benchmark
    from dronevio.eval.benchmark.store import ResultStore

    folder = command.out or Path("benchmarks") / (command.suite or "results")
    engine = _engine(command)
    store = ResultStore(folder)
    with _live(quiet=command.json) as heard:
        rows = run_benchmark(benchmark, store, engine, heard, command.retry)
    if command.json:
        print_json({"results": str(folder / RESULTS_FILE), "rows": [asdict(row) for row in rows]})
        return 0
    print_benchmark(rows)
    print(f"results:  {folder / RESULTS_FILE}")
    return 0


def print_benchmark(rows: Sequence["Row"]) -> None:
    """Print estimator × scenario, and what failed."""
    from dronevio.eval.benchmark.summary import Spread, failures, groups

    columns = (("ATE [m]", "ate_m"), ("RPE 1 s [m]", "rpe_m"))
    cells = []
    for group in groups(rows):
        errors = [Spread.of(group.rows, column) for _, column in columns]
        cost = Spread.of([row for row in group.rows if row.status == "ok"], "cpu_ms_mean")
        figures = ["–" if spread is None else spread.text(len(group.rows) > 1) for spread in errors]
        ok = f"{group.ok}/{len(group.rows)}"
        cells.append((group.scenario, group.estimator, ok, *figures, "–" if cost is None else f"{cost.median:.1f}"))
    headings = ("scenario", "estimator", "ok", *(heading for heading, _ in columns), "ms/frame")
    print_table("Median and quartiles over seeds; a failed run counts as ∞", headings, cells)
    failed = failures(rows)
    if failed:
        print(f"{len(failed)} of {len(rows)} runs failed:")
    for run, how, why in failed:
        print(f"  {run}: {how}, {why}")


def _planned(command: BenchmarkCommand) -> "Benchmark":
    """Return what to run.

    Raises:
        ConfigError: Nothing is to be flown, or an option makes no sense.
    """
    if command.seeds < 1 or command.first_seed < 0:
        raise ConfigError(f"{command.seeds} seeds from {command.first_seed} on; expected one at least, from 0 on")
    if command.workers is not None and command.workers < 1:
        raise ConfigError(f"{command.workers} workers; expected one at least")
    if not command.timeout_s > 0.0:
        raise ConfigError(f"a timeout of {command.timeout_s:g} s; expected more than zero")

    from dronevio.benchmark_jobs import Workbench, recorded_flights, scenario_flights, versions
    from dronevio.eval.benchmark.runner import Benchmark
    from dronevio.registry import EXTERNAL, estimator_named
    from dronevio.sim.scenarios import SUITES

    if command.suite is not None and command.suite not in SUITES:
        raise ConfigError(f"unknown suite {command.suite!r}; expected one of {', '.join(SUITES)}")
    names = [*([command.suite] if command.suite else []), *command.scenarios]
    words = [[given] if EXTERNAL in given else given.split(",") for given in command.estimators]
    estimators = tuple(estimator_named(word.strip()) for group in words for word in group if word.strip())
    labels = [estimator.label for estimator in estimators]
    if not labels or len(set(labels)) < len(labels):
        raise ConfigError(f"estimators {', '.join(labels) or 'none'}; expected one at least, and no name twice")
    seeds = range(command.first_seed, command.first_seed + command.seeds)
    if command.rig is not None and not names:
        raise ConfigError(f"--rig {command.rig} without scenarios; recordings have theirs")
    flights = scenario_flights(names, seeds, command.rig) + recorded_flights(command.recordings)
    if not flights:
        raise ConfigError("nothing to fly; expected --suite, --scenarios or --recordings")
    return Benchmark(
        flights,
        tuple(labels),
        Workbench(estimators, versions()),
        (command.cache or _default_cache()).absolute(),
        command.timeout_s,
        command.keep_recordings,
    )


def _engine(command: BenchmarkCommand) -> "Engine":
    from dronevio.eval.benchmark.engines import LocalEngine, cores

    if command.engine == "local":
        if command.address is not None:
            raise ConfigError(f"--address {command.address} with the engine local; expected --engine ray")
        return LocalEngine(command.workers or cores())
    from dronevio.eval.benchmark.ray_engine import RayEngine

    return RayEngine(command.address, command.workers or cores())


def _default_cache() -> Path:
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "dronevio" / "recordings"


@contextmanager
def _live(quiet: bool) -> Iterator["Listener"]:
    """Show on standard error how many runs are done, how long the rest will take, and what fails."""
    with RichProgress(
        TextColumn("runs"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[failed]}"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        console=Console(stderr=True),
        disable=quiet,
        speed_estimate_period=float("inf"),  # runs take minutes: all of them tell how long the next will
    ) as bars:
        task, failed = bars.add_task("runs", total=None, failed=""), 0

        def heard(done: int, total: int, row: "Row | None") -> None:
            nonlocal failed
            if row is not None and row.status != "ok":
                failed += 1
                seed = "" if row.seed is None else f", seed {row.seed}"
                bars.console.print(f"{row.status}: {row.scenario}{seed}, {row.estimator}: {row.reason}", markup=False)
            bars.update(task, completed=done, total=total, failed=f"{failed} failed" if failed else "")

        yield heard


def _size(command: BenchmarkCommand, benchmark: "Benchmark") -> int:
    """Measure the first flight and say what many would take."""
    from dronevio.eval.benchmark.engines import cores
    from dronevio.eval.benchmark.jobs import Job
    from dronevio.eval.benchmark.sizing import measure

    flight = benchmark.flights[0]
    if flight.path is not None:
        raise ConfigError("--sizing with recordings from elsewhere; expected scenarios, whose making is measured")
    job = Job(flight, benchmark.estimators, benchmark.workshop, benchmark.cache, benchmark.timeout_s)
    sizing, workers = measure(job), command.workers or cores()
    rows = sizing.scaled(_MANY, workers)
    if command.json:
        names = ("work", "cpu_hours", "hours", "gigabytes")
        scaled = [dict(zip(names, row, strict=True)) for row in rows]
        print_json({"flight": flight.scenario, "measured": asdict(sizing), "flights": _MANY, "scaled": scaled})
        return 0
    measured = [sizing.flight, *(cost for _, cost in sizing.estimates)]
    table: list[tuple[str, ...]] = [
        (name, f"{one.cpu_s:.1f}", f"{one.disk_mb:.1f}", f"{cpu_h:.1f}", f"{hours:.1f}", f"{gigabytes:.1f}")
        for one, (name, cpu_h, hours, gigabytes) in zip(measured, rows, strict=False)
    ]
    table.append(("all", "", "", *(f"{value:.1f}" for value in rows[-1][1:])))
    print_table(
        f"{_MANY} flights like {flight.scenario}, from one that was measured",
        ("", "one: CPU-s", "MB", "all: CPU-h", f"h on {workers} cores", "GB"),
        table,
    )
    print("with --no-keep-recordings, the disk holds no more than the recordings under way")
    return 0
