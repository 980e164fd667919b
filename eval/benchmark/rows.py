"""The rows of a benchmark: one run each, the failed ones included, kept as Parquet."""

import json
from collections.abc import Iterable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeAlias, get_args

from dronevio.eval.benchmark.cache import content_hash
from dronevio.models.errors import InputError
from dronevio.models.recordings.files import read_text

if TYPE_CHECKING:
    import pyarrow

    from dronevio.eval.metrics.scores import Scores

Status: TypeAlias = Literal["ok", "failed", "timeout", "crashed"]
"""How a run ended: scored, with an error that was told, past its time, or with its process dead."""
Identity: TypeAlias = tuple[str, int | None, str]
"""What makes two runs of two benchmarks a pair: scenario, seed and estimator."""
RESULTS_FILE = "results.parquet"
"""All rows of a benchmark, in its folder."""
_REPORT = "report.json"


@dataclass(frozen=True)
class Row:
    """One run. Of a failed one, all that follows ``reason`` may be None but ``wall_s`` and ``recording``."""

    scenario: str
    """What was flown: a scenario's name, or that of a recording from elsewhere."""
    world: str
    """Where; empty for a recording from elsewhere."""
    seed: int | None
    """The scenario's seed; None for a recording from elsewhere."""
    estimator: str
    """Who estimated: a name that `dronevio.registry` knows."""
    config_hash: str
    """Tells the estimator's settings apart."""
    versions: str
    """What the run depends on: the package, its code, and the libraries."""
    status: Status
    """How the run ended."""
    reason: str = ""
    """Why it is not ok."""
    coverage_percent: float | None = None
    """Share of the frames later than 3 s after the first that have a pose [%]."""
    first_s: float | None = None
    """Time of the first pose after the truth's first [s]."""
    path_m: float | None = None
    """Length of the true path over the compared poses [m]."""
    duration_s: float | None = None
    """Time from the first frame to the last [s]."""
    ate_m: float | None = None
    """Absolute error of position, yaw and position aligned, root mean square [m]."""
    ate_deg: float | None = None
    """Absolute error of orientation, root mean square [°]."""
    rpe_m: float | None = None
    """Relative error of position over one second, root mean square [m]."""
    rpe_deg: float | None = None
    """Relative error of orientation over one second, root mean square [°]."""
    scale_error_percent: float | None = None
    """By how much the estimated path is too large [%]."""
    drift_percent: float | None = None
    """Mean drift over the sub-trajectories, by their lengths [%]."""
    nees_position: float | None = None
    """Mean normalized squared error of position, 3 expected; None without covariances."""
    nees_orientation: float | None = None
    """The same of orientation."""
    beyond_3_sigma_percent: float | None = None
    """Share of position errors beyond three standard deviations [%]."""
    velocity_m_s: float | None = None
    """Error of velocity, root mean square [m/s]; None where either side does not tell it."""
    cpu_ms_mean: float | None = None
    """Processor time a frame, of all threads [ms]."""
    cpu_ms_p99: float | None = None
    """Its 99th percentile [ms]; None for a program of which only the whole is known."""
    real_time_factor: float | None = None
    """Seconds of flight that are estimated in one second of processor time."""
    wall_s: float = 0.0
    """How long the run's process lived [s]."""
    peak_mb: float | None = None
    """The most memory that the process held [MB]; of an external program, the largest of its processes."""
    recording: str = ""
    """Content hash of the recording."""
    machine: str = ""
    """What the run was done on: processor and cores; timings of different machines tell nothing."""
    length_m: tuple[float, ...] = ()
    """Lengths of the sub-trajectories: 10 % to 50 % of the true path [m]."""
    rpe_len_m: tuple[float, ...] = ()
    """Relative error of position over each of them, root mean square [m]."""
    rpe_len_deg: tuple[float, ...] = ()
    """Relative error of orientation over each of them, root mean square [°]."""

    @property
    def identity(self) -> Identity:
        """What this run is compared with in another benchmark."""
        return self.scenario, self.seed, self.estimator

    @property
    def dependencies(self) -> tuple[str, str, str]:
        """All that its result depends on: the run need not be done again while these are the same."""
        return self.recording, self.config_hash, self.versions


def figures_of(scores: "Scores") -> dict[str, Any]:
    """Return the columns that come out of the scores of an estimate."""
    return {
        "coverage_percent": scores.coverage_percent,
        "first_s": scores.first_s,
        "path_m": scores.path_m,
        "ate_m": scores.ate_m.rmse,
        "ate_deg": scores.ate_deg.rmse,
        "rpe_m": scores.rpe_m and scores.rpe_m.rmse,
        "rpe_deg": scores.rpe_deg and scores.rpe_deg.rmse,
        "scale_error_percent": scores.scale_error_percent,
        "drift_percent": scores.drift_percent,
        "nees_position": scores.nees_position,
        "nees_orientation": scores.nees_orientation,
        "beyond_3_sigma_percent": scores.position_beyond_3_sigma_percent,
        "velocity_m_s": scores.velocity_m_s and scores.velocity_m_s.rmse,
        "length_m": tuple(piece.length_m for piece in scores.lengths),
        "rpe_len_m": tuple(piece.translation_m.rmse for piece in scores.lengths),
        "rpe_len_deg": tuple(piece.rotation_deg.rmse for piece in scores.lengths),
    }


