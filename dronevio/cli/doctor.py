"""``dronevio doctor``: what this machine has and lacks."""

import os
import platform
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

from dronevio.cli.machine import cores, memory_gb, package_version
from dronevio.cli.terminal import parse, print_json, print_table

PACKAGES = ("dronevio", "mujoco", "gtsam", "opencv-python-headless", "numpy", "gymnasium", "rerun-sdk", "av")
"""The packages whose versions matter when something does not work."""


@dataclass(frozen=True)
class DoctorCommand:
    """Say what this machine has and lacks, and what to type if frames cannot be drawn.

    Draws one frame off screen to find out. Exits with 0 if flights can be simulated here, with 2 if not.

    Examples:
      dronevio doctor
      dronevio doctor --json
    """

    json: bool = False
    """Print one JSON document instead of a table."""


def main(arguments: Sequence[str]) -> int:
    """Run the command."""
    command = parse(DoctorCommand, arguments, "doctor")

    from dronevio.sim.cameras.gl import probe_gl

    gl = probe_gl()
    findings = {
        "python": platform.python_version(),
        "platform": platform.platform(),
        "cores": cores(),
        "memory_gb": memory_gb(),
        "packages": {name: package_version(name) for name in PACKAGES},
        "gl": {
            "works": gl.works,
            "backend": gl.backend,
            "renderer": gl.renderer,
            "vendor": gl.vendor,
            "problem": gl.problem,
        },
        "av1_encoder": _av1_encoder(),
        "rerun_viewer": _rerun_viewer(),
        "display": _display(),
        "advice": "" if gl.works else gl.advice,
    }
    if command.json:
        print_json(findings)
        return 0 if gl.works else 2
    print_table(
        "What is here",
        ("", "found"),
        (
            ("Python", f"{findings['python']} ({sys.executable})"),
            ("platform", platform.platform()),
            ("cores", f"{cores()}"),
            ("memory", f"{memory_gb():.1f} GB"),
            *((name, package_version(name) or "missing") for name in PACKAGES),
            ("OpenGL", f"{gl.backend}: {gl.renderer or 'draws'}" if gl.works else f"none: {gl.problem}"),
            ("AV1 encoder", _av1_encoder() or "none: run.rrd will hold single images"),
            ("rerun viewer", "present" if _rerun_viewer() else "missing"),
            ("display", "yes" if _display() else "none: recordings open in the browser"),
        ),
    )
    if not gl.works:
        print(f"dronevio: frames cannot be drawn here; {gl.advice}", file=sys.stderr)
        return 2
    print("All that a flight needs is here.")
    return 0


def _av1_encoder() -> str:
    """Return the name of an AV1 encoder that PyAV has; empty if there is none."""
    import av

    for name in ("libsvtav1", "libaom-av1"):
        if name in av.codecs_available:
            return name
    return ""


def _rerun_viewer() -> bool:
    """Return whether the rerun wheel brought the viewer's executable."""
    found = find_spec("rerun_cli")
    folders = [Path(place) for place in (found.submodule_search_locations or ())] if found else []
    return any(file.is_file() for folder in folders for file in folder.glob("rerun*"))


def _display() -> bool:
    """Return whether a window could be opened."""
    return sys.platform == "darwin" or any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))
