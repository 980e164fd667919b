"""Rows of a benchmark: one for each run, failed ones included, stored as Parquet."""

import json
from collections.abc import Iterable, Mapping
from dataclasses import MISSING, asdict, dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self, TypeAlias, get_args

from dronevio.eval.benchmark.cache import content_hash
from dronevio.eval.benchmark.isolation import Status
from dronevio.eval.benchmark.metrics import DERIVED_METRICS, METRICS, STORED_METRICS, OwnMetric, score_columns
from dronevio.eval.metrics.scores import Scores
from dronevio.models.errors import InputError
from dronevio.models.python_names import PREFIX
from dronevio.models.recordings.files import read_text

if TYPE_CHECKING:
    import pyarrow

Identity: TypeAlias = tuple[str, int | None, str]
"""Scenario, seed and estimator: runs of two benchmarks with the same identity are compared with each other."""
RESULTS_FILE = "results.parquet"
"""Name of the file with all rows of a benchmark, in its folder."""
VARIANT_SIGN = "+"
"""Stands between the name of a scenario and that of its variant."""
_REPORT_FILE = "report.json"
_METRIC = b"dronevio.metric"  # key of the metadata of a column
MIN_COVERAGE_PERCENT, MAX_ATE_PERCENT = 99.0, 1.0
"""Smallest coverage, and largest ATE relative to the length of the path, of a run that has not diverged [%]."""
START_VELOCITY_PERCENT, START_VELOCITY_M_S = 5.0, 0.03
"""Largest error of the velocity two seconds after the first pose of an accurate initialization, relative to the true
speed [%], and at small speeds [m/s]."""


@dataclass(frozen=True)
class Row:
    """One run: what was run, how it ended, and its metrics."""

    scenario: str
    """Name of the scenario, or of an existing recording."""
    world: str
    """World in which the scenario is flown; empty for an existing recording."""
    seed: int | None
    """Seed of the scenario; None for an existing recording."""
    estimator: str
    """Label of the estimator, as given on the command line."""
    config_hash: str
    """Hash of the estimator's settings."""
    versions: str
    """Versions of the packages and hash of the code on which the result depends."""
    status: Status
    """How the run ended."""
    reason: str = ""
    """Why the status is not ok; empty if it is."""
    recording_hash: str = ""
    """Hash of the recording's content."""
    machine: str = ""
    """Processor, number of cores and system of the machine; timings of different machines are not comparable."""
    processor: str = ""
    """Kind of the processor, on whose linear algebra the last digits of the result depend; empty if it is not known."""
    defects: str = ""
    """Numbers of the recording's defects, such as ``3 × missing image, 1 × IMU gap``; empty without defects."""
    sub_trajectory_m: tuple[float, ...] = ()
    """Lengths of the sub-trajectories: 10 % to 50 % of the true path [m]."""
    sub_trajectory_rpe_m: tuple[float, ...] = ()
    """Relative position error over each of these lengths, root mean square [m]."""
    sub_trajectory_rpe_deg: tuple[float, ...] = ()
    """Relative orientation error over each of these lengths, root mean square [°]."""
    values: Mapping[str, float] = field(default_factory=dict)
    """Values of `STORED_METRICS` and of the metrics of the user by name, without those that are not known."""
    own_metrics: tuple[OwnMetric, ...] = ()
    """Metrics of the user."""

    @classmethod
    def from_columns(cls, columns: Mapping[str, Any], own_metrics: tuple[OwnMetric, ...] = ()) -> Self:
        """Return the row with some columns, metrics among them; other columns are not known."""
        run = {name: columns[name] for name in _RUN_COLUMNS if name in columns}
        names = (metric.name for metric in (*STORED_METRICS, *own_metrics))
        values = {name: columns[name] for name in names if columns.get(name) is not None}
        return cls(**run, values=values, own_metrics=own_metrics)

    @property
    def columns(self) -> dict[str, Any]:
        """All columns by name, in the order of the file; None where a metric is not known."""
        run = {name: getattr(self, name) for name in _RUN_COLUMNS}
        return run | {metric.name: self.values.get(metric.name) for metric in (*STORED_METRICS, *self.own_metrics)}

    def __getitem__(self, name: str) -> float | None:
        """Return the value of a metric; None if it is not known, as the errors of a failed run.

        Raises:
            KeyError: There is no such metric.
        """
        if name.startswith(PREFIX):  # a metric of the user
            return self.values.get(name)
        metric = METRICS[name]
        return metric.of(self.values) if metric in DERIVED_METRICS else self.values.get(name)

    @property
    def identity(self) -> Identity:
        """Scenario, seed and estimator."""
        return self.scenario, self.seed, self.estimator

    @property
    def diverged(self) -> bool:
        """Whether the run has scores, but a coverage below 99 % or an ATE above 1 % of the path.

        A flight without a path, such as one at rest, has diverged only if its coverage is too small.
        """
        if self.status != "ok":
            return False
        coverage_percent = self["coverage_percent"]
        covered = coverage_percent is None or coverage_percent >= MIN_COVERAGE_PERCENT
        return not covered or (self["ate_percent"] or 0.0) > MAX_ATE_PERCENT

    @property
    def started_accurately(self) -> bool:
        """Whether the velocity two seconds after the first pose is within 5 % or 3 cm/s of the true one."""
        error_m_s, speed_m_s = self["start_velocity_error_m_s"], self["start_speed_m_s"]
        if error_m_s is None or speed_m_s is None:
            return False
        return error_m_s <= max(START_VELOCITY_PERCENT / 100.0 * speed_m_s, START_VELOCITY_M_S)

    @property
    def dependencies(self) -> tuple[str, str, str]:
        """Everything on which the result depends: the run need not be repeated while this is the same."""
        return self.recording_hash, self.config_hash, self.versions


