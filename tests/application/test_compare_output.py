"""The output of ``dronevio compare`` and ``gate``: what changed comes first, and failures in both are left out."""

from collections.abc import Sequence
from pathlib import Path

import pytest

from dronevio.cli import main
from dronevio.eval.benchmark.rows import write_rows
from tests.rows import row_of


def write_results(path: Path, errors_m: dict[str, Sequence[float | None]]) -> str:
    """Write runs with the given position errors for each estimator, None for a failed run, and return the path."""
    rows = [
        row_of("room-v0", "room", seed, estimator, "c", "v", "ok", ate_m=value, rpe_m=1.0, coverage_percent=100.0)
        if value is not None
        else row_of("room-v0", "room", seed, estimator, "c", "v", "failed", reason="no pose")
        for estimator, values in errors_m.items()
        for seed, value in enumerate(values)
    ]
    write_rows(path, rows)
    return str(path)


def compared(
    tmp_path: Path, first: dict[str, Sequence[float | None]], second: dict[str, Sequence[float | None]]
) -> None:
    """Compare two benchmarks with the command."""
    names = [write_results(tmp_path / f"{name}.parquet", errors) for name, errors in (("a", first), ("b", second))]
    assert main(["compare", *names]) == 0


def test_what_changed_is_printed_first(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first: dict[str, Sequence[float | None]] = {
        "a": [0.1] * 6,
        "b": [0.1, None, 0.1, 0.1],
        "c": [0.1] * 6,
        "d": [0.1, 0.1],
    }
    compared(tmp_path, first, first | {"c": [0.2] * 6, "d": [0.1, None]})
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].startswith("c: ate_m 100.0 % larger, significantly worse")
    assert "d: 0 runs failed in the first, 1 in the second" in lines
    assert "  newly failed: room-v0, seed 1, d: failed, no pose" in lines
    assert "d: mean coverage 100.0 % in the first, 50.0 % in the second" in lines
    assert "the same in both: a, b" in lines
    assert not [line for line in lines if line.startswith(("a: ", "b: ", "c: rpe_m"))]
    table = [line.split()[0] for line in lines[lines.index("") + 3 :] if line]
    assert table == ["c", "c", "d", "d", "a", "a", "b", "b"]


def test_estimators_that_failed_in_both_are_left_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first: dict[str, Sequence[float | None]] = {"good": [0.1, 0.2], "useless": [None, None]}
    compared(tmp_path, first, first)
    assert "useless" not in capsys.readouterr().out
    compared(tmp_path, {"useless": [None]}, {"useless": [None]})
    assert capsys.readouterr().out.splitlines()[1:] == ["Every run failed in both."]


def test_changes_that_cancel_are_not_called_the_same(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    compared(tmp_path, {"vio": [1.0] * 9}, {"vio": [1.0] * 7 + [2.0, 0.5]})
    out = capsys.readouterr().out
    assert "vio: ate_m did not change, not significant" in out
    assert "the same in both" not in out


def test_the_gate_names_its_violations_first(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = write_results(tmp_path / "a.parquet", {"good": [0.1] * 3, "vio": [0.1] * 3, "useless": [None]})
    after = write_results(tmp_path / "b.parquet", {"good": [0.1] * 3, "vio": [0.2] * 3, "useless": [None]})
    assert main(["gate", after, "--baseline", before]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("failed: vio: ate_m 100.0 % larger")
    assert lines[-1] == "gate failed, limit 5 %"
    assert "useless" not in "\n".join(lines)
