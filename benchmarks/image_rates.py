"""Rates of the images of environments: images per second of processor time by world, kind and size.

Each figure is the median of some runs, each of which renders the images of a vector of environments in one step, with
the lens of EuRoC's camera, along the route through the world and in all directions. The time is that of all threads of
the process; programs that use the processor at the same time still disturb it::

    .venv/bin/python benchmarks/image_rates.py
    .venv/bin/python benchmarks/image_rates.py --worlds room forest --sizes 64x64 320x240 --count 16 --runs 5
"""

import os
import platform
from dataclasses import dataclass
from importlib.metadata import version
from itertools import groupby

import tyro

from dronevio.models.errors import ConfigError

os.environ.setdefault("LP_NUM_THREADS", "1")  # the software renderer starts one thread for each core by default

from dronevio.cli.terminal import print_table
from dronevio.sim.envs.sensing.camera_observation import IMAGES, ImageKind
from dronevio.sim.speed.image_rate import ImageRate, image_rates
from dronevio.sim.world import WORLDS


@dataclass(frozen=True)
class RatesCommand:
    """Measure the rates of the images of environments."""

    worlds: tuple[str, ...] = tuple(WORLDS)
    """Names of the worlds."""
    kinds: tuple[ImageKind, ...] = IMAGES
    """Kinds of images."""
    sizes: tuple[str, ...] = ("64x64",)
    """Widths and heights of images [px]."""
    count: int = 64
    """Number of environments of the vector, which is that of images of a run."""
    runs: int = 7
    """Number of runs, of which the medians are printed."""


def size_of(text: str) -> tuple[int, int]:
    """Return width and height of a size such as ``64x48``.

    Raises:
        ConfigError: The text has another form.
    """
    width, _, height = text.partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise ConfigError(f"size {text!r}; expected a width and a height, such as 64x64")
    return int(width), int(height)


def rows_of(rates: list[ImageRate]) -> list[tuple[str, ...]]:
    """Return a row for each world with the rates of all kinds, from rates in order of worlds."""
    return [
        (world, *(f"{rate.per_cpu_s:.0f}" for rate in of_world))
        for world, of_world in groupby(rates, lambda rate: rate.world)
    ]


def measure(command: RatesCommand) -> None:
    """Measure and print a table for each size."""
    versions = ", ".join(f"{name} {version(name)}" for name in ("mujoco", "numpy", "opencv-python-headless"))
    print(f"{platform.machine()}, Python {platform.python_version()}, {versions}")
    for size in command.sizes:
        rates = image_rates(command.worlds, command.kinds, command.count, command.runs, size=size_of(size))
        print_table(f"Images of {size} px per second of processor time", ("world", *command.kinds), rows_of(rates))


if __name__ == "__main__":
    measure(tyro.cli(RatesCommand, description=__doc__))
