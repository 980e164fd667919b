"""Measure errors on three semi-real sequences: real trajectories and IMU samples of EuRoC with rendered images.

The sequences are written by ``make_semi_real.py``, a tool that comes with the data folder (DRONEVIO_DATA), as NAME-SEED
(NAME for seed 0)::

    python scripts/semi_real.py --sequences FOLDER --seeds 0-4
    python scripts/semi_real.py --sequences FOLDER --make      # makes missing sequences first

Every run is causal and evaluated after alignment of yaw and position. The tables have the median over seeds of each
sequence and the geometric mean of these medians; the error of a failed run is infinite.
"""

import importlib.util
import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
from estimation_tasks import (
    CAMERAS,
    ONE_THREAD,
    EstimationTask,
    Mode,
    estimator_hash,
    provenance,
    run_all,
    write_json,
)
from markdown_tables import geometric_mean, median, numbers, table, text
from run_metrics import RunMetrics, failures

STARTS_S = {"V1_02": 0, "V2_01": 0, "MH_04": 15}
"""Sequences, and the time in the real flight at which they begin [s]."""
BOUNDS_M: dict[Mode, float] = {"mono": 0.038, "stereo": 0.0156}
"""Bound of the geometric mean of the ATE [m]."""
REFERENCES: dict[Mode, tuple[str, dict[str, float]]] = {
    "mono": ("OpenVINS mono", {"V1_02": 0.045, "V2_01": 0.094, "MH_04": 0.106}),
    "stereo": ("Basalt stereo", {"V1_02": 0.027, "V2_01": 0.011, "MH_04": 0.013}),
}
"""ATE of other programs on seed 0, measured by the authors of the tool [m]."""


@dataclass(frozen=True)
class SemiRealCommand:
    """Estimate the semi-real sequences and print Markdown tables."""

    sequences: Path
    """Folder of the sequences."""
    seeds: str = "0-4"
    """Seeds of the rendered images, such as 0-4 or 0,2."""
    modes: tuple[Mode, ...] = ("mono", "stereo")
    """Cameras of the estimator."""
    names: tuple[str, ...] = tuple(STARTS_S)
    """Names of the sequences."""
    workers: int = 1
    """Number of runs at the same time."""
    results: Path | None = None
    """Folder of the cached metrics and estimates of runs."""
    make: bool = False
    """Make missing sequences first, which takes about two minutes each."""
    tools: Path | None = None
    """Folder of make_semi_real.py and score.py; the folder tools beside DRONEVIO_DATA by default."""
    json: Path | None = None
    """JSON file for the metrics of all runs."""


def sequence_folder(folder: Path, name: str, seed: int) -> Path:
    """Return the folder of a sequence: NAME-SEED, or NAME for seed 0."""
    numbered = folder / f"{name}-{seed}"
    return folder / name if seed == 0 and not numbered.exists() else numbered


def make_missing(folder: Path, names: Sequence[str], seeds: Sequence[int], cameras: int, tool: Path) -> None:
    """Make the sequences that do not exist or have too few cameras.

    Args:
        folder: Folder of the sequences.
        names: Names of the sequences.
        seeds: Seeds of the rendered images.
        cameras: Number of cameras.
        tool: Path of ``make_semi_real.py``.
    """
    data = Path(os.environ.get("DRONEVIO_DATA", ""))
    for seed in seeds:
        for name in names:
            sequence = sequence_folder(folder, name, seed)
            if (sequence / "mav0" / f"cam{cameras - 1}" / "data").is_dir():
                continue
            print(f"making {sequence}", file=sys.stderr, flush=True)
            real = data / "euroc" / name
            options = {"gt": real / "groundtruth.csv", "imu": real / "imu0.csv", "start-s": STARTS_S[name]}
            options |= {"duration-s": 40, "rate-hz": 20, "seed": seed, "width": 752, "height": 480, "out": sequence}
            words = [word for option, value in options.items() for word in (f"--{option}", str(value))]
            environment = {**os.environ, **ONE_THREAD, "MUJOCO_GL": os.environ.get("MUJOCO_GL", "egl")}
            subprocess.run([sys.executable, str(tool), *words], check=True, env=environment)


