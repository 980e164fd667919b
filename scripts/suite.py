"""Errors, failures and honesty over suites of simulated flights: room, hall, corridor, each easy, medium, difficult.

Flights are folders named SCENARIO-SEED, as ``dronevio fly --rig euroc-stereo`` makes them; what is there is measured::

    python scripts/suite.py --flights FOLDER --results ROWS
    python scripts/suite.py --flights FOLDER --results ROWS --quick     # one flight of each scenario, mono

A group of flights counts with its median, a failed run as infinitely wrong. The covariances are judged by the NEES: the
gauge (position and yaw) is fixed at the first pose of each flight, and what is independent is a flight, never an
instant. The mean over n flights of the NEES at one instant is χ² distributed with 3n degrees of freedom, divided by n,
if the covariances are right; its two-sided 95 % band is given beside it. What was averaged along the flight first
varies less, never more: a mean outside the band is outside with more than 95 % certainty.
"""

import math
import re
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import tyro
from figures import Figures, failures
from measuring import Mode, Task, done, provenance, write_json
from tables import median, numbers, table, text

from dronevio.eval.metrics.consistency import nees_bounds

WORLDS = ("room", "hall", "corridor")
LEVELS = ("easy", "medium", "difficult")
BOUNDS_PERCENT: dict[Mode, float] = {"mono": 0.2, "stereo": 0.1}
"""What the median ATE is to stay below [% of the path]."""
_NAME = re.compile(r"(?P<world>\w+)-(?P<level>\w+)-v\d+-(?P<seed>\d+)")


@dataclass(frozen=True)
class Suite:
    """Estimate the flights of the suites that are there and print Markdown tables."""

    flights: Path
    """Folder of the flights, each named SCENARIO-SEED."""
    results: Path
    """Folder in which rows are kept, so that what is done need not be done again."""
    modes: tuple[Mode, ...] = ("mono", "stereo")
    """How many cameras to use."""
    seeds: str = "0-11"
    """Which flights, such as 0-11 or 0,3."""
    worlds: tuple[str, ...] = WORLDS
    """Where."""
    levels: tuple[str, ...] = LEVELS
    """How lively."""
    quick: bool = False
    """Only the first seed of each scenario, mono."""
    workers: int = 1
    """How many runs at a time."""
    json: Path | None = None
    """File for all rows."""


@dataclass(frozen=True)
class Anees:
    """The mean NEES of some flights, beside what a consistent estimator's would be."""

    flights: int
    """How many there are."""
    mean: float
    """Mean over the flights of the mean over time; infinite if a flight failed."""
    median: float
    """Median over the flights of the mean over time: what a single bad flight does not move."""
    low: float
    """Lower end of the 95 % band for so many flights."""
    high: float
    """Upper end of it."""
    inside_percent: float
    """Share of the seconds since the first pose at which the mean over the flights is in the band [%]; 95 expected."""

    @property
    def inside(self) -> bool:
        """Whether the mean is in the band."""
        return self.low <= self.mean <= self.high


def anees(means: Sequence[float], over_time: Sequence[Sequence[float]], degrees: int = 3) -> Anees:
    """Return the mean NEES of flights, each of which counts once.

    Args:
        means: The mean over time of each flight; infinite of a failed one.
        over_time: For each flight, the NEES at every second since its first pose; none of a failed one.
        degrees: Size of the error.
    """
    n = len(means)
    low, high = nees_bounds(degrees, n)
    shortest = min((len(values) for values in over_time), default=0)
    instants = [math.fsum(values[second] for values in over_time) / n for second in range(shortest)]
    inside = sum(low <= value <= high for value in instants)
    share = 100.0 * inside / shortest if shortest else math.nan
    return Anees(n, math.fsum(means) / n, median(means), low, high, share)


def known_flights(command: Suite) -> dict[str, Path]:
    """Return the flights that are there and wanted, the first seed of all first."""
    seeds = numbers(command.seeds)
    found: list[tuple[int, int, str, Path]] = []
    for place in command.flights.iterdir():
        named = _NAME.fullmatch(place.name)
        if named is None or not (place / "mav0").is_dir() or (place / "mav0" / "INCOMPLETE").exists():
            continue
        world, level, seed = named["world"], named["level"], int(named["seed"])
        if world in command.worlds and level in command.levels and seed in seeds:
            order = command.worlds.index(world) * len(command.levels) + command.levels.index(level)
            found.append((seed, order, place.name, place))
    if command.quick:
        first = {order: seed for seed, order, _, _ in sorted(found, reverse=True)}
        found = [each for each in found if first[each[1]] == each[0]]
    return {name: place for _, _, name, place in sorted(found)}


