"""Draw the learning curves of all trainings, and print the tables of their results and costs.

```console
python curves.py --out ../../docs/images/learning-curves.svg
```
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import tyro
from matplotlib.axes import Axes
from matplotlib.figure import Figure

HERE = Path(__file__).resolve().parent

TITLES = {
    "hover": ("Hover, true state", "mean_return"),
    "hover-imu": ("Hover, IMU and randomization", "mean_return"),
    "waypoints": ("Waypoints", "success_rate"),
    "race": ("Race", "mean_return"),
}
"""Title of each training, and the value of its learning curve that is drawn."""
LABELS = {"mean_return": "return of an episode", "success_rate": "share of successful episodes"}
"""Labels of the values."""
TRAINERS = {"ppo": "", "sb3": ", SB3"}
"""What the tables add to the name of a training, by the trainer: `ppo.py`, or Stable-Baselines3 (SB3)."""
RESULTS = ("success", "crashes", "final error [m]", "lap [s]")
"""Columns of the table of results, beside training and seed."""
COSTS = ("samples [M]", "wall [s]", "CPU [s]")
"""Columns of the table of costs, beside training and seed."""


@dataclass(frozen=True)
class CurvesCommand:
    """Draw the learning curves, and print the tables of results and costs."""

    results: Path = HERE / "results"
    """Folder with the results of the trainings."""
    out: Path = Path("learning-curves.svg")
    """Picture to write."""


def results_of(folder: Path, name: str, algorithm: str) -> list[dict[str, Any]]:
    """Return the results of all seeds of a training, in the order of the seeds."""
    found = [json.loads(path.read_text(encoding="utf-8")) for path in folder.glob(f"{name}-{algorithm}-[0-9]*.json")]
    return sorted(found, key=lambda result: int(result["seed"]))


def draw(axes: Axes, name: str, results: list[dict[str, Any]]) -> None:
    """Draw the learning curves of the seeds of a training over samples, with the processor time on a second axis."""
    title, value = TITLES[name]
    for result in results:
        curve = {key: np.array(result["curve"][key].split(), float) for key in ("samples", value)}
        axes.plot(curve["samples"] / 1e6, curve[value], label=f"seed {result['seed']}", linewidth=1.2)
    seconds = np.mean([result["cpu_s"] / result["samples"] for result in results]) * 1e6
    above = axes.secondary_xaxis("top", functions=(lambda x: x * seconds / 60, lambda x: x * 60 / seconds))
    above.set_xlabel("processor time [min]")
    axes.set(title=title, xlabel="samples [millions]", ylabel=LABELS[value])
    axes.set_xlim(left=0.0)
    axes.set_ylim(bottom=0.0)
    axes.grid(alpha=0.3)


def scores_of(name: str, result: dict[str, Any]) -> tuple[str, ...]:
    """Return a row of the table of results."""
    scores = result["evaluation"]
    return (
        f"{scores['success_rate']:.0%}",
        f"{scores['crash_rate']:.0%}",
        f"{scores['final_distance_m']:.3f}" if name.startswith("hover") else "",
        "" if scores["lap_s"] is None else f"{scores['lap_s']:.1f}",
    )


def costs_of(result: dict[str, Any]) -> tuple[str, ...]:
    """Return a row of the table of costs."""
    return f"{result['samples'] / 1e6:.1f}", f"{result['wall_s']:.0f}", f"{result['cpu_s']:.0f}"


def print_table(columns: tuple[str, ...], rows: list[tuple[str, ...]]) -> None:
    """Print a table of trainings and seeds in Markdown."""
    header = ("training", "seed", *columns)
    for cells in (header, ("---",) * len(header), *rows):
        print(f"| {' | '.join(cells)} |")
    print()


def main(command: CurvesCommand) -> None:
    """Draw the picture and print the tables."""
    figure = Figure(figsize=(9.0, 7.0), layout="constrained")
    for axes, name in zip(figure.subplots(2, 2).flat, TITLES, strict=True):
        results = results_of(command.results, name, "ppo")
        if results:
            draw(axes, name, results)
    figure.axes[0].legend(loc="lower right")
    matplotlib.rcParams["svg.hashsalt"] = "dronevio"  # the same picture has the same bytes
    figure.savefig(command.out, metadata={"Date": None})
    trained = [
        (name, (f"`{name}`{trainer}", str(result["seed"])), result)
        for algorithm, trainer in TRAINERS.items()
        for name in TITLES
        for result in results_of(command.results, name, algorithm)
    ]
    print_table(RESULTS, [(*first, *scores_of(name, result)) for name, first, result in trained])
    print_table(COSTS, [(*first, *costs_of(result)) for _, first, result in trained])


if __name__ == "__main__":
    main(tyro.cli(CurvesCommand, description=__doc__))
