"""Provenance of results: the versions and the machine that produced them."""

import os
import platform
from collections.abc import Mapping
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

PACKAGES = ("dronevio", "gtsam", "mujoco", "opencv-python-headless", "numpy", "rerun-sdk")
"""Packages whose versions are recorded."""


def versions_here() -> dict[str, str]:
    """Return the versions of Python and of the installed ones of `PACKAGES`."""
    versions = {"python": platform.python_version()}
    for package in PACKAGES:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            continue
    return versions


def machine_here() -> dict[str, str]:
    """Return the system, the processor, and the number of cores that this process may use."""
    return {
        "system": f"{platform.system()} {platform.release()}",
        "processor": processor_here(),
        "cores": str(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()),
    }


def processor_here(cpuinfo: Path = Path("/proc/cpuinfo")) -> str:
    """Return the name of the processor if the system has it, or else the architecture.

    Args:
        cpuinfo: File of Linux that describes the processors.
    """
    try:
        names = [line.partition(":")[2] for line in cpuinfo.read_text().splitlines() if line.startswith("model name")]
    except OSError:
        names = []
    return names[0].strip() if names else platform.processor() or platform.machine()


@dataclass(frozen=True)
class RunInfo:
    """Provenance of a run, for its report."""

    title: str
    """Title of the report: name of the scenario or recording."""
    command: str
    """Command that produced the run."""
    open_command: str
    """Command that opens the recording of the run."""
    seed: int | None = None
    """Seed of all random numbers; None for a real recording."""
    configuration: dict[str, object] = field(default_factory=dict)
    """All settings by name, nested, of types that JSON can represent."""
    versions: dict[str, str] = field(default_factory=versions_here)
    """Versions of Python and of `PACKAGES`."""
    machine: dict[str, str] = field(default_factory=machine_here)
    """System, processor and number of cores."""

    @property
    def sections(self) -> list[tuple[str, Mapping[str, object], bool]]:
        """Titles and contents of the sections of a report, and whether each is open at first."""
        return [
            ("Run", {"command": self.command}, True),
            ("Configuration", self.configuration, False),
            ("Versions", self.versions, False),
            ("Machine", self.machine, False),
        ]
