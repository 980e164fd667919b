"""What all commands share at the terminal: options from a dataclass, progress bars, tables and JSON."""

import inspect
import io
import json
import os
import shlex
import shutil
import sys
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stderr
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, TypeVar

import tyro

from dronevio.cli.fields import registry, settings_groups
from dronevio.cli.progress import Bars, LineBars, NoBars, RichBars
from dronevio.cli.settings.changes import with_changes
from dronevio.cli.usage import WIDTH, range_message, setting_message, usage_message
from dronevio.models.errors import ConfigError
from dronevio.models.ranges import RangeError

if TYPE_CHECKING:
    from dronevio.eval.run import EstimatorRun, Innovations
    from dronevio.models.defects import Defect

Command = TypeVar("Command")

HELP_ALL = "--help-all"
"""Option that prints the help text with all settings."""
HELP = ("-h", "--help", HELP_ALL)
"""Options that print a help text."""

MIN_TEXT_WIDTH = 20
"""Smallest width to which the last column of a table is narrowed."""
MAX_RUN_WARNINGS = 5
"""Number of warnings of an estimator that are printed."""


def with_scenario(arguments: Sequence[str]) -> list[str]:
    """Return the words of a command, of which a first one that is no option names the scenario, as an option."""
    named = bool(arguments) and not arguments[0].startswith("-")
    return ["--scenario", *arguments] if named else list(arguments)


def parse(
    command: type[Command], arguments: Sequence[str], name: str, defaults: Mapping[str, object] = MappingProxyType({})
) -> Command:
    """Return the dataclass ``command`` filled from the command line; its docstring is the text of ``--help``.

    ``--help`` explains the options of the command and names its groups of settings; ``--help-all`` explains these, too.
    Both end the process with exit code 0.

    Args:
        command: The dataclass. The docstrings under its fields explain the options.
        arguments: The words after the command's name.
        name: The command's name without ``dronevio``.
        defaults: Values of fields that replace the defaults of the dataclass.

    Raises:
        ConfigError: An argument is wrong or missing; the message names the option.
        InputError: A file of settings cannot be read.
    """
    asked = [word for word in arguments if word in HELP]
    is_short = bool(asked) and HELP_ALL not in asked
    prog = f"dronevio {name}"
    if not asked:
        defaults = with_changes(command, arguments, defaults)

    def call() -> Command:
        return tyro.cli(
            command,
            args=["--help"] if asked else list(arguments),
            prog=prog,
            description=inspect.cleandoc(command.__doc__ or ""),  # tyro itself would drop the examples
            registry=registry(command, defaults, with_settings=not is_short),
        )

    if asked:
        try:
            return call()
        except SystemExit:
            if is_short:
                _print_groups(settings_groups(command))
            raise
    printed = io.StringIO()
    try:
        with redirect_stderr(printed), _terminal_width(WIDTH):
            return call()
    except SystemExit as end:
        if end.code != 2:
            raise
        message = setting_message(command, arguments) or usage_message(printed.getvalue(), prog)
        raise ConfigError(message) from None
    except RangeError as error:
        raise ConfigError(range_message(error, command, arguments)) from None


def _print_groups(groups: Mapping[str, str]) -> None:
    """Print the names of groups of settings, if there are any, below a help text."""
    if not groups:
        return
    width = max(map(len, groups))
    rows = "".join(f"  --{prefix + '.*':<{width + 2}}  {text}\n" for prefix, text in groups.items())
    print(f"More options, which {HELP_ALL} explains:\n{rows}")


@contextmanager
def _terminal_width(columns: int) -> Iterator[None]:
    """Let text be formatted for a number of columns until the context ends."""
    before = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = str(columns)
    try:
        yield
    finally:
        del os.environ["COLUMNS"]
        if before is not None:
            os.environ["COLUMNS"] = before


