"""``dronevio scenarios``: a list of all scenarios and suites."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated

from dronevio.cli.options import Printing, PrintOptions
from dronevio.cli.terminal import parse, print_json, print_table
from dronevio.models.ranges import Range, Settings


@dataclass(frozen=True)
class ScenariosCommand(Settings):
    """List the scenarios that can be simulated, with their planned peak speeds and rotation rates, and the suites.

    Examples:
      dronevio scenarios
      dronevio scenarios --seed 3
      dronevio scenarios --json
      dronevio run --scenario hover
    """

    seed: Annotated[int, Range(0, 2**32 - 1)] = 0
    """Seed of the waypoints, on which duration and peaks depend."""
    printing: Printing = field(default_factory=PrintOptions)
    """How results are printed."""


def main(arguments: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    command = parse(ScenariosCommand, arguments, "scenarios")

    import math

    from dronevio.sim.flight import reference_of
    from dronevio.sim.physics.plant import QuadrotorPlant
    from dronevio.sim.scenarios import SCENARIOS, SUITES, scenario_named

    rows = []
    for name in SCENARIOS:
        chosen = scenario_named(name, command.seed)
        reference = reference_of(chosen, QuadrotorPlant(chosen.rig, chosen.quadrotor))  # physics without obstacles
        rows.append(
            {
                "name": name,
                "world": chosen.world,
                "duration_s": reference.duration_s,
                "peak_speed_m_s": round(reference.peak_speed_m_s, 3),
                "peak_rate_deg_s": round(math.degrees(reference.peak_rate_rad_s), 1),
                "description": chosen.description,
            }
        )
    if command.printing.json:
        suites = {name: list(names) for name, names in SUITES.items()}
        print_json({"seed": command.seed, "scenarios": rows, "suites": suites})
        return 0
    print_table(
        f"Scenarios of seed {command.seed}: duration, peak speed, peak rotation rate",
        ("name", "world", "s", "m/s", "°/s", "description"),
        [
            (
                str(row["name"]),
                str(row["world"]),
                f"{row['duration_s']:.0f}",
                f"{row['peak_speed_m_s']:.1f}",
                f"{row['peak_rate_deg_s']:.0f}",
                str(row["description"]),
            )
            for row in rows
        ],
        left=("world", "description"),
    )
    suites_table = [(name, ", ".join(names)) for name, names in SUITES.items()]
    print_table("Suites of scenarios, for a benchmark", ("name", "scenarios"), suites_table, left=("scenarios",))
    return 0
