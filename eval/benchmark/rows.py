"""Rows of a benchmark: one for each run, failed ones included, stored as Parquet."""

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

Status: TypeAlias = Literal["ok", "failed", "timeout", "crashed"]
"""How a run ended: with scores, with an error message, at the time limit, or with the death of its process."""
Identity: TypeAlias = tuple[str, int | None, str]
"""Scenario, seed and estimator: runs of two benchmarks with the same identity are compared with each other."""
RESULTS_FILE = "results.parquet"
"""Name of the file with all rows of a benchmark, in its folder."""
VARIANT_SIGN = "+"
"""Stands between the name of a scenario and that of its variant."""
_REPORT_FILE = "report.json"
_LATER_COLUMNS = (
    "defects",
    "longest_loss_s",
    "tracking_sigmas",
    "processor",
    "nees_velocity",
    "max_error_m",
    "longest_gap_s",
    "step_error_m",
    "cpu_growth",
    "start_s",
    "start_acceleration_m_s2",
    "start_velocity_error_m_s",
    "start_speed_m_s",
    "start_scale_error_percent",
    "first_revisit_s",
    "rmse_after_revisit_m",
    "odometry_after_revisit_m",
    "final_after_revisit_m",
    "final_ate_m",
    "loops",
    "wrong_loops",
    "recall_percent",
    "worker_cpu_ms",
    "map_results",
    "map_waits",
)
"""Columns that results of earlier versions lack."""
MIN_COVERAGE_PERCENT, MAX_ATE_PERCENT = 99.0, 1.0
"""Smallest coverage, and largest ATE relative to the length of the path, of a run that has not diverged [%]."""
START_VELOCITY_PERCENT, START_VELOCITY_M_S = 5.0, 0.03
"""Largest error of the velocity two seconds after the first pose of an accurate initialization, relative to the true
speed [%], and at small speeds [m/s]."""


