"""``dronevio speed eval``: what scoring trajectories costs, beside evo."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from dronevio.cli.speed.figures import plain_figures, print_figures
from dronevio.cli.terminal import parse, print_json, progress_bars

if TYPE_CHECKING:
    from dronevio.models.performance import Figure
    from dronevio.models.progress import Progress


@dataclass(frozen=True)
class EvalCommand:
    """Measure what scoring trajectories costs here: the whole command, the library, and its memory.

    All times are processor time, the least of several tries. Where evo is installed it does the same work in the same
    run; where it is not, the figures beside it are left out.

    Examples:
      dronevio speed eval
      dronevio speed eval --truth KITTI_00_gt.txt --estimate KITTI_00_ORB.txt
      dronevio speed eval --quick --json
    """

    truth: Path | None = None
    """A true path as a KITTI file, for the whole command; one of 4541 poses is made by default."""
    estimate: Path | None = None
    """The estimate that belongs to it."""
    quick: bool = False
    """Look whether everything can be measured, in seconds. The figures mean little."""
    json: bool = False
    """Print one JSON document instead of a table."""


def main(arguments: Sequence[str]) -> int:
    """Run the command."""
    command = parse(EvalCommand, arguments, "speed eval")
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # or its idle threads would count

    from dronevio.cli.machine import cores, memory_gb, package_version, processor

    with progress_bars(quiet=command.json) as bars:
        figures = _measured(command, bars.bar("measuring"))
    packages = {name: package_version(name) for name in ("dronevio", "evo", "numpy")}
    if command.json:
        machine = {"processor": processor(), "cores": cores(), "memory_gb": memory_gb()}
        named = {"subject": "eval", "quick": command.quick, "machine": machine, "packages": packages}
        print_json(named | {"figures": plain_figures(figures)})
        return 0
    print_figures("Scoring trajectories", figures)
    print(f"{processor()}, {cores()} cores, {memory_gb():.0f} GB")
    print(", ".join(f"{name} {number}" for name, number in packages.items()))
    return 0


def _measured(command: EvalCommand, progress: "Progress") -> list["Figure"]:
    """Return all figures."""
    from dronevio.cli.speed.scoring import command_figure, has_evo, library_figure, memory_figure, size_figure
    from dronevio.models.errors import ConfigError

    if (command.truth is None) != (command.estimate is None):
        raise ConfigError("a truth without an estimate, or the other way round; expected both or none")
    files = None if command.truth is None or command.estimate is None else (command.truth, command.estimate)
    many, tries = (10_000, 1) if command.quick else (1_000_000, 3)
    steps, figures = 4, []
    progress(0, steps)
    if has_evo():
        figures.append(command_figure(files, tries))
    progress(1, steps)
    if has_evo():
        figures.append(library_figure(many // 10, tries))
    progress(2, steps)
    figures.append(size_figure(many, tries))
    progress(3, steps)
    figures.append(memory_figure(many))
    progress(4, steps)
    return figures
