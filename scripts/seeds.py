"""Fly seeds 0 to 9 and print what came of it as Markdown: ``make seeds``; ``ARGS=--write`` puts it into the README.

Every seed is one ``dronevio run`` in a process of its own. Times are those of the whole command, from its start to its
end; memory is the most that its processes together held at once, looked at ten times a second, pages that they share
counted once (on Linux; elsewhere once in each).
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

LOOK_EVERY_S = 0.1
README = Path(__file__).resolve().parents[1] / "README.md"
BEGINNING, END = "<!-- seeds -->", "<!-- /seeds -->"


@dataclass(frozen=True)
class Seeds:
    """Fly a scenario with several seeds and print a Markdown table of scores and costs."""

    seeds: tuple[int, ...] = tuple(range(10))
    """Which seeds."""
    scenario: str = "room"
    """What to fly."""
    write: bool = False
    """Put the table into the README, too."""


@dataclass(frozen=True)
class Cost:
    """What one command cost."""

    wall_s: float
    """By the clock on the wall [s]."""
    cpu_s: float
    """Processor time of all its processes [s]."""
    memory_gb: float
    """The most memory that they held together [GB]."""


def largest(values: Iterable[float]) -> float:
    """Return the number farthest from zero."""
    return max(values, key=abs)


@dataclass(frozen=True)
class Column:
    """One column of the table."""

    title: str
    """With its unit."""
    form: str
    """How a number is written."""
    value: Callable[[Mapping[str, Any], Cost], float]
    """Takes report and cost, returns the number."""
    worst: Callable[[Iterable[float]], float] = largest
    """Picks the worst of several numbers."""


COLUMNS = (
    Column("ATE [m]", ".3f", lambda report, cost: report["scores"]["ate_m"]["rmse"]),
    Column("ATE [°]", ".2f", lambda report, cost: report["scores"]["ate_deg"]["rmse"]),
    Column("RPE [m]", ".3f", lambda report, cost: report["scores"]["rpe_m"]["rmse"]),
    Column("RPE [°]", ".2f", lambda report, cost: report["scores"]["rpe_deg"]["rmse"]),
    Column("scale error [%]", "+.2f", lambda report, cost: report["scores"]["scale_error_percent"]),
    Column("coverage [%]", ".1f", lambda report, cost: report["scores"]["coverage_percent"], min),
    Column("NEES", ".1f", lambda report, cost: report["scores"]["nees_position"]),
    Column("a frame [ms]", ".1f", lambda report, cost: report["timing"]["cpu_ms_mean"]),
    Column("wall [s]", ".0f", lambda report, cost: cost.wall_s),
    Column("CPU [s]", ".0f", lambda report, cost: cost.cpu_s),
    Column("memory [GB]", ".2f", lambda report, cost: cost.memory_gb),
)


def measure(command: Sequence[str]) -> tuple[str, Cost]:
    """Run a command; return what it printed and what it cost."""
    start = time.perf_counter()
    with tempfile.TemporaryFile("w+", encoding="utf-8") as output:
        process = psutil.Popen(command, stdout=output)
        most = 0
        while True:
            most = max(most, held(process))
            pid, status, usage = os.wait4(process.pid, os.WNOHANG)
            if pid:
                break
            time.sleep(LOOK_EVERY_S)
        if os.waitstatus_to_exitcode(status) != 0:
            sys.exit(f"seeds: {' '.join(command)} failed")
        output.seek(0)
        printed = output.read()
    return printed, Cost(time.perf_counter() - start, usage.ru_utime + usage.ru_stime, most * 1e-9)


def held(process: psutil.Process) -> int:
    """Return how much memory a process and its descendants hold [bytes]."""
    total = 0
    try:
        for each in (process, *process.children(recursive=True)):
            memory = each.memory_full_info()
            total += getattr(memory, "pss", memory.rss)
    except (psutil.NoSuchProcess, psutil.AccessDenied):  # it ended while we looked
        pass
    return total


def row(cells: Sequence[str]) -> str:
    """Return a row of a Markdown table."""
    return f"| {' | '.join(cells)} |"


def main(command: Seeds) -> None:
    """Fly, and print the table row by row."""
    lines: list[str] = []

    def say(line: str) -> None:
        print(line, flush=True)
        lines.append(line)

    say(row(["seed", *(column.title for column in COLUMNS)]))
    say(row(["---:"] * (len(COLUMNS) + 1)))
    values, report = [], {}
    with tempfile.TemporaryDirectory(prefix="dronevio-") as folder:
        for seed in command.seeds:
            out = Path(folder) / f"{seed}"
            options = ["--scenario", command.scenario, "--seed", str(seed), "--out", str(out), "--json"]
            printed, cost = measure([sys.executable, "-m", "dronevio.cli", "run", *options])
            report = json.loads(printed)
            values.append([float(column.value(report, cost)) for column in COLUMNS])
            say(row([f"{seed}", *written(values[-1])]))
    say(row(["mean", *written(np.mean(values, axis=0))]))
    worst = [column.worst(figures) for column, figures in zip(COLUMNS, zip(*values, strict=True), strict=True)]
    say(row(["worst", *written(worst)]))
    say(f"\n{described(report)}")
    if command.write:
        before, _, rest = README.read_text(encoding="utf-8").partition(BEGINNING)
        after = rest.partition(END)[2]
        README.write_text("\n".join([before + BEGINNING, "", *lines, "", END]) + after, encoding="utf-8")


def written(values: Sequence[float]) -> list[str]:
    """Return the numbers of a row as text."""
    return [format(value, column.form) for value, column in zip(values, COLUMNS, strict=True)]


def described(report: Mapping[str, Any]) -> str:
    """Return which machine and which packages the numbers are from."""
    machine = report["machine"]
    system = machine["system"].split()[0]
    packages = ", ".join(f"{name} {version}" for name, version in report["versions"].items())
    return f"{machine['processor']}, {machine['cores']} cores, no GPU used; {system}; {packages}."


if __name__ == "__main__":
    main(tyro.cli(Seeds, description=__doc__))
