"""``dronevio compare``: statistical comparison of two benchmarks, or of two runs."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from dronevio.cli.options import Printing, PrintOptions
from dronevio.cli.terminal import parse, print_json, print_table
from dronevio.models.errors import ConfigError
from dronevio.models.ranges import Range, Settings

if TYPE_CHECKING:
    from dronevio.eval.compare import Comparison, Pair


@dataclass(frozen=True)
class CompareCommand(Settings):
    """Compare two benchmarks run by run, or two single runs.

    Runs are paired by scenario, seed and estimator. For each metric, the table has the median of the ratios second /
    first, its 95 % confidence interval (bootstrap over the pairs), their geometric mean, and the p-value of Wilcoxon's
    signed-rank test. A failed run counts as an infinite error and is never left out.

    Examples:
      dronevio compare benchmarks/before benchmarks/after
      dronevio compare runs/room-v0-0 runs/room-v0-0-2
      dronevio compare a/results.parquet b/results.parquet --metrics ate_m rpe_m cpu_ms_mean
      dronevio compare benchmarks/room benchmarks/room --estimators dead-reckoning vio
    """

    first: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FIRST")]
    """Folder or results.parquet of a benchmark, or folder of a run: the reference."""
    second: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="SECOND")]
    """Folder or results.parquet of a benchmark, or folder of a run, to compare with the first."""
    metrics: tuple[str, ...] = ()
    """Columns of errors or costs to compare; ate_m and rpe_m by default."""
    estimators: tuple[str, str] | None = None
    """Two estimators: compare the one in the first benchmark with the other in the second. By default, each estimator
    is compared with itself."""
    allow_missing: bool = False
    """Leave out runs that only one of the benchmarks has. By default, such runs are an error."""
    seed: Annotated[int, Range(0, 2**32 - 1)] = 0
    """Seed of the bootstrap."""
    printing: Printing = field(default_factory=PrintOptions)
    """How results are printed."""


def main(arguments: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    command = parse(CompareCommand, arguments, "compare")

    from dronevio.eval.compare import DEFAULT_METRICS, compare

    pairs = read_pairs(command.first, command.second, command.estimators, command.allow_missing)
    comparisons = compare(pairs, command.metrics or DEFAULT_METRICS, command.seed)
    if command.printing.json:
        print_json(document(comparisons))
        return 0
    print_comparisons(f"{command.second} relative to {command.first}", comparisons)
    return 0


def read_pairs(
    first: Path, second: Path, estimators: tuple[str, str] | None = None, allow_missing: bool = False
) -> "list[Pair]":
    """Read the rows of two results and return the pairs of runs to compare.

    Args:
        first: Folder or results.parquet of a benchmark, or folder of a run.
        second: The same of the results to compare with the first.
        estimators: Estimator of the first and of the second; None to pair each estimator with itself.
        allow_missing: Whether runs without a partner are left out.

    Raises:
        InputError: A file cannot be read.
        ConfigError: A result does not have the estimator that is asked for.
        EvaluationError: A run has no partner.
    """
    from dronevio.eval.benchmark.rows import read_results
    from dronevio.eval.compare import pair_runs

    a, b = read_results(first), read_results(second)
    if estimators is None:
        return pair_runs(a, b, allow_missing)
    chosen = []
    for path, rows, name in zip((first, second), (a, b), estimators, strict=True):
        present = {row.estimator: None for row in rows}
        if name not in present:
            raise ConfigError(f"{path}: no estimator {name!r}; expected one of {', '.join(present) or 'none'}")
        chosen.append([row for row in rows if row.estimator == name])
    # Rows are paired by estimator too: the second gets the name of the first for the pairing.
    renamed = pair_runs(chosen[0], [replace(row, estimator=estimators[0]) for row in chosen[1]], allow_missing)
    return [(one, replace(other, estimator=estimators[1])) for one, other in renamed]


def print_comparisons(title: str, comparisons: "Sequence[Comparison]") -> None:
    """Print what changed in words, then the ratios of all metrics, estimators with changes first.

    Estimators of which all runs failed in both benchmarks are left out.
    """
    compared = sorted((one for one in comparisons if not one.failed_in_both), key=lambda one: not one.changed)
    print(title)
    if not compared:
        print("Every run failed in both.")
        return
    for one in compared:
        if one.changed:
            _print_changes(one)
    same = [one.estimator for one in compared if not one.changed]
    if same:
        print(f"the same in both: {', '.join(same)}")
    cells = [
        (
            one.estimator,
            ratio.metric,
            str(ratio.pairs),
            *map(_ratio_text, (ratio.median, ratio.low, ratio.high, ratio.geometric_mean)),
            _p_text(ratio.p),
        )
        for one in compared
        for ratio in one.ratios
    ]
    headings = ("estimator", "metric", "pairs", "ratio", "from", "to", "geometric mean", "p")
    print()
    print_table("", headings, cells, left=("metric",))


def _print_changes(one: "Comparison") -> None:
    """Print the differences of an estimator between two benchmarks as sentences."""
    for ratio in one.ratios:
        if not ratio.unchanged:
            print(f"{one.estimator}: {ratio.conclusion}")
        if ratio.missing:
            print(f"{one.estimator}: {ratio.missing} pairs have no {ratio.metric}")
    if one.other_failures:
        print(f"{one.estimator}: {one.failed[0]} runs failed in the first, {one.failed[1]} in the second")
    for text in one.newly_failed:
        print(f"  newly failed: {text}")
    before, after = one.coverage_percent
    if before != after and before is not None and after is not None:
        print(f"{one.estimator}: mean coverage {before:.1f} % in the first, {after:.1f} % in the second")
    if one.different_recordings:
        print(f"{one.estimator}: {one.different_recordings} of {one.pairs} pairs were run on different recordings")


def document(comparisons: "Sequence[Comparison]") -> dict[str, object]:
    """Return comparisons for JSON, with infinite ratios as text."""
    from dronevio.models.serialization import to_jsonable

    rows = [
        {**asdict(one), "ratios": [{**asdict(ratio), "conclusion": ratio.conclusion} for ratio in one.ratios]}
        for one in comparisons
    ]
    return {"comparisons": to_jsonable(rows)}


def _ratio_text(ratio: float) -> str:
    return "∞" if ratio == float("inf") else f"{ratio:.3f}"


def _p_text(p: float) -> str:
    return f"{p:.3f}" if p >= 0.001 else f"{p:.0e}"
