"""Groups of subcommands: their help text, and the call of the one that a command line names."""

import importlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from dronevio.models.errors import unknown_name

HELP = ("-h", "--help", "--help-all", "help")


@dataclass(frozen=True)
class Subcommand:
    """A command of a group."""

    module: str
    """Name of a module with ``main(arguments) -> int``. It is imported only when the command is called."""
    summary: str
    """What the command does, on one line of the group's help text."""


@dataclass(frozen=True)
class CommandGroup:
    """A command that consists of subcommands, such as `dronevio` itself or `dronevio book`."""

    program: str
    """The words that call the group, such as ``dronevio book``."""
    description: str
    """Purpose of the group, for the help text."""
    subcommands: Mapping[str, Subcommand]
    """The subcommands by name, in the order of the help text."""
    examples: Sequence[str]
    """Command lines that the help text shows."""

    def usage(self) -> str:
        """Return the text that ``--help`` prints."""
        width = max(map(len, self.subcommands))
        rows = "\n".join(f"  {name:<{width}}  {command.summary}" for name, command in self.subcommands.items())
        examples = "\n".join(f"  {line}" for line in (*self.examples, f"{self.program} COMMAND --help"))
        return (
            f"usage: {self.program} COMMAND [OPTIONS]\n\n{self.description}\n\ncommands:\n{rows}\n\n"
            f"examples:\n{examples}\n\n"
            "Errors are one line, with exit code 2 for wrong input and 70 for a defect in dronevio, whose traceback\n"
            "--debug shows.\n"
        )

    def run(self, arguments: Sequence[str]) -> int:
        """Call the subcommand that the first argument names with the rest, or print the help text.

        Args:
            arguments: The words after those that call the group; without any, the help text is printed.

        Returns:
            The exit code of the subcommand.

        Raises:
            ConfigError: There is no such subcommand.
        """
        if not arguments or arguments[0] in HELP:
            print(self.usage())
            return 0
        name, *rest = arguments
        if name not in self.subcommands:
            words = " ".join([*self.program.split()[1:], name])
            raise unknown_name("command", words, self.subcommands)
        return int(importlib.import_module(self.subcommands[name].module).main(rest))
