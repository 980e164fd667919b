"""``dronevio vehicles``: the vehicles by name, or one of the user's own, with what they weigh and lift."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import tyro

from dronevio.cli.options import Printing, PrintOptions
from dronevio.cli.terminal import parse, print_json, print_table
from dronevio.models.ranges import Settings

if TYPE_CHECKING:
    from dronevio.models.quadrotor import Quadrotor


@dataclass(frozen=True)
class VehiclesCommand(Settings):
    """Describe the vehicles that fly in scenarios and environments, or check vehicles of your own.

    Examples:
      dronevio vehicles
      dronevio vehicles my-hexa.yaml
      dronevio vehicles nano python:my_package.drones:RACER --json
    """

    vehicles: tyro.conf.Positional[tuple[str, ...]] = ()
    """Names, YAML files or python:package.module:NAME; the vehicles by name by default."""
    printing: Printing = field(default_factory=PrintOptions)
    """How results are printed."""


def main(arguments: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    command = parse(VehiclesCommand, arguments, "vehicles")

    from dronevio.models.quadrotor import VEHICLES
    from dronevio.models.vehicles import vehicle_of

    found = {name: _described(vehicle_of(name)) for name in command.vehicles or VEHICLES}
    if command.printing.json:
        print_json({"vehicles": [{"name": name, **described} for name, described in found.items()]})
        return 0
    print_table(
        "Vehicles: thrust-to-weight ratio with a full battery, and rotor speed and power at hover",
        ("name", "mass kg", "rotors", "size m", "thrust/weight", "hover rad/s", "hover W"),
        [
            (
                name,
                f"{row['mass_kg']:.3g}",
                f"{row['arrangement']} ({row['rotors']})",
                f"{row['size_m']:.2f}",
                f"{row['thrust_to_weight']:.2f}",
                f"{row['hover_speed_rad_s']:.0f}",
                f"{row['hover_power_w']:.3g}",
            )
            for name, row in found.items()
        ],
        left=("rotors",),
    )
    return 0


def _described(vehicle: "Quadrotor") -> dict[str, str | int | float]:
    """Return what a vehicle weighs and lifts."""
    return {
        "mass_kg": vehicle.mass_kg,
        "rotors": vehicle.rotor_count,
        "arrangement": vehicle.rotors if isinstance(vehicle.rotors, str) else "own",
        "size_m": 2.0 * (vehicle.reach_m + vehicle.rotor_radius_m),
        "thrust_to_weight": vehicle.thrust_to_weight,
        "hover_speed_rad_s": vehicle.hover_speed_rad_s,
        "hover_power_w": vehicle.hover_power_w,
    }
