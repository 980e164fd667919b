"""What recording costs: time with one process and with several, and memory."""

import json
import resource
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

from dronevio.models.performance import Figure
from dronevio.models.progress import Progress, silent
from dronevio.models.rig import Rig
from dronevio.models.rig_presets import rig_named
from dronevio.recorder import record_flight
from dronevio.sim.flight import fly
from dronevio.sim.paths.plan import FlightPlan
from dronevio.sim.rendering.painter import at_a_glance
from dronevio.sim.scenario import Scenario

_WEIGH = "from dronevio.cli.speed.recording import weigh; weigh()"
_LOOK_EVERY_S = 0.05  # at the memory of the processes that draw: it only ever grows, and the last look counts
_RISE_S, _SINK_S, _REST_S = 1.2, 1.5, 0.4
_HOPS = ((0.1, 0.05, 0.1), (-0.05, 0.1, 0.0), (-0.1, -0.05, 0.1), (0.05, -0.1, 0.0))
_SETTLED, _LEFT = 0.2, 0.8  # of the frames: when all processes draw, and before the first of them has finished


@dataclass(frozen=True)
class Recorded:
    """One recording, clocked."""

    duration_s: float
    """Length of the flight [s]."""
    wall_s: float
    """How long it took to fly and record it [s]."""
    starting_s: float
    """How much of it went by before the first frame, but for flying [s]."""
    frames_per_s: float
    """Frames drawn per second, once all processes were at it."""


def a_stretch(world: str, rig: Rig, seed: int, duration_s: float) -> Scenario:
    """Return a scenario that hops about above a world's pad for so long."""
    tour_s = duration_s - _RISE_S - _SINK_S - 2.0 * _REST_S
    plan = FlightPlan(
        rest_s=_REST_S,
        takeoff_s=_RISE_S,
        tour_s=tour_s,
        landing_s=_SINK_S,
        stand_s=_REST_S,
        height_m=0.6,
        floor_m=0.3,
        waypoints=_HOPS * max(1, round(tour_s / (1.5 * len(_HOPS)))),
        turning=0.5,
    )
    return Scenario("bench", "hops above the pad", plan, world, rig, seed=seed)


def bench_rig(name: str, cheap: bool, rate_hz: float | None = None) -> Rig:
    """Return a rig by its name; with few pixels if it is to be cheap, with another frame rate if one is given."""
    rig = rig_named(name)
    cameras = [
        replace(
            camera,
            model=at_a_glance(camera.model) if cheap else camera.model,
            rate_hz=camera.rate_hz if rate_hz is None else rate_hz,
        )
        for camera in rig.cameras
    ]
    return replace(rig, cameras=tuple(cameras))


def record(flown: Scenario, workers: int, progress: Progress = silent) -> Recorded:
    """Record a flight into a folder that is thrown away, with so many drawing processes."""
    marks: list[tuple[float, int]] = []

    def heard(done: int, total: int) -> None:
        marks.append((time.perf_counter(), done))
        progress(done, total)

    with tempfile.TemporaryDirectory(prefix="dronevio-speed-") as folder:
        start = time.perf_counter()
        flight = record_flight(flown, Path(folder), rendering=heard, workers=workers)
        wall_s = time.perf_counter() - start
    total = marks[-1][1]
    drawn = [(t, done) for t, done in marks if done >= 1]
    steady = [(t, done) for t, done in drawn if _SETTLED * total <= done <= _LEFT * total] or drawn
    (first_s, first), (last_s, last) = steady[0], steady[-1]
    rate = (last - first) / (last_s - first_s) if last > first else total / wall_s
    return Recorded(float(flight.truth.t_s[-1]), wall_s, drawn[0][0] - marks[0][0], rate)


