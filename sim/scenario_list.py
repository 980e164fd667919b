"""List of all scenarios with the figures of their planned trajectories, and of the suites.

Planning all scenarios takes ten seconds. The list of seed 0 is therefore a file of the package, which
``tools/scenario_list.py`` writes and a test compares with the code.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from dronevio.models.progress import Progress, silent

LIST_FILE = Path(__file__).with_suffix(".json")
"""File with the list of seed 0."""


@dataclass(frozen=True)
class ScenarioRow:
    """A scenario with the figures of its planned trajectory."""

    name: str
    """Name with version."""
    world: str
    """Name of the world."""
    duration_s: float
    """Duration from the first to the last sample [s]."""
    peak_speed_m_s: float
    """Largest planned speed of the centre of mass [m/s]."""
    peak_rate_deg_s: float
    """Largest planned angular rate [°/s]."""
    description: str
    """What the scenario is."""


@dataclass(frozen=True)
class ScenarioList:
    """All scenarios, and the suites."""

    seed: int
    """Seed of the worlds and waypoints."""
    scenarios: Sequence[ScenarioRow]
    """The scenarios in the order of `dronevio.sim.scenarios.SCENARIOS`."""
    suites: Mapping[str, Sequence[str]]
    """Names of the scenarios of each suite."""


def list_of_seed(seed: int, progress: Progress = silent) -> ScenarioList:
    """Return the list of a seed: that of seed 0 is read from its file, others are computed.

    Raises:
        ConfigError: The seed is negative.
    """
    return _read() if seed == 0 else computed_list(seed, progress)


def computed_list(seed: int, progress: Progress = silent) -> ScenarioList:
    """Return the list of a seed by planning the trajectories of all scenarios.

    Raises:
        ConfigError: The seed is negative.
    """
    from dronevio.sim.scenarios import SCENARIOS, SUITES

    rows = []
    for number, name in enumerate(SCENARIOS):
        rows.append(planned_row(name, seed))
        progress(number + 1, len(SCENARIOS))
    return ScenarioList(seed, rows, {suite: list(names) for suite, names in SUITES.items()})


def planned_row(name: str, seed: int) -> ScenarioRow:
    """Return a scenario with the figures of its trajectory, which is planned for a seed.

    Raises:
        ConfigError: The scenario is unknown, or the seed is negative.
    """
    import math

    from dronevio.sim.flight import reference_of
    from dronevio.sim.physics.plant import QuadrotorPlant
    from dronevio.sim.scenarios import scenario_named

    chosen = scenario_named(name, seed)
    reference = reference_of(chosen, QuadrotorPlant(chosen.rig, chosen.quadrotor))  # physics without obstacles
    return ScenarioRow(
        chosen.name,
        chosen.world,
        reference.duration_s,
        round(reference.peak_speed_m_s, 3),
        round(math.degrees(reference.peak_rate_rad_s), 1),
        chosen.description,
    )


def _read() -> ScenarioList:
    """Return the list of seed 0 from its file."""
    document = json.loads(LIST_FILE.read_text(encoding="utf-8"))
    return ScenarioList(document["seed"], [ScenarioRow(**row) for row in document["scenarios"]], document["suites"])
