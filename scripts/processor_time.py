"""Measure the processor time per frame and the memory of the odometry on a long flight, and whether either grows.

A recording that begins and ends at rest at the same pose is repeated. Images and IMU samples are those of the
recording; the biases of the IMU continue their random walk from lap to lap. The distance between the first and the last
pose is printed. Reading images is not measured. Other load on the machine increases the figures::

    dronevio fly --scenario room-medium --plan.heading fixed --plan.tour-s 26 --rig euroc-stereo --out FOLDER
    python scripts/processor_time.py --recording FOLDER --minutes 10
    python scripts/processor_time.py --recording FOLDER --minutes 1 --profile     # also by stage and by function
"""

import json
import os
import sys
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from estimation_tasks import CAMERAS, ONE_THREAD, Mode, provenance
from markdown_tables import table, text
from profiler import OUTSIDE, Profile
from repeated_recording import RepeatedRecording

from dronevio.eval.benchmark.isolation import call_in_process
from dronevio.models.imu import ImuSamples
from dronevio.models.protocols import measurements

BOUND_MS: dict[Mode, float] = {"mono": 10.0, "stereo": 16.0}
"""Bound of the mean processor time per frame [ms]."""
BOUND_P99_MS = 50.0
"""Bound of the 99th percentile of the processor time per frame: the frame interval at 20 Hz [ms]."""
BOUND_GROWTH = 1.05
"""Bound of the processor time in the last minute relative to the second."""


@dataclass(frozen=True)
class ProcessorTimeCommand:
    """Estimate a long flight and print Markdown tables of its processor time and memory."""

    recording: Path
    """EuRoC folder of a flight that begins and ends at rest at the same pose; with two cameras for stereo."""
    minutes: float = 10.0
    """Duration of the flight [min]."""
    modes: tuple[Mode, ...] = ("mono", "stereo")
    """Cameras of the estimator."""
    profile: bool = False
    """Measure processor time by stage and by function, with a thousand samples per second."""
    json: Path | None = None
    """JSON file for all figures of all frames."""


@dataclass(frozen=True)
class Growth:
    """Mean of a quantity in the second minute of a flight and in the last one."""

    second: float
    """Mean over the second minute, or over the nearest number of whole laps; NaN for a flight of less than three."""
    last: float
    """Mean over the same time at the end of the flight; NaN for a flight of less than three minutes."""
    ratio: float
    """Ratio of the last mean to the second; NaN for a flight of less than three minutes."""


def growth(values: Sequence[float], per_lap: int, per_minute: int) -> Growth:
    """Compare the second minute with the last, both of whole laps and hence of the same motion.

    Args:
        values: The quantity at equal intervals over the flight.
        per_lap: Number of values per lap.
        per_minute: Number of values per minute.
    """
    span = max(1, round(per_minute / per_lap)) * per_lap
    if len(values) < 3 * span:
        return Growth(float("nan"), float("nan"), float("nan"))
    second, last = float(np.mean(values[span : 2 * span])), float(np.mean(values[-span:]))
    return Growth(second, last, last / second)


def measure(folder: Path, mode: Mode, minutes: float, profile: bool) -> dict[str, Any]:
    """Estimate a repeated recording and return the processor time of each frame, the memory and the profile.

    Args:
        folder: The recording of one lap.
        mode: Cameras of the estimator.
        minutes: Duration of the flight, rounded to whole laps [min].
        profile: Whether to sample stages and functions.
    """
    import cv2

    from dronevio.estimator.vio import VisualInertialOdometry
    from dronevio.models.recordings.open import open_recording

    cv2.setNumThreads(1)
    inner = open_recording(folder, CAMERAS[mode])
    lap_s = RepeatedRecording(inner, 1).lap_ns * 1e-9
    recording = RepeatedRecording(inner, max(1, round(60.0 * minutes / lap_s)))
    estimator = VisualInertialOdometry(recording.rig)
    profiled, healths = Profile(), Counter[str]()
    cpu_ms: list[float] = []
    memory_mb: list[float] = []
    keyframes: list[bool] = []
    cpu_s = 0.0
    for measurement in measurements(recording):
        start_s = time.process_time()
        with profiled.sampling() if profile else nullcontext():
            if isinstance(measurement, ImuSamples):
                estimator.add_imu(measurement)
                estimate = None
            else:
                estimate = estimator.add_frame(measurement)
        cpu_s += time.process_time() - start_s
        if estimate is None:
            continue
        cpu_ms.append(1e3 * cpu_s)
        cpu_s = 0.0
        healths[estimate.health.value] += 1
        keyframes.append("keyframe" in estimate.events)
        if len(cpu_ms) % 100 == 0:
            memory_mb.append(resident_mb())
    return {
        "mode": mode,
        "recording": recording.name,
        "lap_s": lap_s,
        "rate_hz": recording.rig.cameras[0].rate_hz,
        "discontinuity": recording.discontinuity(),
        "cpu_ms": cpu_ms,
        "keyframe": keyframes,
        "memory_mb": memory_mb,
        "health": dict(healths),
        "stages": dict(profiled.stages),
        "functions": dict(profiled.functions.most_common(15)),
    }


