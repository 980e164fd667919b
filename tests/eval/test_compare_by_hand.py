"""Comparisons of a few runs, with values worked out by hand."""

import pytest

from dronevio.eval.benchmark.rows import Row
from dronevio.eval.compare import Ratio, compare, gate, metric_ratio, pair_runs
from tests.rows import row_of


def run(seed: int, coverage_percent: float | None, ate_m: float = 0.1) -> Row:
    """Return a run with scores."""
    return row_of("s", "w", seed, "vio", "c", "v", "ok", coverage_percent=coverage_percent, ate_m=ate_m, rpe_m=ate_m)


def ratio_to_one_metre(errors_m: list[float]) -> Ratio:
    """Return the ratio of errors to errors of 1 m."""
    first = [run(number, 100.0, 1.0) for number in range(len(errors_m))]
    second = [run(number, 100.0, ate_m) for number, ate_m in enumerate(errors_m)]
    return metric_ratio("ate_m", pair_runs(first, second))


def failed(seed: int) -> Row:
    """Return a run without scores."""
    return row_of("s", "w", seed, "vio", "c", "v", "timeout", "no end after 9 s")


def test_a_failed_run_has_zero_coverage() -> None:
    """The mean of 90, 100 and 0 %; a completed run with unknown coverage does not count."""
    first = [run(0, 90.0), run(1, 100.0), failed(2), run(3, None)]
    second = [failed(0), failed(1), failed(2), run(3, None)]
    (found,) = compare(pair_runs(first, second))
    assert found.coverage_percent == (190.0 / 3.0, None)
    assert found.failed == (1, 3)
    assert found.newly_failed == tuple(f"s, seed {seed}, vio: timeout, no end after 9 s" for seed in (0, 1))


def test_failed_runs_lower_the_coverage_of_a_gate() -> None:
    """One of four runs fails, which is a quarter of the runs and of the coverage."""
    first = [run(seed, 100.0) for seed in range(4)]
    second = [*first[:3], failed(3)]
    runs, coverage = gate(pair_runs(first, second), 24.0).violations
    assert runs == "vio: 1 of 4 runs failed, 0 before"
    assert coverage == "vio: mean coverage 75.0 %, 100.0 % before"
    assert gate(pair_runs(first, second), 26.0).passed
    assert gate(pair_runs(second, first), 0.0).passed


def test_a_gate_tests_the_median_not_its_interval() -> None:
    """Three of five errors are 20 % larger, two are halved: the median is 1.2, the interval from 0.5 to 1.2."""
    errors_m = [1.2, 1.2, 1.2, 0.5, 0.5]
    found = ratio_to_one_metre(errors_m)
    assert (found.median, found.low, found.high) == pytest.approx((1.2, 0.5, 1.2))
    first = [run(seed, 100.0, 1.0) for seed in range(5)]
    second = [run(seed, 100.0, ate_m) for seed, ate_m in enumerate(errors_m)]
    violations = gate(pair_runs(first, second), 19.0).violations
    assert [text.partition(" (")[0] for text in violations] == ["vio: ate_m 20.0 % larger", "vio: rpe_m 20.0 % larger"]
    assert gate(pair_runs(first, second), 21.0).passed


def test_a_difference_is_significant_below_five_percent_only() -> None:
    """Six ratios on one side are as extreme as 2 of 2⁶ sign patterns; with the smallest on the other side, as 4."""
    five_larger = ratio_to_one_metre([0.99, 1.5, 1.6, 1.7, 1.8, 1.9])
    assert five_larger.p == pytest.approx(1 / 16)
    assert five_larger.low > 1.0
    assert "not significant" in five_larger.conclusion
    six_larger = ratio_to_one_metre([1.01, 1.5, 1.6, 1.7, 1.8, 1.9])
    assert six_larger.p == pytest.approx(1 / 32)
    assert "significantly worse" in six_larger.conclusion
