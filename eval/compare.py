"""Comparison of two benchmarks run by run: whether the second is better, worse, or not significantly different.

Runs are paired by scenario, seed and estimator. All metrics are positive and smaller is better, so that a pair is
described by the ratio of the second value to the first. **A failed run is never left out**: its values count as
infinite, so that

====================  ====================  =====
first                 second                ratio
====================  ====================  =====
failed                failed                1
ok                    failed                ∞
failed                ok                    0
====================  ====================  =====

and a run without a value that its partner has counts as failed in that metric. Statistics are computed on logarithms of
the ratios, so that exchanging the benchmarks gives the reciprocals: the median; a percentile bootstrap of the median
over the pairs (Efron and Tibshirani, "An introduction to the bootstrap", 1993, ch. 13); and the two-sided signed-rank
test (Wilcoxon, Biometrics Bulletin 1, 1945), in which infinite ratios share the highest rank and equal pairs count on
both sides.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from dronevio.eval.benchmark.metrics import METRICS
from dronevio.eval.benchmark.rows import Identity, Row, own_metrics, run_name
from dronevio.eval.benchmark.summary import known_values
from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError, EvaluationError

Pair = tuple[Row, Row]
"""Runs of the first and the second benchmark with the same scenario, seed and estimator."""

_BEST = ("low", "any")  # of errors and costs: smaller is better, and zero is perfect
COMPARABLE = tuple(metric.name for metric in METRICS.values() if metric.best in _BEST)
"""Metrics that are errors or costs, beside those of the user."""
DEFAULT_METRICS = ("ate_m", "rpe_m")
"""Metrics that are compared by default."""
_RESAMPLES = 10_000
_VALUES_PER_BLOCK = 2_000_000  # of the bootstrap, 16 MB
_CONFIDENCE = 0.95
_SIGNIFICANCE = 0.05  # p-value below which a difference is called significant
_MAX_EXACT_PAIRS = 50  # beyond, the normal approximation is accurate to three digits of p
_MIN_PAIRS_FOR_A_TEST = 6  # with five pairs, p is at least 2 / 2⁵ > 0.05


@dataclass(frozen=True)
class Ratio:
    """The ratio of a metric in the second benchmark to that in the first; 1.1 means 10 % larger."""

    metric: str
    """Name of the metric."""
    pairs: int
    """Number of compared pairs."""
    missing: int
    """Number of pairs that were left out because neither of two successful runs has a value."""
    median: float
    """Median ratio, 0 to ∞."""
    low: float
    """Lower end of the 95 % confidence interval of the median."""
    high: float
    """Upper end of the 95 % confidence interval of the median."""
    geometric_mean: float
    """Geometric mean of the ratios, 0 to ∞; 1 if it has both an infinite ratio and one of zero."""
    p: float
    """Two-sided p-value of Wilcoxon's signed-rank test."""
    differing: int
    """Number of compared pairs whose values differ."""

    @property
    def unchanged(self) -> bool:
        """Whether the metric is the same in every pair."""
        return self.differing == 0

    @property
    def conclusion(self) -> str:
        """The conclusion as a sentence."""
        change = f"{self.metric} {_change(self.median)}"
        if self.unchanged:
            return f"{self.metric} is the same"
        if self.pairs < _MIN_PAIRS_FOR_A_TEST:
            return f"{change}, but {self.pairs} pairs are too few for a test of significance"
        if self.p >= _SIGNIFICANCE or self.low <= 1.0 <= self.high:
            return f"{change}, not significant (p = {self.p:.2g})"
        return f"{change}, significantly {'worse' if self.median > 1.0 else 'better'} (p = {self.p:.2g})"


