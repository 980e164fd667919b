"""``dronevio speed``: measurements of processor time, frame rates and memory on this machine."""

from collections.abc import Sequence

from dronevio.cli.dispatch import CommandGroup, Subcommand

__all__ = ["COMMANDS", "main"]

COMMANDS = CommandGroup(
    "dronevio speed",
    "Measure the speed of dronevio on this machine, and print each figure beside its bound.",
    {
        "sim": Subcommand("dronevio.cli.commands.speed.sim", "rendering, physics and recording"),
        "gym": Subcommand("dronevio.cli.commands.speed.gym", "many vehicles at once, beside the bare physics"),
        "eval": Subcommand("dronevio.cli.commands.speed.eval", "evaluation of trajectories, beside evo"),
    },
    ("dronevio speed sim", "dronevio speed eval --json > figures.json"),
)
"""The measurements."""


def main(arguments: Sequence[str]) -> int:
    """Run the measurement that the command line names and return its exit code."""
    return COMMANDS.run(arguments)
