"""Measure the robustness of the odometry: dark images, lost frames, wrong calibrations, noise, no parallax.

Each flight is simulated once with two cameras, and estimated with one and with two cameras::

    python scripts/stress.py --flights FOLDER --results ROWS
    python scripts/stress.py --flights FOLDER --results ROWS --only dark-1s dark-5s --seeds 0-2

Each run should end with a bounded error, or report a loss and recover. Values that are not finite are a failure, and so
is a discontinuity: a step from one frame to the next with a large error while the estimator reports that it tracks. An
error beyond five of its standard deviations while the estimator reports that it tracks is a failure, too.
"""

import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import tyro
from estimation_tasks import EstimationTask, Mode, provenance, run_all, write_json
from markdown_tables import median, numbers, table, text
from run_metrics import RunMetrics, failures

from dronevio.models.rig_presets import rig_named
from dronevio.sim.physics.wind import Wind
from dronevio.sim.scenario import Scenario
from dronevio.sim.scenarios import SUITES, scenario_named

HOVER_S = 60.0
_HOVER_FROM_S = 5.0  # time after which the drone has climbed and hovers
DISCONTINUITY_M = 0.25
"""Error of a step from which it is a discontinuity: 5 m/s at 20 Hz [m]."""
BOUNDED_PERCENT = 5.0
"""Largest error of a position relative to the length of the path that is a bounded error [%]."""
LARGEST_SIGMAS = 5.0
"""Largest error of position in standard deviations while an estimator reports that it tracks."""
HOVER_DRIFT_M = 0.01
"""Bound of the drift while the drone hovers for a minute [m]."""


@dataclass(frozen=True)
class Trial:
    """One condition under which the odometry is measured."""

    scenario: Scenario
    """Scenario with its faults."""
    window_s: tuple[float, float] | None = None
    """Time window of the fault, or of the hover [s]."""
    front_end: str = ""
    """Name in `corrupted_tracks.CORRUPTED_FRONT_ENDS`; empty for the front end of the estimator."""
    recording: str = ""
    """Name of the trial whose recording is used; empty for a recording of its own."""


@dataclass(frozen=True)
class StressCommand:
    """Simulate flights under difficult conditions, estimate them, and print Markdown tables."""

    flights: Path
    """Folder of the flights; those that do not exist are simulated first."""
    results: Path
    """Folder of the cached metrics of runs."""
    only: tuple[str, ...] = ()
    """Names of the trials to run; all by default."""
    modes: tuple[Mode, ...] = ("mono", "stereo")
    """Cameras of the estimator."""
    seeds: str = "0"
    """Seeds of each trial, such as 0-2."""
    fly: bool = True
    """Simulate flights that do not exist. Otherwise they are left out and listed below the tables."""
    workers: int = 1
    """Number of runs at the same time."""
    json: Path | None = None
    """JSON file for the metrics of all runs."""


def trials() -> dict[str, Trial]:
    """Return all trials by name."""
    named = {name: scenario_named(name) for name in SUITES["stress"][1:]}
    short = {name.removeprefix("room-").rpartition("-v")[0]: each for name, each in named.items()}
    fault_windows = {
        name: (each.faults.dark_from_s, each.faults.dark_from_s + each.faults.dark_for_s)
        for name, each in short.items()
        if each.faults.dark_for_s
    }
    hover = scenario_named("hover")
    calm = replace(hover, plan=replace(hover.plan, tour_s=HOVER_S + 2.0))
    gusty = replace(calm, wind=Wind((3.0, 0.0, 0.0), 1.0))
    hovering = (_HOVER_FROM_S, _HOVER_FROM_S + HOVER_S)
    return {
        "none": Trial(scenario_named("room")),
        **{name: Trial(each, fault_windows.get(name)) for name, each in short.items()},
        "outliers": Trial(scenario_named("room"), front_end="outliers", recording="none"),
        "low-texture": Trial(scenario_named("low-texture")),
        "rotation": Trial(scenario_named("room-rotation")),
        "hover": Trial(calm, hovering),
        "hover-gusts": Trial(gusty, hovering),
    }


def simulate_missing(folder: Path, flown: Scenario) -> None:
    """Simulate a scenario with the stereo rig and write its recording, unless the folder exists."""
    from dronevio.cli.output_files import atomic_folder
    from dronevio.recorder import record_flight

    if (folder / "mav0").is_dir():
        return
    print(f"simulating {folder.name}", file=sys.stderr, flush=True)
    with atomic_folder(folder) as unfinished:
        record_flight(replace(flown, rig=rig_named("euroc-stereo")), unfinished, workers=1)


def ending(row: RunMetrics) -> str:
    """Return how a run ended, in words; a failure is marked with ``**``."""
    not_tracking_percent = row.health.get("lost", 0.0) + row.health.get("initializing", 0.0)
    if row.not_finite:
        return "**NOT FINITE**"
    if row.status != "ok":
        reported = row.status == "failed" and row.health.get("initializing", 0.0) == 100.0
        return "never initialized" if reported else f"**{row.status.upper()}**"
    if row.step_error_m > DISCONTINUITY_M and row.longest_gap_s < 2.0 * row.duration_s / max(row.frames - 1, 1):
        return "**DISCONTINUOUS**"
    if row.tracking_sigmas is not None and row.tracking_sigmas > LARGEST_SIGMAS:
        return "**OVERCONFIDENT**"
    if row.max_m <= BOUNDED_PERCENT / 100.0 * row.path_m:
        return "bounded"
    return "loss reported" if row.health.get("lost", 0.0) > 0.0 and not_tracking_percent < 100.0 else "**UNBOUNDED**"


