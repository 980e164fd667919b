"""Reports of benchmarks: quartiles with failed runs, rankings, tables, and self-contained pages of escaped text."""

import csv
import io
import math
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dronevio.eval.benchmark.isolation import Status
from dronevio.eval.benchmark.metrics import METRICS, metric_named
from dronevio.eval.benchmark.rows import Row, write_rows
from dronevio.eval.benchmark.summary import Quartiles, quantile
from dronevio.eval.metrics.metric import Metric, significant
from dronevio.eval.report.benchmark.model import (
    BenchmarkResults,
    metric_quartiles,
    read_benchmark,
    seed_ranges,
    value_of,
)
from dronevio.eval.report.benchmark.page import benchmark_page
from dronevio.eval.report.benchmark.tables import as_csv, as_latex, as_markdown, failure_table, measure_table
from dronevio.models.errors import ConfigError, InputError
from tests.browser import WIDTHS_PX, Browser
from tests.rows import changed, row_of

if TYPE_CHECKING:
    from tests.eval.conftest import ReadPage
ATE, COVERAGE, COST, NEES = map(metric_named, ("ate_m", "coverage_percent", "cpu_ms_mean", "nees_position"))
BASE = row_of("room-v0", "room", 0, "vio", "a81c", "dronevio 1, numpy 2", "ok", recording_hash="r0", wall_s=30.0)
SHARES = np.array([0.1, 0.2, 0.3, 0.4, 0.5])
HOSTILE = '</td><script>alert("1")</script>$x$ & <b>|'


def scored(scenario: str, seed: int | None, estimator: str, ate_m: float, **others: Any) -> Row:
    """Return a run with scores in proportion to its position error, except for the given columns."""
    lengths = SHARES * 60.0
    values: dict[str, Any] = {
        "coverage_percent": 99.0,
        "path_m": 60.0,
        "ate_m": ate_m,
        "rpe_m": 0.2 * ate_m,
        "drift_percent": 2.0 * ate_m,
        "nees_position": 3.0 if estimator == "vio" else None,
        "cpu_ms_mean": 20.0,
        "sub_trajectory_m": tuple(lengths),
        "sub_trajectory_rpe_m": tuple(0.1 * ate_m * lengths**0.5),
        "sub_trajectory_rpe_deg": tuple(ate_m * lengths**0.5),
    }
    return changed(BASE, scenario=scenario, seed=seed, estimator=estimator, **(values | others))


def failed(
    scenario: str, seed: int | None, estimator: str, status: Status = "crashed", reason: str = "signal 11"
) -> Row:
    """Return a run without scores."""
    return changed(BASE, scenario=scenario, seed=seed, estimator=estimator, status=status, reason=reason)


def make_rows(scenarios: Sequence[str], seeds: int) -> Iterator[Row]:
    """Yield the runs of three estimators of different accuracy; some runs of two of them fail."""
    rng = np.random.default_rng(5)
    for scenario in scenarios:
        for seed in range(seeds):
            for estimator, typical_m in (("vio", 0.05), ("dead-reckoning", 8.0), ("external:mine", 0.06)):
                if estimator != "dead-reckoning" and rng.random() < 0.15:
                    yield failed(scenario, seed, estimator)
                else:
                    yield scored(scenario, seed, estimator, typical_m * 10.0 ** rng.normal(0.0, 0.15))


SUITE_ERRORS_M = {"dead-reckoning": 8.0, "eqvio": 0.3, "openvins-stereo": 0.08, "vio": 0.05, "vio-stereo": 0.03}
"""Typical position errors of the estimators of a suite [m]."""


def make_suite() -> Iterator[Row]:
    """Yield two runs of five estimators on twelve scenarios; all of one fail on the difficult scenarios."""
    rng = np.random.default_rng(3)
    for world in ("room", "corridor", "warehouse", "machine-hall"):
        for level in ("easy", "medium", "difficult"):
            for estimator, typical_m in SUITE_ERRORS_M.items():
                for seed in range(2):
                    name = f"{world}-{level}-v0"
                    if level == "difficult" and estimator == "openvins-stereo":
                        yield failed(name, seed, estimator, "failed", "no pose: the estimator was not initialized")
                    else:
                        yield scored(name, seed, estimator, typical_m * 10.0 ** rng.normal(0.0, 0.1))


