"""Groups of runs, their ANEES, and the tables with a row for each scenario and estimator."""

from dataclasses import replace

import numpy as np
import pytest

from dronevio.eval.benchmark.summary import AverageNees, all_runs
from dronevio.eval.metrics import nees_bounds
from dronevio.eval.report.benchmark.model import BenchmarkResults
from dronevio.eval.report.benchmark.overview import consistency_table, start_table, summary_table
from dronevio.eval.report.benchmark.page import benchmark_page
from dronevio.eval.report.benchmark.tables import as_markdown, loss_table, run_table
from dronevio.eval.report.tables import Table
from tests.rows import changed, row_of

RUN = row_of(
    "room-v0", "room", 0, "vio", "c", "v", "ok", coverage_percent=100.0, path_m=20.0, ate_m=0.02, rpe_m=0.01,
    scale_error_percent=-0.5, nees_position=2.0, nees_orientation=4.0, cpu_ms_mean=9.0, cpu_ms_p99=20.0, start_s=1.5,
    start_acceleration_m_s2=0.8, start_velocity_error_m_s=0.02, start_speed_m_s=0.3, start_scale_error_percent=-3.0,
)  # fmt: skip
DRIFTED = changed(RUN, seed=1, ate_m=0.3, nees_position=6.0, nees_velocity=5.0, start_s=2.5, start_speed_m_s=None)
LOST = row_of("room-v0", "room", 2, "vio", "c", "v", "crashed", "killed")
HALL = changed(RUN, scenario="hall-v0")
VARIANTS = tuple(changed(RUN, scenario=f"{name}+imu-100hz") for name in ("room-v0", "hall-v0"))


def cells(table: Table, row: int = 0) -> dict[str, str]:
    """Return the texts of a row by the headings of its columns."""
    return {name: cell.text for name, cell in zip(table.columns, table.rows[row], strict=True)}


def test_anees_is_the_mean_over_the_runs_with_scores() -> None:
    found = AverageNees.of([RUN, DRIFTED, LOST])
    assert found == AverageNees(2, 4.0, 4.0, 5.0, nees_bounds(3, 2))
    assert AverageNees.of([LOST, changed(RUN, nees_position=None)]) is None


@pytest.mark.parametrize("factor", [0.4, 1.0, 2.5])
def test_bounds_of_anees_have_a_probability_of_95_percent(factor: float) -> None:
    rng = np.random.default_rng(3)
    inside = 0
    for _ in range(200):
        rows = [changed(RUN, nees_position=float(value)) for value in factor * rng.chisquare(3, 36)]
        found = AverageNees.of(rows)
        assert found is not None and found.position is not None
        inside += found.bounds[0] <= found.position <= found.bounds[1]
    assert inside / 200 == pytest.approx(0.95 if factor == 1.0 else 0.0, abs=0.04)


def test_all_scenarios_are_grouped_by_variant() -> None:
    found = all_runs([RUN, DRIFTED, HALL, *VARIANTS])
    assert [(group.scenario, len(group.rows)) for group in found] == [
        ("all scenarios", 3),
        ("all scenarios, imu-100hz", 2),
    ]
    assert not all_runs([RUN, DRIFTED])


def test_the_summary_counts_failed_and_diverged_runs() -> None:
    table = summary_table(BenchmarkResults("x", (RUN, DRIFTED, LOST)))
    row = cells(table)
    assert (row["runs"], row["failed"], row["diverged"]) == ("3", "1", "1")
    assert (row["ATE [% of path]"], row["largest [%]"]) == ("1.50", "failed")  # of 0.1, 1.5 and a failed run
    assert (row["smallest coverage [%]"], row["latest first pose [s]"]) == ("100.0", "2.50")
    assert (row["ms per frame"], row["p99"], row["scale [%]"]) == ("9.0", "20.0", "−0.500")
    assert (row["longest loss [s]"], row["largest error while tracking [σ]"]) == ("–", "–")
    assert len(table.rows) == 1  # a single scenario has no row over all