def _shares(row: RunMetrics) -> str:
    names = ("initializing", "tracking", "inertial-only", "lost")
    return " / ".join(f"{row.health[name]:.0f}" if name in row.health else "–" for name in names)


COLUMNS: tuple[tuple[str, Callable[[RunMetrics], str]], ...] = (
    ("ATE [m]", lambda row: text(row.ate_m)),
    ("ATE [% of path]", lambda row: text(row.ate_percent, ".2f")),
    ("max [m]", lambda row: text(row.max_m)),
    ("coverage [%]", lambda row: text(row.coverage_percent, ".1f")),
    ("initializing / tracking / inertial-only / lost [%]", _shares),
    ("longest gap [s]", lambda row: text(row.longest_gap_s, ".2f")),
    ("drift in the window [m]", lambda row: text(row.window_drift_m)),
    ("recovery [s]", lambda row: text(row.recovery_s, ".2f")),
    ("largest step error [m]", lambda row: text(row.step_error_m)),
    ("largest jump [m]", lambda row: text(row.step_jump_m)),
    ("largest error while tracking [σ]", lambda row: text(row.tracking_sigmas, ".1f")),
    ("NEES p", lambda row: text(row.nees_position, ".1f")),
    ("NEES θ", lambda row: text(row.nees_orientation, ".1f")),
    ("CPU ms", lambda row: text(row.cpu_ms_mean, ".1f")),
    ("p99", lambda row: text(row.cpu_ms_p99, ".1f")),
    ("result", ending),
)


def summary(rows: Sequence[RunMetrics], names: Sequence[str]) -> str:
    """Return a table of all runs, in the order of the trials."""
    by_run = {(row.flight, row.mode): row for row in rows}
    ordered = sorted(by_run, key=lambda key: (names.index(key[0].rpartition("-")[0]), key[1], key[0]))
    cells = [[*key, *(cell(by_run[key]) for _, cell in COLUMNS)] for key in ordered]
    return table(("trial", "", *(heading for heading, _ in COLUMNS)), cells, 2)


def verdicts(rows: Sequence[RunMetrics]) -> str:
    """Return sentences on the failures and on the bound of the drift while the drone hovers."""
    ends = [ending(row) for row in rows]
    failed = [f"{row.flight} {row.mode} {end}" for row, end in zip(rows, ends, strict=True) if end.startswith("**")]
    lines = [f"{len(rows)} runs, {len(failed)} of which fail{': ' + ', '.join(failed) if failed else ''}."]
    for mode in ("mono", "stereo"):
        for name in ("hover", "hover-gusts"):
            own = [row for row in rows if row.mode == mode and row.flight.rpartition("-")[0] == name]
            if own:
                drift_m = max(math.inf if row.window_drift_m is None else row.window_drift_m for row in own)
                lines.append(
                    f"{name} {mode}: drift in {HOVER_S:g} s {text(1e3 * drift_m, '.1f')} mm"
                    f" (≤ {1e3 * HOVER_DRIFT_M:g} mm: {'yes' if drift_m <= HOVER_DRIFT_M else '**no**'})."
                )
    return "\n".join(lines)


def medians(rows: Sequence[RunMetrics], names: Sequence[str]) -> str:
    """Return a table of medians over seeds, with one row per trial."""
    cells = []
    for name in names:
        cell = [name]
        for mode in ("mono", "stereo"):
            own = [row for row in rows if row.mode == mode and row.flight.rpartition("-")[0] == name]
            cell.append(
                f"{text(median(row.ate_m for row in own))} ({text(median(row.ate_percent for row in own), '.2f')})"
            )
        cells.append(cell)
    return table(("median over seeds: ATE [m] (% of path)", "mono", "stereo"), cells)


def main(command: StressCommand) -> int:
    """Simulate and estimate what is missing, print the tables, and return 1 if a run fails."""
    every, seeds = trials(), numbers(command.seeds)
    unknown = [name for name in command.only if name not in every]
    if unknown:
        print(f"no trial {', '.join(unknown)}; expected some of {', '.join(every)}", file=sys.stderr)
        return 2
    names = [name for name in every if not command.only or name in command.only]
    tasks, missing = [], []
    for seed in seeds:
        for name in names:
            trial = every[name]
            folder = command.flights / f"{trial.recording or name}-{seed}"
            if command.fly:
                simulate_missing(folder, replace(trial.scenario, seed=seed))
            if not (folder / "mav0").is_dir():
                missing.append(folder.name)
                continue
            label = f"{name}-{seed}"
            tasks += [EstimationTask(label, folder, mode, trial.front_end, trial.window_s) for mode in command.modes]
    rows = list(run_all(tasks, command.results, command.workers))
    print(f"{len(tasks)} runs. {provenance()}\n")
    print(summary(rows, names) + "\n")
    if len(seeds) > 1:
        print(medians(rows, names) + "\n")
    print(verdicts(rows))
    if missing:
        print(f"\nNot simulated: {', '.join(missing)}.")
    print(failures(rows))
    write_json(command.json, rows)
    return int(any(ending(row).startswith("**") for row in rows))


if __name__ == "__main__":
    sys.exit(main(tyro.cli(StressCommand, description=__doc__)))