_RUN_COLUMNS = tuple(each.name for each in fields(Row) if each.name not in ("values", "own_metrics"))
_REQUIRED_COLUMNS = tuple(each.name for each in fields(Row) if each.default is each.default_factory is MISSING)


def own_metrics(rows: Iterable[Row]) -> tuple[OwnMetric, ...]:
    """Return the metrics of the user that some rows have."""
    return tuple({metric.name: metric for row in rows for metric in row.own_metrics}.values())


def schema(own: Iterable[OwnMetric] = ()) -> "pyarrow.Schema":
    """Return names and types of the columns; ``seed``, ``reason`` and the columns after it may be null.

    Args:
        own: Metrics of the user, which are metadata of their columns.
    """
    import pyarrow as pa

    kinds = {int | None: pa.int64(), tuple[float, ...]: pa.list_(pa.float64())}
    run = [(name, kinds.get(Row.__annotations__[name], pa.string())) for name in _RUN_COLUMNS]
    metrics = [(metric.name, pa.float64() if metric.decimals else pa.int64()) for metric in STORED_METRICS]
    columns = [pa.field(metric.name, pa.float64(), metadata={_METRIC: _definition(metric)}) for metric in own]
    return pa.schema([*run, *metrics, *columns])


def write_rows(path: Path, rows: Iterable[Row]) -> None:
    """Write rows to a Parquet file, which is renamed from a temporary one so that readers never see a part of it."""
    import pyarrow as pa
    from pyarrow import parquet

    temporary = path.with_name(f".{path.name}.part")
    rows = tuple(rows)
    parquet.write_table(pa.Table.from_pylist([row.columns for row in rows], schema(own_metrics(rows))), temporary)
    temporary.replace(path)


