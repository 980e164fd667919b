"""What the odometry costs on a long flight: processor time a frame, memory, whether either grows, and where it goes.

A recording that begins and ends at rest on the same pad is flown again and again, as often as it takes: images and IMU
are those of the recording, the biases of the IMU walk on from one lap to the next. How well the pads meet is printed.
Reading images is not timed; whoever measures keeps the machine quiet, or takes the figures as upper bounds::

    dronevio fly --scenario room-medium --plan.heading fixed --plan.tour-s 26 --rig euroc-stereo --out FOLDER
    python scripts/cost.py --recording FOLDER --minutes 10
    python scripts/cost.py --recording FOLDER --minutes 1 --profile     # also says what the time is spent on
"""

import json
import os
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from long_flight import measure
from measuring import ONE_THREAD, Mode, provenance
from tables import table, text

from dronevio.eval.benchmark.isolation import isolated

BOUND_MS: dict[Mode, float] = {"mono": 10.0, "stereo": 16.0}
BOUND_P99_MS = 50.0
"""One frame's time at 20 Hz."""
GROWTH = 1.05
"""How much more the last minute may cost than the second."""


@dataclass(frozen=True)
class Cost:
    """Estimate a long flight and print Markdown tables of what that costs."""

    recording: Path
    """EuRoC folder of a flight that begins and ends at rest on the same pad; with two cameras for stereo."""
    minutes: float = 10.0
    """For how long to fly."""
    modes: tuple[Mode, ...] = ("mono", "stereo")
    """How many cameras to use."""
    profile: bool = False
    """Look what the time is spent on, a thousand times a second."""
    json: Path | None = None
    """File for all figures, frame by frame."""


@dataclass(frozen=True)
class Flatness:
    """What the second minute of a flight cost, and the last one."""

    second_ms: float
    """Mean over the second minute, or over as many whole laps as fit best [ms]."""
    last_ms: float
    """Mean over the last as many [ms]."""
    ratio: float
    """How much more the last one costs; nan of a flight of less than three."""


def flatness(values: Sequence[float], per_lap: int, per_minute: int) -> Flatness:
    """Compare the second minute with the last, both of whole laps, so that the same is flown in both.

    Args:
        values: What each frame cost, or what was held, evenly over the flight.
        per_lap: How many values a lap has.
        per_minute: How many values a minute has.
    """
    span = max(1, round(per_minute / per_lap)) * per_lap
    if len(values) < 3 * span:
        return Flatness(float("nan"), float("nan"), float("nan"))
    second, last = float(np.mean(values[span : 2 * span])), float(np.mean(values[-span:]))
    return Flatness(second, last, last / second)


def cost_row(found: dict[str, Any]) -> list[str]:
    """Return a row of the table."""
    mode: Mode = found["mode"]
    cpu = np.array(found["cpu_ms"])
    is_keyframe = np.array(found["keyframe"], bool)
    per_lap = round(found["lap_s"] * found["rate_hz"])
    flat = flatness(cpu.tolist(), per_lap, round(60 * found["rate_hz"]))
    memory = np.array(found["memory_mb"])
    grown = flatness(memory.tolist(), max(1, per_lap // 100), round(0.6 * found["rate_hz"]))
    mean, p99 = float(cpu.mean()), float(np.percentile(cpu, 99.0))
    return [
        mode,
        f"{len(cpu) / found['rate_hz'] / 60.0:.1f}",
        f"{mean:.2f} (≤ {BOUND_MS[mode]:g}: {'yes' if mean <= BOUND_MS[mode] else '**no**'})",
        text(float(np.percentile(cpu, 50.0)), ".2f"),
        f"{p99:.1f} (≤ {BOUND_P99_MS:g}: {'yes' if p99 <= BOUND_P99_MS else '**no**'})",
        text(float(cpu.max()), ".0f"),
        f"{text(float(cpu[is_keyframe].mean()), '.1f')} ({100 * is_keyframe.mean():.0f} %)"
        if is_keyframe.any()
        else "–",
        f"{text(flat.second_ms, '.2f')} → {text(flat.last_ms, '.2f')}, ×{text(flat.ratio)}",
        "–" if np.isnan(flat.ratio) else "yes" if flat.ratio <= GROWTH else "**no**",
        f"{text(grown.second_ms, '.0f')} → {text(grown.last_ms, '.0f')}, ×{text(grown.ratio)}",
        ", ".join(f"{name} {100 * count / len(cpu):.1f} %" for name, count in found["health"].items()),
    ]


HEADINGS = (
    "",
    "minutes",
    "CPU ms a frame",
    "median",
    "p99",
    "max",
    "keyframe (share)",
    "second → last minute",
    "flat",
    "memory, second → last minute [MB]",
    "health",
)


def profile_table(found: dict[str, Any]) -> str:
    """Return where the time goes, the largest first."""
    frames = len(found["cpu_ms"])
    counted = {name: s for name, s in found["stages"].items() if name != "reading, not counted"}
    total_s = sum(counted.values())
    rows = [
        [stage, f"{100 * s / total_s:.1f}", f"{1e3 * s / frames:.2f}"]
        for stage, s in sorted(counted.items(), key=lambda item: -item[1])
    ]
    functions = [[name, f"{100 * s / total_s:.1f}"] for name, s in found["functions"].items()]
    return "\n\n".join(
        [
            table((f"{found['mode']}: stage", "share [%]", "ms a frame"), rows),
            table(("function, and what of C it calls", "share [%]"), functions),
        ]
    )


def main(command: Cost) -> int:
    """Measure, print; 1 if a bound is missed or a run failed."""
    results, failed = [], []
    for mode in command.modes:
        outcome = isolated(
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
        metres, degrees = results[0]["seam"]
        print(
            f"{results[0]['recording']}: laps of {results[0]['lap_s']:.2f} s that meet to {1e3 * metres:.2f} mm,",
            end="",
        )
        print(f" {degrees:.3f}°\n")
        print(table(HEADINGS, [cost_row(found) for found in results]))
        print("".join(f"\n{profile_table(found)}\n" for found in results if command.profile))
    print("\n".join(failed))
    if command.json is not None:
        command.json.write_text(
            json.dumps({"provenance": provenance(), "command": str(asdict(command)), "runs": results})
        )
    return int(bool(failed) or any("**no**" in cell for found in results for cell in cost_row(found)))


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Cost, description=__doc__)))
