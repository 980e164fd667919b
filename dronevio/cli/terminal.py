"""What every command shares at the terminal: arguments made from a dataclass, progress bars, tables, JSON."""

import inspect
import json
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TypeVar

import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.progress import Progress as RichProgress
from rich.table import Table

from dronevio.models.progress import Progress

Command = TypeVar("Command")


def parse(command: type[Command], arguments: Sequence[str], name: str, default: Command | None = None) -> Command:
    """Return the dataclass ``command`` filled from the command line; its docstring is the ``--help``.

    What is not given is as in ``default``, or as the dataclass has it. A wrong argument prints what is wrong and exits
    with 2.
    """
    # Left to itself, tyro takes the examples out of the docstring.
    description = inspect.cleandoc(command.__doc__ or "")
    prog = f"dronevio {name}"
    if default is None:
        return tyro.cli(command, args=list(arguments), prog=prog, description=description)
    return tyro.cli(command, args=list(arguments), prog=prog, description=description, default=default)


@contextmanager
def progress_bars(quiet: bool = False) -> Iterator["Bars"]:
    """Show progress bars on the terminal (standard error) while the context lasts."""
    with RichProgress(
        TextColumn("{task.description:<12}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=Console(stderr=True),
        disable=quiet,
    ) as bars:
        yield Bars(bars)


class Bars:
    """Makes a progress bar for each long piece of work."""

    def __init__(self, bars: RichProgress) -> None:
        self._bars = bars

    def bar(self, description: str) -> Progress:
        """Return a listener that draws a bar of its own."""
        task = self._bars.add_task(description, total=None, start=False)

        def advance(done: int, total: int) -> None:
            self._bars.start_task(task)  # its clock runs from the first call on
            self._bars.update(task, completed=done, total=total)

        return advance


def print_json(document: Mapping[str, object]) -> None:
    """Print a document for machines on standard output."""
    json.dump(document, sys.stdout, indent=2, allow_nan=False)
    sys.stdout.write("\n")


def print_table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]], prose: Sequence[str] = ()) -> None:
    """Print a table on standard output; the first column and those of ``prose`` are left-aligned, the others right."""
    table = Table(title=title, title_justify="left")
    for i, column in enumerate(columns):
        table.add_column(column, justify="left" if i == 0 or column in prose else "right")
    for row in rows:
        table.add_row(*row)
    Console().print(table)