def summary(rows: Sequence[RunMetrics], mode: Mode, names: Sequence[str], seeds: Sequence[int]) -> str:
    """Return the table of one mode: medians over seeds, with those of another program and the bound."""
    other, theirs = REFERENCES[mode]
    cells, medians = [], []
    for name in names:
        own = [row for row in rows if row.mode == mode and row.flight.rsplit("-", 1)[0] == name]
        errors = [row.ate_m for row in own] + [float("inf")] * (len(seeds) - len(own))
        medians.append(median(errors))
        cells.append(
            [
                name,
                text(medians[-1], ".4f"),
                f"{text(min(errors), '.4f')}–{text(max(errors), '.4f')}",
                text(theirs.get(name)),
                "yes" if medians[-1] <= theirs.get(name, float("inf")) else "**no**",
                text(median(row.rpe_m for row in own), ".4f"),
                text(median(row.rpe_deg for row in own), ".3f"),
                text(min((row.coverage_percent for row in own), default=0.0), ".1f"),
                text(max((row.first_s for row in own), default=float("inf")), ".2f"),
                text(median(row.scale_error_percent for row in own), "+.2f"),
                text(median(row.nees_position for row in own), ".1f"),
                text(median(row.nees_orientation for row in own), ".1f"),
                text(median(row.cpu_ms_mean for row in own), ".1f"),
                text(median(row.cpu_ms_p99 for row in own), ".1f"),
            ]
        )
    total = geometric_mean(medians)
    of_theirs = geometric_mean([theirs[name] for name in names if name in theirs])
    verdict = "yes" if total <= BOUNDS_M[mode] else "**no**"
    last = ["geometric mean", text(total, ".4f"), "", text(of_theirs), f"≤ {BOUNDS_M[mode]}: {verdict}", *[""] * 9]
    headings = (
        mode,
        "ATE [m]",
        "min–max",
        other,
        "not worse",
        "RPE 1 s [m]",
        "RPE [°]",
        "smallest coverage [%]",
        "latest first pose [s]",
        "scale [%]",
        "NEES position",
        "NEES orientation",
        "CPU ms",
        "p99",
    )
    return table(headings, [*cells, last])


def detail(rows: Sequence[RunMetrics]) -> str:
    """Return a table of all runs."""
    cells = [
        [
            row.flight,
            row.mode,
            text(row.ate_m, ".4f"),
            text(row.max_m),
            text(row.rpe_m, ".4f"),
            text(row.scale_error_percent, "+.2f"),
            text(row.coverage_percent, ".1f"),
            text(row.first_s, ".2f"),
            text(row.nees_position, ".1f"),
            text(row.nees_orientation, ".1f"),
            text(row.step_jump_m),
            text(row.cpu_ms_mean, ".1f"),
            text(row.cpu_ms_p99, ".1f"),
        ]
        for row in sorted(rows, key=lambda row: (row.mode, row.flight))
    ]
    headings = ("flight", "", "ATE [m]", "max [m]", "RPE [m]", "scale [%]", "coverage [%]", "first pose [s]")
    return table(
        (*headings, "NEES p", "NEES θ", "largest jump [m]", "CPU ms", "p99"),
        cells,
        2,
    )


def cross_check(rows: Sequence[RunMetrics], command: SemiRealCommand, tools: Path) -> str:
    """Evaluate one successful run of each mode with the tool of the data folder, and return both results as text."""
    if command.results is None or not (tools / "score.py").exists():
        return ""
    spec = importlib.util.spec_from_file_location("score", tools / "score.py")
    assert spec is not None and spec.loader is not None
    tool: Any = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(tool)
    lines = [""]
    for mode in command.modes:
        successful = sorted(
            (row for row in rows if row.mode == mode and row.status == "ok"), key=lambda row: row.flight
        )
        for row in successful[:1]:
            name, _, seed = row.flight.rpartition("-")
            folder = sequence_folder(command.sequences, name, int(seed))
            key = EstimationTask(row.flight, folder, mode).key(estimator_hash())
            truth = folder / "mav0" / "state_groundtruth_estimate0" / "data.csv"
            theirs = tool.evaluate(str(command.results / f"{key}.tum"), str(truth))
            lines.append(
                f"score.py on {row.flight} {mode}: ATE {theirs['ate_yaw']:.5f} m (ours {row.ate_m:.5f}), RPE"
                f" {theirs['rpe_m']:.5f} m (ours {row.rpe_m:.5f}), n {theirs['n']}, first {theirs['first_s']:.2f} s."
            )
    return "\n".join(lines)


def main(command: SemiRealCommand) -> int:
    """Execute the runs that are not cached, print the tables, and return 1 if a bound is missed."""
    seeds = numbers(command.seeds)
    tools = command.tools or Path(os.environ.get("DRONEVIO_DATA", ".")).parent / "tools"
    if command.make:
        make_missing(
            command.sequences, command.names, seeds, max(CAMERAS[m] for m in command.modes), tools / "make_semi_real.py"
        )
    tasks = [
        EstimationTask(f"{name}-{seed}", sequence_folder(command.sequences, name, seed), mode)
        for seed in seeds
        for name in command.names
        for mode in command.modes
    ]
    rows = list(run_all(tasks, command.results, command.workers))
    print(f"Seeds {command.seeds}; medians over seeds. {provenance()}\n")
    for mode in command.modes:
        print(summary(rows, mode, command.names, seeds) + "\n")
    print(detail(rows))
    print(failures(rows) + cross_check(rows, command, tools))
    write_json(command.json, rows)
    means = {
        mode: geometric_mean(
            [median(r.ate_m for r in rows if r.mode == mode and r.flight.startswith(n)) for n in command.names]
        )
        for mode in command.modes
    }
    return int(any(means[mode] > BOUNDS_M[mode] for mode in command.modes))


if __name__ == "__main__":
    sys.exit(main(tyro.cli(SemiRealCommand, description=__doc__)))