SUITE = BenchmarkResults("suite", tuple(make_suite()))
SMALL = BenchmarkResults("small", tuple(make_rows(("room-v0", "hall-v0"), 4)))


def known_quartiles(metric: Metric, rows: Sequence[Row]) -> Quartiles:
    """Return the quartiles of runs of which at least one has the metric."""
    quartiles = metric_quartiles(metric, rows)
    assert quartiles is not None
    return quartiles


@pytest.fixture(scope="module")
def large() -> str:
    """Return the page of a benchmark of 360 runs."""
    return benchmark_page(BenchmarkResults("large", tuple(make_rows([f"scenario-{i}-v0" for i in range(12)], 10))))


@pytest.fixture(scope="module")
def large_file(large: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the same page as a file."""
    path = tmp_path_factory.mktemp("large") / "report.html"
    path.write_text(large, encoding="utf-8")
    return path


@settings(deadline=None)
@given(st.lists(st.floats(0.0, 1e6), min_size=1, max_size=30), st.sampled_from((0.25, 0.5, 0.75)))
def test_quantiles_of_finite_values_agree_with_numpy(values: list[float], share: float) -> None:
    assert quantile(sorted(values), share) == pytest.approx(np.quantile(values, share), rel=1e-12, abs=1e-12)


@settings(deadline=None)
@given(st.lists(st.floats(1e-3, 1e3), min_size=1, max_size=20), st.integers(0, 19), st.sampled_from((ATE, COVERAGE)))
def test_a_failed_run_never_improves_the_quartiles(values: list[float], index: int, metric: Metric) -> None:
    columns: list[dict[str, Any]] = [{metric.name: value} for value in values]
    rows = [changed(scored("s", seed, "vio", 1.0), **column) for seed, column in enumerate(columns)]
    with_failure = list(rows)
    with_failure[index % len(rows)] = failed("s", index % len(rows), "vio")
    before, after = known_quartiles(metric, rows), known_quartiles(metric, with_failure)
    for name in ("median", "lower", "upper"):
        assert metric.ranking_key(getattr(after, name)) >= metric.ranking_key(getattr(before, name))
    assert (before.failed, after.failed) == (0, 1)


def test_a_median_that_falls_on_a_failed_run_is_failed() -> None:
    rows = [scored("s", 0, "vio", 0.1), failed("s", 1, "vio"), failed("s", 2, "vio")]
    found = known_quartiles(ATE, rows)
    assert (found.median, found.runs, found.failed) == (math.inf, 3, 2)
    assert ATE.compared_text(found.median) == "failed"
    assert COVERAGE.compared_text(known_quartiles(COVERAGE, rows).median) == "failed"
    assert known_quartiles(COST, rows).median == 20.0  # a failed run has no cost per frame


def test_the_best_is_the_smallest_largest_or_nearest_to_three() -> None:
    rows = (
        scored("s", 0, "a", 0.1, coverage_percent=90.0, nees_position=0.2),
        scored("s", 0, "b", 0.2, coverage_percent=99.0, nees_position=4.0),
        failed("s", 0, "c"),
    )
    benchmark = BenchmarkResults("b", rows)
    assert benchmark.best(ATE) == {"a"}
    assert benchmark.best(COVERAGE) == {"b"}
    assert benchmark.best(NEES) == {"b"}
    assert benchmark.wins(ATE) == {"a": 1}
    tie = (*rows, scored("s", 0, "d", 0.1))
    assert BenchmarkResults("b", tie).best(ATE) == {"a", "d"}
    assert BenchmarkResults("b", tie[::3]).best(ATE) == frozenset()  # all are equal
    assert BenchmarkResults("b", rows[:1]).best(ATE) == frozenset()  # one estimator has no competitor
    assert BenchmarkResults("b", (failed("s", 0, "a"), failed("s", 0, "b"))).best(ATE) == frozenset()


def test_estimators_without_covariances_have_no_consistency() -> None:
    rows = (scored("s", 0, "mine", 0.1), failed("t", 0, "mine"), scored("s", 0, "vio", 0.1), failed("t", 0, "vio"))
    benchmark = BenchmarkResults("b", rows)
    assert benchmark.estimators_with(NEES) == ("vio",)
    assert benchmark.quartiles(NEES, "mine", "t") is None
    quartiles = benchmark.quartiles(NEES, "vio", "t")
    assert quartiles is not None and quartiles.median == math.inf


def test_numbers_and_seeds_are_written_briefly() -> None:
    values = (0.0, 0.04567, 1.0, 12.34, 99.99, 1234.5, 3.2e-6)
    assert [significant(v) for v in values] == ["0", "0.0457", "1.00", "12.3", "100", "1234", "3.20e-06"]
    assert seed_ranges((0, 1, 2, 5, 7, 8)) == "0–2, 5, 7–8"
    assert seed_ranges((None,)) == "–"
    assert value_of(METRICS["scale_error_percent"], scored("s", 0, "vio", 1.0, scale_error_percent=-0.5)) == 0.5
    with pytest.raises(ConfigError, match="'speed'"):
        metric_named("speed")


def test_failures_are_grouped_by_reason() -> None:
    rows = [failed("s", seed, "vio") for seed in (3, 1, 2)] + [failed("s", 5, "vio", "timeout", "not done after 9 s")]
    table = failure_table(BenchmarkResults("b", tuple(rows)))
    assert [[cell.text for cell in row] for row in table.rows] == [
        ["vio", "s", "signal 11", "3", "1–3"],
        ["vio", "s", "not done after 9 s", "1", "5"],
    ]
    assert [row[2].warning for row in table.rows] == ["crashed", "timeout"]


def test_the_best_estimator_has_the_first_column() -> None:
    assert SUITE.ranking == ("vio-stereo", "vio", "openvins-stereo", "eqvio", "dead-reckoning")
    assert SUITE.estimators == tuple(sorted(SUITE.ranking))  # colours do not depend on the results
    assert measure_table(SUITE, ATE).columns == ("scenario", *SUITE.ranking)
    rows = (
        *(failed("s", seed, "a") for seed in range(3)),
        *(failed("s", seed, "b") for seed in range(2)),
        scored("s", 2, "b", 0.1),
        *(scored("s", seed, "c", 9.0) for seed in range(3)),
        changed(scored("s", 0, "d", 0.1), ate_m=None),
    )
    assert BenchmarkResults("b", rows).ranking == ("c", "b", "a", "d")


def test_a_failed_median_is_not_called_failed_twice() -> None:
    rows = [failed("s", 0, "vio"), failed("s", 1, "vio"), *(failed("t", seed, "vio") for seed in range(3))]
    rows += [scored("t", seed, "vio", 0.1) for seed in (3, 4)] + [failed("u", 0, "vio"), scored("u", 1, "vio", 0.1)]
    rows += [scored("u", 2, "vio", 0.1)]
    cells = [row[1] for row in measure_table(BenchmarkResults("b", tuple(rows)), ATE).rows]
    assert [(cell.text, cell.detail, cell.warning) for cell in cells] == [
        ("failed", "", "2 of 2 runs"),
        ("failed", "(0.100–failed)", "3 of 5 runs"),
        ("0.100", "(0.100–failed)", "1 of 3 failed"),
    ]


def test_the_card_of_a_failed_estimator_has_no_unit(read_page: "ReadPage") -> None:
    rows = (failed("s", 0, "mine"), scored("s", 0, "vio", 0.1))
    text = " ".join("".join(read_page(benchmark_page(BenchmarkResults("b", rows))).text).split())
    assert "mine failed median ATE" in text.replace("minefailed", "mine failed")
    assert "failed m " not in text


def test_csv_holds_the_quartiles_of_the_runs() -> None:
    lines = list(csv.DictReader(io.StringIO(as_csv(SMALL, SMALL.measures))))
    assert {line["measure"] for line in lines} <= set(METRICS)
    (line,) = (
        r for r in lines if (r["scenario"], r["estimator"], r["measure"]) == ("hall-v0", "dead-reckoning", "ate_m")
    )
    runs = [row for row in SMALL.rows if (row.scenario, row.estimator) == ("hall-v0", "dead-reckoning")]
    values = [row["ate_m"] for row in runs if row["ate_m"] is not None]
    assert len(values) == 4
    quartiles = [float(line[name]) for name in ("lower_quartile", "median", "upper_quartile")]
    assert quartiles == pytest.approx(np.quantile(values, (0.25, 0.5, 0.75)), rel=1e-14)
    assert (line["runs"], line["failed"], line["unit"]) == ("4", "0", "m")


def test_markdown_and_latex_have_every_measure_and_failure() -> None:
    chosen = (ATE, COVERAGE)
    markdown, latex = as_markdown(SMALL, chosen), as_latex(SMALL, chosen)
    assert re.findall(r"^\*\*(.*)\*\*$", markdown, re.MULTILINE) == [
        r"ATE, position \[m\]",
        r"Coverage \[% of frames after 3 s\]",
        "Failed runs",
    ]
    assert markdown.count("\n| room-v0 |") == 2
    assert latex.count(r"\begin{tabular}{lrrr}") == latex.count(r"\midrule" + "\n" + "all scenarios") == 2
    assert "signal 11" in latex


def test_the_page_shows_the_summary_and_all_sections(read_page: "ReadPage") -> None:
    page = read_page(benchmark_page(SMALL))
    text = " ".join("".join(page.text).split())
    crashed = sum(row.status != "ok" for row in SMALL.rows)
    assert crashed > 0
    assert f"24 runs, 2 scenarios × 3 estimators × 4 seeds: {24 - crashed} with scores, {crashed} crashed." in text
    vio = SMALL.quartiles(ATE, "vio")
    assert vio is not None
    assert f"vio{ATE.compared_text(vio.median)} m" in text
    assert f"{vio.runs - vio.failed} of {vio.runs} runs with scores" in text
    for heading in (
        "Results by scenario",
        "All runs",
        "by sub-trajectory length",
        "Consistency",
        "Processor time",
        "Failed runs",
    ):
        assert heading in text
    assert "signal 11" in text
    assert "dronevio 1, numpy 2" in text
    assert "a81c" in text


def test_the_page_is_self_contained(large: str, read_page: "ReadPage") -> None:
    page = read_page(large)
    assert all(link.startswith("#") for link in page.links)
    assert page.tags.count("script") == 1
    assert not {"link", "iframe", "object", "img"} & set(page.tags)
    assert not re.search(r"url\((?!#)|@import", large)
    assert "http" not in re.sub(r'"http://www\.w3\.org/(2000/svg|1999/xlink)"', "", large)  # XML namespaces
    assert page.alts and all(page.alts)
    assert len(large.encode()) < 2e6


def test_every_run_is_a_dot_of_the_plot_and_a_row_of_the_list(large: str, read_page: "ReadPage") -> None:
    text = "".join(read_page(large).text)
    assert "List of 360 runs" in text
    ate = large.split('<svg role="img" aria-label="ATE')[1].partition("</svg>")[0]
    assert ate.count("<use") - ate.count("tick") >= 360
    listed = large.split("List of 360 runs</summary>")[1].partition("</details>")[0]
    assert listed.count("<tr>") == 361


def test_names_and_reasons_are_shown_as_text(read_page: "ReadPage") -> None:
    rows = (
        scored(HOSTILE, 0, HOSTILE, 0.1),
        scored(HOSTILE, 0, "--><svg onload=alert(1)>", 0.2),
        scored(f"another {HOSTILE}", 0, HOSTILE, 0.2),
        changed(failed(HOSTILE, 1, HOSTILE, reason=HOSTILE), config_hash=HOSTILE, versions=HOSTILE, world=HOSTILE),
    )
    html = benchmark_page(BenchmarkResults(HOSTILE, rows))
    page = read_page(html)
    text = "".join(page.text)
    assert page.tags.count("script") == 1
    assert "onload" not in re.sub(r">[^<]*<|(?:aria-label|data-heading)=\"[^\"]*\"", "", html)
    assert text.count(HOSTILE) > 10


def test_the_page_does_not_depend_on_the_order_of_the_rows(tmp_path: Path) -> None:
    for name, rows in (("a", SMALL.rows), ("b", SMALL.rows[::-1])):
        (tmp_path / name / "small").mkdir(parents=True)
        write_rows(tmp_path / name / "small" / "results.parquet", rows)
    a, b = (read_benchmark(tmp_path / name / "small") for name in "ab")
    assert a.title == b.title == "small"
    assert benchmark_page(a) == benchmark_page(b)


@pytest.mark.parametrize(
    "rows",
    [
        (failed("s", 0, "vio"),),
        (failed("s", None, "vio"), failed("t", None, "vio")),
        (scored("s", None, "vio", 0.1),),
        (scored("s", 0, "vio", 0.0, cpu_ms_mean=0.0, nees_position=0.0),),
        (scored("s", 0, "vio", math.nan, cpu_ms_mean=None, nees_position=math.inf, sub_trajectory_m=()),),
        (changed(BASE, ate_m=0.1),),
        (
            scored(
                "s",
                0,
                "vio",
                0.1,
                sub_trajectory_m=(1.0, 0.0),
                sub_trajectory_rpe_m=(0.1,),
                sub_trajectory_rpe_deg=(),
                path_m=None,
            ),
        ),
    ],
)
def test_benchmarks_of_few_values_have_a_page_and_tables(rows: tuple[Row, ...], read_page: "ReadPage") -> None:
    benchmark = BenchmarkResults("little", rows)
    text = " ".join("".join(read_page(benchmark_page(benchmark)).text).split())
    assert "little" in text and "dronevio 1, numpy 2" in text
    markdown = as_markdown(benchmark, benchmark.measures)
    latex = as_latex(benchmark, benchmark.measures)
    failures = any(row.status != "ok" for row in rows)
    assert ("**Failed runs**" in markdown) == failures
    assert latex.count(r"\begin{tabular}") == latex.count(r"\end{tabular}") == len(benchmark.measures) + failures


def test_the_page_of_ten_thousand_runs_omits_their_list(read_page: "ReadPage") -> None:
    rows = tuple(scored("s", seed, "vio", 0.1 + 1e-4 * seed, sub_trajectory_m=()) for seed in range(10_000))
    html = benchmark_page(BenchmarkResults("many", rows))
    assert "The list of 10000 runs is omitted" in "".join(read_page(html).text)
    assert len(html) < 5e5


def test_a_folder_without_results_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError):
        read_benchmark(tmp_path)
    write_rows(tmp_path / "results.parquet", [])
    with pytest.raises(InputError, match="no runs"):
        read_benchmark(tmp_path)


def test_the_page_in_a_browser_is_sorted_by_clicks(large_file: Path, browser: Browser) -> None:
    assert browser.faults(large_file.as_uri()) == []
    rows = "[...document.querySelector('table.sortable').tBodies[0].rows]"
    order = f"{rows}.map(x => Math.min(1e9, Number(x.cells[1].dataset.order)))"  # of a failed median, it is infinite
    assert browser.evaluate(f"{rows}[0].cells[0].textContent") == "scenario-0-v0"
    browser.evaluate("document.querySelectorAll('table.sortable button')[1].click()")
    ascending = browser.evaluate(order)
    browser.evaluate("document.querySelectorAll('table.sortable button')[1].click()")
    assert len(ascending) == 12
    assert ascending == sorted(ascending) == browser.evaluate(order)[::-1]


@pytest.mark.slow
def test_five_estimators_are_shown_without_scrolling(tmp_path: Path, browser: Browser) -> None:
    path = tmp_path / "report.html"
    path.write_text(benchmark_page(SUITE), encoding="utf-8")
    assert browser.faults(path.as_uri()) == []
    browser.open(path.as_uri())
    cells = "[...document.querySelector('table.sortable').rows[1].cells].map(x => x.getBoundingClientRect().right)"
    for width_px in WIDTHS_PX:
        browser.show(width_px)
        overflows = "[...document.querySelectorAll('details[open] .wide')].map(x => x.scrollWidth - x.clientWidth)"
        assert browser.evaluate(overflows) == [0, 0, 0]  # of the position error, the drift and the settings
        right = browser.evaluate(cells)
        assert len(right) == 6 and max(right) <= width_px
        shown = browser.evaluate("document.querySelector('table.sortable').rows[1].innerText")
        assert "failed" in shown and "2 of 2 runs" in shown