def resident_mb() -> float:
    """Return the memory of this process [MB]: its present size on Linux, elsewhere its peak."""
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    except OSError:
        import resource

        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1e6 if sys.platform == "darwin" else 1e3)
    return pages * os.sysconf("SC_PAGE_SIZE") * 1e-6


HEADINGS = (
    "",
    "minutes",
    "CPU ms per frame",
    "median",
    "p99",
    "max",
    "keyframe (share)",
    "second → last minute",
    "constant",
    "memory, second → last minute [MB]",
    "health",
)


def mode_row(measured: dict[str, Any]) -> list[str]:
    """Return the cells of one mode, see `HEADINGS`; a missed bound is marked with ``**no**``."""
    mode: Mode = measured["mode"]
    cpu = np.array(measured["cpu_ms"])
    is_keyframe = np.array(measured["keyframe"], bool)
    per_lap = round(measured["lap_s"] * measured["rate_hz"])
    time_growth = growth(cpu.tolist(), per_lap, round(60 * measured["rate_hz"]))
    memory = growth(measured["memory_mb"], max(1, per_lap // 100), round(0.6 * measured["rate_hz"]))
    mean, p99 = float(cpu.mean()), float(np.percentile(cpu, 99.0))
    return [
        mode,
        f"{len(cpu) / measured['rate_hz'] / 60.0:.1f}",
        f"{mean:.2f} (≤ {BOUND_MS[mode]:g}: {'yes' if mean <= BOUND_MS[mode] else '**no**'})",
        text(float(np.percentile(cpu, 50.0)), ".2f"),
        f"{p99:.1f} (≤ {BOUND_P99_MS:g}: {'yes' if p99 <= BOUND_P99_MS else '**no**'})",
        text(float(cpu.max()), ".0f"),
        f"{text(float(cpu[is_keyframe].mean()), '.1f')} ({100 * is_keyframe.mean():.0f} %)"
        if is_keyframe.any()
        else "–",
        f"{text(time_growth.second, '.2f')} → {text(time_growth.last, '.2f')}, ×{text(time_growth.ratio)}",
        "–" if np.isnan(time_growth.ratio) else "yes" if time_growth.ratio <= BOUND_GROWTH else "**no**",
        f"{text(memory.second, '.0f')} → {text(memory.last, '.0f')}, ×{text(memory.ratio)}",
        ", ".join(f"{name} {100 * count / len(cpu):.1f} %" for name, count in measured["health"].items()),
    ]


def profile_table(measured: dict[str, Any]) -> str:
    """Return tables of the processor time by stage and by function, in descending order."""
    frames = len(measured["cpu_ms"])
    counted = {name: s for name, s in measured["stages"].items() if name != OUTSIDE}
    total_s = sum(counted.values())
    rows = [
        [stage, f"{100 * s / total_s:.1f}", f"{1e3 * s / frames:.2f}"]
        for stage, s in sorted(counted.items(), key=lambda item: -item[1])
    ]
    functions = [[name, f"{100 * s / total_s:.1f}"] for name, s in measured["functions"].items()]
    return "\n\n".join(
        [
            table((f"{measured['mode']}: stage", "share [%]", "ms per frame"), rows),
            table(("function, with the C functions that it calls", "share [%]"), functions),
        ]
    )


def main(command: ProcessorTimeCommand) -> int:
    """Measure, print the tables, and return 1 if a bound is missed or a run failed."""
    results, failed = [], []
    for mode in command.modes:
        outcome = call_in_process(
            measure,
            command.recording,
            mode,
            command.minutes,
            command.profile,
            environment={**ONE_THREAD, "PYTHONPATH": os.pathsep.join([str(Path(__file__).parent), *sys.path])},
        )
        if outcome.status == "ok":
            results.append({**outcome.value, "peak_mb": outcome.peak_mb})
        else:
            failed.append(f"- {mode}: {outcome.status}, {outcome.reason}")
    print(f"{provenance()}\n")
    if results:
        metres, degrees = results[0]["discontinuity"]
        print(
            f"{results[0]['recording']}: laps of {results[0]['lap_s']:.2f} s with a discontinuity of"
            f" {1e3 * metres:.2f} mm and {degrees:.3f}° between them\n"
        )
        print(table(HEADINGS, [mode_row(measured) for measured in results]))
        print("".join(f"\n{profile_table(measured)}\n" for measured in results if command.profile))
    print("\n".join(failed))
    if command.json is not None:
        command.json.write_text(
            json.dumps({"provenance": provenance(), "command": str(asdict(command)), "runs": results})
        )
    return int(bool(failed) or any("**no**" in cell for measured in results for cell in mode_row(measured)))


if __name__ == "__main__":
    sys.exit(main(tyro.cli(ProcessorTimeCommand, description=__doc__)))
