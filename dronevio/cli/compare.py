"""``dronevio compare``: two benchmarks, or two runs, against each other."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from dronevio.cli.terminal import parse, print_json, print_table
from dronevio.models.errors import ConfigError

if TYPE_CHECKING:
    from dronevio.eval.compare import Comparison, Pair


@dataclass(frozen=True)
class CompareCommand:
    """Compare two benchmarks run by run, or two single runs.

    Runs are paired by scenario, seed and estimator. For each metric it prints the median of the ratios second / first,
    its 95 % confidence interval (bootstrap over the pairs), how likely so clear a difference is by chance (Wilcoxon's
    signed-rank test), and what that means. A failed run counts as infinitely bad: it never drops out.

    Examples:
      dronevio compare benchmarks/before benchmarks/after
      dronevio compare runs/room-v0-0 runs/room-v0-0-2
      dronevio compare a/results.parquet b/results.parquet --metrics ate_m rpe_m cpu_ms_mean
      dronevio compare benchmarks/room benchmarks/room --estimators dead-reckoning vio
    """

    first: Annotated[Path, tyro.conf.Positional]
    """A benchmark's folder or results.parquet, or the folder of a run."""
    second: Annotated[Path, tyro.conf.Positional]
    """What to compare with it."""
    metrics: tuple[str, ...] = ()
    """Columns to compare, errors or costs; ate_m and rpe_m by default."""
    estimators: tuple[str, str] | None = None
    """Compare this estimator of the first with that one of the second, rather than each with itself."""
    allow_missing: bool = False
    """Leave out runs that only one of them has; else they are an error."""
    seed: int = 0
    """Of the bootstrap."""
    json: bool = False
    """Print one JSON document instead of a table."""


def main(arguments: Sequence[str]) -> int:
    """Run the command."""
    command = parse(CompareCommand, arguments, "compare")

    from dronevio.eval.compare import DEFAULT_METRICS, compare

    pairs = paired(command.first, command.second, command.estimators, command.allow_missing)
    comparisons = compare(pairs, command.metrics or DEFAULT_METRICS, command.seed)
    if command.json:
        print_json(document(comparisons))
        return 0
    print_comparisons(f"{command.second} against {command.first}", comparisons)
    return 0


def paired(
    first: Path, second: Path, estimators: tuple[str, str] | None = None, allow_missing: bool = False
) -> "list[Pair]":
    """Read the rows of two results and return those that belong together.

    Raises:
        InputError: A file cannot be read.
        ConfigError: A result does not have the estimator that was asked for.
        EvaluationError: A run has no partner.
    """
    from dronevio.eval.benchmark.rows import read_results
    from dronevio.eval.compare import pair_up

    a, b = read_results(first), read_results(second)
    if estimators is None:
        return pair_up(a, b, allow_missing)
    chosen = []
    for path, rows, name in zip((first, second), (a, b), estimators, strict=True):
        known = {row.estimator: None for row in rows}
        if name not in known:
            raise ConfigError(f"{path}: no estimator {name!r}; expected one of {', '.join(known) or 'none'}")
        chosen.append([row for row in rows if row.estimator == name])
    # Paired as if both were one estimator, and each then given its own row back.
    renamed = pair_up(chosen[0], [replace(row, estimator=estimators[0]) for row in chosen[1]], allow_missing)
    return [(one, replace(other, estimator=estimators[1])) for one, other in renamed]


def print_comparisons(title: str, comparisons: "Sequence[Comparison]") -> None:
    """Print what became of each metric of each estimator, and the verdicts in words."""
    cells = [
        (
            one.estimator,
            ratio.metric,
            str(ratio.pairs),
            *map(_figure, (ratio.median, ratio.low, ratio.high)),
            _p(ratio.p),
        )
        for one in comparisons
        for ratio in one.ratios
    ]
    print_table(title, ("estimator", "metric", "pairs", "ratio", "from", "to", "p"), cells)
    for one in comparisons:
        for ratio in one.ratios:
            print(f"{one.estimator}: {ratio.verdict}")
            if ratio.unknown:
                print(f"{one.estimator}: {ratio.unknown} pairs do not know {ratio.metric}")
        if any(one.failed):
            print(f"{one.estimator}: {one.failed[0]} runs failed in the first, {one.failed[1]} in the second")
        for text in one.newly_failed:
            print(f"  newly failed: {text}")
        if one.other_recordings:
            print(f"{one.estimator}: {one.other_recordings} of {one.pairs} pairs were not run on the same recording")


def document(comparisons: "Sequence[Comparison]") -> dict[str, object]:
    """Return comparisons for JSON, infinite ratios as text."""
    from dronevio.models.serialization import to_plain

    told = [
        {**asdict(one), "ratios": [{**asdict(ratio), "verdict": ratio.verdict} for ratio in one.ratios]}
        for one in comparisons
    ]
    return {"comparisons": to_plain(told)}


def _figure(ratio: float) -> str:
    return "∞" if ratio == float("inf") else f"{ratio:.3f}"


def _p(p: float) -> str:
    return f"{p:.3f}" if p >= 0.001 else f"{p:.0e}"
