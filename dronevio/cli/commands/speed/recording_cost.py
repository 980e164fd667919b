"""Time and memory of recordings, with one rendering process and with two."""

import json
import resource
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

from dronevio.models.performance import PerformanceFigure
from dronevio.models.progress import Progress, silent
from dronevio.models.rig import Rig
from dronevio.models.rig_presets import rig_named
from dronevio.recording.recorder import record_flight
from dronevio.sim.flight import fly
from dronevio.sim.paths.plan import FlightPlan
from dronevio.sim.rendering.frame_renderer import thumbnail
from dronevio.sim.scenario import Scenario

_MEASURE_MEMORY = "from dronevio.cli.commands.speed.recording_cost import print_peak_memory; print_peak_memory()"
_SAMPLE_EVERY_S = 0.05  # sampling of the peak memory of the rendering processes, which never falls
_TAKEOFF_S, _LANDING_S, _STAND_S = 1.2, 1.5, 0.4
_HOPS = ((0.1, 0.05, 0.1), (-0.05, 0.1, 0.0), (-0.1, -0.05, 0.1), (0.05, -0.1, 0.0))
_FIRST, _LAST = 0.2, 0.8  # share of the frames between which all rendering processes are busy


@dataclass(frozen=True)
class Timing:
    """Timing of one recording."""

    duration_s: float
    """Duration of the flight [s]."""
    wall_s: float
    """Wall-clock time of simulation and rendering [s]."""
    startup_s: float
    """Part of the wall-clock time between the end of the physics and the first frame [s]."""
    frames_per_s: float
    """Rendered frames per second while all processes are busy [Hz]."""


def measured_scenario(world: str, rig: Rig, seed: int, duration_s: float) -> Scenario:
    """Return a scenario of a given duration that flies small hops above the pad of a world."""
    tour_s = duration_s - _TAKEOFF_S - _LANDING_S - 2.0 * _STAND_S
    plan = FlightPlan(
        initial_rest_s=_STAND_S,
        takeoff_s=_TAKEOFF_S,
        tour_s=tour_s,
        landing_s=_LANDING_S,
        final_rest_s=_STAND_S,
        height_m=0.6,
        min_height_m=0.3,
        waypoints=_HOPS * max(1, round(tour_s / (1.5 * len(_HOPS)))),
        heading_scale=0.5,
    )
    return Scenario("speed", "hops above the pad", plan, world, rig, seed=seed)


def measured_rig(name: str, small_images: bool, rate_hz: float | None = None) -> Rig:
    """Return a rig by its name, with few pixels if small images are asked for, and with another frame rate if given."""
    rig = rig_named(name)
    cameras = [
        replace(
            camera,
            model=thumbnail(camera.model) if small_images else camera.model,
            rate_hz=camera.rate_hz if rate_hz is None else rate_hz,
        )
        for camera in rig.cameras
    ]
    return replace(rig, cameras=tuple(cameras))


def record(scenario: Scenario, workers: int, progress: Progress = silent) -> Timing:
    """Record a flight into a temporary folder with a number of rendering processes, and return its timing."""
    marks: list[tuple[float, int]] = []

    def note(done: int, total: int) -> None:
        marks.append((time.perf_counter(), done))
        progress(done, total)

    with tempfile.TemporaryDirectory(prefix="dronevio-speed-") as folder:
        start = time.perf_counter()
        flight = record_flight(scenario, Path(folder), rendering=note, workers=workers)
        wall_s = time.perf_counter() - start
    total = marks[-1][1]
    rendered = [(t, done) for t, done in marks if done >= 1]
    steady = [(t, done) for t, done in rendered if _FIRST * total <= done <= _LAST * total] or rendered
    (first_s, first), (last_s, last) = steady[0], steady[-1]
    rate = (last - first) / (last_s - first_s) if last > first else total / wall_s
    return Timing(float(flight.truth.t_s[-1]), wall_s, rendered[0][0] - marks[0][0], rate)