def scaling_figure(one: Recorded, two: Recorded) -> Figure:
    """Return how much faster two drawing processes are than one."""
    return Figure(
        "two drawing processes, by one",
        two.frames_per_s / one.frames_per_s,
        "",
        1.7,
        "at least",
        f"{two.frames_per_s:.1f} and {one.frames_per_s:.1f} frames a second, one GL thread each",
    )


def minute_figure(recorded: Recorded, world_s: float) -> Figure:
    """Return how long 60 s of recording take, from a shorter stretch if need be.

    Args:
        recorded: The stretch.
        world_s: How long its world takes to build [s].
    """
    once_s = world_s + recorded.starting_s
    running_s = recorded.wall_s - recorded.starting_s
    whole = abs(recorded.duration_s - 60.0) < 1.0
    return Figure(
        "60 s recorded",
        once_s + running_s * 60.0 / recorded.duration_s,
        "s",
        45.0,
        "at most",
        f"world {world_s:.1f} s, start {recorded.starting_s:.1f} s, "
        + ("all of it" if whole else f"the rest from a stretch of {recorded.duration_s:.0f} s"),
    )


def memory_figure(
    world: str, rig: str, seed: int, cheap: bool, durations_s: tuple[float, float], rate_hz: float
) -> Figure:
    """Measure how the peak memory of recording grows with the flight's length, in processes of their own.

    Args:
        world: Where.
        rig: Name of the sensors.
        seed: Draws the world.
        cheap: Whether cameras have few pixels.
        durations_s: A short flight and a long one [s].
        rate_hz: Frame rate; 0 for flights without frames.
    """
    tasks = [json.dumps([world, rig, seed, cheap, duration_s, rate_hz]) for duration_s in durations_s]
    with ThreadPoolExecutor() as pool:
        peaks_mb = list(pool.map(_weighed, tasks))
    (short_s, long_s), (short_mb, long_mb) = durations_s, peaks_mb
    return Figure(
        "peak memory of a long flight, by a short one",
        long_mb / short_mb,
        "",
        1.1,
        "at most",
        f"{long_mb:.0f} MB for {long_s:.0f} s, {short_mb:.0f} MB for {short_s:.0f} s, "
        + (f"frames at {rate_hz:g} Hz" if rate_hz > 0.0 else "without frames"),
    )


def _weighed(task: str) -> float:
    """Return what `weigh` prints in a process of its own."""
    said = subprocess.run([sys.executable, "-c", _WEIGH], input=task, capture_output=True, text=True, check=True)
    return float(said.stdout.split()[-1])


def weigh() -> None:
    """Record the flight that stdin tells of and print its peak memory [MB], of this process and one that draws."""
    world, rig, seed, cheap, duration_s, rate_hz = json.load(sys.stdin)
    flown = a_stretch(world, bench_rig(rig, cheap, rate_hz or None), seed, duration_s)
    with ThreadPoolExecutor() as pool:
        work = pool.submit(record, flown, 1) if rate_hz > 0.0 else pool.submit(fly, flown)
        drawing_mb = 0.0
        while not work.done():
            drawing_mb = max(drawing_mb, *map(_peak_mb, _children()), 0.0)
            time.sleep(_LOOK_EVERY_S)
    work.result()
    print(_peak_mb("self") + drawing_mb)


def _children() -> list[str]:
    """Return the ids of this process's children; where the system does not tell, none."""
    lists = Path("/proc/self/task").glob("*/children")
    return [child for children in lists for child in children.read_text(encoding="utf-8").split()]


def _peak_mb(process: str) -> float:
    """Return the peak memory of a process [MB]; where the system does not tell, this one's.

    What `resource` says of children counts the parent's memory, too: each of them was its copy at first.
    """
    try:
        status = Path(f"/proc/{process}/status").read_text(encoding="utf-8")
    except OSError:  # it has ended, or there is no such file system
        status = ""
    for line in status.splitlines():
        if line.startswith("VmHWM"):
            return float(line.split()[1]) / 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024**2 if process == "self" else 0.0