@dataclass(frozen=True)
class Row:
    """One run. In a failed run, all columns after ``reason`` may be None except ``wall_s`` and ``recording_hash``."""

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
    coverage_percent: float | None = None
    """Share of the frames later than 3 s after the first that have a pose [%]."""
    first_pose_s: float | None = None
    """Time of the first compared pose after the first true pose [s]."""
    path_m: float | None = None
    """Length of the true path over the compared poses [m]."""
    duration_s: float | None = None
    """Time from the first frame to the last [s]."""
    ate_m: float | None = None
    """Absolute position error after alignment of yaw and position, root mean square [m]."""
    ate_deg: float | None = None
    """Absolute orientation error after the same alignment, root mean square [°]."""
    rpe_m: float | None = None
    """Relative position error over 1 s, root mean square [m]."""
    rpe_deg: float | None = None
    """Relative orientation error over 1 s, root mean square [°]."""
    scale_error_percent: float | None = None
    """Relative error of the scale of the estimated path, positive if it is too large [%]."""
    drift_percent: float | None = None
    """Mean drift over sub-trajectories, relative to their lengths [%]."""
    nees_position: float | None = None
    """Mean normalized estimation error squared of the position, 3 expected; None without covariances."""
    nees_orientation: float | None = None
    """Mean normalized estimation error squared of the orientation, 3 expected; None without covariances."""
    position_beyond_3_sigma_percent: float | None = None
    """Share of position errors beyond three standard deviations [%]; None without covariances."""
    velocity_m_s: float | None = None
    """Velocity error, root mean square [m/s]; None if the truth or the estimate has no velocities."""
    cpu_ms_mean: float | None = None
    """Mean processor time of all threads per frame [ms]."""
    cpu_ms_p99: float | None = None
    """99th percentile of the processor time per frame [ms]; None for an external program."""
    real_time_factor: float | None = None
    """Seconds of flight that are estimated in one second of processor time."""
    wall_s: float = 0.0
    """Elapsed time of the run's process [s]."""
    peak_mb: float | None = None
    """Peak memory of the process, or of the largest process of an external program [MB]."""
    recording_hash: str = ""
    """Hash of the recording's content."""
    machine: str = ""
    """Processor, number of cores and system of the machine; timings of different machines are not comparable."""
    sub_trajectory_m: tuple[float, ...] = ()
    """Lengths of the sub-trajectories: 10 % to 50 % of the true path [m]."""
    sub_trajectory_rpe_m: tuple[float, ...] = ()
    """Relative position error over each of these lengths, root mean square [m]."""
    sub_trajectory_rpe_deg: tuple[float, ...] = ()
    """Relative orientation error over each of these lengths, root mean square [°]."""
    defects: str = ""
    """Numbers of the recording's defects, such as ``3 × missing image, 1 × IMU gap``; empty without defects."""
    longest_loss_s: float | None = None
    """Longest time without tracking after the first frame that is tracked [s]; None if none is, or for a program."""
    tracking_sigmas: float | None = None
    """Largest error of position while the estimator reports that it tracks, in standard deviations along the least
    certain axis; None if it never does, without covariances, or for a program."""
    processor: str = ""
    """Kind of the processor, on whose linear algebra the last digits of the result depend; empty if it is not known."""
    nees_velocity: float | None = None
    """Mean normalized estimation error squared of the velocity, 3 expected; None without covariances or velocities."""
    max_error_m: float | None = None
    """Largest absolute position error after alignment of yaw and position [m]."""
    longest_gap_s: float | None = None
    """Longest time between two successive compared poses [s]."""
    step_error_m: float | None = None
    """Largest error of a step from one pose to the next [m]: jumps of the estimate."""
    cpu_growth: float | None = None
    """Mean processor time per frame in the last quarter of the flight, relative to the second quarter; None for an
    external program."""
    start_s: float | None = None
    """Time from the first frame to the first pose [s]."""
    start_acceleration_m_s2: float | None = None
    """Root mean square of the true acceleration in the first two seconds [m/s²]."""
    start_velocity_error_m_s: float | None = None
    """Error of the velocity two seconds after the first pose [m/s]; None if the estimate has no velocities."""
    start_speed_m_s: float | None = None
    """True speed two seconds after the first pose [m/s]."""
    start_scale_error_percent: float | None = None
    """Relative error of the scale in the two seconds after the first pose, positive if it is too large [%]; None at
    rest."""
    first_revisit_s: float | None = None
    """Time from the first frame to the first revisit of a place by the true motion [s]; None without revisits, or if
    the simulated world is not known."""
    rmse_after_revisit_m: float | None = None
    """Position error over the frames later than 2 s after the first revisit, or over all frames without revisits, root
    mean square [m], after the alignment of ``ate_m``; None if the simulated world is not known."""
    odometry_after_revisit_m: float | None = None
    """The same of the odometry of an estimator with a map, aligned by itself [m]; None without a map."""
    final_after_revisit_m: float | None = None
    """The same of the path corrected by the final map [m]; None without a map."""
    final_ate_m: float | None = None
    """Absolute position error of the path corrected by the final map, root mean square [m]; None without a map."""
    loops: int | None = None
    """Number of loops that the final map accepts; None without a map."""
    wrong_loops: int | None = None
    """Number of them whose relative pose is wrong by the truth; None if the simulated world is not known."""
    recall_percent: float | None = None
    """Share of the revisiting keyframes with a right loop within 1 s [%]; None without revisits."""
    worker_cpu_ms: float | None = None
    """Mean processor time per frame of the process that builds the map, a part of ``cpu_ms_mean`` [ms]; None without a
    map."""
    map_results: int | None = None
    """Number of results of that process; None without a map."""
    map_waits: int | None = None
    """Number of results for which a frame had to wait; None without a map."""

    @property
    def identity(self) -> Identity:
        """Scenario, seed and estimator."""
        return self.scenario, self.seed, self.estimator

    @property
    def ate_percent(self) -> float | None:
        """Absolute position error relative to the length of the true path [%]; None in a failed run or at rest."""
        return 100.0 * self.ate_m / self.path_m if self.ate_m is not None and self.path_m else None

    @property
    def diverged(self) -> bool:
        """Whether the run has scores, but a coverage below 99 % or an ATE above 1 % of the path.

        A flight without a path, such as one at rest, has diverged only if its coverage is too small.
        """
        if self.status != "ok":
            return False
        covered = self.coverage_percent is None or self.coverage_percent >= MIN_COVERAGE_PERCENT
        return not covered or (self.ate_percent or 0.0) > MAX_ATE_PERCENT

    @property
    def started_accurately(self) -> bool:
        """Whether the velocity two seconds after the first pose is within 5 % or 3 cm/s of the true one."""
        if self.start_velocity_error_m_s is None or self.start_speed_m_s is None:
            return False
        bound_m_s = max(START_VELOCITY_PERCENT / 100.0 * self.start_speed_m_s, START_VELOCITY_M_S)
        return self.start_velocity_error_m_s <= bound_m_s

    @property
    def dependencies(self) -> tuple[str, str, str]:
        """Everything on which the result depends: the run need not be repeated while this is the same."""
        return self.recording_hash, self.config_hash, self.versions


