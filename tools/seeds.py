"""Run a scenario with seeds 0 to 9 and print scores and costs as a Markdown table: ``make seeds``.

With ``ARGS=--write``, the table in ``docs/getting-started.md`` is replaced. Each seed is one ``dronevio run`` in a
process of its own. Times are those of the whole command. The memory is the peak of all its processes together, sampled
ten times per second; shared pages count once on Linux, and once per process on other systems.
"""

import json
import os
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import tyro

SAMPLE_EVERY_S = 0.1
PAGE = Path(__file__).resolve().parents[1] / "docs" / "getting-started.md"
SHOWN = (0, 1, 2)
"""Seeds whose rows are in the documentation; mean and worst are those of all."""
BEGINNING, END = "<!-- seeds -->", "<!-- /seeds -->"


@dataclass(frozen=True)
class SeedsCommand:
    """Run a scenario with several seeds and print a Markdown table of scores and costs."""

    seeds: tuple[int, ...] = tuple(range(10))
    """Seeds of the scenario."""
    scenario: str = "room"
    """Name of the scenario."""
    write: bool = False
    """Replace the table in the documentation."""
    keep: Path | None = None
    """Folder in which the runs are kept, in a subfolder for each seed; by default they are deleted."""


@dataclass(frozen=True)
class CommandCost:
    """Resources that one command used."""

    wall_s: float
    """Wall-clock time [s]."""
    cpu_s: float
    """Processor time of all processes [s]."""
    memory_gb: float
    """Peak memory of all processes together [GB]."""


def largest(values: Iterable[float]) -> float:
    """Return the number with the largest absolute value."""
    return max(values, key=abs)


@dataclass(frozen=True)
class Column:
    """One column of the table."""

    title: str
    """Heading with the unit."""
    form: str
    """Format specification of the numbers."""
    value: Callable[[Mapping[str, Any], CommandCost], float]
    """Function that returns the number from the report of a run and its cost."""
    worst: Callable[[Iterable[float]], float] = largest
    """Function that selects the worst of several numbers."""


COLUMNS = (
    Column("ATE [m]", ".3f", lambda report, cost: report["scores"]["ate_m"]["rmse"]),
    Column("ATE [°]", ".2f", lambda report, cost: report["scores"]["ate_deg"]["rmse"]),
    Column("RPE [m]", ".3f", lambda report, cost: report["scores"]["rpe_m"]["rmse"]),
    Column("RPE [°]", ".2f", lambda report, cost: report["scores"]["rpe_deg"]["rmse"]),
    Column("scale error [%]", "+.2f", lambda report, cost: report["scores"]["scale_error_percent"]),
    Column("coverage [%]", ".1f", lambda report, cost: report["scores"]["coverage_percent"], min),
    Column("NEES", ".1f", lambda report, cost: report["scores"]["nees_position"]),
    Column("per frame [ms]", ".1f", lambda report, cost: report["timing"]["cpu_ms_mean"]),
    Column("wall [s]", ".0f", lambda report, cost: cost.wall_s),
    Column("CPU [s]", ".0f", lambda report, cost: cost.cpu_s),
    Column("memory [GB]", ".2f", lambda report, cost: cost.memory_gb),
)
ACCURACY = 7
"""Number of columns, from the first on, that do not depend on the machine."""


def measure(command: Sequence[str]) -> tuple[str, CommandCost]:
    """Run a command, and return its standard output and its cost. If it fails, this process ends with its error."""
    start = time.perf_counter()
    with tempfile.TemporaryFile("w+", encoding="utf-8") as output:
        process = psutil.Popen(command, stdout=output)
        peak = 0
        while True:
            peak = max(peak, memory_of(process))
            pid, status, usage = os.wait4(process.pid, os.WNOHANG)
            if pid:
                break
            time.sleep(SAMPLE_EVERY_S)
        if os.waitstatus_to_exitcode(status) != 0:
            sys.exit(f"seeds: {' '.join(command)} failed")
        output.seek(0)
        printed = output.read()
    return printed, CommandCost(time.perf_counter() - start, usage.ru_utime + usage.ru_stime, peak * 1e-9)


def memory_of(process: psutil.Process) -> int:
    """Return the memory of a process and its descendants [bytes]."""
    total = 0
    try:
        for each in (process, *process.children(recursive=True)):
            memory = each.memory_full_info()
            total += getattr(memory, "pss", memory.rss)
    except (psutil.NoSuchProcess, psutil.AccessDenied):  # a process ended while it was sampled
        pass
    return total


def main(command: SeedsCommand) -> int:
    """Run all seeds, print the table, and replace that in the documentation if this is asked for."""
    values, report = [], {}
    with tempfile.TemporaryDirectory(prefix="dronevio-") as folder:
        for seed in command.seeds:
            print(f"seed {seed}", file=sys.stderr, flush=True)
            out = (command.keep or Path(folder)) / f"{seed}"
            options = ["--scenario", command.scenario, "--seed", str(seed), "--out", str(out), "--json"]
            printed, cost = measure([sys.executable, "-m", "dronevio.cli", "run", *options])
            report = json.loads(printed)
            values.append([float(column.value(report, cost)) for column in COLUMNS])
    text = f"{seeds_table(command.seeds, values)}\n\n{provenance(report)}"
    print(text)
    if command.write:
        shown = f"{seeds_table(command.seeds, values, SHOWN)}\n\n{provenance(report)}"
        before, _, rest = PAGE.read_text(encoding="utf-8").partition(BEGINNING)
        after = rest.partition(END)[2]
        PAGE.write_text("\n".join([before + BEGINNING, "", shown, "", END]) + after, encoding="utf-8")
    return 0


def seeds_table(seeds: Sequence[int], values: Sequence[Sequence[float]], shown: Sequence[int] | None = None) -> str:
    """Return the Markdown table of seeds with rows of means and of the worst values.

    Args:
        seeds: N seeds.
        values: N rows with the values of `COLUMNS`.
        shown: Seeds whose rows are in the table; all by default.
    """
    worst = [column.worst(each) for column, each in zip(COLUMNS, zip(*values, strict=True), strict=True)]
    rows = [(f"{seed}", row) for seed, row in zip(seeds, values, strict=True) if shown is None or seed in shown]
    rows += [("mean", np.mean(values, axis=0).tolist()), ("worst", worst)]
    headings = ["seed", *(column.title for column in COLUMNS)]
    lines = [headings, ["---:"] * len(headings), *([name, *cells(row)] for name, row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def accuracy(report: Mapping[str, Any]) -> dict[str, str]:
    """Return the cells of a run that do not depend on the machine, by the titles of their columns."""
    free = CommandCost(0.0, 0.0, 0.0)
    return {column.title: format(float(column.value(report, free)), column.form) for column in COLUMNS[:ACCURACY]}


def cells(values: Sequence[float]) -> list[str]:
    """Return the values of `COLUMNS` as text."""
    return [format(value, column.form) for value, column in zip(values, COLUMNS, strict=True)]


def provenance(report: Mapping[str, Any]) -> str:
    """Return the machine and the packages of a run as text."""
    machine = report["machine"]
    system = machine["system"].split()[0]
    packages = ", ".join(f"{name} {version}" for name, version in report["versions"].items())
    return f"{machine['processor']}, {machine['cores']} cores, no GPU used; {system}; {packages}."


if __name__ == "__main__":
    sys.exit(main(tyro.cli(SeedsCommand, description=__doc__)))