def group_row(label: str, rows: Sequence[Figures]) -> list[str]:
    """Return a row of the table: errors, failures and costs of some flights."""
    position, orientation = _anees_of(rows)
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


def _anees_of(rows: Sequence[Figures]) -> tuple[Anees, Anees]:
    """Return the mean NEES of position and of orientation."""
    return (
        anees([row.nees_position for row in rows], [row.nees_position_over_time for row in rows]),
        anees([row.nees_orientation for row in rows], [row.nees_orientation_over_time for row in rows]),
    )


HEADINGS = (
    "flights",
    "n",
    "ATE [% of path], median",
    "worst",
    "failures",
    "RPE 1 s [m]",
    "scale [%]",
    "least coverage [%]",
    "latest first pose [s]",
    "ANEES position (median)",
    "ANEES orientation (median)",
    "95 % band",
    "CPU ms",
    "p99",
)


def summary(rows: Sequence[Figures], mode: Mode) -> str:
    """Return the table of one mode: world × level, and all."""
    own = [row for row in rows if row.mode == mode]
    cells = []
    for world in WORLDS:
        for level in LEVELS:
            group = [row for row in own if row.flight.startswith(f"{world}-{level}-")]
            if group:
                cells.append(group_row(f"{world} {level}", group))
    cells += [group_row(f"all {level}", group) for level, group in _by(own, LEVELS, 1).items()]
    cells += [group_row(f"all {world}", group) for world, group in _by(own, WORLDS, 0).items()]
    if own:
        cells.append(group_row("all", own))
    return table((f"{mode}: {HEADINGS[0]}", *HEADINGS[1:]), cells)


def _by(rows: Sequence[Figures], names: Sequence[str], part: int) -> dict[str, list[Figures]]:
    groups = {name: [row for row in rows if row.flight.split("-")[part] == name] for name in names}
    return {name: group for name, group in groups.items() if group}


def verdict(rows: Sequence[Figures], mode: Mode) -> str:
    """Say whether one mode keeps what is asked of it."""
    own = [row for row in rows if row.mode == mode]
    if not own:
        return f"{mode}: no flights"
    middle = median(row.ate_percent for row in own)
    failed = [row for row in own if row.failed]
    lines = [
        f"{mode}, {len(own)} flights: median ATE {text(middle)} % (≤ {BOUNDS_PERCENT[mode]} %:"
        f" {'yes' if middle <= BOUNDS_PERCENT[mode] else '**no**'}), failures {len(failed)}"
        f" (none: {'**no**' if failed else 'yes'})."
    ]
    for name, found in zip(("position", "orientation"), _anees_of(own), strict=True):
        lines.append(
            f"ANEES of {name} {text(found.mean, '.2f')} (median of flights {text(found.median, '.2f')}), band"
            f" {found.low:.2f}–{found.high:.2f}: {'inside' if found.inside else '**outside**'};"
            f" at {text(found.inside_percent, '.0f')} % of the seconds the mean over flights is inside."
        )
    lines += [
        f"- failed: {row.flight}: {row.status} {row.reason} coverage {row.coverage_percent:.1f} %,"
        f" ATE {text(row.ate_percent, '.2f')} %"
        for row in failed
    ]
    return "\n".join(lines)


def worst(rows: Iterable[Figures], count: int = 8) -> str:
    """Return a table of the worst flights."""
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
    headings = ("worst flights", "", "ATE [%]", "ATE [m]", "max [m]", "scale [%]", "coverage [%]", "first pose [s]")
    return table((*headings, "NEES p", "NEES θ", "largest jump [m]", "at [s]"), cells, 2)


def main(command: Suite) -> int:
    """Run all that is missing, print the tables; 1 if a flight failed."""
    flights = known_flights(command)
    modes: tuple[Mode, ...] = ("mono",) if command.quick else command.modes
    tasks = [Task(name, place, mode) for mode in modes for name, place in flights.items()]
    rows = sorted(done(tasks, command.results, command.workers), key=lambda row: row.flight)
    print(f"{len(flights)} flights. {provenance()}\n")
    for mode in modes:
        print(summary(rows, mode) + "\n")
        print(verdict(rows, mode) + "\n")
    print(worst(rows))
    print(failures(rows))
    write_json(command.json, rows)
    return int(any(row.failed for row in rows))


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Suite, description=__doc__)))
