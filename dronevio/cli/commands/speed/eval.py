"""``dronevio speed eval``: processor time and memory of the evaluation, compared with evo."""

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from dronevio.cli.commands.speed.printing import print_speed
from dronevio.cli.options import Printing, PrintOptions
from dronevio.cli.terminal import parse, progress_bars

if TYPE_CHECKING:
    from dronevio.models.performance import PerformanceFigure
    from dronevio.models.progress import Progress


@dataclass(frozen=True)
class EvalCommand:
    """Measure the processor time and the memory of the evaluation of trajectories, as a command and as a library.

    All times are processor time, the smallest of several measurements. If evo is installed, it is measured in the same
    run on the same trajectories; otherwise the figures relative to evo are left out.

    Examples:
      dronevio speed eval
      dronevio speed eval --truth KITTI_00_gt.txt --estimate KITTI_00_ORB.txt
      dronevio speed eval --quick --json
    """

    truth: Path | None = None
    """Ground truth for the command, a KITTI file. By default, trajectories of 4541 poses are generated."""
    estimate: Path | None = None
    """Estimate that belongs to the ground truth, a KITTI file."""
    quick: bool = False
    """Test in seconds whether everything can be measured. The figures are not accurate."""
    printing: Printing = field(default_factory=PrintOptions)
    """How results are printed."""


def main(arguments: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    command = parse(EvalCommand, arguments, "speed eval")
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # its waiting threads would count as processor time

    with progress_bars(quiet=command.printing.json) as bars:
        figures = _measured(command, bars.bar("measuring"))
    settings = {"subject": "eval", "quick": command.quick}
    packages = ("dronevio", "evo", "numpy")
    print_speed("Evaluation of trajectories", settings, figures, packages, json=command.printing.json)
    return 0


def _measured(command: EvalCommand, progress: "Progress") -> list["PerformanceFigure"]:
    """Return all figures."""
    from dronevio.cli.commands.speed.evaluation_cost import (
        command_figure,
        has_evo,
        library_figure,
        memory_figure,
        size_figure,
    )
    from dronevio.models.errors import ConfigError

    if (command.truth is None) != (command.estimate is None):
        raise ConfigError("only one of --truth and --estimate; expected both or none")
    files = None if command.truth is None or command.estimate is None else (command.truth, command.estimate)
    poses, tries = (10_000, 3) if command.quick else (1_000_000, 3)
    steps, figures = 4, []
    progress(0, steps)
    if has_evo():
        figures.append(command_figure(files, tries))
    progress(1, steps)
    if has_evo():
        figures.append(library_figure(poses // 10, tries))
    progress(2, steps)
    figures.append(size_figure(poses, tries))
    progress(3, steps)
    figures.append(memory_figure(poses))
    progress(4, steps)
    return figures
