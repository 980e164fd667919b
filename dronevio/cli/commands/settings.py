"""``dronevio settings``: a list of all settings of a command."""

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal

import tyro

from dronevio.cli.terminal import parse
from dronevio.models.errors import ConfigError

Name = Literal["run", "fly", "estimate", "sfm", "dense", "map", "explore"]
WIDTH = 99
"""Largest number of columns of an explanation."""


@dataclass(frozen=True)
class SettingsCommand:
    """List the settings of a command, with their defaults, explanations and ranges, as a TOML file.

    Any of them is changed with --set NAME=VALUE, or in a file with --settings FILE; those that a guide tells when to
    change are options, too. All lines of the list are comments: remove the # before a setting to change it in the file.

    Examples:
      dronevio settings
      dronevio settings smoother keyframe
      dronevio settings --of sfm > sfm.toml
      dronevio estimate V1_01_easy --set estimator.smoother.min-parallax-px=8
    """

    names: Annotated[tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="NAME")] = ()
    """Parts of names of settings; all settings by default."""
    of: Name = "run"
    """The command."""


def main(arguments: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    asked = parse(SettingsCommand, arguments, "settings")

    from dronevio.cli.settings.listing import listed_settings

    wanted = [name.replace("_", "-") for name in asked.names]
    listed = listed_settings(*command_named(asked.of))
    shown = [each for each in listed if not wanted or any(name in each.field.name for name in wanted)]
    if not shown:
        raise ConfigError(f"no setting of {asked.of} has {' or '.join(asked.names)} in its name")
    for each in shown:
        print(textwrap.fill(each.text, WIDTH, initial_indent="# ", subsequent_indent="# "))
        print(f"#{each.field.name} = {each.toml}\n")
    return 0


def command_named(name: Name) -> tuple[type, dict[str, object]]:
    """Return the dataclass of a command with settings, and the defaults that replace those of its fields."""
    from dronevio.cli.commands.dense import DenseCommand
    from dronevio.cli.commands.estimate import EstimateCommand
    from dronevio.cli.commands.explore import ExploreCommand
    from dronevio.cli.commands.fly import FlyCommand
    from dronevio.cli.commands.map import MapCommand
    from dronevio.cli.commands.run import RunCommand
    from dronevio.cli.commands.sfm import SfmCommand
    from dronevio.cli.flight_options import DEFAULT_SCENARIO, FlightOptions
    from dronevio.sim.scenarios import scenario_named

    found: dict[str, type] = {"run": RunCommand, "fly": FlyCommand, "estimate": EstimateCommand}
    found |= {"sfm": SfmCommand, "dense": DenseCommand, "map": MapCommand, "explore": ExploreCommand}
    is_flight = name in ("run", "fly")
    return found[name], {"flight": FlightOptions.of(scenario_named(DEFAULT_SCENARIO))} if is_flight else {}
