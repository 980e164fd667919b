"""``dronevio speed gym``: speed of the simulation of many vehicles at once, and of their images."""

import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated

from dronevio.cli.commands.speed.printing import print_speed
from dronevio.cli.options import Printing, PrintOptions
from dronevio.cli.terminal import parse, progress_bars
from dronevio.models.ranges import Range, Settings


@dataclass(frozen=True)
class GymCommand(Settings):
    """Measure the speed of the simulation of many vehicles in one thread, beside the bare physics of MuJoCo.

    The plant and the vector environment ``Hover-v0`` are measured with and without IMUs, images of 64 × 64 px in all
    worlds. The figures are processor times, and both sides run in turn, but other programs that use the same processor
    still disturb them.

    Examples:
      dronevio speed gym
      dronevio speed gym --envs 256 --no-images --json
    """

    envs: Annotated[int, Range(1, 1_000_000)] = 1024
    """Number of vehicles."""
    runs: Annotated[int, Range(1, 1000)] = 7
    """Number of runs, of which the medians are printed."""
    images: bool = True
    """Also measure the rate of images of 64 × 64 px in all worlds, which takes a minute."""
    quick: bool = False
    """Test in seconds whether everything can be measured, with few vehicles. The figures are not accurate."""
    printing: Printing = field(default_factory=PrintOptions)
    """How results are printed."""


def main(arguments: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    command = parse(GymCommand, arguments, "speed gym")
    os.environ.setdefault("LP_NUM_THREADS", "1")  # before Mesa starts: its threads would count as processor time

    from dronevio.sim.speed.batch_throughput import batch_figures
    from dronevio.sim.speed.image_rate import image_figures, image_rates
    from dronevio.sim.world import WORLDS

    count, actions, runs = (16, 3, 2) if command.quick else (command.envs, 25, command.runs)
    with progress_bars(quiet=command.printing.json) as bars:
        figures = batch_figures(count, actions, runs, bars.bar("measuring"))
        if command.images:
            worlds, frames = (("low-texture",), 4) if command.quick else (tuple(WORLDS), 64)
            figures += image_figures(image_rates(worlds, frames=frames, runs=runs, progress=bars.bar("images")))
    settings = {"subject": "gym", "envs": count, "runs": runs, "images": command.images}
    print_speed(
        f"{count} vehicles at once", settings, figures, ("dronevio", "mujoco", "numpy"), json=command.printing.json
    )
    return 0
