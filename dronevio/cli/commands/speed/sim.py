"""``dronevio speed sim``: processor time, frame rates and memory of the simulator."""

import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Annotated

from dronevio.cli.commands.speed.printing import print_speed
from dronevio.cli.options import Printing, PrintOptions
from dronevio.cli.terminal import parse, progress_bars
from dronevio.models.ranges import Range, Settings

if TYPE_CHECKING:
    from dronevio.models.performance import PerformanceFigure
    from dronevio.models.progress import Progress


@dataclass(frozen=True)
class SimCommand(Settings):
    """Measure the speed of rendering, physics and recording on this machine, each with its bound.

    The machine should be idle and have two cores or more. A missed bound is shown in the table and is not an error. By
    default, the time of a recording of 60 s is extrapolated from a shorter one, and memory is compared at one frame per
    second. With --full, both are measured completely, which takes some minutes.

    Examples:
      dronevio speed sim
      dronevio speed sim --full
      dronevio speed sim --quick --json
    """

    world: str = "room"
    """Name of the world, see `dronevio worlds`, or a file of a world of your own, such as yard.yaml."""
    rig: str = "euroc"
    """Name of the sensors, such as euroc-stereo."""
    seed: Annotated[int, Range(0, 2**32 - 1)] = 0
    """Seed of the world."""
    full: bool = False
    """Measure a recording of 60 s, and for the memory recordings of 30 and 120 s, with all frames."""
    quick: bool = False
    """Test in seconds whether everything can be measured, with few and small images. The figures are not accurate."""
    printing: Printing = field(default_factory=PrintOptions)
    """How results are printed."""


@dataclass(frozen=True)
class _Effort:
    """Extent of the measurements."""

    frames: int
    """Number of frames that are rendered to measure the camera."""
    flight_s: float
    """Duration of the flight without images [s]."""
    recording_s: float
    """Duration of the recording [s]."""
    memory_s: tuple[float, float]
    """Durations of the two recordings whose memory is compared [s]."""
    memory_rate_hz: float
    """Frame rate of these recordings; 0 for recordings without images [Hz]."""
    small_images: bool = False
    """Whether the images have few pixels."""


_USUAL = _Effort(frames=30, flight_s=60.0, recording_s=8.0, memory_s=(30.0, 120.0), memory_rate_hz=1.0)
_FULL = _Effort(frames=60, flight_s=60.0, recording_s=60.0, memory_s=(30.0, 120.0), memory_rate_hz=20.0)
_QUICK = _Effort(frames=2, flight_s=6.0, recording_s=5.0, memory_s=(5.0, 6.0), memory_rate_hz=0.0, small_images=True)


def main(arguments: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    command = parse(SimCommand, arguments, "speed sim")
    os.environ.setdefault("LP_NUM_THREADS", "1")  # before Mesa starts: its threads would count as processor time

    from dronevio.sim.cameras.gl import require_gl

    gl = require_gl()
    effort = _QUICK if command.quick else _FULL if command.full else _USUAL
    with progress_bars(quiet=command.printing.json) as bars:
        figures = _measured(command, effort, bars.bar("measuring"))
    chosen = {"world": command.world, "rig": command.rig, "seed": command.seed}
    settings = {"subject": "sim", **chosen, "effort": asdict(effort)}
    title = "Simulator: " + ", ".join(f"{name} {value}" for name, value in chosen.items())
    packages = ("dronevio", "mujoco", "numpy", "opencv-python-headless")
    print_speed(title, settings, figures, packages, gl.renderer, json=command.printing.json)
    return 0


def _measured(command: SimCommand, effort: _Effort, progress: "Progress") -> list["PerformanceFigure"]:
    """Return all figures."""
    import time

    from dronevio.cli.commands.speed.recording_cost import (
        measured_rig,
        measured_scenario,
        memory_figure,
        minute_figure,
        record,
        scaling_figure,
    )
    from dronevio.sim.speed.throughput import camera_figure, flight_figure
    from dronevio.sim.world import build_world

    place = command.world, (rig := measured_rig(command.rig, effort.small_images)), command.seed
    flight = measured_scenario(*place, effort.recording_s)
    steps = 6
    progress(0, steps)
    start = time.perf_counter()
    world = build_world(command.world, command.seed)
    world_s = time.perf_counter() - start
    progress(1, steps)
    figures = [camera_figure(world, rig.cameras[0].model, effort.frames)]
    progress(2, steps)
    figures.append(flight_figure(measured_scenario(*place, effort.flight_s)))
    progress(3, steps)
    one = record(flight, workers=1)
    progress(4, steps)
    two = record(flight, workers=2)
    progress(5, steps)
    figures += [
        scaling_figure(one, two),
        minute_figure(two, world_s),
        memory_figure(
            command.world, command.rig, command.seed, effort.small_images, effort.memory_s, effort.memory_rate_hz
        ),
    ]
    progress(6, steps)
    return figures
