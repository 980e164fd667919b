"""Tables of results, and their form as Markdown and LaTeX with all names escaped; pages show the same tables."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

_MARKDOWN_SPECIAL = re.compile(r"([\\`*_{}\[\]<>#|~$&!])")
_LATEX_SPECIAL = {
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
_LATEX_PRINTABLE = frozenset(map(chr, (*range(0x20, 0x7F), *range(0xC0, 0x100)))) - set(
    "ÐÞðþ÷"
)  # in LaTeX's standard fonts


@dataclass(frozen=True)
class Cell:
    """A cell of a table."""

    text: str
    """Value as text."""
    detail: str = ""
    """Further values in small print, such as quartiles."""
    warning: str = ""
    """Warning in small print, such as a number of failures."""
    best: bool = False
    """Whether the value is the best of its row."""
    order: float | None = None
    """Key by which the column is sorted; None to sort by the text."""


@dataclass(frozen=True)
class Table:
    """Rows of cells with a heading for each column."""

    title: str
    """Title of the table, with the unit of its values."""
    columns: tuple[str, ...]
    """(C) Headings of the columns."""
    rows: tuple[tuple[Cell, ...], ...]
    """(R) Rows of C cells each; the first cell is the name of the row."""
    total: tuple[Cell, ...] = ()
    """(C) Last row over all others, which sorting does not move; empty for none."""
    text_columns: frozenset[int] = frozenset()
    """Indices of columns with text rather than numbers, besides the first column."""


def markdown_table(table: Table) -> str:
    """Return a table as Markdown, with its title above."""
    rule = ["---" if _is_text(i, table) else "---:" for i in range(len(table.columns))]
    lines = [[_markdown(name) for name in table.columns], rule]
    lines += [[_markdown_cell(cell) for cell in row] for row in _all_rows(table)]
    return f"**{_markdown(table.title)}**\n\n" + "".join(f"| {' | '.join(line)} |\n" for line in lines)


def latex_table(table: Table) -> str:
    """Return a table as LaTeX, for a document that uses the package booktabs."""
    spec = "".join("l" if _is_text(i, table) else "r" for i in range(len(table.columns)))
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
    """Return text with LaTeX's special characters escaped; characters that its fonts lack become ``[U+XXXX]``."""
    return "".join(
        _LATEX_SPECIAL.get(letter) or (letter if letter in _LATEX_PRINTABLE else f"[U+{ord(letter):04X}]")
        for letter in _one_line(text)
    )


def _markdown(text: str) -> str:
    return _MARKDOWN_SPECIAL.sub(r"\\\1", _one_line(text))


def _markdown_cell(cell: Cell) -> str:
    text = _markdown(cell.text)
    return _joined(f"**{text}**" if cell.best and text else text, _markdown(cell.detail), _markdown(cell.warning))


def _latex_cell(cell: Cell) -> str:
    text = latex_text(cell.text)
    detail = f"{{\\footnotesize {latex_text(cell.detail)}}}" if cell.detail else ""
    return _joined(f"\\textbf{{{text}}}" if cell.best else text, detail, latex_text(cell.warning))


def _latex_row(cells: Sequence[str]) -> str:
    return f"{' & '.join(cells)} \\\\"


def _joined(text: str, detail: str, warning: str) -> str:
    return ", ".join(filter(None, (f"{text} {detail}".strip(), warning)))


def _all_rows(table: Table) -> tuple[tuple[Cell, ...], ...]:
    return (*table.rows, table.total) if table.total else table.rows


def _is_text(column: int, table: Table) -> bool:
    return column == 0 or column in table.text_columns


def _one_line(text: str) -> str:
    """Return text on one line, without characters that cannot be printed."""
    return "".join(letter for letter in " ".join(text.split()) if letter.isprintable())
