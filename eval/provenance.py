"""Where numbers come from: the versions and the machine that made them."""

import os
import platform
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

PACKAGES = ("dronevio", "gtsam", "mujoco", "opencv-python-headless", "numpy", "rerun-sdk")
"""What can change a result."""


def versions_here() -> dict[str, str]:
    """Return the versions of Python and of those `PACKAGES` that are installed."""
    found = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            continue
    return found


def machine_here() -> dict[str, str]:
    """Return this machine's system, processor, and how many cores this process may use."""
    return {
        "system": f"{platform.system()} {platform.release()}",
        "processor": _processor(),
        "cores": str(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()),
    }


def _processor(cpuinfo: Path = Path("/proc/cpuinfo")) -> str:
    """Return the processor's name where the system tells it, else its architecture."""
    try:
        names = [line.partition(":")[2] for line in cpuinfo.read_text().splitlines() if line.startswith("model name")]
    except OSError:
        names = []
    return names[0].strip() if names else platform.processor() or platform.machine()


@dataclass(frozen=True)
class RunInfo:
    """What a report says of a run besides its results."""

    title: str
    """What was flown or read."""
    command: str
    """The command that made it."""
    open_command: str
    """The command that opens its recording."""
    seed: int | None = None
    """Seed of everything random; None for a recording of the real world."""
    configuration: dict[str, object] = field(default_factory=dict)
    """Every setting that took effect, by name; nested as the settings are, of what JSON can hold."""
    versions: dict[str, str] = field(default_factory=versions_here)
    """Versions of Python and of `PACKAGES`."""
    machine: dict[str, str] = field(default_factory=machine_here)
    """The machine that it ran on."""
