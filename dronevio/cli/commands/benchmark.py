"""``dronevio benchmark``: several estimators on many flights."""

import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from dronevio.cli import report_defect
from dronevio.cli.options import Printing, PrintOptions
from dronevio.cli.progress import LineBars
from dronevio.cli.terminal import parse, print_defects, print_json, print_table, print_warning
from dronevio.models.errors import DEFECT, ConfigError, InputError, unknown_name
from dronevio.models.ranges import Range, Settings

if TYPE_CHECKING:
    from dronevio.eval.benchmark.engines import Engine
    from dronevio.eval.benchmark.jobs import RecordingSpec
    from dronevio.eval.benchmark.rows import Row
    from dronevio.eval.benchmark.runner import BenchmarkPlan, ProgressListener

EXPLORE = "explore"
"""Name of the suite of flights to goals through unknown worlds, which runs no estimators on recordings."""
_MANY = 10_000  # number of flights to which --sizing extrapolates


@dataclass(frozen=True)
class BenchmarkCommand(Settings):
    """Run estimators on many flights and tabulate their errors, one row per run in results.parquet.

    Flights are scenarios with seeds, or recordings with ground truth. Each scenario is simulated once and its recording
    is cached for all estimators and for later benchmarks. A run that crashes or exceeds the time limit is a row with
    that status. The same command continues an interrupted benchmark, and repeats only the runs whose code, settings or
    recording have changed.

    An estimator is vio (one camera), vio-stereo (all cameras, at least two), slam and slam-stereo (the same odometry,
    corrected by loops), eqvio (GTSAM's equivariant filter with our front end), dead-reckoning (no camera), your own
    class, or any program that reads an EuRoC folder and writes a TUM file. A class is given as
    LABEL=python:package.module:Class; it is made from the rig of the recording and has the methods add_imu and
    add_frame. Its module is installed or in the current folder. A program is given as LABEL=external:COMMAND with
    {recording} and {output} in the command. It gets a copy of the recording without ground truth. Its poses must have
    the time stamps of frames, or differ from them by a constant offset that is stated as
    LABEL=external@SECONDS:COMMAND.

    Examples:
      dronevio benchmark --suite room --estimators vio,dead-reckoning --seeds 10
      dronevio benchmark --scenarios hover short --seeds 3 --out benchmarks/quick
      dronevio benchmark --suite hall --rig euroc-stereo --estimators vio,vio-stereo,eqvio,dead-reckoning
      dronevio benchmark --suite reference --seeds 100 --variants as-is imu-100hz imu-400hz noise-2x
      dronevio benchmark --suite loops --estimators vio,slam --variants as-is light=1 reverse light=1+reverse
      dronevio benchmark --recordings MH_01_easy --starts-s 0 0.5 1 1.5 2 --out benchmarks/starts
      dronevio benchmark --suite hall --rig euroc-stereo --image-sensor vi-sensor --estimators vio,vio-stereo
      dronevio benchmark --recordings V1_01_easy V1_02_medium --out benchmarks/euroc
      dronevio benchmark --suite easy --estimators vio 'mine=external:./mine --in {recording} --out {output}'
      dronevio benchmark --suite easy --estimators vio mine=python:my_package.odometry:Odometry
      dronevio benchmark --suite room --metrics python:my_metrics:FINAL_ERROR
      dronevio benchmark --suite room --seeds 1000 --engine ray --address auto
      dronevio benchmark --suite room --sizing
      dronevio benchmark --suite explore --variants rays --seeds 4
    """

    suite: str | None = None
    """Name of a suite of scenarios: a world such as room, or a difficulty such as easy; explore for flights to goals
    through unknown worlds, see docs/explore.md, of which only --variants, --seeds, --workers and --out are options."""
    scenarios: tuple[str, ...] = ()
    """Names of scenarios, which `dronevio scenarios` lists, or python:package.module:NAME; and of the measured flights
    of the suite loops, such as measured-MH_04, which exist where DRONEVIO_DATA names a folder with their data."""
    rig: str | None = None
    """Sensors that replace those of the scenarios: a name such as euroc-stereo or fisheye, a Kalibr camchain.yaml, a
    recording with its calibration, or python:package.module:NAME."""
    variants: tuple[str, ...] = ()
    """Variants of each scenario, whose rows are named SCENARIO+VARIANT: imu-100hz or imu-400hz, an IMU of that rate;
    noise-2x or noise-half, IMU noise that differs from the calibration; rig=NAME, other sensors; world=SEED, the world
    of that seed in all flights; light=SEED, other light in the same world; reverse, the tour in the opposite direction;
    as-is, the scenario itself. Variants are combined by plus signs: world=3+light=1+reverse. By default only the
    scenario itself."""
    image_sensor: str | None = None
    """Image sensor that replaces those of the scenarios: standard, with short exposures, or vi-sensor, with the
    exposures, noise and contrast of EuRoC's images."""
    recordings: tuple[Path, ...] = ()
    """Recordings with ground truth: folders of data sets or bags."""
    starts_s: tuple[Annotated[float, Range(low=0.0)], ...] = ()
    """Times after the first frame of each flight at which estimators start [s], to measure their initialization, also
    in motion. Each time is a row of its own, named FLIGHT@TIMEs. By default estimators start with the first frame."""
    laps: Annotated[int, Range(1, 1000)] = 1
    """Number of times that each flight is repeated without a break, to measure time and memory of long flights, whose
    rows are named FLIGHT×LAPS. Flights must begin and end at rest at the same pose, as room-aggressive and hover do."""
    estimators: tuple[str, ...] = ("vio",)
    """Estimators to run. Several names may be joined by commas."""
    metrics: tuple[str, ...] = ()
    """Metrics of your own that become columns of the results: python:package.module:NAME, as in `dronevio evaluate`.
    Runs that lack them, or have an earlier version of them, are repeated."""
    seeds: Annotated[int, Range(1, 100_000)] = 10
    """Number of seeds of each scenario."""
    first_seed: Annotated[int, Range(0, 2**32 - 1)] = 0
    """Smallest seed of each scenario."""
    out: Path | None = None
    """Folder of the results; benchmarks/SUITE by default. A benchmark that exists there is continued."""
    engine: Literal["local", "ray"] = "local"
    """Where runs are executed: in processes on this machine, or by Ray."""
    workers: Annotated[int | None, Range(1, 1024)] = None
    """Number of runs at the same time; the number of cores by default. A Ray cluster decides by itself."""
    address: str | None = None
    """Address of a Ray cluster; auto for the cluster of this machine. Without it, Ray is started on this machine."""
    timeout_s: Annotated[float, Range(above=0.0, infinite=True)] = 1800.0
    """Time limit of one run, and of the simulation of one recording [s]."""
    strict: bool = False
    """Refuse recordings with defects: missing, damaged or unpaired images, time stamps that do not increase, gaps of
    the IMU, IMU samples that are not finite, and frames without IMU. By default, their numbers are printed as warnings
    and stored in the column defects."""
    retry: bool = False
    """Repeat failed runs."""
    cache: Path | None = None
    """Folder of the cached recordings, on every machine; ~/.cache/dronevio/recordings by default. Beyond
    50 GB or half of the free disk, or the number of GB in the environment variable DRONEVIO_RECORDINGS_GB, the least
    recently used ones are deleted."""
    keep_recordings: bool = True
    """Keep the recordings in the cache. Otherwise each is deleted after the runs of all estimators."""
    sizing: bool = False
    """Measure only one flight, and extrapolate time and disk space to 10 000 flights like it."""
    printing: Printing = field(default_factory=PrintOptions)
    """How results are printed."""


