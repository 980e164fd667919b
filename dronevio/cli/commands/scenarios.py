"""``dronevio scenarios``: a list of all scenarios and suites."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Annotated

from dronevio.cli.options import Printing, PrintOptions
from dronevio.cli.terminal import parse, print_json, print_table, progress_bars
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

    from dronevio.sim.scenario_list import list_of_seed

    with progress_bars(command.printing.json) as bars:
        listed = list_of_seed(command.seed, bars.bar("planning"))
    if command.printing.json:
        print_json(asdict(listed))
        return 0
    print_table(
        f"Scenarios of seed {listed.seed}: duration, peak speed, peak rotation rate",
        ("name", "world", "s", "m/s", "°/s", "description"),
        [
            (
                row.name,
                row.world,
                f"{row.duration_s:.0f}",
                f"{row.peak_speed_m_s:.1f}",
                f"{row.peak_rate_deg_s:.0f}",
                row.description,
            )
            for row in listed.scenarios
        ],
        left=("world", "description"),
    )
    suites_table = [(name, ", ".join(names)) for name, names in listed.suites.items()]
    print_table("Suites of scenarios, for a benchmark", ("name", "scenarios"), suites_table, left=("scenarios",))
    return 0
