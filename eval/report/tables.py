"""Tables of results: the cells that a page shows, and the same as Markdown and LaTeX that no name can break."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

DASH = "–"
"""What stands where a number is not known."""
_MARKDOWN = re.compile(r"([\\`*_{}\[\]<>#|~$&!])")
_LATEX = {
    "\\": r"\textbackslash{}",
    "{": r"\{",
    "}": r"\}",
    "$": r"\$",
    "&": r"\&",
    "#": r"\#",
    "%": r"\%",
    "_": r"\_",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    '"': "''",
    "–": "--",
    "−": "$-$",
    "×": r"$\times$",
    "°": r"$^\circ$",
    "²": "$^2$",
    "σ": r"$\sigma$",
    "…": r"\dots{}",
}
_DRAWN = frozenset(map(chr, (*range(0x20, 0x7F), *range(0xC0, 0x100)))) - set("ÐÞðþ÷")  # in LaTeX's own fonts


@dataclass(frozen=True)
class Cell:
    """What stands in one place of a table."""

    text: str
    """The value."""
    aside: str = ""
    """What is to be known with it, such as its spread."""
    warning: str = ""
    """What is wrong with it."""
    best: bool = False
    """Whether it is the best of its row."""
    order: float | None = None
    """Where it goes when its column is sorted; None to go by the text."""


@dataclass(frozen=True)
class Table:
    """Rows of cells under a heading."""

    title: str
    """What it shows, with the unit."""
    columns: tuple[str, ...]
    """(C) Headings."""
    rows: tuple[tuple[Cell, ...], ...]
    """(R) Of C cells each; the first says what the row is about."""
    total: tuple[Cell, ...] = ()
    """(C) A last row over all others, which stays the last; may be missing."""
    words: frozenset[int] = frozenset()
    """Columns that hold words rather than numbers, besides the first."""


def markdown_table(table: Table) -> str:
    """Return a table as Markdown, its title above it."""
    rule = ["---" if _is_words(i, table) else "---:" for i in range(len(table.columns))]
    lines = [[_markdown(name) for name in table.columns], rule]
    lines += [[_markdown_cell(cell) for cell in row] for row in _all_rows(table)]
    return f"**{_markdown(table.title)}**\n\n" + "".join(f"| {' | '.join(line)} |\n" for line in lines)


def latex_table(table: Table) -> str:
    """Return a table as LaTeX, for a document that uses the package booktabs."""
    spec = "".join("l" if _is_words(i, table) else "r" for i in range(len(table.columns)))
    total = ["\\midrule", _latex_row([_latex_cell(cell) for cell in table.total])] if table.total else []
    return "\n".join(
        (
            "\\begin{table}",
            "\\centering\\small",
            f"\\caption{{{latex_text(table.title)}}}",
            f"\\begin{{tabular}}{{{spec}}}",
            "\\toprule",
            _latex_row([latex_text(name) for name in table.columns]),
            "\\midrule",
            *(_latex_row([_latex_cell(cell) for cell in row]) for row in table.rows),
            *total,
            "\\bottomrule",
            "\\end{tabular}",
            "\\end{table}",
            "",
        )
    )


def latex_text(text: str) -> str:
    """Return text that LaTeX sets as it is; what no font of its may have is named by its number."""
    return "".join(
        _LATEX.get(letter) or (letter if letter in _DRAWN else f"[U+{ord(letter):04X}]") for letter in _one_line(text)
    )


def _markdown(text: str) -> str:
    return _MARKDOWN.sub(r"\\\1", _one_line(text))


def _markdown_cell(cell: Cell) -> str:
    text = _markdown(cell.text)
    return _joined(f"**{text}**" if cell.best and text else text, _markdown(cell.aside), _markdown(cell.warning))


def _latex_cell(cell: Cell) -> str:
    text = latex_text(cell.text)
    aside = f"{{\\footnotesize {latex_text(cell.aside)}}}" if cell.aside else ""
    return _joined(f"\\textbf{{{text}}}" if cell.best else text, aside, latex_text(cell.warning))


def _latex_row(cells: Sequence[str]) -> str:
    return f"{' & '.join(cells)} \\\\"


def _joined(text: str, aside: str, warning: str) -> str:
    return ", ".join(filter(None, (f"{text} {aside}".strip(), warning)))


def _all_rows(table: Table) -> tuple[tuple[Cell, ...], ...]:
    return (*table.rows, table.total) if table.total else table.rows


def _is_words(column: int, table: Table) -> bool:
    return column == 0 or column in table.words


def _one_line(text: str) -> str:
    """Return text on one line, without characters that print nothing."""
    return "".join(letter for letter in " ".join(text.split()) if letter.isprintable())
