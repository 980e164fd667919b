"""``dronevio doctor``: a check of this machine."""

import os
import platform
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from dronevio.cli.machine import cores, memory_gb, package_version
from dronevio.cli.options import Printing, PrintOptions
from dronevio.cli.terminal import parse, print_json, print_table

PACKAGES = ("dronevio", "mujoco", "gtsam", "opencv-python-headless", "numpy", "gymnasium", "rerun-sdk", "av")
"""Packages whose versions are printed."""


@dataclass(frozen=True)
class DoctorCommand:
    """Check this machine: versions of packages, off-screen rendering, video encoder, viewer, display and caches.

    One image is rendered off screen. The exit code is 0 if flights can be simulated on this machine, and 2 otherwise;
    then the command that installs the missing driver is printed.

    Examples:
      dronevio doctor
      dronevio doctor --json
    """

    printing: Printing = field(default_factory=PrintOptions)
    """How results are printed."""


def main(arguments: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    command = parse(DoctorCommand, arguments, "doctor")

    from dronevio.sim.cameras.gl import probe_gl

    gl = probe_gl()
    caches = _caches()
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
        "caches": caches,
        "advice": "" if gl.works else gl.advice,
    }
    if command.printing.json:
        print_json(findings)
        return 0 if gl.works else 2
    print_table(
        "This machine",
        ("", "found"),
        (
            ("Python", f"{findings['python']} ({sys.executable})"),
            ("platform", platform.platform()),
            ("cores", f"{cores()}"),
            ("memory", f"{memory_gb():.1f} GB"),
            *((name, package_version(name) or "missing") for name in PACKAGES),
            ("OpenGL", f"{gl.backend}: {gl.renderer or 'works'}" if gl.works else f"none: {gl.problem}"),
            ("AV1 encoder", _av1_encoder() or "none: run.rrd will contain single images"),
            ("rerun viewer", "present" if _rerun_viewer() else "missing"),
            *((f"cached {name}", _cache_text(cache)) for name, cache in caches.items()),
            ("display", "yes" if _display() else "none: `dronevio view` serves a web viewer"),
        ),
        left=("found",),
    )
    if not gl.works:
        print(f"dronevio: images cannot be rendered on this machine; {gl.advice}", file=sys.stderr)
        return 2
    print("Flights can be simulated on this machine.")
    return 0


def _caches() -> dict[str, dict[str, Any]]:
    """Return folder, size and limit of the caches, by their contents.

    Raises:
        ConfigError: The environment variable with the limit of the recordings is not a size.
    """
    from dronevio.eval.benchmark.cache_limit import default_folder, limit_bytes, size_bytes
    from dronevio.sim.pictures import world_pictures
    from dronevio.sim.rendering import world_files

    recordings = default_folder()
    used = size_bytes(recordings)
    caches: dict[str, dict[str, Any]] = {
        "recordings": {"folder": str(recordings), "gb": used * 1e-9, "limit_gb": limit_bytes(recordings, used) * 1e-9}
    }
    worlds = world_files.folder()
    for folder, files in ((worlds, world_files.FILES_MAX), (worlds.with_name("pictures"), world_pictures.FILES_MAX)):
        caches[folder.name] = {"folder": str(folder), "gb": size_bytes(folder) * 1e-9, "limit_files": files}
    return caches


def _cache_text(cache: dict[str, Any]) -> str:
    """Return size, limit and folder of a cache in words."""
    limit = f"{cache['limit_gb']:.1f} GB" if "limit_gb" in cache else f"{cache['limit_files']} files"
    return f"{cache['gb']:.2f} GB, at most {limit}: {cache['folder']}"


def _av1_encoder() -> str:
    """Return the name of an AV1 encoder of PyAV, or an empty text if there is none."""
    import av

    for name in ("libsvtav1", "libaom-av1"):
        if name in av.codecs_available:
            return name
    return ""


def _rerun_viewer() -> bool:
    """Return whether the executable of the rerun viewer is installed."""
    viewer = find_spec("rerun_cli")
    folders = [Path(place) for place in (viewer.submodule_search_locations or ())] if viewer else []
    return any(file.is_file() for folder in folders for file in folder.glob("rerun*"))


def _display() -> bool:
    """Return whether a window could be opened."""
    return sys.platform == "darwin" or any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))
