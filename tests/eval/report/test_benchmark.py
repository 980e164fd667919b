import csv
import io
import math
import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dronevio.eval.benchmark.rows import Row, write_rows
from dronevio.eval.benchmark.summary import quantile
from dronevio.eval.report.benchmark.model import (
    MEASURES,
    BenchmarkResults,
    find_measure,
    measure_quartiles,
    read_benchmark,
    seed_ranges,
    significant,
)
from dronevio.eval.report.benchmark.page import benchmark_page
from dronevio.eval.report.benchmark.tables import as_csv, as_latex, as_markdown, failure_table
from dronevio.models.errors import ConfigError, InputError

ATE, COVERAGE, COST, NEES = map(find_measure, ("ate_m", "coverage_percent", "cpu_ms_mean", "nees_position"))
BASE = Row("room-v0", "room", 0, "vio", "a81c", "dronevio 1, numpy 2", "ok", recording_hash="r0", wall_s=30.0)
SHARES = np.array([0.1, 0.2, 0.3, 0.4, 0.5])
HOSTILE = '</td><script>alert("1")</script>$x$ & <b>|'


def scored(scenario, seed, estimator, ate_m, **others):
    lengths = SHARES * 60.0
    values = {
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
    return replace(BASE, scenario=scenario, seed=seed, estimator=estimator, **(values | others))


def failed(scenario, seed, estimator, status="crashed", reason="signal 11"):
    return replace(BASE, scenario=scenario, seed=seed, estimator=estimator, status=status, reason=reason)


def make_rows(scenarios, seeds):
    rng = np.random.default_rng(5)
    for scenario in scenarios:
        for seed in range(seeds):
            for estimator, typical_m in (("vio", 0.05), ("dead-reckoning", 8.0), ("external:mine", 0.06)):
                if estimator != "dead-reckoning" and rng.random() < 0.15:
                    yield failed(scenario, seed, estimator)
                else:
                    yield scored(scenario, seed, estimator, typical_m * 10.0 ** rng.normal(0.0, 0.15))


SMALL = BenchmarkResults("small", tuple(make_rows(("room-v0", "hall-v0"), 4)))


@pytest.fixture(scope="module")
def large():
    return benchmark_page(BenchmarkResults("large", tuple(make_rows([f"scenario-{i}-v0" for i in range(12)], 10))))


@pytest.fixture(scope="module")
def large_file(large, tmp_path_factory):
    path = tmp_path_factory.mktemp("large") / "report.html"
    path.write_text(large, encoding="utf-8")
    return path


@settings(deadline=None)
@given(st.lists(st.floats(0.0, 1e6), min_size=1, max_size=30), st.sampled_from((0.25, 0.5, 0.75)))
def test_quantiles_of_finite_values_are_numpys(values, share):
    assert quantile(sorted(values), share) == pytest.approx(np.quantile(values, share), rel=1e-12, abs=1e-12)


@settings(deadline=None)
@given(st.lists(st.floats(1e-3, 1e3), min_size=1, max_size=20), st.integers(0, 19), st.sampled_from((ATE, COVERAGE)))
def test_failing_never_looks_better(values, which, what):
    rows = [replace(scored("s", seed, "vio", 1.0), **{what.column: v}) for seed, v in enumerate(values)]
    worse = list(rows)
    worse[which % len(rows)] = failed("s", which % len(rows), "vio")
    before, after = measure_quartiles(what, rows), measure_quartiles(what, worse)
    for name in ("median", "lower", "upper"):
        assert what.ranking_key(getattr(after, name)) >= what.ranking_key(getattr(before, name))
    assert (before.failed, after.failed) == (0, 1)


def test_a_median_on_a_failed_run_says_so():
    rows = [scored("s", 0, "vio", 0.1), failed("s", 1, "vio"), failed("s", 2, "vio")]
    found = measure_quartiles(ATE, rows)
    assert (found.median, found.runs, found.failed) == (math.inf, 3, 2)
    assert ATE.text(found.median) == "failed"
    assert COVERAGE.text(measure_quartiles(COVERAGE, rows).median) == "failed"
    assert measure_quartiles(COST, rows).median == 20.0  # a dead process says nothing of what a frame costs


def test_the_best_is_the_smallest_largest_or_nearest_to_three():
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
    draw = (*rows, scored("s", 0, "d", 0.1))
    assert BenchmarkResults("b", draw).best(ATE) == {"a", "d"}
    assert BenchmarkResults("b", draw[::3]).best(ATE) == frozenset()  # all alike
    assert BenchmarkResults("b", rows[:1]).best(ATE) == frozenset()  # nothing to choose between
    assert BenchmarkResults("b", (failed("s", 0, "a"), failed("s", 0, "b"))).best(ATE) == frozenset()


def test_who_never_tells_a_covariance_has_no_consistency_to_fail():
    rows = (scored("s", 0, "mine", 0.1), failed("t", 0, "mine"), scored("s", 0, "vio", 0.1), failed("t", 0, "vio"))
    benchmark = BenchmarkResults("b", rows)
    assert benchmark.estimators_with(NEES) == ("vio",)
    assert benchmark.quartiles(NEES, "mine", "t") is None
    assert benchmark.quartiles(NEES, "vio", "t").median == math.inf


def test_figures_for_people():
    values = (0.0, 0.04567, 1.0, 12.34, 99.99, 1234.5, 3.2e-6)
    assert [significant(v) for v in values] == ["0", "0.0457", "1.00", "12.3", "100", "1234", "3.20e-06"]
    assert seed_ranges((0, 1, 2, 5, 7, 8)) == "0–2, 5, 7–8"
    assert seed_ranges((None,)) == "–"
    assert find_measure("scale_error_percent").of(scored("s", 0, "vio", 1.0, scale_error_percent=-0.5)) == 0.5
    with pytest.raises(ConfigError, match="'speed'"):
        find_measure("speed")


def test_failures_of_one_kind_stand_together():
    rows = [failed("s", seed, "vio") for seed in (3, 1, 2)] + [failed("s", 5, "vio", "timeout", "not done after 9 s")]
    table = failure_table(BenchmarkResults("b", tuple(rows)))
    assert [[cell.text for cell in row] for row in table.rows] == [
        ["vio", "s", "signal 11", "3", "1–3"],
        ["vio", "s", "not done after 9 s", "1", "5"],
    ]
    assert [row[2].warning for row in table.rows] == ["crashed", "timeout"]


def test_csv_holds_the_quartiles_of_the_runs():
    lines = list(csv.DictReader(io.StringIO(as_csv(SMALL, SMALL.measures))))
    assert {line["measure"] for line in lines} <= {m.column for m in MEASURES}
    (line,) = (
        r for r in lines if (r["scenario"], r["estimator"], r["measure"]) == ("hall-v0", "dead-reckoning", "ate_m")
    )
    values = [row.ate_m for row in SMALL.rows if (row.scenario, row.estimator) == ("hall-v0", "dead-reckoning")]
    quartiles = [float(line[name]) for name in ("lower_quartile", "median", "upper_quartile")]
    assert quartiles == pytest.approx(np.quantile(values, (0.25, 0.5, 0.75)), rel=1e-14)
    assert (line["runs"], line["failed"], line["unit"]) == ("4", "0", "m")


def test_markdown_and_latex_have_every_measure_and_failure():
    chosen = (ATE, COVERAGE)
    markdown, latex = as_markdown(SMALL, chosen), as_latex(SMALL, chosen)
    assert re.findall(r"^\*\*(.*)\*\*$", markdown, re.MULTILINE) == [
        r"ATE, position \[m\]",
        r"Coverage \[% of the frames\]",
        "Failed runs",
    ]
    assert markdown.count("\n| room-v0 |") == 2
    assert latex.count(r"\begin{tabular}{lrrr}") == latex.count(r"\midrule" + "\n" + "all scenarios") == 2
    assert "signal 11" in latex


def test_the_page_says_first_how_it_went(read_page):
    page = read_page(benchmark_page(SMALL))
    text = " ".join("".join(page.text).split())
    bad = sum(row.status != "ok" for row in SMALL.rows)
    assert bad > 0
    assert f"24 runs, 2 scenarios × 3 estimators × 4 seeds: {24 - bad} with scores, {bad} crashed." in text
    vio = SMALL.quartiles(ATE, "vio")
    assert f"vio{ATE.text(vio.median)} m" in text
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


def test_the_page_needs_nothing_but_itself(large, read_page):
    page = read_page(large)
    assert all(link.startswith("#") for link in page.links)
    assert page.tags.count("script") == 1
    assert not {"link", "iframe", "object", "img"} & set(page.tags)
    assert not re.search(r"url\((?!#)|@import", large)
    assert "http" not in re.sub(r'"http://www\.w3\.org/(2000/svg|1999/xlink)"', "", large)  # names, not addresses
    assert page.alts and all(page.alts)
    assert len(large.encode()) < 2e6


def test_every_run_is_a_dot_and_a_line(large, read_page):
    text = "".join(read_page(large).text)
    assert "List of 360 runs" in text
    ate = large.split('<svg role="img" aria-label="ATE')[1].partition("</svg>")[0]
    assert ate.count("<use") - ate.count("tick") >= 360
    listed = large.split("List of 360 runs</summary>")[1].partition("</details>")[0]
    assert listed.count("<tr>") == 361


def test_names_and_reasons_from_files_are_text(read_page):
    rows = (
        scored(HOSTILE, 0, HOSTILE, 0.1),
        scored(HOSTILE, 0, "--><svg onload=alert(1)>", 0.2),
        scored(f"another {HOSTILE}", 0, HOSTILE, 0.2),
        replace(failed(HOSTILE, 1, HOSTILE, reason=HOSTILE), config_hash=HOSTILE, versions=HOSTILE, world=HOSTILE),
    )
    html = benchmark_page(BenchmarkResults(HOSTILE, rows))
    page = read_page(html)
    text = "".join(page.text)
    assert page.tags.count("script") == 1
    assert "onload" not in re.sub(r">[^<]*<|aria-label=\"[^\"]*\"", "", html)
    assert text.count(HOSTILE) > 10


def test_same_rows_same_bytes_in_whatever_order(tmp_path):
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
        (replace(BASE, ate_m=0.1),),
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
def test_little_is_shown_as_little(rows, read_page):
    benchmark = BenchmarkResults("little", rows)
    read_page(benchmark_page(benchmark))
    as_markdown(benchmark, benchmark.measures)
    as_latex(benchmark, benchmark.measures)


def test_ten_thousand_runs_are_still_a_page(read_page):
    rows = tuple(scored("s", seed, "vio", 0.1 + 1e-4 * seed, sub_trajectory_m=()) for seed in range(10_000))
    html = benchmark_page(BenchmarkResults("many", rows))
    assert "The list of 10000 runs is omitted" in "".join(read_page(html).text)
    assert len(html) < 5e5


def test_what_is_no_benchmark_is_refused(tmp_path):
    with pytest.raises(InputError):
        read_benchmark(tmp_path)
    write_rows(tmp_path / "results.parquet", [])
    with pytest.raises(InputError, match="no runs"):
        read_benchmark(tmp_path)


@pytest.mark.parametrize("width", [420, 1280])
def test_a_browser_lays_it_out_within_its_width_and_sorts(large_file, browse, width):
    first = "document.querySelector('table.sortable').tBodies[0].rows[0].cells[0].textContent"
    press = "document.querySelectorAll('table.sortable button')[1].click()"
    best = "[...document.querySelector('table.sortable').tBodies[0].rows].map(x => Number(x.cells[1].dataset.order))"
    scroll, client, before, _, order, _, reverse = browse(
        large_file, width, f"[r.scrollWidth, r.clientWidth, {first}, {press}, {best}, {press}, {best}]"
    )
    assert scroll == client <= width
    assert before == "scenario-0-v0"
    assert len(order) == 12
    assert order == sorted(order) == reverse[::-1]
