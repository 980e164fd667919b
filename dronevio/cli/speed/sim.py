"""``dronevio speed sim``: what drawing, flying and recording cost."""

import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

from dronevio.cli.speed.figures import plain_figures, print_figures
from dronevio.cli.terminal import parse, print_json, progress_bars

if TYPE_CHECKING:
    from dronevio.models.performance import Figure
    from dronevio.models.progress import Progress


@dataclass(frozen=True)
class SimCommand:
    """Measure what drawing, flying and recording cost here, each beside what it should cost.

    Run it on an idle machine with two cores or more. Nothing fails where a bound is missed: the table says so. By
    default the minute's recording is extrapolated from a stretch of it, and memory is compared at one frame a second;
    --full measures all of both, which takes some minutes.

    Examples:
      dronevio speed sim
      dronevio speed sim --full
      dronevio speed sim --quick --json
    """

    world: str = "room"
    """Where; `dronevio worlds` lists them."""
    rig: str = "euroc"
    """With which sensors."""
    seed: int = 0
    """Draws the world."""
    full: bool = False
    """Record 60 s, and 30 and 120 s for the memory, with all frames."""
    quick: bool = False
    """Look whether everything can be measured: a few frames of a small camera, in seconds. The figures mean little."""
    json: bool = False
    """Print one JSON document instead of a table."""


@dataclass(frozen=True)
class _Effort:
    """How much to measure."""

    frames: int
    """Frames of the camera's figure."""
    flight_s: float
    """Length of the flight without images [s]."""
    stretch_s: float
    """Length of the recording [s]."""
    memory_s: tuple[float, float]
    """Lengths of the recordings whose memory is compared [s]."""
    memory_rate_hz: float
    """Their frame rate [Hz]; 0 for no frames."""
    cheap: bool = False
    """Whether the cameras have few pixels."""


_USUAL = _Effort(frames=30, flight_s=60.0, stretch_s=8.0, memory_s=(30.0, 120.0), memory_rate_hz=1.0)
_FULL = _Effort(frames=60, flight_s=60.0, stretch_s=60.0, memory_s=(30.0, 120.0), memory_rate_hz=20.0)
_QUICK = _Effort(frames=2, flight_s=6.0, stretch_s=5.0, memory_s=(5.0, 6.0), memory_rate_hz=0.0, cheap=True)


def main(arguments: Sequence[str]) -> int:
    """Run the command."""
    command = parse(SimCommand, arguments, "speed sim")
    os.environ.setdefault("LP_NUM_THREADS", "1")  # before Mesa starts: its threads would count as our CPU time

    from dronevio.cli.machine import cores, memory_gb, package_version, processor
    from dronevio.sim.cameras.gl import require_gl

    gl = require_gl()
    effort = _QUICK if command.quick else _FULL if command.full else _USUAL
    with progress_bars(quiet=command.json) as bars:
        figures = _measured(command, effort, bars.bar("measuring"))
    packages = {name: package_version(name) for name in ("dronevio", "mujoco", "numpy", "opencv-python-headless")}
    if command.json:
        print_json(
            {
                "subject": "sim",
                "world": command.world,
                "rig": command.rig,
                "seed": command.seed,
                "effort": asdict(effort),
                "machine": {"processor": processor(), "cores": cores(), "memory_gb": memory_gb(), "gl": gl.renderer},
                "packages": packages,
                "figures": plain_figures(figures),
            }
        )
        return 0
    print_figures(f"Simulator: world {command.world}, rig {command.rig}, seed {command.seed}", figures)
    print(f"{processor()}, {cores()} cores, {memory_gb():.0f} GB, {gl.renderer}")
    print(", ".join(f"{name} {number}" for name, number in packages.items()))
    return 0


def _measured(command: SimCommand, effort: _Effort, progress: "Progress") -> list["Figure"]:
    """Return all figures."""
    import time

    from dronevio.cli.speed.recording import (
        a_stretch,
        bench_rig,
        memory_figure,
        minute_figure,
        record,
        scaling_figure,
    )
    from dronevio.sim.throughput import camera_figure, flight_figure
    from dronevio.sim.world import build_world

    place = command.world, (rig := bench_rig(command.rig, effort.cheap)), command.seed
    stretch = a_stretch(*place, effort.stretch_s)
    steps = 6
    progress(0, steps)
    start = time.perf_counter()
    world = build_world(command.world, command.seed)
    world_s = time.perf_counter() - start
    progress(1, steps)
    figures = [camera_figure(world, rig.cameras[0].model, effort.frames)]
    progress(2, steps)
    figures.append(flight_figure(a_stretch(*place, effort.flight_s)))
    progress(3, steps)
    one = record(stretch, workers=1)
    progress(4, steps)
    two = record(stretch, workers=2)
    progress(5, steps)
    figures += [
        scaling_figure(one, two),
        minute_figure(two, world_s),
        memory_figure(command.world, command.rig, command.seed, effort.cheap, effort.memory_s, effort.memory_rate_hz),
    ]
    progress(6, steps)
    return figures
