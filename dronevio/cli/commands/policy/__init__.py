"""``dronevio policy``: description, evaluation and export of trained policies."""

from collections.abc import Sequence

from dronevio.cli.dispatch import CommandGroup, Subcommand

__all__ = ["COMMANDS", "main"]

COMMANDS = CommandGroup(
    "dronevio policy",
    "Evaluate, describe and export trained policies, which are files of the format safetensors.",
    {
        "evaluate": Subcommand(
            "dronevio.cli.commands.policy.evaluate", "success, errors and crashes over many episodes"
        ),
        "show": Subcommand("dronevio.cli.commands.policy.show", "what a policy observes and commands, and its origin"),
        "export-onnx": Subcommand("dronevio.cli.commands.policy.export_onnx", "write a policy as an ONNX model"),
    },
    (
        "dronevio policy evaluate examples/rl/policies/hover.safetensors",
        "dronevio policy show examples/rl/policies/hover.safetensors",
    ),
)
"""The commands for policies."""


def main(arguments: Sequence[str]) -> int:
    """Run the command that the command line names and return its exit code."""
    return COMMANDS.run(arguments)
