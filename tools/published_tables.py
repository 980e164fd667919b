"""Fill the tables of the documentation that commands print from the published measurements.

    python tools/published_tables.py
    python tools/published_tables.py --check

A page has the command of each table in a comment before it, and a comment after it:

    <!-- table of: dronevio report docs/measurements/campaign.parquet --format markdown --tables losses -->
    <!-- end of the table -->

With ``rows "all scenarios" of:`` instead of ``table of:``, only the rows that begin with a match of this regular
expression are taken. The output of commands without a table in Markdown is written as a block of code.
"""

import contextlib
import io
import re
import shlex
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import tyro

ROOT = Path(__file__).resolve().parents[1]
BLOCK = re.compile(
    r"(?P<comment><!-- (?:table|rows \"(?P<rows>[^\"]+)\") of: dronevio (?P<command>.+?) -->\n)"
    r"(?P<table>.*?)(?P<end><!-- end of the table -->\n)",
    re.DOTALL,
)
"""A comment with a command, the table, and the comment after it."""


@dataclass(frozen=True)
class TablesCommand:
    """Fill the tables of the documentation that commands print from the published measurements."""

    check: bool = False
    """Change nothing, and exit with 1 if a table differs from what its command prints."""


def filled(page: str) -> str:
    """Return the text of a page with its tables as their commands print them.

    Raises:
        ValueError: A command fails, or prints no row that the comment asks for.
    """
    return BLOCK.sub(lambda block: f"{block['comment']}{_table(block['command'], block['rows'])}{block['end']}", page)


def pages() -> Iterator[Path]:
    """Yield the pages of the documentation with such tables."""
    for page in sorted((ROOT / "docs").glob("*.md")):
        if BLOCK.search(page.read_text(encoding="utf-8")):
            yield page


def _table(command: str, beginning: str | None) -> str:
    """Return the table that a command prints, with all rows or those that begin with a match."""
    lines = _output(command).splitlines(keepends=True)
    table = [line for line in lines if line.startswith("|")]
    if not table:
        return "".join(["```text\n", *lines, "```\n"])
    if beginning is None:
        return "\n" + "".join(table) + "\n"
    rows = [line for line in table[2:] if re.match(beginning, line.removeprefix("| "))]
    if not rows:
        raise ValueError(f"dronevio {command} prints no row that begins with {beginning!r}")
    return "\n" + "".join([*table[:2], *rows]) + "\n"


def _output(command: str) -> str:
    """Return what a command prints in the top folder of the repository."""
    from dronevio.cli import main as dronevio

    output = io.StringIO()
    with contextlib.chdir(ROOT), contextlib.redirect_stdout(output):
        code = dronevio(shlex.split(command))
    if code:
        raise ValueError(f"dronevio {command} failed with exit code {code}")
    return output.getvalue()


def main(command: TablesCommand) -> int:
    """Fill the tables, or compare them, and return the exit code."""
    stale = 0
    for page in pages():
        text = page.read_text(encoding="utf-8")
        new = filled(text)
        if new != text:
            stale += 1
            print(f"{page.relative_to(ROOT)}: {'differs' if command.check else 'written'}")
            if not command.check:
                page.write_text(new, encoding="utf-8")
    return int(command.check and stale > 0)


if __name__ == "__main__":
    sys.exit(main(tyro.cli(TablesCommand, description=__doc__)))
