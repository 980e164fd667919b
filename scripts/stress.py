"""What becomes of the odometry when things go wrong: dark cameras, lost frames, wrong calibrations, noise, no parallax.

Every flight is flown and rendered once into a folder, in stereo, and estimated in mono and stereo::

    python scripts/stress.py --flights FOLDER --results ROWS
    python scripts/stress.py --flights FOLDER --results ROWS --only dark-1s dark-5s --seeds 0-2

Each is to end in a bounded error, or in an honest "lost" and recovery; never in a number that is none, nor in a silent
teleport: a step from one frame to the next that is far off while the estimator says that it is tracking.
"""

import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import tyro
from figures import Figures, failures
from measuring import Mode, Task, done, provenance, write_json
from tables import median, numbers, table, text

from dronevio.models.rig_presets import rig_named
from dronevio.sim.physics.wind import Wind
from dronevio.sim.scenario import Scenario
from dronevio.sim.scenarios import SUITES, scenario

HOVER_S = 60.0
_HOVER_FROM_S = 5.0  # after the start: it has climbed, and stands in the air
TELEPORT_M = 0.25
"""From so large an error in one step, 5 m/s at 20 Hz, it is called a teleport."""
BOUNDED_PERCENT = 5.0
"""Up to so large an error of a single position, relative to the path, it is called bounded."""
HOVER_DRIFT_M = 0.01
"""How far the estimate may drift at hover in a minute."""


@dataclass(frozen=True)
class Trial:
    """One kind of stress."""

    scenario: Scenario
    """What is flown."""
    window_s: tuple[float, float] | None = None
    """When the fault lasts, or the hover [s]."""
    front_end: str = ""
    """How the front end is spoilt; empty if it is not."""
    recording: str = ""
    """Whose recording is used, if not its own."""


@dataclass(frozen=True)
class Stress:
    """Fly what is hard, estimate it, and print Markdown tables."""

    flights: Path
    """Folder of the flights; what is missing is flown and rendered first."""
    results: Path
    """Folder in which rows are kept, so that what is done need not be done again."""
    only: tuple[str, ...] = ()
    """Which trials; all by default."""
    modes: tuple[Mode, ...] = ("mono", "stereo")
    """How many cameras to use."""
    seeds: str = "0"
    """Which seeds of each, such as 0-2."""
    fly: bool = True
    """Fly what is missing; else it is left out, and the table says so."""
    workers: int = 1
    """How many runs at a time."""
    json: Path | None = None
    """File for all rows."""


def trials() -> dict[str, Trial]:
    """Return all trials by name."""
    named = {name: scenario(name) for name in SUITES["stress"]}
    short = {name.removeprefix("room-").rpartition("-v")[0]: each for name, each in named.items()}
    lasting = {
        name: (each.faults.dark_from_s, each.faults.dark_from_s + each.faults.dark_for_s)
        for name, each in short.items()
        if each.faults.dark_for_s
    }
    hover = scenario("hover")
    calm = replace(hover, plan=replace(hover.plan, tour_s=HOVER_S + 2.0))
    gusty = replace(calm, wind=Wind((3.0, 0.0, 0.0), 1.0))
    at_hover = (_HOVER_FROM_S, _HOVER_FROM_S + HOVER_S)
    return {
        "none": Trial(scenario("room")),
        **{name: Trial(each, lasting.get(name)) for name, each in short.items()},
        "outliers": Trial(scenario("room"), front_end="outliers", recording="none"),
        "low-texture": Trial(scenario("low-texture")),
        "rotation": Trial(scenario("room-rotation")),
        "hover": Trial(calm, at_hover),
        "hover-gusts": Trial(gusty, at_hover),
    }


def fly_missing(place: Path, flown: Scenario) -> None:
    """Fly a scenario with the stereo rig and keep its recording, unless it is there."""
    from dronevio.cli.output_files import atomic_folder
    from dronevio.recorder import record_flight

    if (place / "mav0").is_dir():
        return
    print(f"flying {place.name}", file=sys.stderr, flush=True)
    with atomic_folder(place) as folder:
        record_flight(replace(flown, rig=rig_named("euroc-stereo")), folder, workers=1)


