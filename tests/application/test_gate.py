"""``dronevio gate`` and ``compare`` on results that are written by hand."""

import json
from pathlib import Path

import pytest

from dronevio.cli import main
from dronevio.eval.benchmark.rows import write_rows
from tests.rows import changed, row_of

CLEAN = row_of(
    "room-v0", "room", 0, "vio", "c", "v", "ok", ate_m=0.01, rpe_m=0.01, longest_loss_s=0.0, tracking_sigmas=2.0
)


def test_gate_without_a_baseline_checks_expected_outcomes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    drops = changed(CLEAN, scenario="room-drops-v0", ate_m=0.039)
    results = tmp_path / "results.parquet"
    write_rows(results, [CLEAN, drops])
    assert main(["gate", str(results)]) == 0
    assert "gate passed: 2 of 2 runs as expected" in capsys.readouterr().out
    write_rows(results, [CLEAN, changed(drops, ate_m=0.041)])
    assert main(["gate", str(results), "--json"]) == 1
    (violation,) = json.loads(capsys.readouterr().out)["violations"]
    assert violation == "room-drops-v0, seed 0, vio: error 4.1 ×; expected: error ≤ 4 ×"
    assert main(["report", str(results), "--format", "markdown"]) == 0
    assert "not as expected" in capsys.readouterr().out
    write_rows(results, [CLEAN])
    assert main(["gate", str(results)]) == 2
    assert "no run with an expected outcome" in capsys.readouterr().err


def test_gates_that_cannot_be_judged_are_bad_input(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    results = str(tmp_path)
    write_rows(tmp_path / "results.parquet", [CLEAN, changed(CLEAN, estimator="dead-reckoning", ate_m=0.3)])
    assert main(["gate", results, "--baseline", str(tmp_path / "nowhere.parquet")]) == 2
    assert main(["gate", results, "--baseline", results, "--max-regression", "little"]) == 2
    assert main(["gate", results, "--baseline", results, "--metrics", "beauty"]) == 2
    assert main(["compare", results, results, "--estimators", "vio", "nobody"]) == 2
    errors = capsys.readouterr().err.splitlines()
    assert len(errors) == 4
    assert all(error.startswith("dronevio: ") and "; expected " in error for error in errors)
    assert main(["compare", results, results, "--estimators", "dead-reckoning", "vio"]) == 0
    assert "vio against dead-reckoning: ate_m" in capsys.readouterr().out