def main(arguments: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    command = parse(BenchmarkCommand, arguments, "benchmark")
    if command.suite == EXPLORE:
        from dronevio.cli.commands.benchmark_explore import run_explore_suite

        is_given = any(word.partition("=")[0] == "--seeds" for word in arguments)
        seeds = command.seeds if is_given else None
        return run_explore_suite(command.out, command.variants, seeds, command.workers, command.printing.json)
    if command.sizing:
        return _print_sizing(command, _planned(command))
    engine = _engine(command)  # first, since it takes a while to plan thousands of flights
    benchmark = _planned(command)

    from dronevio.cli.output_files import resumable
    from dronevio.eval.benchmark.cache import RecordingCache
    from dronevio.eval.benchmark.rows import RESULTS_FILE
    from dronevio.eval.benchmark.runner import run_benchmark
    from dronevio.eval.benchmark.store import ResultStore

    folder = command.out or Path("benchmarks") / (command.suite or "results")
    store = ResultStore(folder)
    cache = RecordingCache(benchmark.cache)
    cache.remove_abandoned()
    cache.trim()  # refuses a wrong limit before the first flight
    with resumable(folder, "runs"), _run_progress(quiet=command.printing.json) as listener:
        rows = run_benchmark(benchmark, store, engine, listener, command.retry)
    if command.printing.json:
        print_json({"results": str(folder / RESULTS_FILE), "rows": [row.columns for row in rows]})
    else:
        print_benchmark(rows)
        print(f"results:  {folder / RESULTS_FILE}")
    defects = [row.reason for row in rows if row.reason.startswith(DEFECT)]
    return report_defect(defects[0].removeprefix(f"{DEFECT}: "), ["benchmark", *arguments]) if defects else 0


def print_benchmark(rows: Sequence["Row"]) -> None:
    """Print the errors of each estimator on each scenario, and the failed runs."""
    from dronevio.eval.benchmark.rows import own_metrics
    from dronevio.eval.benchmark.summary import failed_runs, quartiles_of_errors, run_groups
    from dronevio.eval.report.benchmark.model import metric_quartiles

    own = own_metrics(rows)
    columns = (("ATE [m]", "ate_m"), ("RPE 1 s [m]", "rpe_m"))
    cells = []
    for group in run_groups(rows):
        errors = [quartiles_of_errors(group.rows, column) for _, column in columns]
        errors += [metric_quartiles(metric, group.rows) for metric in own]
        cost = quartiles_of_errors([row for row in group.rows if row.status == "ok"], "cpu_ms_mean")
        figures = ["–" if spread is None else spread.text(len(group.rows) > 1) for spread in errors]
        counts = f"{group.ok}/{len(group.rows)}", f"{group.diverged}"
        milliseconds = "–" if cost is None else f"{cost.median:.1f}"
        cells.append((group.scenario, group.estimator, *counts, *figures, milliseconds))
    headings = ("scenario", "estimator", "ok", "diverged", *(heading for heading, _ in columns))
    headings = (*headings, *(metric.heading for metric in own), "ms/frame")
    print_table(
        "Median and quartiles over seeds; a failed run ranks behind all others", headings, cells, left=("estimator",)
    )
    if any(row.diverged for row in rows):
        print("diverged: coverage below 99 %, or ATE above 1 % of the path")
    _print_consistency(rows)
    failed = failed_runs(rows)
    if failed:
        print(f"{len(failed)} of {len(rows)} runs failed (--retry repeats them):")
    for run, status, reason in failed:
        print(f"  {run}: {reason or status}" if status == "failed" else f"  {run}: {status}, {reason}")


def _print_consistency(rows: Sequence["Row"]) -> None:
    """Print the average NEES of each scenario and estimator; nothing if no run has a NEES."""
    from dronevio.eval.report.benchmark.model import BenchmarkResults
    from dronevio.eval.report.benchmark.overview import consistency_table

    table = consistency_table(BenchmarkResults("", tuple(rows)))
    if table.rows:
        print_table(
            table.title, table.columns, [[cell.text for cell in row] for row in table.rows], left=("estimator",)
        )


def _planned(command: BenchmarkCommand) -> "BenchmarkPlan":
    """Return the flights and estimators of a benchmark.

    Raises:
        ConfigError: There is no flight, or an option has an invalid value.
    """
    from dronevio.benchmark.jobs import Workbench, excerpts, recorded_flights, versions
    from dronevio.benchmark.own_metrics import PythonMetric
    from dronevio.estimators.registry import EXTERNAL, estimator_named
    from dronevio.eval.benchmark.cache_limit import default_folder
    from dronevio.eval.benchmark.runner import BenchmarkPlan
    from dronevio.eval.provenance import processor_here
    from dronevio.sim.scenarios import SUITES

    if command.suite is not None and command.suite not in SUITES:
        raise unknown_name("suite", command.suite, (*SUITES, EXPLORE))
    names = [*([command.suite] if command.suite else []), *command.scenarios]
    words = [[given] if EXTERNAL.search(given) else given.split(",") for given in command.estimators]
    estimators = tuple(estimator_named(word.strip()) for group in words for word in group if word.strip())
    labels = [estimator.label for estimator in estimators]
    if not labels or len(set(labels)) < len(labels):
        raise ConfigError(f"estimators {', '.join(labels) or 'none'}; expected at least one, and each name once")
    own = tuple(PythonMetric.parse(text).load() for text in dict.fromkeys(command.metrics))
    if command.engine == "local":
        for estimator in estimators:
            estimator.require_program()
    if command.rig is not None and not names:
        raise ConfigError(f"--rig {command.rig} without scenarios; a recording has its own rig")
    if command.variants and not names:
        raise ConfigError(f"--variants {command.variants[0]} without scenarios; a recording has no variants")
    if command.image_sensor is not None and not names:
        raise ConfigError(f"--image-sensor {command.image_sensor} without scenarios; a recording has its own images")
    planned = _planned_recordings(command, names) + recorded_flights(command.recordings)
    flights = excerpts(planned, command.starts_s, command.laps)
    programs = [each.label for each in estimators if EXTERNAL.match(each.name)]
    if programs and (command.starts_s or command.laps > 1):
        raise ConfigError(f"--starts-s or --laps with {programs[0]}: a program reads a whole recording once")
    for path in command.recordings:
        _report_defects(path, command.strict)
    if not flights:
        raise ConfigError("no flights; expected --suite, --scenarios or --recordings")
    return BenchmarkPlan(
        flights,
        tuple(labels),
        Workbench(estimators, versions(), command.strict, own),
        (command.cache or default_folder()).absolute(),
        command.timeout_s,
        command.keep_recordings,
        processor_here() if command.engine == "local" else None,
    )


def _planned_recordings(command: BenchmarkCommand, names: Sequence[str]) -> "tuple[RecordingSpec, ...]":
    """Return the recordings of scenarios and measured flights, and warn of the latter that lack their data.

    Raises:
        ConfigError: A name, the rig or the image sensor is not known.
        InputError: The data of a measured flight that is named is missing.
    """
    from dronevio.benchmark.jobs import measured_recordings, scenario_flights
    from dronevio.benchmark.measured_flights import measured_flights, measured_name
    from dronevio.benchmark.variants import AS_IS
    from dronevio.recording.recorder import rig_of

    seeds = range(command.first_seed, command.first_seed + command.seeds)
    simulated = [name for name in names if measured_name(name) is None]
    planned = scenario_flights(simulated, seeds, command.rig, command.variants, command.image_sensor)
    if AS_IS not in (command.variants or (AS_IS,)):  # what was measured has no variants
        return planned
    measured, left_out = measured_flights(names, None if command.rig is None else rig_of(command.rig))
    if left_out:
        print_warning(left_out)
    return planned + measured_recordings(measured, seeds, command.image_sensor)


def _report_defects(path: Path, strict: bool) -> None:
    """Print the defects of a recording as warnings.

    Raises:
        InputError: The recording has defects, and ``strict`` is set.
    """
    from dronevio.models.defects import refuse_defects
    from dronevio.models.recordings.open import open_recording

    try:
        recording = open_recording(path, repair=True)
    except InputError:
        return  # the rows of the benchmark have the reason
    if strict:
        refuse_defects(path, recording.defects)
    print_defects(recording.defects, f"{path}: ")
    if recording.later:
        print_warning(f"{path}: the clock steps; only the first of {len(recording.later) + 1} segments is used")


def _engine(command: BenchmarkCommand) -> "Engine":
    from dronevio.eval.benchmark.engines import LocalEngine, available_cores

    if command.engine == "local":
        if command.address is not None:
            raise ConfigError(f"--address {command.address} with the engine local; expected --engine ray")
        return LocalEngine(command.workers or available_cores())
    from dronevio.eval.benchmark.ray_engine import RayEngine

    return RayEngine(command.address, command.workers or available_cores())


@contextmanager
def _run_progress(quiet: bool) -> Iterator["ProgressListener"]:
    """Show on standard error the number of finished runs, the remaining time and the failures."""
    if quiet:
        yield lambda done, total, row: None
    elif not sys.stderr.isatty():
        yield _run_lines()
    else:
        with _run_bars() as listener:
            yield listener


def _failure(row: "Row") -> str:
    """Return the line that names a failed run."""
    seed = "" if row.seed is None else f", seed {row.seed}"
    return f"{row.status}: {row.scenario}{seed}, {row.estimator}: {row.reason}"


def _run_lines() -> "ProgressListener":
    """Return a callback that prints failures, and a line from time to time."""
    advance = LineBars().bar("runs")

    def listener(done: int, total: int, row: "Row | None") -> None:
        if row is not None and row.status != "ok":
            print(_failure(row), file=sys.stderr)
        advance(done, total)

    return listener


@contextmanager
def _run_bars() -> Iterator["ProgressListener"]:
    """Draw a bar of the runs until the context ends, and print failures above it."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
    from rich.progress import Progress as RichProgress

    with RichProgress(
        TextColumn("runs"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[failed]}"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        console=Console(stderr=True),
        speed_estimate_period=float("inf"),  # runs take minutes: the average over all of them predicts the next best
    ) as bars:
        task, failed = bars.add_task("runs", total=None, failed=""), 0

        def listener(done: int, total: int, row: "Row | None") -> None:
            nonlocal failed
            if row is not None and row.status != "ok":
                failed += 1
                bars.console.print(_failure(row), markup=False)
            bars.update(task, completed=done, total=total, failed=f"{failed} failed" if failed else "")

        yield listener


def _print_sizing(command: BenchmarkCommand, benchmark: "BenchmarkPlan") -> int:
    """Measure the first flight, and print what many flights like it would take."""
    from dronevio.eval.benchmark.engines import available_cores
    from dronevio.eval.benchmark.jobs import Job
    from dronevio.eval.benchmark.sizing import measure_job

    flight = benchmark.recordings[0]
    if flight.path is not None:
        raise ConfigError("--sizing with recordings; expected scenarios, whose simulation is measured")
    job = Job(flight, benchmark.estimators, benchmark.pipeline, benchmark.cache, benchmark.timeout_s)
    sizing, workers = measure_job(job), command.workers or available_cores()
    rows = sizing.scaled(_MANY, workers)
    if command.printing.json:
        names = ("work", "cpu_hours", "hours", "gigabytes")
        scaled = [dict(zip(names, row, strict=True)) for row in rows]
        print_json({"flight": flight.scenario, "measured": asdict(sizing), "flights": _MANY, "scaled": scaled})
        return 0
    measured = [sizing.recording, *(cost for _, cost in sizing.estimates)]
    table: list[tuple[str, ...]] = [
        (name, f"{one.cpu_s:.1f}", f"{one.disk_mb:.1f}", f"{cpu_h:.1f}", f"{hours:.1f}", f"{gigabytes:.1f}")
        for one, (name, cpu_h, hours, gigabytes) in zip(measured, rows, strict=False)
    ]
    table.append(("all", "", "", *(f"{value:.1f}" for value in rows[-1][1:])))
    print_table(
        f"{_MANY} flights like {flight.scenario}, extrapolated from one that was measured",
        ("", "one: CPU s", "one: MB", "all: CPU h", f"all: h on {workers} cores", "all: GB"),
        table,
    )
    print("With --no-keep-recordings, only the recordings of current runs are on the disk.")
    return 0