def schema() -> "pyarrow.Schema":
    """Return names and types of the columns; ``seed``, ``reason`` and the columns after it may be null."""
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
    """Write rows to a Parquet file, which is renamed from a temporary one so that readers never see a part of it."""
    import pyarrow as pa
    from pyarrow import parquet

    columns = [field.name for field in fields(Row)]
    values = [{name: getattr(row, name) for name in columns} for row in rows]
    temporary = path.with_name(f".{path.name}.part")
    parquet.write_table(pa.Table.from_pylist(values, schema()), temporary)
    temporary.replace(path)


def read_rows(path: Path) -> tuple[Row, ...]:
    """Read the rows of a benchmark.

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
    for name in _LATER_COLUMNS:
        if name not in table.column_names:
            table = table.append_column(name, pa.nulls(len(table), schema().field(name).type))
    missing = [name for name in schema().names if name not in table.column_names]
    if missing:
        raise InputError(path, f"no column {', '.join(missing)}", expected)
    try:
        table = table.select(schema().names).cast(schema())
    except (pa.ArrowException, ValueError) as error:
        raise InputError(path, f"columns of other types ({str(error).splitlines()[0]})", expected) from None
    rows = tuple(_row(path, number, values) for number, values in enumerate(table.to_pylist(), start=1))
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
        scores, timing, configuration = report["scores"], report["timing"], report["configuration"]
        scenario, estimator = configuration["scenario"], configuration["estimator"]
        errors = {name: scores[name] and scores[name]["rmse"] for name in ("ate_m", "ate_deg", "rpe_m", "rpe_deg")}
        plain = (
            "coverage_percent",
            "first_pose_s",
            "path_m",
            "scale_error_percent",
            "nees_position",
            "nees_orientation",
        )
        return Row(
            scenario["name"],
            scenario["world"],
            scenario["seed"],
            "vio",
            config_hash=content_hash(estimator),
            versions=", ".join(f"{name} {version}" for name, version in report["versions"].items()),
            status="ok",
            duration_s=report["flight"]["duration_s"],
            drift_percent=scores.get("drift_percent"),
            max_error_m=scores["ate_m"] and scores["ate_m"].get("max"),
            nees_velocity=scores.get("nees_velocity"),
            **errors,
            **{name: scores[name] for name in plain},
            **{name: timing[name] for name in ("cpu_ms_mean", "cpu_ms_p99", "real_time_factor")},
        )
    except (ValueError, TypeError, AttributeError) as error:
        raise InputError(path, f"damaged ({error})", expected) from None
    except KeyError as error:
        raise InputError(path, f"no {error}", expected) from None


def _row(path: Path, number: int, values: dict[str, Any]) -> Row:
    """Return a row of the file after the checks that the types of its columns do not cover."""
    required = ("scenario", "estimator", "status", "wall_s")
    empty = [name for name in required if values[name] is None]
    if empty or values["status"] not in get_args(Status):
        found = f"row {number} without {empty[0]}" if empty else f"row {number} with status {values['status']!r}"
        raise InputError(path, found, f"rows with {', '.join(required)}; status one of {', '.join(get_args(Status))}")
    for name, kind in Row.__annotations__.items():
        if kind == tuple[float, ...]:
            values[name] = tuple(values[name] or ())
        elif kind is str:
            values[name] = values[name] or ""
    return Row(**values)


def _counts(rows: Iterable[Row]) -> dict[Identity, int]:
    counts: dict[Identity, int] = {}
    for row in rows:
        counts[row.identity] = counts.get(row.identity, 0) + 1
    return counts