@contextmanager
def progress_bars(quiet: bool = False) -> Iterator[Bars]:
    """Show the progress on standard error until the context ends: as bars on a terminal, as lines of text elsewhere."""
    if quiet:
        yield NoBars()
        return
    if not sys.stderr.isatty():
        yield LineBars()
        return
    # Rich takes 0.1 s to import, a quarter of what `dronevio evaluate` takes.
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
    from rich.progress import Progress as RichProgress

    with RichProgress(
        TextColumn("{task.description:<12}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=Console(stderr=True),
    ) as bars:
        yield RichBars(bars)


def print_warning(text: str) -> None:
    """Print a warning on one line of standard error."""
    print(f"dronevio: warning: {text}", file=sys.stderr)


def print_defects(defects: "Sequence[Defect]", origin: str = "") -> None:
    """Print the defects of a recording as warnings, one line for each kind with its first occurrence.

    Args:
        defects: The defects.
        origin: Text before each warning, such as the path of the recording and a colon.
    """
    from dronevio.models.defects import count_defects

    for each in count_defects(defects):
        print_warning(f"{origin}{each}")


def print_run_warnings(run: "EstimatorRun") -> None:
    """Print the warnings of an estimator, one line for each loss or contradiction of a calibration."""
    begin_ns = run.estimates[0].t_ns if run.estimates else 0
    shown = run.warnings[:MAX_RUN_WARNINGS]
    for t_ns, text in shown:
        print_warning(f"{(t_ns - begin_ns) * 1e-9:.2f} s after the first frame: {text}")
    if len(run.warnings) > len(shown):
        print_warning(f"{len(run.warnings) - len(shown)} more events of this kind")
    if run.imu_outliers:
        print_warning(f"{run.imu_outliers} IMU samples far from those before and after them: left out as outliers")


def print_json(document: Mapping[str, object]) -> None:
    """Print a document for other programs on standard output."""
    json.dump(document, sys.stdout, indent=2, allow_nan=False)
    sys.stdout.write("\n")


def command_line(*words: str | Path) -> str:
    """Return a call of dronevio as it is typed in a shell, with quotation marks where they are needed.

    A program that is not on the PATH, as in an environment that is not active, is named as it was called.

    Args:
        words: The words after ``dronevio``.
    """
    program = "dronevio"
    if shutil.which(program) is None and Path(sys.argv[0]).name == program:
        program = sys.argv[0]
    return shlex.join([program, *map(str, words)])


def print_values(title: str, rows: Sequence[tuple[str, str, str]]) -> None:
    """Print a table of named values with their units on standard output."""
    print_table(title, ("", "value", "unit"), rows, left=("unit",))


def innovation_rows(innovations: "Innovations | None") -> list[tuple[str, float | None, str, str]]:
    """Return names, values, formats and units of the agreement of images and predictions."""
    values: tuple[float | None, ...] = (None,) * 4
    if innovations is not None:
        values = innovations.median_px, innovations.p95_px, innovations.median_nis, innovations.p95_nis
    labels = (
        ("innovation, median over frames", "px"),
        ("innovation, 95th percentile", "px"),
        ("NIS of innovations, median (1 expected)", ""),
        ("NIS of innovations, 95th percentile", ""),
    )
    return [(label, value, ".2f", unit) for (label, unit), value in zip(labels, values, strict=True)]


def print_table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]], left: Sequence[str] = ()) -> None:
    """Print a table as plain text on standard output, with an empty line after it.

    On a terminal, a text in the last column that is too long for the line continues below, broken between words.

    Args:
        title: Line above the table; no line if it is empty.
        columns: Headings of the columns.
        rows: Cells of each row.
        left: Headings of the columns that are left-aligned. The first column always is, all others are right-aligned.
    """
    widths = [max(map(len, cells)) for cells in zip(columns, *rows, strict=True)]
    align = ["<" if i == 0 or column in left else ">" for i, column in enumerate(columns)]
    indent = sum(widths[:-1]) + 2 * len(widths[:-1])
    room = _line_width() - indent
    if align[-1] == "<" and MIN_TEXT_WIDTH <= room < widths[-1]:
        widths[-1] = room
    rule = ["─" * width for width in widths]
    lines = []
    for cells in (columns, rule, *rows):
        *others, text = [f"{cell:{a}{w}}" for cell, a, w in zip(cells, align, widths, strict=True)]
        first, *more = textwrap.wrap(text, widths[-1], break_long_words=False, break_on_hyphens=False) or [""]
        lines += ["  ".join([*others, first]).rstrip(), *(" " * indent + line for line in more)]
    sys.stdout.write("\n".join([*([title] if title else []), *lines, "", ""]))


def _line_width() -> int:
    """Return the number of columns of the terminal; a large number if standard output is none."""
    return shutil.get_terminal_size().columns if sys.stdout.isatty() else sys.maxsize