@dataclass(frozen=True)
class Comparison:
    """The comparison of two estimators, or of two versions of one, on the same recordings."""

    estimator: str
    """Label of the estimator, or of both."""
    pairs: int
    """Number of pairs of runs."""
    ratios: tuple[Ratio, ...]
    """Ratios of the compared metrics."""
    failed: tuple[int, int]
    """Numbers of failed runs in the first and in the second benchmark."""
    newly_failed: tuple[str, ...]
    """Names and reasons of runs that succeeded in the first and failed in the second benchmark."""
    coverage_percent: tuple[float | None, float | None]
    """Mean coverage in both benchmarks, in which a failed run counts as zero [%]; None if no run has a coverage."""
    different_recordings: int
    """Number of pairs whose recordings differ."""

    @property
    def failed_in_both(self) -> bool:
        """Whether every run failed in both benchmarks, so that there is nothing to compare."""
        return self.failed == (self.pairs, self.pairs)

    @property
    def other_failures(self) -> bool:
        """Whether a run failed in only one of the benchmarks."""
        return bool(self.newly_failed) or self.failed[0] != self.failed[1]

    @property
    def changed(self) -> bool:
        """Whether a metric, a failure, the coverage or a recording differs between the benchmarks."""
        before, after = self.coverage_percent
        others = self.other_failures or self.different_recordings > 0 or before != after
        return others or not all(ratio.unchanged for ratio in self.ratios)


@dataclass(frozen=True)
class GateResult:
    """Whether a change passes a gate."""

    comparisons: tuple[Comparison, ...]
    """Comparisons with the baseline, one for each estimator."""
    violations: tuple[str, ...]
    """Why the change does not pass, one sentence each; empty if it passes."""

    @property
    def passed(self) -> bool:
        """Whether there are no violations."""
        return not self.violations


def pair_runs(first: Iterable[Row], second: Iterable[Row], allow_missing: bool = False) -> list[Pair]:
    """Return the pairs of runs of two benchmarks, sorted by estimator, scenario and seed.

    Args:
        first: Rows of the first benchmark, without duplicates.
        second: Rows of the second benchmark, without duplicates.
        allow_missing: Whether runs of only one benchmark are left out instead of being an error.

    Raises:
        EvaluationError: A run has no partner, or no run has one.
    """
    a, b = _by_identity(first), _by_identity(second)
    unpaired = [f"{run_name(i)} (only in the first)" for i in a.keys() - b.keys()]
    unpaired += [f"{run_name(i)} (only in the second)" for i in b.keys() - a.keys()]
    if unpaired and not allow_missing:
        shown = "; ".join(sorted(unpaired)[:3]) + ("; …" if len(unpaired) > 3 else "")
        raise EvaluationError(
            f"{len(unpaired)} runs without a partner: {shown}; expected the same runs in both, or --allow-missing"
        )
    both = sorted(a.keys() & b.keys(), key=lambda i: (i[2], i[0], -1 if i[1] is None else i[1]))
    if not both:
        raise EvaluationError("no run is in both; expected runs of the same scenario, seed and estimator")
    return [(a[identity], b[identity]) for identity in both]


def compare(pairs: Sequence[Pair], metrics: Sequence[str] = DEFAULT_METRICS, seed: int = 0) -> tuple[Comparison, ...]:
    """Compare two benchmarks, separately for each estimator.

    Args:
        pairs: Pairs of runs.
        metrics: Names out of `COMPARABLE`, or of metrics of the user.
        seed: Seed of the bootstrap.

    Raises:
        ConfigError: A metric does not exist.
        EvaluationError: No run of an estimator has a value of a metric.
    """
    own = own_metrics(row for pair in pairs for row in pair)
    known = (*COMPARABLE, *(metric.name for metric in own if metric.best in _BEST))
    unknown = [metric for metric in metrics if metric not in known]
    if unknown or not metrics:
        raise ConfigError(f"metrics {', '.join(unknown) or 'none'}; expected some of {', '.join(known)}")
    groups: dict[str, list[Pair]] = {}
    for a, b in pairs:
        name = a.estimator if a.estimator == b.estimator else f"{b.estimator} against {a.estimator}"
        groups.setdefault(name, []).append((a, b))
    return tuple(_comparison(name, group, metrics, seed) for name, group in groups.items())


