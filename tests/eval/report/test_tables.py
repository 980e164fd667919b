"""Tables as HTML, Markdown and LaTeX: no text of a cell changes the structure of a table."""

import re
import shutil
import subprocess
from html import unescape
from html.parser import HTMLParser
from pathlib import Path

import markupsafe
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from dronevio.eval.report.tables import Cell, Table, latex_table, latex_text, markdown_table
from dronevio.eval.report.templating import environment

HOSTILE = r"""<script>alert('x')</script> | **bold** `c` \end{tabular} $x_1$ & 50 % # ~^ {"}"""
TABLE = Table(
    f"title {HOSTILE}",
    ("scenario", HOSTILE, "vio"),
    (
        (Cell(HOSTILE), Cell("0.1", "(0.05–0.2)", "1 of 3 failed"), Cell("−0.2", best=True, order=2.5)),
        (Cell("line\nbreak"), Cell("–"), Cell("3")),
    ),
    (Cell("all"), Cell("".join(map(chr, range(0x20, 0x250)))), Cell("2")),
)


def html_table(table: Table) -> str:
    """Return a table as HTML, made by the template of the pages."""
    source = '{% import "parts.html.j2" as parts %}{{ parts.results_table(table) }}'
    return environment().from_string(source).render(table=table).strip()


class Cells(HTMLParser):
    """Collects the text of each cell, row by row."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.rows: list[list[str]] = []
        self.tags: set[str] = set()
        self.feed(html)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Begin a row or a cell."""
        self.tags.add(tag)
        if tag == "tr":
            self.rows.append([])
        elif tag in ("th", "td"):
            self.rows[-1].append("")

    def handle_data(self, data: str) -> None:
        """Add text to the last cell."""
        if self.rows and self.rows[-1]:
            self.rows[-1][-1] += data


def markdown_cells(text: str) -> list[list[str]]:
    """Return the rows of a Markdown table, split at bars that are not escaped."""
    header, _, *lines = [line for line in text.splitlines() if line.startswith("|")]
    rows = [re.split(r"(?<!\\)\|", line)[1:-1] for line in (header, *lines)]
    return [[re.sub(r"\\(.)", r"\1", cell.strip()) for cell in row] for row in rows]


def test_html_shows_scripts_in_names_as_text() -> None:
    found = Cells(html_table(TABLE))
    assert "script" not in found.tags
    assert found.rows[0] == ["scenario", HOSTILE, "vio"]
    assert found.rows[1] == [HOSTILE, "0.1(0.05–0.2)1 of 3 failed", "−0.2"]
    assert [len(row) for row in found.rows] == [3, 3, 3, 3]


def test_html_escapes_every_part_of_a_table() -> None:
    cell = Cell(HOSTILE, HOSTILE, HOSTILE)
    found = Cells(html := html_table(Table(HOSTILE, (HOSTILE,), ((cell,),), (cell,))))
    assert found.rows == [[HOSTILE], [3 * HOSTILE], [3 * HOSTILE]]
    assert found.tags == {"div", "table", "thead", "tbody", "tfoot", "tr", "th", "span", "small"}
    assert f'aria-label="{markupsafe.escape(HOSTILE)}"' in html


def test_html_marks_the_best_value_and_the_sorting_key() -> None:
    html = html_table(TABLE)
    assert 'class="best"' in html and 'data-order="2.5"><span>−0.2</span></td>' in html
    assert html.count('class="best"') == 1
    assert html.index("<tfoot") > html.index("</tbody>")  # sorting leaves the last row in its place


def test_markdown_keeps_cells_in_their_columns() -> None:
    rows = markdown_cells(markdown_table(TABLE))
    assert rows[0] == ["scenario", HOSTILE, "vio"]
    assert rows[1] == [HOSTILE, "0.1 (0.05–0.2), 1 of 3 failed", "**−0.2**"]
    assert rows[2][0] == "line break"
    assert rows[-1][::2] == ["all", "2"]


@settings(deadline=None)
@given(st.text(max_size=40))
@example("---")
def test_no_name_breaks_a_row_of_any_table(name: str) -> None:
    table = Table(name, (name, "b"), ((Cell(name), Cell("1")),))
    shown = "".join(letter for letter in " ".join(name.split()) if letter.isprintable())
    rows = markdown_cells(markdown_table(table))
    assert [len(row) for row in rows] == [2, 2]
    assert rows[1][0] == shown.strip()
    assert unescape(Cells(html_table(table)).rows[1][1]) == "1"
    body = latex_table(table).splitlines()
    line = body[body.index("\\midrule") + 1]
    assert len(re.findall(r"(?<!\\)(?:\\\\)*&", line.removesuffix(r" \\"))) == 1
    assert line.count("{") - line.count(r"\{") == line.count("}") - line.count(r"\}")


def test_latex_text_is_escaped() -> None:
    assert latex_text(r"50 % of $x_1$ & \y") == r"50 \% of \$x\_1\$ \& \textbackslash{}y"
    assert latex_text("0.1–0.2 °") == r"0.1--0.2 $^\circ$"
    assert latex_text("é 日") == "é [U+65E5]"


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="pdflatex is not installed")
def test_latex_compiles(tmp_path: Path) -> None:
    document = "\\documentclass{article}\\usepackage{booktabs}\\begin{document}\n%s\\end{document}\n"
    (tmp_path / "t.tex").write_text(document % latex_table(TABLE), encoding="utf-8")
    command = ["pdflatex", "-halt-on-error", "-interaction=nonstopmode", "t.tex"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 0, done.stdout[-1500:]