def test_the_summary_has_the_worst_loss_and_error_while_tracking() -> None:
    """An error of more than five standard deviations that is reported as tracking is marked."""
    lossy = changed(RUN, longest_loss_s=1.25, tracking_sigmas=2.0)
    wrong = changed(DRIFTED, longest_loss_s=0.5, tracking_sigmas=5.1)
    row = cells(summary_table(BenchmarkResults("x", (lossy, wrong, LOST))))
    assert (row["longest loss [s]"], row["largest error while tracking [σ]"]) == ("1.25", "5.1")
    for run, warning in ((wrong, "too large"), (changed(wrong, tracking_sigmas=5.0), "")):
        table = summary_table(BenchmarkResults("x", (lossy, run)))
        assert table.rows[0][table.columns.index("largest error while tracking [σ]")].warning == warning


def test_the_table_of_losses_has_runs_that_left_tracking() -> None:
    tracked = changed(RUN, longest_loss_s=0.0, tracking_sigmas=5.0)
    lossy = changed(RUN, seed=1, longest_loss_s=0.15, tracking_sigmas=2.0, coverage_percent=99.5)
    wrong = changed(RUN, seed=2, longest_loss_s=0.0, tracking_sigmas=5.06)
    drifted = changed(DRIFTED, seed=3)
    table = loss_table(BenchmarkResults("x", (RUN, tracked, lossy, wrong, drifted, changed(LOST, seed=4))))
    assert [row[1].text for row in table.rows] == ["1", "2", "3", "4"]
    assert [row[3].warning for row in table.rows] == ["", "", "diverged", "crashed"]
    row = cells(table)
    assert (row["status"], row["ATE [% of path]"]) == ("ok", "0.100")
    assert (row["coverage [%]"], row["longest loss [s]"], row["largest error while tracking [σ]"]) == (
        "99.5",
        "0.15",
        "2.0",
    )
    assert [row[5].warning for row in table.rows] == ["", "too large", "", ""]
    assert cells(table, 3)["ATE [% of path]"] == "–"


def test_the_consistency_table_has_three_anees_and_bounds() -> None:
    results = BenchmarkResults("x", (RUN, DRIFTED, HALL))
    table = consistency_table(results)
    row = cells(table)
    assert (row["runs"], row["position"], row["orientation"], row["velocity"]) == ("2", "4.00", "4.00", "5.00")
    assert row["95 % bounds"] == "{:.2f}–{:.2f}".format(*nees_bounds(3, 2))
    assert [each[0].text for each in table.rows] == ["room-v0", "hall-v0", "all scenarios"]
    assert cells(table, 1)["velocity"] == "–"


def test_the_table_of_starts_counts_accurate_ones() -> None:
    row = cells(start_table(BenchmarkResults("x", (RUN, DRIFTED, LOST))))
    assert (row["runs"], row["started"], row["first pose [s]"], row["latest [s]"]) == ("3", "2", "2.00", "2.50")
    assert (row["within 5 % or 3 cm/s"], row["largest scale error [%]"]) == ("1", "3.0")


def test_reports_have_the_tables_that_are_asked_for() -> None:
    results = BenchmarkResults("x", (RUN, DRIFTED, LOST))
    text = as_markdown(results, (), ("summary", "consistency", "starts", "losses", "failures"))
    titles = (
        "Summary: medians",
        "Average NEES",
        "Initialization: medians",
        "Runs with losses of tracking",
        "Failed runs",
    )
    places = [text.index(title) for title in titles]
    assert places == sorted(places)
    assert "Average NEES" not in as_markdown(replace(results, rows=(LOST,)), (), ("consistency", "failures"))
    page = benchmark_page(results)
    assert "A run has diverged if its coverage is below 99 %" in page and "95 % bounds" in page
    assert "Losses of tracking" in page and "exceeded 5 standard deviations" in page
    assert "Losses of tracking" not in benchmark_page(BenchmarkResults("x", (RUN, HALL)))
    assert run_table(results).rows[1][3].warning == "diverged"
