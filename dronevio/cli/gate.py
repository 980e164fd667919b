"""``dronevio gate``: exit code 1 where a change made things worse."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from dronevio.cli.compare import document, paired, print_comparisons
from dronevio.cli.terminal import parse, print_json
from dronevio.models.errors import ConfigError


@dataclass(frozen=True)
class GateCommand:
    """Fail where a benchmark is worse than an earlier one: a test for every change.

    It passes (exit code 0) unless, for any estimator, the median ratio of a metric to the baseline is larger than 1 +
    the limit, or the share of failed runs grew by more than the limit, or the mean coverage fell by more than it; then
    the exit code is 1, and 2 where it cannot be told, such as for missing runs. Failed runs count as infinitely bad.

    Examples:
      dronevio gate benchmarks/now --baseline baseline/results.parquet
      dronevio gate results.parquet --baseline baseline.parquet --max-regression 2%
      dronevio gate results.parquet --baseline baseline.parquet --metrics ate_m rpe_m cpu_ms_mean
    """

    results: Annotated[Path, tyro.conf.Positional]
    """What is judged: a benchmark's folder or results.parquet, or the folder of a run."""
    baseline: Path
    """What it has to match."""
    max_regression: str = "5%"
    """The limit, in percent."""
    metrics: tuple[str, ...] = ()
    """Columns that are judged, errors or costs; ate_m and rpe_m by default."""
    allow_missing: bool = False
    """Leave out runs that only one of them has; else they are an error."""
    seed: int = 0
    """Of the bootstrap."""
    json: bool = False
    """Print one JSON document instead of a table."""


def main(arguments: Sequence[str]) -> int:
    """Run the command."""
    command = parse(GateCommand, arguments, "gate")

    from dronevio.eval.compare import DEFAULT_METRICS, gate

    limit = _percent(command.max_regression)
    pairs = paired(command.baseline, command.results, allow_missing=command.allow_missing)
    verdict = gate(pairs, limit, command.metrics or DEFAULT_METRICS, command.seed)
    if command.json:
        told = {"passed": verdict.passed, "objections": list(verdict.objections)}
        print_json({**told, **document(verdict.comparisons)})
        return 0 if verdict.passed else 1
    print_comparisons(f"{command.results} against {command.baseline}", verdict.comparisons)
    for text in verdict.objections:
        print(f"failed: {text}")
    print(f"gate {'passed' if verdict.passed else 'failed'}, at most {limit:g} % worse")
    return 0 if verdict.passed else 1


def _percent(text: str) -> float:
    """Return the number of a text such as ``5%``.

    Raises:
        ConfigError: It is none.
    """
    try:
        return float(text.strip().removesuffix("%"))
    except ValueError:
        raise ConfigError(f"a largest regression of {text!r}; expected percent, such as 5%") from None
