"""Two benchmarks against each other, run by run: is the second better, worse, or is it chance?

Runs are paired by scenario, seed and estimator. Every error is positive and smaller is better, so a pair is the ratio
of the second to the first. **A failed run never drops out**: its error counts as infinite, so that

====================  ====================  =====
first                 second                ratio
====================  ====================  =====
failed                failed                1
ok                    failed                ∞
failed                ok                    0
====================  ====================  =====

and a run that is ok but does not know a figure which its partner knows counts as failed in that figure. All is computed
on the logarithms of the ratios, so that swapping the two gives the reciprocal of every figure: their median; a
percentile bootstrap of that median over the pairs (Efron and Tibshirani, "An introduction to the bootstrap", 1993,
ch. 13); and the two-sided signed-rank test (Wilcoxon, Biometrics Bulletin 1, 1945), in which infinite ratios share the
highest rank and equal pairs stand on both sides.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dronevio.eval.benchmark.rows import Identity, Row, run_name
from dronevio.models.errors import ConfigError, EvaluationError

Array = npt.NDArray[np.float64]
Pair = tuple[Row, Row]

ERRORS = ("ate_m", "ate_deg", "rpe_m", "rpe_deg", "drift_percent", "scale_error_percent", "velocity_m_s")
"""Columns that are errors: smaller is better, zero is perfect."""
COSTS = ("cpu_ms_mean", "cpu_ms_p99", "wall_s", "peak_mb", "first_s")
"""Columns that are costs: smaller is better."""
DEFAULT_METRICS = ("ate_m", "rpe_m")
"""What is compared where nothing else is asked for."""
_RESAMPLES = 10_000
_AT_ONCE = 2_000_000  # figures that are drawn together: 16 MB
_CONFIDENCE = 0.95
_CHANCE = 0.05  # a p-value below is called a difference
_FEWEST_FOR_NORMAL = 50  # pairs, beyond which the sum of ranks is normal to three digits of p
_FEWEST_FOR_A_TEST = 6  # five pairs cannot give p < 0.05, however clear they are: 2 / 2⁵


@dataclass(frozen=True)
class Ratio:
    """How much larger a figure is in the second benchmark than in the first: 1 is equal, 1.1 is 10 % larger."""

    metric: str
    """Which column."""
    pairs: int
    """How many pairs were compared."""
    unknown: int
    """How many pairs were left out, because neither of the two runs that are ok knows the figure."""
    median: float
    """The median ratio; 0 to ∞."""
    low: float
    """Lower end of the 95 % confidence interval of the median."""
    high: float
    """Its upper end."""
    p: float
    """How likely so clear a difference is by chance, if there is none: Wilcoxon, two-sided."""

    @property
    def verdict(self) -> str:
        """What that means, in words."""
        figure = f"{self.metric} {_change(self.median)}"
        if self.low == self.high == 1.0 and self.p == 1.0:
            return f"{self.metric} is the same"
        if self.pairs < _FEWEST_FOR_A_TEST:
            return f"{figure}, but {self.pairs} pairs are too few to tell it from chance"
        if self.p >= _CHANCE or self.low <= 1.0 <= self.high:
            return f"{figure}, no clear difference (p = {self.p:.2g})"
        return f"{figure}, clearly {'worse' if self.median > 1.0 else 'better'} (p = {self.p:.2g})"


@dataclass(frozen=True)
class Comparison:
    """Two estimators, or two versions of one, on the same flights."""

    estimator: str
    """Who was compared."""
    pairs: int
    """How many pairs there are."""
    ratios: tuple[Ratio, ...]
    """What became of each metric that is known at all."""
    failed: tuple[int, int]
    """How many runs failed in the first and in the second benchmark."""
    newly_failed: tuple[str, ...]
    """Runs that were ok in the first and failed in the second, each with why."""
    coverage_percent: tuple[float | None, float | None]
    """Mean coverage, a failed run covering nothing [%]; None where no run knows it."""
    other_recordings: int
    """How many pairs were not run on the same recording."""


@dataclass(frozen=True)
class Verdict:
    """Whether a gate lets a change pass."""

    comparisons: tuple[Comparison, ...]
    """What it was judged by, one for each estimator."""
    objections: tuple[str, ...]
    """Why not, in words; empty where it passes."""

    @property
    def passed(self) -> bool:
        """Whether there is no objection."""
        return not self.objections


def pair_up(first: Iterable[Row], second: Iterable[Row], allow_missing: bool = False) -> list[Pair]:
    """Return the runs of two benchmarks that belong together, sorted by estimator, scenario and seed.

    Args:
        first: Rows, no run twice.
        second: Rows, no run twice.
        allow_missing: Leave out runs that only one of them has.

    Raises:
        EvaluationError: A run has no partner, or none has one.
    """
    a, b = _by_identity(first), _by_identity(second)
    alone = [f"{run_name(i)} (only in the first)" for i in a.keys() - b.keys()]
    alone += [f"{run_name(i)} (only in the second)" for i in b.keys() - a.keys()]
    if alone and not allow_missing:
        shown = "; ".join(sorted(alone)[:3]) + ("; …" if len(alone) > 3 else "")
        raise EvaluationError(f"{len(alone)} runs without a partner: {shown}; expected the same runs in both")
    both = sorted(a.keys() & b.keys(), key=lambda i: (i[2], i[0], -1 if i[1] is None else i[1]))
    if not both:
        raise EvaluationError("no run is in both; expected runs of the same scenario, seed and estimator")
    return [(a[identity], b[identity]) for identity in both]


def compare(pairs: Sequence[Pair], metrics: Sequence[str] = DEFAULT_METRICS, seed: int = 0) -> tuple[Comparison, ...]:
    """Compare two benchmarks, each estimator by itself.

    Args:
        pairs: Runs that belong together.
        metrics: Which of `ERRORS` and `COSTS`.
        seed: Of the bootstrap.

    Raises:
        ConfigError: A metric is none of these.
        EvaluationError: A metric is known of no run of an estimator.
    """
    unknown = [metric for metric in metrics if metric not in (*ERRORS, *COSTS)]
    if unknown or not metrics:
        raise ConfigError(f"metrics {', '.join(unknown) or 'none'}; expected some of {', '.join((*ERRORS, *COSTS))}")
    groups: dict[str, list[Pair]] = {}
    for a, b in pairs:
        name = a.estimator if a.estimator == b.estimator else f"{b.estimator} against {a.estimator}"
        groups.setdefault(name, []).append((a, b))
    return tuple(_compared(name, group, metrics, seed) for name, group in groups.items())


def gate(
    pairs: Sequence[Pair],
    max_regression_percent: float,
    metrics: Sequence[str] = DEFAULT_METRICS,
    seed: int = 0,
) -> Verdict:
    """Judge whether a change may pass: the first of each pair is the baseline, the second what is to be judged.

    It may not where, for any estimator, the median ratio of a metric lies above 1 + the limit; or the share of failed
    runs grew by more than the limit; or the mean coverage fell by more than it. Chance is no excuse: the same scenario
    and seed give the same recording, so what differs does so because of the change.

    Args:
        pairs: Runs that belong together, the baseline first.
        max_regression_percent: The limit [%].
        metrics: Which of `ERRORS` and `COSTS`.
        seed: Of the bootstrap.

    Raises:
        ConfigError: The limit is negative, or a metric does not exist.
        EvaluationError: A metric is known of no run of an estimator.
    """
    if not 0.0 <= max_regression_percent < math.inf:
        raise ConfigError(f"a largest regression of {max_regression_percent:g} %; expected zero or more")
    comparisons = compare(pairs, metrics, seed)
    return Verdict(comparisons, tuple(text for one in comparisons for text in _objections(one, max_regression_percent)))


def ratio_of(metric: str, pairs: Sequence[Pair], seed: int = 0) -> Ratio:
    """Return the ratio of one metric over pairs of runs, with its confidence interval and p-value.

    Raises:
        EvaluationError: The metric is known of no run.
    """
    values = [(_value(a, metric), _value(b, metric)) for a, b in pairs]
    known = [(a, b) for a, b in values if a is not None or b is not None]
    if not known:
        raise EvaluationError(f"{metric} is known of no run; expected a metric that the results have")
    logs = np.array([_log_ratio(*(math.inf if v is None else v for v in pair)) for pair in known])
    low, high = _interval(logs, np.random.default_rng(seed))
    middle = float(_median(logs[None])[0])
    return Ratio(metric, len(known), len(pairs) - len(known), _exp(middle), _exp(low), _exp(high), _wilcoxon_p(logs))


def _compared(name: str, pairs: Sequence[Pair], metrics: Sequence[str], seed: int) -> Comparison:
    new = [b for a, b in pairs if a.status == "ok" and b.status != "ok"]
    return Comparison(
        name,
        len(pairs),
        tuple(ratio_of(metric, pairs, seed) for metric in metrics),
        (sum(a.status != "ok" for a, _ in pairs), sum(b.status != "ok" for _, b in pairs)),
        tuple(f"{run_name(row.identity)}: {row.status}, {row.reason}" for row in new),
        (_coverage([a for a, _ in pairs]), _coverage([b for _, b in pairs])),
        sum(a.recording != b.recording for a, b in pairs),
    )


def _objections(one: Comparison, limit_percent: float) -> list[str]:
    """Return why a change may not pass, as far as one estimator goes."""
    limit, found = limit_percent / 100.0, []
    for ratio in one.ratios:
        if ratio.median > 1.0 + limit:
            interval = f"95 % confidence: {_times(ratio.low)} to {_times(ratio.high)}"
            found.append(f"{one.estimator}: {ratio.metric} {_change(ratio.median)} ({interval}; p = {ratio.p:.2g})")
    before, after = one.failed
    if (after - before) / one.pairs > limit:
        found.append(f"{one.estimator}: {after} of {one.pairs} runs failed, {before} before")
    covered, covers = one.coverage_percent
    if covered is not None and covered - (covers or 0.0) > limit_percent:
        found.append(f"{one.estimator}: mean coverage {covers or 0.0:.1f} %, {covered:.1f} % before")
    return found


def _by_identity(rows: Iterable[Row]) -> dict[Identity, Row]:
    return {row.identity: row for row in rows}


def _value(row: Row, metric: str) -> float | None:
    """Return the size of a run's error: infinite for a failed run, None where it is not known."""
    if row.status != "ok":
        return math.inf
    value = getattr(row, metric)
    return None if value is None or math.isnan(value) else abs(value)


