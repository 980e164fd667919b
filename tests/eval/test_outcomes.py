"""Expected outcomes of flights with faults: error ratios, reported losses and overconfidence, worked out by hand."""

import pytest

from dronevio.benchmark.expectations import EXPECTATIONS
from dronevio.eval.benchmark.outcomes import MAX_SIGMAS, Expectation, verdicts
from dronevio.eval.benchmark.rows import Row
from dronevio.eval.report.benchmark.model import BenchmarkResults
from dronevio.eval.report.benchmark.page import benchmark_page
from dronevio.eval.report.benchmark.tables import outcome_table
from dronevio.sim.scenarios import SUITES
from tests.rows import changed, row_of

CLEAN = row_of("clean", "room", 0, "vio", "c", "v", "ok", ate_m=0.01, longest_loss_s=0.0, tracking_sigmas=1.0)
FAULTY = changed(CLEAN, scenario="faulty")
EXPECTED = {"clean": Expectation("clean", 1.0), "faulty": Expectation("clean", 4.0, 3.0)}


@pytest.mark.parametrize(
    ("faulty", "passed", "outcome"),
    [
        (changed(FAULTY, ate_m=0.04), True, "error 4.0 ×"),
        (changed(FAULTY, ate_m=0.0401), False, "error 4.0 ×"),
        (changed(FAULTY, ate_m=0.5, longest_loss_s=3.0), True, "error 50.0 ×, loss of 3.0 s"),
        (changed(FAULTY, ate_m=0.5, longest_loss_s=3.1), False, "error 50.0 ×, loss of 3.1 s"),
        (changed(FAULTY, ate_m=0.5, longest_loss_s=None), False, "error 50.0 ×"),
        (changed(FAULTY, ate_m=0.03, longest_loss_s=9.0), True, "error 3.0 ×, loss of 9.0 s"),
        (changed(FAULTY, tracking_sigmas=MAX_SIGMAS), True, "error 1.0 ×"),
        (changed(FAULTY, tracking_sigmas=5.06), False, "error 1.0 ×, error of 5.1 σ while tracking"),
        (changed(FAULTY, status="crashed", reason="killed", ate_m=None), False, "crashed, killed"),
    ],
)
def test_verdicts_on_errors_and_losses(faulty: Row, passed: bool, outcome: str) -> None:
    """An error within the ratio passes, a reported loss that ends in time passes, and overconfidence never does."""
    reference, found = verdicts([CLEAN, faulty], EXPECTED)
    assert reference.passed
    assert (found.passed, found.outcome) == (passed, outcome)
    assert found.text.endswith("expected: error ≤ 4 ×, or loss ≤ 3 s")


def test_a_failed_reference_gives_no_error_ratio() -> None:
    """Without the error of the flight without the fault, only a reported loss can pass."""
    lost = changed(FAULTY, longest_loss_s=1.0)
    for others in ([], [changed(CLEAN, status="failed", ate_m=None)], [changed(CLEAN, seed=1)]):
        assert [v.passed for v in verdicts([*others, FAULTY], EXPECTED)][-1] is False
        assert [v.passed for v in verdicts([*others, lost], EXPECTED)][-1] is True
        assert verdicts([*others, FAULTY], EXPECTED)[-1].error_ratio is None


def test_runs_without_faults_or_expectations_are_not_judged() -> None:
    """Benchmarks of other scenarios, or of the flight without faults alone, have no expected outcomes."""
    assert verdicts([CLEAN, changed(CLEAN, scenario="other")], EXPECTED) == ()
    assert [v.row.scenario for v in verdicts([CLEAN, FAULTY, changed(CLEAN, scenario="other")], EXPECTED)] == [
        "clean",
        "faulty",
    ]


def test_every_scenario_of_the_stress_suite_has_an_expectation() -> None:
    """Suite and expected outcomes name the same scenarios, and references are scenarios of the suite."""
    assert set(EXPECTATIONS) == set(SUITES["stress"])
    assert {expectation.reference for expectation in EXPECTATIONS.values()} == {SUITES["stress"][0]}
    ratios = [EXPECTATIONS[f"room-{name}-v0"].max_error_ratio for name in ("noise", "noise-4x", "noise-8x")]
    assert ratios == [2.0, 4.0, 8.0]
    assert EXPECTATIONS["room-dark-2s-v0"].max_loss_s == 4.0


def test_the_page_shows_what_is_not_as_expected() -> None:
    """The table has a row for each flight with what was expected, and the page states how many runs pass."""
    bad = changed(FAULTY, estimator="other", ate_m=0.5)
    results = BenchmarkResults("b", (CLEAN, FAULTY, changed(CLEAN, estimator="other"), bad), EXPECTED)
    table = outcome_table(results)
    assert [row[0].text for row in table.rows] == ["clean", "faulty"]
    other, ours = table.rows[1][3:]
    assert (ours.text, ours.warning) == ("error 1.0 ×", "")
    assert (other.text, other.warning) == ("error 50.0 ×", "not as expected")
    page = benchmark_page(results)
    assert "3 of 4 runs are as expected" in page
    section = page[page.index("<h2>Expected outcomes") :]
    assert 'class="numbers sortable stacked"' in section[: section.index("</section>")]  # readable on narrow pages
    assert "Expected outcomes" not in benchmark_page(BenchmarkResults("b", (CLEAN, FAULTY)))
