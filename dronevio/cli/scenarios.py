"""``dronevio scenarios``: what can be flown."""

from collections.abc import Sequence
from dataclasses import dataclass

from dronevio.cli.terminal import parse, print_json, print_table


@dataclass(frozen=True)
class ScenariosCommand:
    """List the scenarios that can be flown, with their planned peak speed and turn rate, and suites of them.

    Examples:
      dronevio scenarios
      dronevio scenarios --seed 3
      dronevio scenarios --json
      dronevio run --scenario hover
    """

    seed: int = 0
    """Draws the waypoints, and so the peaks."""
    json: bool = False
    """Print one JSON document instead of a table."""


def main(arguments: Sequence[str]) -> int:
    """Run the command."""
    command = parse(ScenariosCommand, arguments, "scenarios")

    import math

    from dronevio.sim.flight import plant_of, reference_of
    from dronevio.sim.scenarios import SCENARIOS, SUITES, scenario

    rows = []
    for name in SCENARIOS:
        chosen = scenario(name, command.seed)
        reference = reference_of(chosen, plant_of(chosen))
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
    if command.json:
        print_json(
            {"seed": command.seed, "scenarios": rows, "suites": {name: list(names) for name, names in SUITES.items()}}
        )
        return 0
    print_table(
        f"Scenarios drawn from seed {command.seed}: duration, peak speed and peak turn rate",
        ("name", "world", "s", "m/s", "°/s", "what is flown"),
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
        prose=("world", "what is flown"),
    )
    print_table(
        "Suites of them, for a benchmark",
        ("name", "scenarios"),
        [(n, ", ".join(m)) for n, m in SUITES.items()],
        prose=("scenarios",),
    )
    return 0
