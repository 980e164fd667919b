"""Comparisons of benchmarks: symmetry, significance, and gates against worse errors, failures and coverage."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
import scipy.stats
from hypothesis import given, settings
from hypothesis import strategies as st

from dronevio.eval.benchmark.rows import Row
from dronevio.eval.compare import Ratio, compare, gate, metric_ratio, pair_runs
from dronevio.models.errors import ConfigError, EvaluationError
from tests.rows import changed, row_of

FAILED = None

errors = st.one_of(st.none(), st.floats(1e-4, 1e3))
pairs_of_errors = st.lists(st.tuples(errors, errors), min_size=1, max_size=12)


def rows(values: Sequence[float | None], estimator: str = "vio", **others: Any) -> list[Row]:
    """Return a run for each error, with seeds from 0 on; None is the error of a failed run."""
    made = []
    for seed, value in enumerate(values):
        row = row_of(
            "room-v0", "room", seed, estimator, "c", "v", "ok", ate_m=value, rpe_m=value, coverage_percent=100.0
        )
        if value is FAILED:
            row = row_of("room-v0", "room", seed, estimator, "c", "v", "crashed", reason="killed by SIGSEGV")
        made.append(changed(row, **others))
    return made


def ratio(first: Sequence[float | None], second: Sequence[float | None]) -> Ratio:
    """Return the ratio of the position errors of two benchmarks."""
    return metric_ratio("ate_m", pair_runs(rows(first), rows(second)))


def passes(first: Sequence[float | None], second: Sequence[float | None], limit: float = 5.0) -> bool:
    """Return whether the second benchmark passes a gate against the first."""
    return gate(pair_runs(rows(first), rows(second)), limit).passed


@given(st.lists(errors, min_size=1, max_size=12), st.floats(0.0, 50.0))
@settings(max_examples=30, deadline=None)
def test_a_benchmark_passes_against_itself(values: list[float | None], limit: float) -> None:
    result = gate(pair_runs(rows(values), rows(values)), limit)
    assert result.passed
    for found in result.comparisons[0].ratios:
        assert (found.median, found.low, found.high, found.p) == (1.0, 1.0, 1.0, 1.0)
        assert found.conclusion.endswith("is the same")


@given(st.lists(st.floats(1e-4, 1e3), min_size=1, max_size=12))
@settings(max_examples=30, deadline=None)
def test_ten_percent_worse_fails_and_ten_percent_better_passes(values: list[float]) -> None:
    worse = [1.1 * value for value in values]
    assert not passes(values, worse)
    assert passes(values, worse, limit=11.0)
    assert passes(worse, values)
    assert ratio(values, worse).median == pytest.approx(1.1)
    assert ratio(values, worse).low == pytest.approx(1.1)


@given(pairs_of_errors)
@settings(max_examples=60, deadline=None)
def test_swapping_the_two_gives_the_reciprocal(pairs: list[tuple[float | None, float | None]]) -> None:
    first, second = zip(*pairs, strict=True)
    there, back = ratio(first, second), ratio(second, first)

    def reciprocal(value: float) -> float:
        return math.inf if value == 0.0 else 1.0 / value

    assert back.median == pytest.approx(reciprocal(there.median), rel=1e-12)
    assert (back.low, back.high) == pytest.approx((reciprocal(there.high), reciprocal(there.low)), rel=1e-12)
    assert back.geometric_mean == pytest.approx(reciprocal(there.geometric_mean), rel=1e-12)
    assert back.p == pytest.approx(there.p, rel=1e-12)
    assert there.low <= there.median <= there.high
    assert 0.0 < there.p <= 1.0


@given(pairs_of_errors, st.integers(0, 11))
@settings(max_examples=40, deadline=None)
def test_a_failed_run_never_helps_to_pass(pairs: list[tuple[float | None, float | None]], index: int) -> None:
    first, second = (list(values) for values in zip(*pairs, strict=True))
    before = gate(pair_runs(rows(first), rows(second)), 5.0)
    second[index % len(second)] = FAILED
    after = gate(pair_runs(rows(first), rows(second)), 5.0)
    assert after.comparisons[0].pairs == len(pairs)
    assert after.comparisons[0].ratios[0].median >= before.comparisons[0].ratios[0].median
    assert before.passed or not after.passed


@pytest.mark.parametrize("count", [1, 2, 3, 10, 19])
def test_one_failed_run_of_few_violates_the_gate(count: int) -> None:
    first = [0.1] * count
    result = gate(pair_runs(rows(first), rows([FAILED, *first[1:]])), 5.0)
    assert not result.passed
    assert any(f"1 of {count} runs failed, 0 before" in text for text in result.violations)
    assert result.comparisons[0].newly_failed == ("room-v0, seed 0, vio: crashed, killed by SIGSEGV",)
    assert passes([FAILED, *first[1:]], first)


def test_one_failed_run_of_a_hundred_is_one_percent() -> None:
    first, second = [0.1] * 100, [FAILED, *[0.1] * 99]
    assert passes(first, second)
    assert not passes(first, second, limit=0.5)


def test_a_failed_run_is_worse_than_any_error() -> None:
    assert ratio([0.1], [FAILED]).median == math.inf
    assert ratio([FAILED], [1e9]).median == 0.0
    assert ratio([FAILED], [FAILED]).median == 1.0
    assert ratio([0.0], [0.0]).median == 1.0
    assert ratio([0.0], [1e-9]).median == math.inf


@pytest.mark.parametrize(
    ("second", "expected"),
    [
        ([0.2, 0.05, 0.4], 4.0 ** (1.0 / 3.0)),
        ([0.1, FAILED, 0.1], math.inf),
        ([0.0, 0.1, 0.1], 0.0),
        ([0.0, FAILED, 1.0], 1.0),
    ],
)
def test_the_geometric_mean_by_hand(second: list[float | None], expected: float) -> None:
    """Ratios of 2, 1/2 and 4; an infinite one; one of zero; both."""
    assert ratio([0.1] * 3, second).geometric_mean == pytest.approx(expected)


def test_a_missing_value_is_the_worst_unless_both_lack_it() -> None:
    first, second = rows([0.1, 0.1, 0.1]), rows([0.1, 0.1, 0.1])
    second[0] = changed(second[0], rpe_m=None)
    assert metric_ratio("rpe_m", pair_runs(first, second)).high == math.inf
    first[0] = changed(first[0], rpe_m=None)
    found = metric_ratio("rpe_m", pair_runs(first, second))
    assert (found.pairs, found.missing, found.median) == (2, 1, 1.0)
    with pytest.raises(EvaluationError, match="no run has a value of velocity_m_s"):
        metric_ratio("velocity_m_s", pair_runs(first, second))


def test_the_signed_rank_test_agrees_with_scipy() -> None:
    rng = np.random.default_rng(3)
    first = rng.uniform(0.05, 0.2, 25)
    second = first * rng.lognormal(0.1, 0.2, 25)
    expected = scipy.stats.wilcoxon(np.log(second / first)).pvalue
    assert ratio(first.tolist(), second.tolist()).p == pytest.approx(expected, rel=1e-9)
    tied = np.array([0.1, 0.2, 0.2, 0.0, -0.1, 0.3, 0.3, 0.3])
    expected = scipy.stats.wilcoxon(tied, zero_method="zsplit", method=scipy.stats.PermutationMethod()).pvalue
    assert ratio([1.0] * 8, np.exp(tied).tolist()).p == pytest.approx(expected, rel=1e-9)
    many = rng.normal(0.1, 1.0, 400)
    expected = scipy.stats.wilcoxon(many, method="asymptotic").pvalue
    assert ratio([1.0] * 400, np.exp(many).tolist()).p == pytest.approx(expected, rel=1e-9)
    assert ratio([1.0] * 6, [1.1] * 6).p == 2 / 2**6


def test_the_confidence_interval_covers_the_median() -> None:
    rng, covered, trials = np.random.default_rng(5), 0, 120
    for _ in range(trials):
        logs = rng.normal(0.1, 0.3, 20)
        found = ratio([1.0] * 20, np.exp(logs).tolist())
        covered += found.low <= math.exp(0.1) <= found.high
    assert 0.88 <= covered / trials <= 1.0


def test_the_bootstrap_is_reproducible_by_its_seed() -> None:
    rng = np.random.default_rng(7)
    pairs = pair_runs(rows([1.0] * 9), rows(rng.lognormal(0.0, 0.5, 9).tolist()))
    assert metric_ratio("ate_m", pairs, seed=1) == metric_ratio("ate_m", pairs, seed=1)


def test_conclusions_state_direction_and_significance() -> None:
    rng = np.random.default_rng(11)
    first = rng.uniform(0.05, 0.2, 12).tolist()
    assert "ate_m 20.0 % larger, significantly worse" in ratio(first, [1.2 * v for v in first]).conclusion
    assert "ate_m 20.0 % smaller, significantly better" in ratio(first, [0.8 * v for v in first]).conclusion
    assert "too few for a test of significance" in ratio(first[:5], [1.2 * v for v in first[:5]]).conclusion
    noise = ratio(first, [v * f for v, f in zip(first, rng.permutation([0.8, 1.25] * 6), strict=True)])
    assert "not significant" in noise.conclusion


def test_less_coverage_violates_the_gate_despite_less_error() -> None:
    first, second = rows([0.1] * 4), rows([0.05] * 4, coverage_percent=60.0)
    result = gate(pair_runs(first, second), 5.0)
    assert result.violations == ("vio: mean coverage 60.0 %, 100.0 % before",)


def test_each_estimator_is_compared_separately() -> None:
    first = rows([0.1] * 3) + rows([0.1] * 3, "other")
    second = rows([0.05] * 3) + rows([0.2] * 3, "other")
    result = gate(pair_runs(first, second), 5.0)
    assert [comparison.estimator for comparison in result.comparisons] == ["other", "vio"]
    assert result.violations
    assert all(text.startswith("other:") for text in result.violations)


def test_runs_without_a_partner_are_refused_unless_allowed() -> None:
    first, second = rows([0.1] * 3), rows([0.1] * 5)
    message = r"2 runs without a partner: room-v0, seed 3, vio \(only in the second\).*; expected .*--allow-missing$"
    with pytest.raises(EvaluationError, match=message):
        pair_runs(first, second)
    assert len(pair_runs(first, second, allow_missing=True)) == 3
    with pytest.raises(EvaluationError, match="no run is in both"):
        pair_runs(first, rows([0.1], "other"), allow_missing=True)


def test_signs_are_ignored_and_other_recordings_are_counted() -> None:
    first = rows([0.1], scale_error_percent=-2.0, recording_hash="a")
    second = rows([0.1], scale_error_percent=3.0, recording_hash="b")
    (comparison,) = compare(pair_runs(first, second), ["scale_error_percent"])
    assert comparison.ratios[0].median == pytest.approx(1.5)
    assert comparison.different_recordings == 1


def test_unknown_metrics_and_invalid_limits_are_refused() -> None:
    pairs = pair_runs(rows([0.1]), rows([0.1]))
    with pytest.raises(ConfigError, match="nees_position; expected some of ate_m"):
        compare(pairs, ["nees_position"])
    for limit in (-1.0, math.nan, math.inf):
        with pytest.raises(ConfigError, match="expected zero or more"):
            gate(pairs, limit)