def read_rows(path: Path) -> tuple[Row, ...]:
    """Read the rows of a benchmark. Columns that a file lacks are not known: metrics may be younger than the file.

    Args:
        path: A Parquet file, or the folder of a benchmark.

    Raises:
        InputError: The file is missing, damaged, not that of a benchmark, or holds a run twice.
    """
    import pyarrow as pa
    from pyarrow import parquet

    path = path / RESULTS_FILE if path.is_dir() else path
    expected = "the results of `dronevio benchmark` (Parquet)"
    try:
        table = parquet.read_table(path)
    except FileNotFoundError:
        raise InputError(path, "no such file", expected) from None
    except (OSError, pa.ArrowException) as error:
        raise InputError(path, f"cannot be read ({str(error).splitlines()[0]})", expected) from None
    if missing := [name for name in _REQUIRED_COLUMNS if name not in table.column_names]:
        raise InputError(path, f"no column {', '.join(missing)}", expected)
    try:
        defined = (column.metadata[_METRIC] for column in table.schema if _METRIC in (column.metadata or {}))
        own = tuple(OwnMetric(**json.loads(text)) for text in defined)
        known = [column for column in schema(own) if column.name in table.column_names]
        table = table.select([column.name for column in known]).cast(pa.schema(known))
    except (pa.ArrowException, ValueError, TypeError) as error:
        raise InputError(path, f"columns of other types ({str(error).splitlines()[0]})", expected) from None
    rows = tuple(_row(path, number, values, own) for number, values in enumerate(table.to_pylist(), start=1))
    duplicates = [identity for identity, count in _counts(rows).items() if count > 1]
    if duplicates:
        raise InputError(path, f"two rows of {run_name(duplicates[0])}", "one row for each run")
    return rows


def run_name(identity: Identity) -> str:
    """Return the name of a run for messages."""
    scenario, seed, estimator = identity
    return f"{scenario}{'' if seed is None else f', seed {seed}'}, {estimator}"


def read_results(path: Path) -> tuple[Row, ...]:
    """Read the rows of a benchmark, or of a single ``dronevio run`` if its folder is given.

    Raises:
        InputError: The path is neither, or a file is damaged.
    """
    return (_row_of_report(path / _REPORT_FILE),) if (path / _REPORT_FILE).exists() else read_rows(path)


def _row_of_report(path: Path) -> Row:
    """Return the report of a run as a row."""
    expected = "the report.json of a `dronevio run`"
    try:
        report = json.loads(read_text(path, expected))
        scores, configuration = Scores.from_json(report["scores"]), report["configuration"]
        scenario, estimator = configuration["scenario"], configuration["estimator"]
        versions = ", ".join(f"{name} {version}" for name, version in report["versions"].items())
        run = {"scenario": scenario["name"], "world": scenario["world"], "seed": scenario["seed"], "estimator": "vio"}
        timing = {name: report["timing"][name] for name in ("cpu_ms_mean", "cpu_ms_p99", "real_time_factor")}
        flight = {"duration_s": report["flight"]["duration_s"]}
        made = {"config_hash": content_hash(estimator), "versions": versions, "status": "ok"}
        return Row.from_columns(run | made | score_columns(scores) | timing | flight)
    except (ValueError, TypeError, AttributeError) as error:
        raise InputError(path, f"damaged ({error})", expected) from None
    except KeyError as error:
        raise InputError(path, f"no {error}", expected) from None


def _definition(metric: OwnMetric) -> str:
    """Return everything about a metric but its function, as JSON."""
    return json.dumps({name: value for name, value in asdict(metric).items() if name != "of"})


def _row(path: Path, number: int, values: dict[str, Any], own: tuple[OwnMetric, ...]) -> Row:
    """Return a row of the file after the checks that the types of its columns do not cover."""
    required = ("scenario", "estimator", "status")
    empty = [name for name in required if values[name] is None]
    if empty or values["status"] not in get_args(Status):
        what = f"row {number} without {empty[0]}" if empty else f"row {number} with status {values['status']!r}"
        raise InputError(path, what, f"rows with {', '.join(required)}; status one of {', '.join(get_args(Status))}")
    for name in _RUN_COLUMNS:
        kind = Row.__annotations__[name]
        if kind is str:
            values[name] = values.get(name) or ""
        elif kind == tuple[float, ...]:
            values[name] = tuple(values.get(name) or ())
    return Row.from_columns(values, own)


def _counts(rows: Iterable[Row]) -> dict[Identity, int]:
    counts: dict[Identity, int] = {}
    for row in rows:
        counts[row.identity] = counts.get(row.identity, 0) + 1
    return counts