def gate(
    pairs: Sequence[Pair],
    max_regression_percent: float,
    metrics: Sequence[str] = DEFAULT_METRICS,
    seed: int = 0,
) -> GateResult:
    """Return whether a change passes, given its runs and those of the baseline.

    The change does not pass if, for any estimator, the median ratio of a metric exceeds 1 + the limit, the share of
    failed runs increased by more than the limit, or the mean coverage decreased by more than the limit. Significance is
    not tested: the same scenario and seed give the same recording, so that the change causes all differences.

    Args:
        pairs: Pairs of runs, that of the baseline first.
        max_regression_percent: The limit [%].
        metrics: Names out of `COMPARABLE`.
        seed: Seed of the bootstrap.

    Raises:
        ConfigError: The limit is negative, or a metric does not exist.
        EvaluationError: No run of an estimator has a value of a metric.
    """
    if not 0.0 <= max_regression_percent < math.inf:
        raise ConfigError(f"a largest regression of {max_regression_percent:g} %; expected zero or more")
    comparisons = compare(pairs, metrics, seed)
    violations = tuple(text for one in comparisons for text in _violations(one, max_regression_percent))
    return GateResult(comparisons, violations)


def metric_ratio(metric: str, pairs: Sequence[Pair], seed: int = 0) -> Ratio:
    """Return the ratio of one metric over pairs of runs, with its confidence interval and p-value.

    Raises:
        EvaluationError: No run has a value of the metric.
    """
    values = [(_value(a, metric), _value(b, metric)) for a, b in pairs]
    known = [(a, b) for a, b in values if a is not None or b is not None]
    if not known:
        raise EvaluationError(f"no run has a value of {metric}; expected a metric of the results")
    logs = np.array([_log_ratio(*(math.inf if v is None else v for v in pair)) for pair in known])
    low, high = _confidence_interval(logs, np.random.default_rng(seed))
    median = float(_median(logs[None])[0])
    interval, missing, differing = (_exp(low), _exp(high)), len(pairs) - len(known), int(np.count_nonzero(logs))
    geometric_mean = _exp(0.0 if {-math.inf, math.inf} <= set(logs.tolist()) else float(logs.mean()))
    return Ratio(metric, len(known), missing, _exp(median), *interval, geometric_mean, _wilcoxon_p(logs), differing)


def _comparison(name: str, pairs: Sequence[Pair], metrics: Sequence[str], seed: int) -> Comparison:
    new = [b for a, b in pairs if a.status == "ok" and b.status != "ok"]
    return Comparison(
        name,
        len(pairs),
        tuple(metric_ratio(metric, pairs, seed) for metric in metrics),
        (sum(a.status != "ok" for a, _ in pairs), sum(b.status != "ok" for _, b in pairs)),
        tuple(f"{run_name(row.identity)}: {row.status}, {row.reason}" for row in new),
        (_coverage([a for a, _ in pairs]), _coverage([b for _, b in pairs])),
        sum(a.recording_hash != b.recording_hash for a, b in pairs),
    )


def _violations(one: Comparison, limit_percent: float) -> list[str]:
    """Return why a change does not pass for one estimator."""
    limit, reasons = limit_percent / 100.0, []
    for ratio in one.ratios:
        if ratio.median > 1.0 + limit:
            interval = f"95 % confidence: {_times(ratio.low)} to {_times(ratio.high)}"
            reasons.append(f"{one.estimator}: {ratio.metric} {_change(ratio.median)} ({interval}; p = {ratio.p:.2g})")
    before, after = one.failed
    if (after - before) / one.pairs > limit:
        reasons.append(f"{one.estimator}: {after} of {one.pairs} runs failed, {before} before")
    coverage_before, coverage_after = one.coverage_percent
    if coverage_before is not None and coverage_before - (coverage_after or 0.0) > limit_percent:
        reasons.append(f"{one.estimator}: mean coverage {coverage_after or 0.0:.1f} %, {coverage_before:.1f} % before")
    return reasons


def _by_identity(rows: Iterable[Row]) -> dict[Identity, Row]:
    return {row.identity: row for row in rows}


def _value(row: Row, metric: str) -> float | None:
    """Return the magnitude of a metric of a run: ∞ for a failed run, None if it has no value."""
    if row.status != "ok":
        return math.inf
    value = row[metric]
    return None if value is None or math.isnan(value) else abs(value)


