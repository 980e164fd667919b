import re
import shutil
import subprocess
from html import unescape
from html.parser import HTMLParser

import markupsafe
import pytest
from hypothesis import given, settings
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


def html_table(table):
    """Return a table as a page shows it."""
    source = '{% import "parts.html.j2" as parts %}{{ parts.results_table(table) }}'
    return environment().from_string(source).render(table=table).strip()


class Cells(HTMLParser):
    """Collects the text of each cell, row by row."""

    def __init__(self, html):
        super().__init__()
        self.rows, self.tags = [], set()
        self.feed(html)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.tags.add(tag)
        if tag == "tr":
            self.rows.append([])
        elif tag in ("th", "td"):
            self.rows[-1].append("")

    def handle_data(self, data):
        if self.rows and self.rows[-1]:
            self.rows[-1][-1] += data


def markdown_cells(text):
    """Split the rows of a Markdown table as a reader of it does: at bars that are not escaped."""
    lines = [line for line in text.splitlines() if line.startswith("|")]
    rows = [re.split(r"(?<!\\)\|", line)[1:-1] for line in lines if not line.startswith("| ---")]
    return [[re.sub(r"\\(.)", r"\1", cell.strip()) for cell in row] for row in rows]


def test_html_shows_names_and_runs_none_of_them():
    found = Cells(html_table(TABLE))
    assert "script" not in found.tags
    assert found.rows[0] == ["scenario", HOSTILE, "vio"]
    assert found.rows[1] == [HOSTILE, "0.1(0.05–0.2)1 of 3 failed", "−0.2"]
    assert [len(row) for row in found.rows] == [3, 3, 3, 3]


def test_html_takes_every_part_of_a_table_as_text():
    cell = Cell(HOSTILE, HOSTILE, HOSTILE)
    found = Cells(html := html_table(Table(HOSTILE, (HOSTILE,), ((cell,),), (cell,))))
    assert found.rows == [[HOSTILE], [3 * HOSTILE], [3 * HOSTILE]]
    assert found.tags == {"div", "table", "thead", "tbody", "tfoot", "tr", "th", "small"}
    assert f'aria-label="{markupsafe.escape(HOSTILE)}"' in html


def test_html_marks_the_best_and_says_how_to_sort():
    html = html_table(TABLE)
    assert '<td class="best" data-order="2.5">−0.2</td>' in html
    assert html.count('class="best"') == 1
    assert html.index("<tfoot") > html.index("</tbody>")  # the last row stays the last


def test_markdown_cells_stay_in_their_columns():
    rows = markdown_cells(markdown_table(TABLE))
    assert rows[0] == ["scenario", HOSTILE, "vio"]
    assert rows[1] == [HOSTILE, "0.1 (0.05–0.2), 1 of 3 failed", "**−0.2**"]
    assert rows[2][0] == "line break"
    assert rows[-1][::2] == ["all", "2"]


@settings(deadline=None)
@given(st.text(max_size=40))
def test_no_name_breaks_a_row_of_any_table(name):
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


def test_latex_text_sets_what_stands_there():
    assert latex_text(r"50 % of $x_1$ & \y") == r"50 \% of \$x\_1\$ \& \textbackslash{}y"
    assert latex_text("0.1–0.2 °") == r"0.1--0.2 $^\circ$"
    assert latex_text("é 日") == "é [U+65E5]"


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="no LaTeX to set the tables with")
def test_latex_compiles(tmp_path):
    document = "\\documentclass{article}\\usepackage{booktabs}\\begin{document}\n%s\\end{document}\n"
    (tmp_path / "t.tex").write_text(document % latex_table(TABLE), encoding="utf-8")
    command = ["pdflatex", "-halt-on-error", "-interaction=nonstopmode", "t.tex"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 0, done.stdout[-1500:]
