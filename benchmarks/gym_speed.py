"""Speed of many quadrotors at once, beside other simulators of quadrotors for reinforcement learning.

Each of the others is installed in a virtual environment of its own, whose Python runs `rival_speed.py`. The times are
those of the processor; programs that use it at the same time disturb them::

    .venv/bin/python benchmarks/gym_speed.py
    .venv/bin/python benchmarks/gym_speed.py --pyflyt a/bin/python --rotorpy b/bin/python --crazyflow c/bin/python

RotorPy needs torch, torchdiffeq, roma and stable-baselines3 for its vector environment.
"""

import json
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from dronevio.cli.terminal import print_table
from dronevio.sim.speed.batch_throughput import environment_speed

_SCRIPT = Path(__file__).with_name("rival_speed.py")
LEFT_OUT = {
    "pyflyt": "IMU, ground effect, battery",
    "rotorpy": "contacts, IMU, ground effect, battery",
    "crazyflow": "rotors, drag, contacts, IMU, ground effect, battery",
}
"""What the measured environment of each simulator does not simulate."""


@dataclass(frozen=True)
class GymSpeedCommand:
    """Measure the speed of many quadrotors at once, beside other simulators."""

    pyflyt: Path | None = None
    """Python of an environment with PyFlyt."""
    rotorpy: Path | None = None
    """Python of an environment with RotorPy."""
    crazyflow: Path | None = None
    """Python of an environment with crazyflow."""
    count: int = 1024
    """Number of vehicles of this simulator."""
    runs: int = 7
    """Number of runs of this simulator, of which the medians are printed."""


def rows_of(name: str, measured: list[dict[str, Any]]) -> list[tuple[str, ...]]:
    """Return the rows of a simulator, given its measurements as `rival_speed.py` prints them."""
    return [(f"{name} {one['version']}", one["settings"], f"{one['speed']:.0f}", LEFT_OUT[name]) for one in measured]


def measurements(python: Path, name: str) -> list[dict[str, Any]]:
    """Return the measurements of a simulator by the Python of its environment."""
    done = subprocess.run([str(python), str(_SCRIPT), name], capture_output=True, text=True, check=True)
    return [json.loads(line) for line in done.stdout.splitlines() if line.startswith('{"name"')]


def measure(command: GymSpeedCommand) -> None:
    """Measure all simulators and print the table."""
    rows: list[tuple[str, ...]] = []
    for rate_hz, imu in ((50.0, True), (50.0, False), (500.0, False)):
        speed = environment_speed(command.count, round(0.5 * rate_hz), command.runs, rate_hz, imu)
        settings = f"{command.count} vehicles, actions {rate_hz:g} Hz{', IMU 200 Hz' if imu else ''}"
        rows.append(("dronevio", settings, f"{speed:.0f}", "–" if imu else "IMU"))
    rivals = {"pyflyt": command.pyflyt, "rotorpy": command.rotorpy, "crazyflow": command.crazyflow}
    for name, python in rivals.items():
        if python is not None:
            rows += rows_of(name, measurements(python, name))
    print_table(
        "Simulated seconds per second of processor time",
        ("simulator", "settings", "speed", "does not simulate"),
        rows,
        left=("simulator", "settings", "does not simulate"),
    )


if __name__ == "__main__":
    measure(tyro.cli(GymSpeedCommand, description=__doc__))
