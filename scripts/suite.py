"""Measure errors, failures and consistency over suites of simulated flights: room, hall and corridor at three levels.

Flights are folders named SCENARIO-SEED, as ``dronevio fly --rig euroc-stereo`` writes them. Those that exist are used::

    python scripts/suite.py --flights FOLDER --results ROWS
    python scripts/suite.py --flights FOLDER --results ROWS --quick     # one flight of each scenario, mono

The tables have the median of each group of flights; the error of a failed run is infinite. Covariances are evaluated by
the NEES with the gauge (position and yaw) fixed at the first pose of each flight. Flights are independent samples;
instants of one flight are not. If the covariances are correct, n times the mean over n flights of the NEES at one
instant is χ² distributed with 3n degrees of freedom. The tables have the two-sided 95 % interval of this mean. Averages
over time have a smaller variance, so a mean outside the interval is outside with more than 95 % confidence.
"""

import math
import re
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro
from estimation_tasks import EstimationTask, Mode, provenance, run_all, write_json
from markdown_tables import median, numbers, table, text
from run_metrics import RunMetrics, failures

from dronevio.eval.metrics.consistency import nees_bounds

WORLDS = ("room", "hall", "corridor")
LEVELS = ("easy", "medium", "difficult")
BOUNDS_PERCENT: dict[Mode, float] = {"mono": 0.2, "stereo": 0.1}
"""Bound of the median ATE [% of the length of the path]."""
_NAME = re.compile(r"(?P<world>\w+)-(?P<level>\w+)-v\d+-(?P<seed>\d+)")


@dataclass(frozen=True)
class SuiteCommand:
    """Estimate the existing flights of the suites and print Markdown tables."""

    flights: Path
    """Folder of the flights, which are named SCENARIO-SEED."""
    results: Path
    """Folder of the cached metrics of runs."""
    modes: tuple[Mode, ...] = ("mono", "stereo")
    """Cameras of the estimator."""
    seeds: str = "0-11"
    """Seeds of the flights, such as 0-11 or 0,3."""
    worlds: tuple[str, ...] = WORLDS
    """Worlds of the flights."""
    levels: tuple[str, ...] = LEVELS
    """Levels of the flights."""
    quick: bool = False
    """Use only the first seed of each scenario and one camera."""
    workers: int = 1
    """Number of runs at the same time."""
    json: Path | None = None
    """JSON file for the metrics of all runs."""


@dataclass(frozen=True)
class MeanNees:
    """Mean NEES of several flights, with the interval that is expected of a consistent estimator."""

    flights: int
    """Number of flights."""
    mean: float
    """Mean over the flights of the mean over time; infinite if a flight failed."""
    median: float
    """Median over the flights of the mean over time, which is robust against single bad flights."""
    low: float
    """Lower end of the 95 % interval of the mean."""
    high: float
    """Upper end of the 95 % interval of the mean."""
    inside_percent: float
    """Share of the seconds since the first pose with a mean over the flights within the interval; expected: 95 [%]."""

    @property
    def inside(self) -> bool:
        """Whether the mean is within the interval."""
        return self.low <= self.mean <= self.high


def mean_nees(means: Sequence[float], over_time: Sequence[Sequence[float]], degrees: int = 3) -> MeanNees:
    """Return the mean NEES of flights with equal weights.

    Args:
        means: Mean over time of each flight; infinite for a failed one.
        over_time: NEES of each flight at every second since its first pose; empty for a failed one.
        degrees: Dimension of the error.
    """
    n = len(means)
    low, high = nees_bounds(degrees, n)
    shortest = min((len(values) for values in over_time), default=0)
    instants = [math.fsum(values[second] for values in over_time) / n for second in range(shortest)]
    inside = sum(low <= value <= high for value in instants)
    share = 100.0 * inside / shortest if shortest else math.nan
    return MeanNees(n, math.fsum(means) / n, median(means), low, high, share)


def selected_flights(command: SuiteCommand) -> dict[str, Path]:
    """Return the existing flights that the options select, by name, ordered by seed and then by scenario."""
    seeds = numbers(command.seeds)
    found: list[tuple[int, int, str, Path]] = []
    for folder in command.flights.iterdir():
        parts = _NAME.fullmatch(folder.name)
        if parts is None or not (folder / "mav0").is_dir() or (folder / "mav0" / "INCOMPLETE").exists():
            continue
        world, level, seed = parts["world"], parts["level"], int(parts["seed"])
        if world in command.worlds and level in command.levels and seed in seeds:
            order = command.worlds.index(world) * len(command.levels) + command.levels.index(level)
            found.append((seed, order, folder.name, folder))
    if command.quick:
        first = {order: seed for seed, order, _, _ in sorted(found, reverse=True)}
        found = [each for each in found if first[each[1]] == each[0]]
    return {name: folder for _, _, name, folder in sorted(found)}


def group_row(label: str, rows: Sequence[RunMetrics]) -> list[str]:
    """Return the cells of a group of flights, see `HEADINGS`."""
    position, orientation = _mean_nees_of(rows)
    failed = sum(row.failed for row in rows)
    return [
        label,
        str(len(rows)),
        text(median(row.ate_percent for row in rows)),
        text(max(row.ate_percent for row in rows)),
        str(failed) if not failed else f"**{failed}**",
        text(median(row.rpe_m for row in rows), ".4f"),
        text(median(row.scale_error_percent for row in rows), "+.2f"),
        text(min(row.coverage_percent for row in rows), ".1f"),
        text(max(row.first_s for row in rows), ".2f"),
        f"{text(position.mean, '.2f')} ({text(position.median, '.2f')})",
        f"{text(orientation.mean, '.2f')} ({text(orientation.median, '.2f')})",
        f"{position.low:.2f}–{position.high:.2f}",
        text(median(row.cpu_ms_mean for row in rows), ".1f"),
        text(median(row.cpu_ms_p99 for row in rows), ".1f"),
    ]


