"""Output of the commands ``dronevio speed``: figures with their bounds, for people and for programs."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict

from dronevio.cli.machine import cores, memory_gb, package_version, processor
from dronevio.cli.terminal import print_json, print_table
from dronevio.models.performance import PerformanceFigure


def print_speed(
    title: str,
    settings: Mapping[str, object],
    figures: Sequence[PerformanceFigure],
    packages: Sequence[str],
    renderer: str | None = None,
    *,
    json: bool,
) -> None:
    """Print figures, the machine and the versions of packages.

    Args:
        title: Title of the table.
        settings: What was measured, for the JSON document.
        figures: The figures.
        packages: Names of the packages whose versions are printed.
        renderer: Name of the OpenGL renderer, if one was used.
        json: Whether to print one JSON document instead of a table.
    """
    versions = {name: package_version(name) for name in packages}
    if json:
        machine: dict[str, object] = {"processor": processor(), "cores": cores(), "memory_gb": memory_gb()}
        if renderer is not None:
            machine["gl"] = renderer
        rows = [{**asdict(figure), "ratio": figure.ratio, "met": figure.met} for figure in figures]
        print_json({**settings, "machine": machine, "packages": versions, "figures": rows})
        return
    print_table(
        title,
        ("", "measured", "bound", "ratio", ""),
        [
            (
                figure.name,
                f"{figure.value:.3g} {figure.unit}".strip(),
                f"{'≤' if figure.sense == 'at most' else '≥'} {figure.bound:g}",
                f"{figure.ratio:.2f}",
                "met" if figure.met else "missed",
            )
            for figure in figures
        ],
    )
    for figure in figures:
        print(f"{figure.name}: {figure.method}")
    print(", ".join([processor(), f"{cores()} cores", f"{memory_gb():.0f} GB", *([renderer] if renderer else [])]))
    print(", ".join(f"{name} {number}" for name, number in versions.items()))