def _log_ratio(a: float, b: float) -> float:
    """Return log(b / a), with ∞ / ∞ = 0 / 0 = 1."""
    if a == b:
        return 0.0
    if a == 0.0 or b == math.inf:
        return math.inf
    return -math.inf if b == 0.0 or a == math.inf else math.log(b) - math.log(a)


def _median(logs: Array) -> Array:
    """Return the median of each row (M, N); between -∞ and ∞, 0."""
    middle = ((logs.shape[1] - 1) // 2, logs.shape[1] // 2)
    below, above = np.partition(logs, middle, axis=1)[:, middle].T
    opposite = np.isinf(below) & np.isinf(above) & (below != above)
    return np.where(opposite, 0.0, 0.5 * np.where(opposite, 0.0, below) + 0.5 * np.where(opposite, 0.0, above))


def _interval(logs: Array, rng: np.random.Generator) -> tuple[float, float]:
    """Return the percentile bootstrap's confidence interval of the median of (N,) logarithms."""
    n, rows = len(logs), max(1, _AT_ONCE // len(logs))
    counts = [rows] * (_RESAMPLES // rows) + [_RESAMPLES % rows]
    medians = np.sort(np.concatenate([_median(logs[rng.integers(n, size=(count, n))]) for count in counts]))
    cut = int((1.0 - _CONFIDENCE) / 2.0 * _RESAMPLES)  # as many off either end, so that swapping mirrors them
    return float(medians[cut]), float(medians[-1 - cut])


def _wilcoxon_p(logs: Array) -> float:
    """Return the two-sided p-value of the signed-rank test; 1 where all pairs are equal.

    Exact up to fifty pairs, ties and equal pairs or not (scipy is exact only without them): every way to give the ranks
    signs is equally likely, so the distribution of their sum is a product of two-pointed ones.
    """
    from scipy.stats import norm, rankdata

    if not np.any(logs):
        return 1.0
    finite = np.abs(logs[np.isfinite(logs)])
    worst = (float(finite.max()) if len(finite) else 0.0) + 1.0
    # Ties in the last digits of a logarithm are ties: 1.1 / 1 and 2.2 / 2 are one ratio.
    differences = np.round(np.clip(logs, -worst, worst), 12)
    ranks = rankdata(np.abs(differences)) * np.sign(differences)
    if len(ranks) > _FEWEST_FOR_NORMAL:
        return float(2.0 * norm.sf(abs(ranks.sum()) / math.sqrt(ranks @ ranks))) if np.any(ranks) else 1.0
    doubled = np.round(2.0 * np.abs(ranks)).astype(np.int64)  # ties have half ranks
    likely = np.ones(1)
    for rank in doubled:
        likely = 0.5 * (np.pad(likely, (0, 2 * rank)) + np.pad(likely, (2 * rank, 0)))
    sums = np.arange(-doubled.sum(), doubled.sum() + 1)
    return float(min(1.0, likely[np.abs(sums) >= abs(round(2.0 * float(ranks.sum())))].sum()))


def _coverage(rows: Sequence[Row]) -> float | None:
    """Return the mean coverage, of failed runs zero; None where no run that is ok knows it."""
    known = [row.coverage_percent for row in rows if row.status == "ok" and row.coverage_percent is not None]
    failed = sum(row.status != "ok" for row in rows)
    return sum(known) / (len(known) + failed) if known else None


def _exp(value: float) -> float:
    return math.exp(value) if value < 700.0 else math.inf


def _change(ratio: float) -> str:
    """Return a ratio in words."""
    if ratio in (0.0, math.inf):
        return "failed where it was known" if ratio else "is known where it failed"
    percent = 100.0 * (ratio - 1.0)
    return "did not change" if percent == 0.0 else f"{abs(percent):.1f} % {'larger' if percent > 0.0 else 'smaller'}"


def _times(ratio: float) -> str:
    return "∞" if ratio == math.inf else f"×{ratio:.3f}"