def _mean_nees_of(rows: Sequence[RunMetrics]) -> tuple[MeanNees, MeanNees]:
    """Return the mean NEES of position and of orientation."""
    return (
        mean_nees([row.nees_position for row in rows], [row.nees_position_over_time for row in rows]),
        mean_nees([row.nees_orientation for row in rows], [row.nees_orientation_over_time for row in rows]),
    )


HEADINGS = (
    "flights",
    "n",
    "ATE [% of path], median",
    "largest",
    "failures",
    "RPE 1 s [m]",
    "scale [%]",
    "smallest coverage [%]",
    "latest first pose [s]",
    "mean NEES of position (median)",
    "mean NEES of orientation (median)",
    "95 % interval",
    "CPU ms",
    "p99",
)


def summary(rows: Sequence[RunMetrics], mode: Mode) -> str:
    """Return the table of one mode: each world and level, all worlds, all levels, and all flights."""
    own = [row for row in rows if row.mode == mode]
    cells = []
    for world in WORLDS:
        for level in LEVELS:
            group = [row for row in own if row.flight.startswith(f"{world}-{level}-")]
            if group:
                cells.append(group_row(f"{world} {level}", group))
    cells += [group_row(f"all {level}", group) for level, group in _grouped(own, LEVELS, 1).items()]
    cells += [group_row(f"all {world}", group) for world, group in _grouped(own, WORLDS, 0).items()]
    if own:
        cells.append(group_row("all", own))
    return table((f"{mode}: {HEADINGS[0]}", *HEADINGS[1:]), cells)


def _grouped(rows: Sequence[RunMetrics], names: Sequence[str], part: int) -> dict[str, list[RunMetrics]]:
    groups = {name: [row for row in rows if row.flight.split("-")[part] == name] for name in names}
    return {name: group for name, group in groups.items() if group}


def verdict(rows: Sequence[RunMetrics], mode: Mode) -> str:
    """Return sentences on the bounds of one mode, and a list of its failed flights."""
    own = [row for row in rows if row.mode == mode]
    if not own:
        return f"{mode}: no flights"
    typical = median(row.ate_percent for row in own)
    failed = [row for row in own if row.failed]
    lines = [
        f"{mode}, {len(own)} flights: median ATE {text(typical)} % (≤ {BOUNDS_PERCENT[mode]} %:"
        f" {'yes' if typical <= BOUNDS_PERCENT[mode] else '**no**'}), failures {len(failed)}"
        f" (none: {'**no**' if failed else 'yes'})."
    ]
    for name, nees in zip(("position", "orientation"), _mean_nees_of(own), strict=True):
        lines.append(
            f"Mean NEES of {name} {text(nees.mean, '.2f')} (median of flights {text(nees.median, '.2f')}), interval"
            f" {nees.low:.2f}–{nees.high:.2f}: {'inside' if nees.inside else '**outside**'};"
            f" at {text(nees.inside_percent, '.0f')} % of the seconds the mean over flights is inside."
        )
    lines += [
        f"- failed: {row.flight}: {row.status} {row.reason} coverage {row.coverage_percent:.1f} %,"
        f" ATE {text(row.ate_percent, '.2f')} %"
        for row in failed
    ]
    return "\n".join(lines)


def largest_errors(rows: Iterable[RunMetrics], count: int = 8) -> str:
    """Return a table of the flights with the largest errors relative to their paths."""
    ordered = sorted(rows, key=lambda row: -row.ate_percent)[:count]
    cells = [
        [
            row.flight,
            row.mode,
            text(row.ate_percent),
            text(row.ate_m),
            text(row.max_m),
            text(row.scale_error_percent, "+.2f"),
            text(row.coverage_percent, ".1f"),
            text(row.first_s, ".2f"),
            text(row.nees_position, ".1f"),
            text(row.nees_orientation, ".1f"),
            text(row.step_jump_m),
            text(row.step_jump_s, ".1f"),
        ]
        for row in ordered
    ]
    headings = (
        "flights with the largest errors",
        "",
        "ATE [%]",
        "ATE [m]",
        "max [m]",
        "scale [%]",
        "coverage [%]",
        "first pose [s]",
    )
    return table((*headings, "NEES p", "NEES θ", "largest jump [m]", "at [s]"), cells, 2)


def main(command: SuiteCommand) -> int:
    """Execute the runs that are not cached, print the tables, and return 1 if a flight failed."""
    flights = selected_flights(command)
    modes: tuple[Mode, ...] = ("mono",) if command.quick else command.modes
    tasks = [EstimationTask(name, folder, mode) for mode in modes for name, folder in flights.items()]
    rows = sorted(run_all(tasks, command.results, command.workers), key=lambda row: row.flight)
    print(f"{len(flights)} flights. {provenance()}\n")
    for mode in modes:
        print(summary(rows, mode) + "\n")
        print(verdict(rows, mode) + "\n")
    print(largest_errors(rows))
    print(failures(rows))
    write_json(command.json, rows)
    return int(any(row.failed for row in rows))


if __name__ == "__main__":
    sys.exit(main(tyro.cli(SuiteCommand, description=__doc__)))
