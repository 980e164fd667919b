"""What loops do to the accuracy, over runs: medians, ratios, worst differences, and the table."""

from pathlib import Path

import pyarrow as pa
import pytest
from pyarrow import parquet

from dronevio.eval.benchmark.loop_summary import Excess, LoopSummary, PathSummary
from dronevio.eval.benchmark.rows import read_rows, schema, write_rows
from dronevio.eval.report.benchmark.model import BenchmarkResults
from dronevio.eval.report.benchmark.overview import loop_table
from dronevio.eval.report.benchmark.page import benchmark_page
from dronevio.eval.report.benchmark.tables import as_markdown
from tests.rows import changed, row_of

VIO = row_of("room-v0", "room", 0, "vio", "c", "v", "ok", ate_m=0.05, rmse_after_revisit_m=0.04)
SLAM = changed(
    VIO, estimator="slam", rmse_after_revisit_m=0.02, odometry_after_revisit_m=0.04, final_after_revisit_m=0.01,
    final_ate_m=0.012, loops=30, wrong_loops=0, recall_percent=80.0, first_revisit_s=12.5, map_results=40, map_waits=1,
)  # fmt: skip
WORSE = changed(
    SLAM, seed=1, rmse_after_revisit_m=0.021, odometry_after_revisit_m=0.03, final_after_revisit_m=0.009, loops=20,
    wrong_loops=1, recall_percent=60.0,
)  # fmt: skip
SMALL = changed(
    SLAM, seed=2, rmse_after_revisit_m=0.0125, odometry_after_revisit_m=0.01, final_after_revisit_m=0.0095, loops=0,
    recall_percent=None,
)  # fmt: skip
LOST = row_of("room-v0", "room", 3, "slam", "c", "v", "crashed", "killed")


def test_ratios_are_those_where_the_odometry_errs() -> None:
    found = LoopSummary.of([SLAM, WORSE, SMALL, LOST])
    assert found is not None
    assert (found.runs, found.large, found.odometry_m) == (3, 2, 0.03)
    assert (found.loops, found.wrong_loops, found.recall_percent, found.smallest_recall_percent) == (50, 1, 70.0, 60.0)
    assert found.online is not None and found.final is not None
    assert found.online.ratio == pytest.approx((0.5 + 0.7) / 2.0)
    assert found.final.ratio == pytest.approx((0.25 + 0.3) / 2.0)
    assert (found.online.median_m, found.final.median_m) == (0.02, 0.0095)
    assert found.online.worst is not None and found.final.worst is not None
    assert (found.online.worst.difference_m, found.online.worst.percent) == pytest.approx((0.0025, 25.0))
    assert (found.final.worst.difference_m, found.final.worst.percent) == pytest.approx((-0.0005, -5.0))


def test_the_worst_run_is_the_farthest_beyond_its_limit() -> None:
    small, large = (0.0029, 0.002), (0.0215, 0.020)  # + 0.9 mm of 2 mm; + 1.5 mm of 20 mm
    found = PathSummary.of([small, large])
    assert found is not None and found.ratio is None and found.worst is not None  # 20 mm are not above 20 mm
    assert found.worst.difference_m == pytest.approx(0.0015)
    assert found.worst.ratio_to_limit == pytest.approx(1.5) and Excess.of(*small).ratio_to_limit == pytest.approx(0.9)
    assert Excess.of(0.0105, 0.01).ratio_to_limit == pytest.approx(0.5)  # half a millimetre, five percent
    assert PathSummary.of([]) is None


def test_an_odometry_has_no_loops() -> None:
    found = LoopSummary.of([VIO, changed(VIO, seed=1, rmse_after_revisit_m=0.01)])
    assert found == LoopSummary(2, 1, 0.025, None, None, None, None, None, None)
    assert LoopSummary.of([changed(VIO, rmse_after_revisit_m=None), LOST]) is None


def test_the_table_of_loops_has_a_row_for_each_group() -> None:
    results = BenchmarkResults("x", (VIO, SLAM, WORSE, SMALL, LOST))
    table = loop_table(results)
    rows = [dict(zip(table.columns, (cell.text for cell in row), strict=True)) for row in table.rows]
    assert [row["estimator"] for row in rows] == ["vio", "slam"]
    odometry, slam = rows
    assert (odometry["odometry [mm]"], odometry["online [mm]"], odometry["loops"]) == ("40.0", "–", "–")
    assert (slam["odometry [mm]"], slam["online [mm]"], slam["final [mm]"]) == ("30.0", "20.0", "9.5")
    assert (slam["above 20 mm"], slam["online ratio"], slam["final ratio"]) == ("2", "0.60", "0.28")
    assert (slam["others: online"], slam["others: final"]) == ("+2.5 mm, +25 %", "−0.5 mm, −5 %")
    assert (slam["loops"], slam["wrong loops"], slam["recall [%]"], slam["smallest [%]"]) == ("50", "1", "70", "60")
    warnings = [cell.warning for cell in table.rows[1] if cell.warning]
    assert warnings == ["1 failed", "worse", "wrong"]
    assert "| room-v0 | slam | 4, 1 failed | 30.0 |" in as_markdown(results, (), ("loops",))
    assert "<h2>Loops</h2>" in benchmark_page(results) and "<h2>Loops</h2>" not in benchmark_page(
        BenchmarkResults("x", (VIO,))
    )


def test_results_without_the_columns_of_loops_are_read(tmp_path: Path) -> None:
    write_rows(tmp_path / "results.parquet", [SLAM])
    assert read_rows(tmp_path) == (SLAM,)
    old = parquet.read_table(tmp_path / "results.parquet")
    dropped = [name for name, value in SLAM.columns.items() if value != VIO.columns[name] and name != "estimator"]
    assert len(dropped) == 10
    parquet.write_table(old.drop_columns([*dropped, "worker_cpu_ms"]), tmp_path / "old.parquet")
    (row,) = read_rows(tmp_path / "old.parquet")
    assert row == changed(VIO, estimator="slam", rmse_after_revisit_m=None)
    assert schema().field("loops").type == pa.int64()