def ending(row: Figures) -> str:
    """Say in a word how a run ended."""
    lost_percent = row.health.get("lost", 0.0) + row.health.get("initializing", 0.0)
    if row.not_finite:
        return "**NOT FINITE**"
    if row.status != "ok":
        honest = row.status == "failed" and row.health.get("initializing", 0.0) == 100.0
        return "never started" if honest else f"**{row.status.upper()}**"
    if row.step_error_m > TELEPORT_M and row.longest_gap_s < 2.0 * row.duration_s / max(row.frames - 1, 1):
        return "**TELEPORT**"
    if row.max_m <= BOUNDED_PERCENT / 100.0 * row.path_m:
        return "bounded"
    return "lost, says so" if row.health.get("lost", 0.0) > 0.0 and lost_percent < 100.0 else "**UNBOUNDED**"


def _shares(row: Figures) -> str:
    names = ("initializing", "tracking", "inertial-only", "lost")
    return " / ".join(f"{row.health[name]:.0f}" if name in row.health else "–" for name in names)


COLUMNS: tuple[tuple[str, Callable[[Figures], str]], ...] = (
    ("ATE [m]", lambda row: text(row.ate_m)),
    ("ATE [% of path]", lambda row: text(row.ate_percent, ".2f")),
    ("max [m]", lambda row: text(row.max_m)),
    ("coverage [%]", lambda row: text(row.coverage_percent, ".1f")),
    ("initializing / tracking / inertial-only / lost [%]", _shares),
    ("longest gap [s]", lambda row: text(row.longest_gap_s, ".2f")),
    ("drift meanwhile [m]", lambda row: text(row.window_drift_m)),
    ("recovery [s]", lambda row: text(row.recovery_s, ".2f")),
    ("largest step error [m]", lambda row: text(row.step_error_m)),
    ("largest jump [m]", lambda row: text(row.step_jump_m)),
    ("NEES p", lambda row: text(row.nees_position, ".1f")),
    ("NEES θ", lambda row: text(row.nees_orientation, ".1f")),
    ("CPU ms", lambda row: text(row.cpu_ms_mean, ".1f")),
    ("p99", lambda row: text(row.cpu_ms_p99, ".1f")),
    ("ends", ending),
)


def summary(rows: Sequence[Figures], names: Sequence[str]) -> str:
    """Return the table of all runs."""
    found = {(row.flight, row.mode): row for row in rows}
    ordered = sorted(found, key=lambda key: (names.index(key[0].rpartition("-")[0]), key[1], key[0]))
    cells = [[*key, *(cell(found[key]) for _, cell in COLUMNS)] for key in ordered]
    return table(("stress", "", *(heading for heading, _ in COLUMNS)), cells, 2)


def verdicts(rows: Sequence[Figures]) -> str:
    """Say how the trials ended, and whether the drift at hover is small enough."""
    ends = [ending(row) for row in rows]
    bad = [f"{row.flight} {row.mode} {end}" for row, end in zip(rows, ends, strict=True) if end.startswith("**")]
    lines = [f"{len(rows)} runs, {len(bad)} of which end badly{': ' + ', '.join(bad) if bad else ''}."]
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


def medians(rows: Sequence[Figures], names: Sequence[str]) -> str:
    """Return a table of medians over seeds, one row a trial."""
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


def main(command: Stress) -> int:
    """Fly and run all that is missing, print the tables; 1 if something ends badly."""
    known, seeds = trials(), numbers(command.seeds)
    unknown = [name for name in command.only if name not in known]
    if unknown:
        print(f"no trial {', '.join(unknown)}; expected of {', '.join(known)}", file=sys.stderr)
        return 2
    names = [name for name in known if not command.only or name in command.only]
    tasks, missing = [], []
    for seed in seeds:
        for name in names:
            trial = known[name]
            place = command.flights / f"{trial.recording or name}-{seed}"
            if command.fly:
                fly_missing(place, replace(trial.scenario, seed=seed))
            if not (place / "mav0").is_dir():
                missing.append(place.name)
                continue
            label = f"{name}-{seed}"
            tasks += [Task(label, place, mode, trial.front_end, trial.window_s) for mode in command.modes]
    rows = list(done(tasks, command.results, command.workers))
    print(f"{len(tasks)} runs. {provenance()}\n")
    print(summary(rows, names) + "\n")
    if len(seeds) > 1:
        print(medians(rows, names) + "\n")
    print(verdicts(rows))
    if missing:
        print(f"\nNot flown: {', '.join(missing)}.")
    print(failures(rows))
    write_json(command.json, rows)
    return int(any(ending(row).startswith("**") for row in rows))


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Stress, description=__doc__)))