def schema() -> "pyarrow.Schema":
    """Return the columns and their types; ``reason`` and what follows may be null, as may ``seed``."""
    import pyarrow as pa

    kinds = {int | None: pa.int64(), float: pa.float64(), float | None: pa.float64()}
    lists = pa.list_(pa.float64())
    return pa.schema(
        [
            (name, lists if kind == tuple[float, ...] else kinds.get(kind, pa.string()))
            for name, kind in Row.__annotations__.items()
        ]
    )


def write_rows(path: Path, rows: Iterable[Row]) -> None:
    """Write rows as a Parquet file, beside its place first: nobody ever sees half of it."""
    import pyarrow as pa
    from pyarrow import parquet

    columns = [field.name for field in fields(Row)]
    values = [{name: getattr(row, name) for name in columns} for row in rows]
    beside = path.with_name(f".{path.name}.part")
    parquet.write_table(pa.Table.from_pylist(values, schema()), beside)
    beside.replace(path)


def read_rows(path: Path) -> tuple[Row, ...]:
    """Read the rows of a benchmark.

    Args:
        path: A Parquet file, or a benchmark's folder.

    Raises:
        InputError: It is missing, damaged, or no benchmark's; or one run is there twice.
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
    missing = [name for name in schema().names if name not in table.column_names]
    if missing:
        raise InputError(path, f"no column {', '.join(missing)}", expected)
    try:
        table = table.select(schema().names).cast(schema())
    except (pa.ArrowException, ValueError) as error:
        raise InputError(path, f"columns of other types ({str(error).splitlines()[0]})", expected) from None
    rows = tuple(_row(path, number, values) for number, values in enumerate(table.to_pylist(), start=1))
    doubled = [identity for identity, count in _counted(rows).items() if count > 1]
    if doubled:
        raise InputError(path, f"{run_name(doubled[0])} is there twice", "one row for each run")
    return rows


def run_name(identity: Identity) -> str:
    """Return what to call a run, for people."""
    scenario, seed, estimator = identity
    return f"{scenario}{'' if seed is None else f', seed {seed}'}, {estimator}"


def read_results(path: Path) -> tuple[Row, ...]:
    """Read the rows of a benchmark, or of a single ``dronevio run``, given its folder.

    Raises:
        InputError: It is neither, or damaged.
    """
    return (_row_of_report(path / _REPORT),) if (path / _REPORT).exists() else read_rows(path)


def _row_of_report(path: Path) -> Row:
    """Return a run's report as a row."""
    expected = "the report.json of a `dronevio run`"
    try:
        report = json.loads(read_text(path, expected))
        scores, timing, configuration = report["scores"], report["timing"], report["configuration"]
        flown, estimator = configuration["scenario"], configuration["estimator"]
        errors = {name: scores[name] and scores[name]["rmse"] for name in ("ate_m", "ate_deg", "rpe_m", "rpe_deg")}
        plain = ("coverage_percent", "first_s", "path_m", "scale_error_percent", "nees_position", "nees_orientation")
        return Row(
            flown["name"],
            flown["world"],
            flown["seed"],
            "vio",
            config_hash=content_hash(estimator),
            versions=", ".join(f"{name} {version}" for name, version in report["versions"].items()),
            status="ok",
            duration_s=report["flight"]["duration_s"],
            drift_percent=scores.get("drift_percent"),
            **errors,
            **{name: scores[name] for name in plain},
            **{name: timing[name] for name in ("cpu_ms_mean", "cpu_ms_p99", "real_time_factor")},
        )
    except (ValueError, TypeError, AttributeError) as error:
        raise InputError(path, f"damaged ({error})", expected) from None
    except KeyError as error:
        raise InputError(path, f"no {error}", expected) from None


def _row(path: Path, number: int, values: dict[str, Any]) -> Row:
    """Return a row of the file, its cells checked as far as types do not do it."""
    must = ("scenario", "estimator", "status", "wall_s")
    empty = [name for name in must if values[name] is None]
    if empty or values["status"] not in get_args(Status):
        found = f"row {number} without {empty[0]}" if empty else f"row {number} of status {values['status']!r}"
        raise InputError(path, found, f"rows with {', '.join(must)}; status one of {', '.join(get_args(Status))}")
    for name, kind in Row.__annotations__.items():
        if kind == tuple[float, ...]:
            values[name] = tuple(values[name] or ())
        elif kind is str:
            values[name] = values[name] or ""
    return Row(**values)


def _counted(rows: Iterable[Row]) -> dict[Identity, int]:
    counts: dict[Identity, int] = {}
    for row in rows:
        counts[row.identity] = counts.get(row.identity, 0) + 1
    return counts
