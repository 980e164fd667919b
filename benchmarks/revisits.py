"""Share of the frames that revisit a place, of scenarios along their planned paths, as a Markdown table.

Nothing is rendered or flown: the depth of the frames is that of the geometry of the world along the planned path. Every
fourth of a second counts as a frame::

    .venv/bin/python benchmarks/revisits.py
    .venv/bin/python benchmarks/revisits.py --scenarios loops room-medium --seeds 0-9
    .venv/bin/python benchmarks/revisits.py --scenarios room-laps --seeds 0 --flown
"""

import statistics
from dataclasses import dataclass, replace

import tyro
from measuring import numbers, table

from dronevio.benchmark.true_views import flight_views, planned_views
from dronevio.eval.metrics.revisits import find_revisits
from dronevio.sim.flight import fly
from dronevio.sim.scenario import Scenario
from dronevio.sim.scenarios import SUITES, scenario_named


@dataclass(frozen=True)
class RevisitsCommand:
    """Measure how many frames of scenarios revisit a place."""

    scenarios: tuple[str, ...] = ("loops", "loops-deceptive")
    """Names of scenarios and suites."""
    seeds: str = "0-2"
    """Seeds of each scenario."""
    flown: bool = False
    """Measure along the simulated flight, at ten times the cost, instead of along the planned path."""


@dataclass(frozen=True)
class RevisitRow:
    """Figures of one flight."""

    length_m: float
    """Length of the path [m]."""
    duration_s: float
    """Duration from the first to the last frame [s]."""
    percent: float
    """Share of the frames that revisit a place [%]."""


def revisit_row(scenario: Scenario, flown: bool = False) -> RevisitRow:
    """Return the figures of a scenario.

    Args:
        scenario: The scenario.
        flown: Whether the flight is simulated.
    """
    views = flight_views(fly(scenario)) if flown else planned_views(scenario)
    duration_s = float(views.t_ns[-1] - views.t_ns[0]) * 1e-9
    return RevisitRow(float(views.path_m[-1]), duration_s, find_revisits(views).percent)


def main(command: RevisitsCommand) -> None:
    """Print the table."""
    names = [name for given in command.scenarios for name in SUITES.get(given, (given,))]
    scenarios = [scenario_named(name) for name in names]
    seeds, lines = numbers(command.seeds), []
    for scenario in scenarios:
        rows = [revisit_row(replace(scenario, seed=seed), command.flown) for seed in seeds]
        length, duration = (
            statistics.median(getattr(row, part) for row in rows) for part in ("length_m", "duration_s")
        )
        percent = ", ".join(f"{row.percent:.0f}" for row in rows)
        laps = "–" if scenario.plan.tour_s > 0.0 else str(scenario.plan.laps)
        lines.append((f"`{scenario.name}`", f"{length:.0f}", f"{duration:.0f}", laps, percent))
    print(table(("scenario", "path [m]", "duration [s]", "laps", "revisits by seed [%]"), lines))


if __name__ == "__main__":
    main(tyro.cli(RevisitsCommand, description=__doc__))
