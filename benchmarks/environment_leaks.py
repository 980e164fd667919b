"""Memory, open files and graphics memory over many resets of environments with a camera.

One environment is reset again and again; then environments are made, reset, rendered and closed. After the first tenth,
nothing may grow: the script prints a table and fails otherwise.

    tools/uv run python benchmarks/environment_leaks.py
    tools/uv run python benchmarks/environment_leaks.py --resets 100 --environments 10
"""

import argparse
import gc
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium

from dronevio.sim.pictures.chase_camera import CHASE_CAMERAS
from dronevio.sim.rendering.loaded_world import LOADED_WORLDS

ID = "dronevio.envs:dronevio/Hover-v0"
OBSERVATIONS = "grey", "depth", "position"
GROWTH_MAX_MB = 8.0
"""Largest growth of memory after the first tenth [MB]; the allocator's reserves vary by less."""


@dataclass(frozen=True)
class Resources:
    """Resources of this process."""

    memory_mb: float
    """Resident memory [MB]."""
    files: int
    """Number of open files."""
    contexts: int
    """Number of worlds and chase cameras in graphics memory."""


def resources() -> Resources:
    """Return the resources of this process, on Linux."""
    gc.collect()
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    files = len(list(Path("/proc/self/fd").iterdir()))
    return Resources(1e-6 * pages * os.sysconf("SC_PAGE_SIZE"), files, len(LOADED_WORLDS) + len(CHASE_CAMERAS))


def growth(work: Callable[[int], None], count: int) -> tuple[Resources, Resources]:
    """Return the resources after a tenth of the calls of ``work``, and after all of them."""
    first = max(count // 10, 1)
    for number in range(first):
        work(number)
    before = resources()
    for number in range(first, count):
        work(number)
    return before, resources()


def make_and_close(number: int) -> None:
    """Make an environment, reset and render it, and close it."""
    env = gymnasium.make(ID, observations=OBSERVATIONS, render_mode="rgb_array")
    env.reset(seed=number)
    env.render()
    env.close()


def leaks(before: Resources, after: Resources) -> bool:
    """Return whether anything grows."""
    grown_mb = after.memory_mb - before.memory_mb
    return grown_mb > GROWTH_MAX_MB or after.files > before.files or after.contexts > before.contexts


def main() -> int:
    """Print the table, and return 1 if anything grows."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--resets", type=int, default=1000, help="Number of resets of one environment.")
    parser.add_argument(
        "--environments", type=int, default=200, help="Number of environments that are made and closed."
    )
    options = parser.parse_args()
    env: gymnasium.Env[Any, Any] = gymnasium.make(ID, observations=OBSERVATIONS)

    def reset(number: int) -> None:
        env.reset(seed=number)
        env.step(env.action_space.sample())

    print("| | memory before, after [MB] | files | worlds and cameras |\n|---|---|---|---|")
    failed = False
    for name, work, count in (
        ("resets", reset, options.resets),
        ("environments", make_and_close, options.environments),
    ):
        before, after = growth(work, count)
        memory = f"{before.memory_mb:.1f}, {after.memory_mb:.1f}"
        print(f"| {count} {name} | {memory} | {before.files}, {after.files} | {before.contexts}, {after.contexts} |")
        failed |= leaks(before, after)
    env.close()
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