def _log_ratio(a: float, b: float) -> float:
    """Return log(b / a), with ∞ / ∞ = 0 / 0 = 1."""
    if a == b:
        return 0.0
    if a == 0.0 or b == math.inf:
        return math.inf
    return -math.inf if b == 0.0 or a == math.inf else math.log(b) - math.log(a)


def _median(logs: Array) -> Array:
    """Return the median of each row (M, N); it is 0 between −∞ and ∞."""
    middle = ((logs.shape[1] - 1) // 2, logs.shape[1] // 2)
    below, above = np.partition(logs, middle, axis=1)[:, middle].T
    opposite = np.isinf(below) & np.isinf(above) & (below != above)
    return np.where(opposite, 0.0, 0.5 * np.where(opposite, 0.0, below) + 0.5 * np.where(opposite, 0.0, above))


def _confidence_interval(logs: Array, rng: np.random.Generator) -> tuple[float, float]:
    """Return the percentile bootstrap's confidence interval of the median of logarithms (N,)."""
    n, rows = len(logs), max(1, _VALUES_PER_BLOCK // len(logs))
    counts = [rows] * (_RESAMPLES // rows) + [_RESAMPLES % rows]
    medians = np.sort(np.concatenate([_median(logs[rng.integers(n, size=(count, n))]) for count in counts]))
    cut = int((1.0 - _CONFIDENCE) / 2.0 * _RESAMPLES)  # at either end, so that exchanging the benchmarks mirrors them
    return float(medians[cut]), float(medians[-1 - cut])


def _wilcoxon_p(logs: Array) -> float:
    """Return the two-sided p-value of the signed-rank test; 1 if all pairs are equal.

    It is exact for up to fifty pairs, also with ties and equal pairs, for which scipy is not: all assignments of signs
    to the ranks are equally likely, so that the distribution of their sum is a convolution of two-point distributions.
    """
    from scipy.stats import norm, rankdata

    if not np.any(logs):
        return 1.0
    finite = np.abs(logs[np.isfinite(logs)])
    worst = (float(finite.max()) if len(finite) else 0.0) + 1.0
    # Logarithms that differ by rounding are ties: 1.1 / 1 and 2.2 / 2 are the same ratio.
    differences = np.round(np.clip(logs, -worst, worst), 12)
    ranks = rankdata(np.abs(differences)) * np.sign(differences)
    if len(ranks) > _MAX_EXACT_PAIRS:
        return float(2.0 * norm.sf(abs(ranks.sum()) / math.sqrt(ranks @ ranks))) if np.any(ranks) else 1.0
    doubled = np.round(2.0 * np.abs(ranks)).astype(np.int64)  # ties have half-integer ranks
    probabilities = np.ones(1)
    for rank in doubled:
        probabilities = 0.5 * (np.pad(probabilities, (0, 2 * rank)) + np.pad(probabilities, (2 * rank, 0)))
    sums = np.arange(-doubled.sum(), doubled.sum() + 1)
    return float(min(1.0, probabilities[np.abs(sums) >= abs(round(2.0 * float(ranks.sum())))].sum()))


def _coverage(rows: Sequence[Row]) -> float | None:
    """Return the mean coverage, in which failed runs count as zero; None if no successful run has a coverage."""
    known = known_values([row for row in rows if row.status == "ok"], "coverage_percent")
    failed = sum(row.status != "ok" for row in rows)
    return sum(known) / (len(known) + failed) if known else None


def _exp(value: float) -> float:
    return math.exp(value) if value < 700.0 else math.inf


def _change(ratio: float) -> str:
    """Return a ratio in words."""
    if ratio in (0.0, math.inf):
        return "failed and did not before" if ratio else "failed before and does not now"
    percent = 100.0 * (ratio - 1.0)
    return "did not change" if percent == 0.0 else f"{abs(percent):.1f} % {'larger' if percent > 0.0 else 'smaller'}"


def _times(ratio: float) -> str:
    return "∞" if ratio == math.inf else f"×{ratio:.3f}"