def scaling_figure(one: Timing, two: Timing) -> PerformanceFigure:
    """Return the frame rate of two rendering processes relative to that of one."""
    return PerformanceFigure(
        "two rendering processes, relative to one",
        two.frames_per_s / one.frames_per_s,
        "",
        1.7,
        "at least",
        f"{two.frames_per_s:.1f} and {one.frames_per_s:.1f} frames per second, with one GL thread per process",
    )


def minute_figure(timing: Timing, world_s: float) -> PerformanceFigure:
    """Return the wall-clock time of a recording of 60 s, extrapolated if the measured one is shorter.

    Args:
        timing: Timing of the measured recording.
        world_s: Time to build its world [s].
    """
    once_s = world_s + timing.startup_s
    running_s = timing.wall_s - timing.startup_s
    complete = abs(timing.duration_s - 60.0) < 1.0
    return PerformanceFigure(
        "recording of 60 s",
        once_s + running_s * 60.0 / timing.duration_s,
        "s",
        45.0,
        "at most",
        f"world {world_s:.1f} s, start-up {timing.startup_s:.1f} s, "
        + ("measured completely" if complete else f"the rest extrapolated from {timing.duration_s:.0f} s"),
    )


def memory_figure(
    world: str, rig: str, seed: int, small_images: bool, durations_s: tuple[float, float], rate_hz: float
) -> PerformanceFigure:
    """Measure how the peak memory of recordings grows with the duration, each in a process of its own.

    Args:
        world: Name of the world.
        rig: Name of the sensors.
        seed: Seed of the world.
        small_images: Whether the images have few pixels.
        durations_s: Duration of a short flight and of a long one [s].
        rate_hz: Frame rate; 0 for flights without images [Hz].
    """
    tasks = [json.dumps([world, rig, seed, small_images, duration_s, rate_hz]) for duration_s in durations_s]
    with ThreadPoolExecutor() as pool:
        peaks_mb = list(pool.map(_peak_memory_mb, tasks))
    (short_s, long_s), (short_mb, long_mb) = durations_s, peaks_mb
    return PerformanceFigure(
        "peak memory of a long flight, relative to a short one",
        long_mb / short_mb,
        "",
        1.1,
        "at most",
        f"{long_mb:.0f} MB for {long_s:.0f} s, {short_mb:.0f} MB for {short_s:.0f} s, "
        + (f"frames at {rate_hz:g} Hz" if rate_hz > 0.0 else "without images"),
    )


def _peak_memory_mb(task: str) -> float:
    """Return what `print_peak_memory` prints in a process of its own [MB]."""
    ended = subprocess.run(
        [sys.executable, "-c", _MEASURE_MEMORY], input=task, capture_output=True, text=True, check=True
    )
    return float(ended.stdout.split()[-1])


def print_peak_memory() -> None:
    """Record the flight that standard input describes, and print its peak memory [MB].

    The memory is that of this process and of the largest rendering process together.
    """
    world, rig, seed, small_images, duration_s, rate_hz = json.load(sys.stdin)
    scenario = measured_scenario(world, measured_rig(rig, small_images, rate_hz or None), seed, duration_s)
    with ThreadPoolExecutor() as pool:
        work = pool.submit(record, scenario, 1) if rate_hz > 0.0 else pool.submit(fly, scenario)
        rendering_mb = 0.0
        while not work.done():
            rendering_mb = max(rendering_mb, *map(_peak_mb, _children()), 0.0)
            time.sleep(_SAMPLE_EVERY_S)
    work.result()
    print(_peak_mb("self") + rendering_mb)


def _children() -> list[str]:
    """Return the ids of the children of this process; none where there is no proc file system."""
    lists = Path("/proc/self/task").glob("*/children")
    return [child for children in lists for child in children.read_text(encoding="utf-8").split()]


def _peak_mb(process: str) -> float:
    """Return the peak memory of a process [MB]; without a proc file system only that of this process.

    The figures of `resource` for children contain memory of the parent, of which a child is a copy at first.
    """
    try:
        status = Path(f"/proc/{process}/status").read_text(encoding="utf-8")
    except OSError:  # it has ended, or there is no such file system
        status = ""
    for line in status.splitlines():
        if line.startswith("VmHWM"):
            return float(line.split()[1]) / 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024**2 if process == "self" else 0.0
