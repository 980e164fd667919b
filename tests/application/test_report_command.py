"""``dronevio report``: pages and tables of a benchmark."""

import csv
from pathlib import Path

import pytest

from dronevio.cli import main
from dronevio.eval.benchmark.rows import write_rows
from tests.rows import row_of


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Folder of a benchmark with three runs, one of which crashed."""
    folder = tmp_path / "suite"
    folder.mkdir()
    made = ("a81c", "dronevio 1")
    rows = [
        row_of("room-v0", "room", 0, "vio", *made, "ok", ate_m=0.05, rpe_m=0.01, cpu_ms_mean=20.0),
        row_of("room-v0", "room", 1, "vio", *made, "crashed", "signal 11"),
        row_of("room-v0", "room", 0, "other", *made, "ok", ate_m=0.07, rpe_m=0.02, cpu_ms_mean=30.0),
    ]
    write_rows(folder / "results.parquet", rows)
    return folder


def test_page_is_written_beside_the_results(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["report", str(folder)]) == 0
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert "<title>suite · dronevio</title>" in page
    assert str(folder / "report.html") in capsys.readouterr().out
    assert sorted(p.name for p in folder.iterdir()) == ["report.html", "results.parquet"]


def test_tables_are_printed_on_standard_output(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    results = str(folder / "results.parquet")
    assert main(["report", results, "--format", "csv", "--measures", "ate_m"]) == 0
    lines = list(csv.DictReader(capsys.readouterr().out.splitlines()))
    found = [(line["estimator"], line["failed"], line["median"], line["lower_quartile"]) for line in lines]
    assert found == [("other", "0", "0.07", "0.07"), ("vio", "1", "inf", "inf")]
    assert main(["report", results, "--format", "markdown"]) == 0
    assert "| room-v0 | **0.0700** | failed, 1 of 2 runs |" in capsys.readouterr().out
    assert main(["report", results, "--format", "latex", "--measures", "ate_m"]) == 0
    assert r"room-v0 & \textbf{0.0700} & failed, 1 of 2 runs \\" in capsys.readouterr().out


def test_output_file_can_be_chosen(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "new" / "table.tex"
    assert main(["report", str(folder), "--format", "latex", "--title", "x", "--out", str(out)]) == 0
    assert out.read_text(encoding="utf-8").count(r"\begin{table}") == 4  # three measures and the failed runs
    assert [p.name for p in out.parent.iterdir()] == ["table.tex"]


@pytest.mark.parametrize(
    "arguments",
    [
        ["{folder}/missing.parquet"],
        ["{folder}", "--format", "csv", "--measures", "speed"],
        ["{folder}", "--out", "{folder}/results.parquet/report.html"],
    ],
)
def test_bad_input_is_one_line(folder: Path, capsys: pytest.CaptureFixture[str], arguments: list[str]) -> None:
    before = (folder / "results.parquet").read_bytes()
    assert main(["report", *(argument.format(folder=folder) for argument in arguments)]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert (folder / "results.parquet").read_bytes() == before
