"""The lessons of ``dronevio book open``: they can be read and copied, and everything that they name exists."""

import ast
import json
import re
import subprocess
import sys
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path
from typing import Any

import jupytext
import nbformat
import pytest

from dronevio.book import open_lesson
from dronevio.book.open_lesson import LESSONS, lesson_source, read_lesson
from dronevio.cli import main
from dronevio.models.extras import install_command

# --- the scripts


def test_every_script_is_listed() -> None:
    folder = files("dronevio.book") / "lessons"
    assert {f"{name}.py" for name in LESSONS} == {p.name for p in folder.iterdir() if p.name.endswith(".py")}


@pytest.mark.parametrize("name", LESSONS)
def test_scripts_round_trip_as_notebooks(name: str) -> None:
    source = lesson_source(name)
    notebook = jupytext.reads(source, fmt="py:percent")
    assert jupytext.writes(notebook, fmt="py:percent") == source
    kinds = [cell.cell_type for cell in notebook.cells]
    assert kinds.count("code") >= 5 and kinds.count("markdown") >= 5 and "raw" not in kinds


@pytest.mark.parametrize("name", LESSONS)
def test_names_in_the_text_exist(name: str, exists: Callable[[str], bool]) -> None:
    text = "\n".join(cell.source for cell in read_lesson(name).cells if cell.cell_type == "markdown")
    named = re.findall(r"`(dronevio(?:\.\w+)+)`", text)
    assert len(named) >= 5
    assert [one for one in named if not exists(one)] == []


@pytest.mark.parametrize("name", LESSONS)
def test_imports_exist(name: str, exists: Callable[[str], bool]) -> None:
    imported = [
        f"{node.module}.{alias.name}"
        for node in ast.walk(ast.parse(lesson_source(name)))
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    ]
    assert imported and [one for one in imported if not exists(one)] == []


@pytest.mark.parametrize("name", LESSONS)
def test_each_lesson_has_its_parts(name: str) -> None:
    first, *cells = read_lesson(name).cells
    assert re.match(r"# \S.*\n\n.*section 7\.4", first.source, re.DOTALL)
    text = "\n".join(cell.source for cell in cells if cell.cell_type == "markdown")
    headings = re.findall(r"^## (.+)$", text, re.MULTILINE)
    assert headings[-2:] == ["Exercises", "What to change to see it break"]
    exercises = text.partition("## Exercises")[2].partition("## What")[0]
    numbers = [int(number) for number in re.findall(r"^\*\*(\d)\. ", exercises, re.MULTILINE)]
    assert numbers == list(range(1, len(numbers) + 1)) and 2 <= len(numbers) <= 4
    assert exercises.count("<details ") == exercises.count("</details>") == len(numbers)


@pytest.mark.parametrize("name", LESSONS)
def test_changes_can_be_made(name: str, script: Any) -> None:
    lessons, source = script("lessons"), lesson_source(name)
    changes = lessons.changes(source)
    section = source.partition("What to change to see it break")[2]
    assert 1 <= len(changes) == section.count("```python")
    for change in changes:
        changed = lessons.changed(source, change)
        assert changed != source and f"\n{change}\n" in changed


# --- dronevio book open


def test_lessons_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["book", "open"]) == 0
    printed = capsys.readouterr().out
    assert all(f"{name} " in printed and summary in printed for name, summary in LESSONS.items())


def test_a_lesson_is_copied_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["book", "open", "imu"]) == 0
    assert "notebook: imu.ipynb" in capsys.readouterr().out
    notebook = nbformat.read(tmp_path / "imu.ipynb", as_version=4)
    nbformat.validate(notebook)
    assert notebook.metadata.kernelspec.name == "python3"
    assert [cell.source for cell in notebook.cells] == [cell.source for cell in read_lesson("imu").cells]
    assert not any(cell.get("outputs") for cell in notebook.cells)


