"""The declaration of metrics: texts, rankings, and a metric that is added in one place."""

import json
import re
import subprocess
import sys
from dataclasses import asdict, fields, replace
from pathlib import Path

import numpy as np
import pytest

from dronevio.eval.benchmark.metrics import METRICS, STORED_METRICS
from dronevio.eval.benchmark.rows import Row, write_rows
from dronevio.eval.metrics import Scores, score
from dronevio.models.recordings.tum import write_tum
from dronevio.models.state import Trajectory
from tests.rows import row_of

PAGE = Path(__file__).parents[3] / "docs" / "benchmark.md"


ADDED = """    p90_m: float = computed(
        lambda e: float(np.percentile(e.translation_error_m, 90)), Metric("90th percentile", "m", 3)
    )
"""
"""The declaration of a metric, as it would be written into `Scores`."""
SCRIPT = """
import json, sys
from dataclasses import asdict
from importlib.machinery import SourceFileLoader
from pathlib import Path

plain, added, folder = SourceFileLoader.get_code, sys.argv[1], Path(sys.argv[2])

def get_code(loader, name):
    if name != "dronevio.eval.metrics.scores":
        return plain(loader, name)
    source = Path(loader.path).read_text(encoding="utf-8")
    method = "    @classmethod\\n    def from_json"
    return compile(source.replace(method, added + method), name, "exec")

SourceFileLoader.get_code = get_code

from dronevio.cli.commands.evaluate import print_scores
from dronevio.eval.benchmark.metrics import score_columns
from dronevio.eval.benchmark.rows import Row, read_rows, write_rows
from dronevio.eval.compare import metric_ratio
from dronevio.eval.metrics import score
from dronevio.eval.report.benchmark.model import BenchmarkResults
from dronevio.eval.report.benchmark.tables import as_csv, as_markdown
from dronevio.models.recordings.tum import read_tum

scores = score(read_tum(folder / "truth.tum"), read_tum(folder / "estimate.tum"))
print(json.dumps(asdict(scores)))
print_scores("title", scores)
run = dict(scenario="room-v0", world="room", seed=0, estimator="vio", config_hash="c", versions="v", status="ok")
row = Row.from_columns(run | score_columns(scores))
write_rows(folder / "results.parquet", [row])
assert read_rows(folder) == (row,) and row["p90_m"] == scores.p90_m
(older,) = read_rows(folder / "older.parquet")
assert older["p90_m"] is None and older["ate_m"] == 0.1
results = BenchmarkResults("b", (row,))
print(as_markdown(results, results.measures), as_csv(results, results.measures))
print(metric_ratio("p90_m", [(row, row)]).conclusion)
"""


def flight() -> tuple[Trajectory, Trajectory]:
    """Return a truth and an estimate of four poses."""
    p = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    truth = Trajectory(10**9 * np.arange(4), p, np.tile([1.0, 0, 0, 0], (4, 1)))
    return truth, replace(truth, p_world_imu=p + [[0, 0, 0.1], [0, 0, -0.1], [0, 0, 0.1], [0, 0, -0.1]])


@pytest.mark.slow
def test_a_metric_is_added_in_one_place(tmp_path: Path) -> None:
    """Scores, JSON, terminal, columns of rows and their files, tables and units follow from its declaration."""
    write_rows(tmp_path / "older.parquet", [row_of("room-v0", "room", 0, "vio", ate_m=0.1)])
    for name, trajectory in zip(("truth", "estimate"), flight(), strict=True):
        write_tum(tmp_path / f"{name}.tum", trajectory)
    command = [sys.executable, "-c", SCRIPT, ADDED, str(tmp_path)]
    out = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    document, _, rest = out.partition("\n")
    assert json.loads(document)["p90_m"] == pytest.approx(0.1)
    assert re.search(r"90th percentile +0\.100 +m", rest)
    assert "**90th percentile \\[m\\]**" in rest
    assert "room-v0,vio,p90_m,m,1,0,0.1" in rest
    assert "p90_m is the same" in rest


def test_scores_survive_json() -> None:
    scores = score(*flight(), np.arange(5) * 10**9)
    document = json.loads(json.dumps(asdict(scores), allow_nan=False))
    assert Scores.from_json(document) == scores
    del document["path_m"]
    older = Scores.from_json(document)
    assert [name for name, value in asdict(older).items() if value != asdict(scores)[name]] == ["path_m"]


def test_every_metric_has_its_unit_in_its_name() -> None:
    units = {
        "m": "_m",
        "°": "_deg",
        "m/s": "_m_s",
        "m/s²": "_m_s2",
        "rad/s": "_rad_s",
        "ms": "_ms",
        "s": "_s",
        "MB": "_mb",
    }
    for metric in METRICS.values():
        ending = "_percent" if metric.unit.startswith("%") else units.get(metric.unit, "")
        assert ending in metric.name, metric.name
    assert len({metric.heading for metric in METRICS.values()}) == len(METRICS)
    columns = [*Row("", "", None, "", "", "", "ok").columns]
    assert len(set(columns)) == len(columns) == len(fields(Row)) - 2 + len(STORED_METRICS)


@pytest.mark.skipif(not PAGE.is_file(), reason="not a checkout")
def test_the_columns_are_documented() -> None:
    page = PAGE.read_text(encoding="utf-8")
    table = page[page.index("## Columns") : page.index("## Comparison and")]
    documented = set(re.findall(r"`(\w+)`", table))
    assert {*Row("", "", None, "", "", "", "ok").columns} <= documented


def test_values_are_written_with_their_decimals() -> None:
    scale = METRICS["scale_error_percent"]
    assert (scale.text(-0.5), scale.text(0.5), scale.text(None)) == ("−0.50", "+0.50", "–")
    assert (scale.heading, scale.label("1 s")) == ("Absolute scale error [%]", "scale error")
    rpe = METRICS["rpe_m"]
    assert (rpe.heading, rpe.label("10 m")) == ("RPE over 1 s, position [m]", "RPE over 10 m, position")
    assert (rpe.compared_text(0.04567), rpe.compared_text(np.inf)) == ("0.0457", "failed")
    assert METRICS["coverage_percent"].worst == -np.inf and rpe.worst == np.inf
    assert METRICS["wall_s"].ranking_key(1.0) == METRICS["wall_s"].ranking_key(2.0)
    nees = METRICS["nees_position"]
    assert nees.ranking_key(3.0) < nees.ranking_key(2.0) < nees.ranking_key(5.0) < nees.ranking_key(0.0)