def test_a_notebook_is_overwritten_on_demand_only(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    target = tmp_path / "new" / "first.ipynb"
    assert main(["book", "open", "imu", "--out", str(target)]) == 0
    target.write_text("{}", encoding="utf-8")
    assert main(["book", "open", "imu", "--out", str(target)]) == 2
    assert "it exists already" in capsys.readouterr().err
    assert target.read_text(encoding="utf-8") == "{}"
    assert main(["book", "open", "imu", "--out", str(target), "--overwrite"]) == 0
    assert json.loads(target.read_text(encoding="utf-8"))["cells"]
    assert main(["book", "open", "imu", "--out", str(tmp_path)]) == 0
    assert {path.name for path in tmp_path.iterdir()} == {"new", "imu.ipynb"}


def test_wrong_names_are_bad_input(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["book", "open", "quantum"]) == 2
    assert f"unknown lesson 'quantum'; expected one of {', '.join(LESSONS)}" in capsys.readouterr().err
    assert main(["book", "open", "imu", "--out", str(tmp_path / "imu.py")]) == 2
    assert ".ipynb" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_lesson_opens_in_jupyterlab(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """On this machine only; a changed notebook is opened as it is. Without JupyterLab, its installation is named."""
    started, target = list[list[str]](), tmp_path / "imu.ipynb"
    command = ["book", "open", "imu", "--out", str(target)]
    monkeypatch.setattr(open_lesson, "find_spec", lambda name: None)
    assert main([*command, "--lab"]) == 2
    assert install_command("book") in capsys.readouterr().err and not target.exists()
    assert main(command) == 0
    assert install_command("book") in capsys.readouterr().out
    target.write_text("changed", encoding="utf-8")

    def run(words: list[str], **_: object) -> subprocess.CompletedProcess[bytes]:
        started.append(words)
        return subprocess.CompletedProcess(words, 0)

    monkeypatch.setattr(open_lesson, "find_spec", lambda name: object())
    monkeypatch.setattr(subprocess, "run", run)
    assert main([*command, "--lab"]) == 0
    assert started[0][1:4] == ["-m", "jupyterlab", "--ip=127.0.0.1"] and started[0][-1] == str(target)
    assert target.read_text(encoding="utf-8") == "changed"
    assert main([*command, "--overwrite"]) == 0
    assert f"dronevio book open imu --out {target} --lab" in capsys.readouterr().out


def test_the_missing_extra_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "jupytext", None)
    assert main(["book", "open", "imu", "--out", str(tmp_path / "imu.ipynb")]) == 2
    assert install_command("book") in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


# --- the script that executes them


def test_a_change_needs_one_assignment(script: Any) -> None:
    changed = script("lessons").changed
    assert changed("\nA = 1\nB = A\n", "A = 2") == "\nA = 2\nB = A\n"
    for source in ("\nB = 1\n", "\nA = 1\nA = 3\n"):
        with pytest.raises(ValueError, match="assignments to 'A'"):
            changed(source, "A = 2")


def test_pages_of_an_executed_notebook(script: Any) -> None:
    lessons = script("lessons")
    cells = nbformat.v4
    png = cells.new_output("display_data", {"image/png": "aGVsbG8=", "text/plain": "<Figure>"})
    notebook = cells.new_notebook(
        cells=[
            cells.new_markdown_cell("# Title\n\nWith `dronevio.models.rotation`.\n\n```python\n`dronevio.cli`\n```"),
            cells.new_code_cell("print(1)", outputs=[cells.new_output("stream", text="1\n")]),
            cells.new_code_cell(
                "# Figure: a path\ndraw()", outputs=[png], metadata={"jupyter": {"source_hidden": True}}
            ),
            cells.new_code_cell("draw_again()", outputs=[png]),
        ]
    )
    text, images = lessons.page(notebook, "first")
    assert images == {"first/1.png": b"hello", "first/2.png": b"hello"}
    assert text.startswith("# Title\n") and "make lesson NAME=first" in text
    assert "[`dronevio.models.rotation`][dronevio.models.rotation]" in text and "\n`dronevio.cli`\n" in text
    assert "```{ .text .output }\n1\n```" in text and "<Figure>" not in text
    assert "![a path](first/1.png)" in text and "![](first/2.png)" in text
    assert text.count("<details") == text.count("</details>") == 1
    assert lessons.unnamed_figures(notebook) == ["draw_again()"]


def test_executed_lessons_are_used_again(script: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lessons = script("lessons")
    monkeypatch.setattr(lessons, "EXECUTED", tmp_path)
    notebook = read_lesson("imu")
    notebook.metadata["dronevio"] = {"digest": lessons._digest("imu")}
    nbformat.write(notebook, tmp_path / "imu.ipynb")
    assert lessons.execute("imu").metadata == notebook.metadata
    monkeypatch.setattr(lessons, "read_lesson", lambda name: pytest.fail("it is executed"))
    notebook.metadata["dronevio"] = {"digest": "of another version"}
    nbformat.write(notebook, tmp_path / "imu.ipynb")
    with pytest.raises(pytest.fail.Exception, match="it is executed"):
        lessons.execute("imu")
