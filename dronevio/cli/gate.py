"""``dronevio gate``: a check that fails where a benchmark is worse than an earlier one."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from dronevio.cli.compare import document, print_comparisons, read_pairs
from dronevio.cli.options import Printing, PrintOptions
from dronevio.cli.terminal import parse, print_json
from dronevio.models.errors import ConfigError


@dataclass(frozen=True)
class GateCommand:
    """Fail if a benchmark is worse than an earlier one, as a check of every change.

    The exit code is 1 if, for any estimator, the median ratio of a metric to the baseline exceeds 1 + the limit, the
    share of failed runs has grown by more than the limit, or the mean coverage has fallen by more than the limit.
    Otherwise it is 0; it is 2 if the benchmarks cannot be compared, for example because runs are missing. A failed run
    counts as an infinite error.

    Examples:
      dronevio gate benchmarks/now --baseline baseline/results.parquet
      dronevio gate results.parquet --baseline baseline.parquet --max-regression 2%
      dronevio gate results.parquet --baseline baseline.parquet --metrics ate_m rpe_m cpu_ms_mean
    """

    results: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RESULTS")]
    """Folder or results.parquet of the benchmark to check, or folder of a run."""
    baseline: Path
    """Folder or results.parquet of the earlier benchmark, or folder of a run."""
    max_regression: str = "5%"
    """Limit in percent."""
    metrics: tuple[str, ...] = ()
    """Columns of errors or costs to check; ate_m and rpe_m by default."""
    allow_missing: bool = False
    """Leave out runs that only one of the benchmarks has. By default, such runs are an error."""
    seed: int = 0
    """Seed of the bootstrap."""
    printing: Printing = field(default_factory=PrintOptions)
    """How results are printed."""


def main(arguments: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    command = parse(GateCommand, arguments, "gate")

    from dronevio.eval.compare import DEFAULT_METRICS, gate

    limit = _percent(command.max_regression)
    pairs = read_pairs(command.baseline, command.results, allow_missing=command.allow_missing)
    verdict = gate(pairs, limit, command.metrics or DEFAULT_METRICS, command.seed)
    if command.printing.json:
        result = {"passed": verdict.passed, "violations": list(verdict.violations)}
        print_json({**result, **document(verdict.comparisons)})
        return 0 if verdict.passed else 1
    print_comparisons(f"{command.results} relative to {command.baseline}", verdict.comparisons)
    for text in verdict.violations:
        print(f"failed: {text}")
    print(f"gate {'passed' if verdict.passed else 'failed'}, limit {limit:g} %")
    return 0 if verdict.passed else 1


def _percent(text: str) -> float:
    """Return the number of a text such as ``5%``.

    Raises:
        ConfigError: The text is not a number.
    """
    try:
        return float(text.strip().removesuffix("%"))
    except ValueError:
        raise ConfigError(f"--max-regression {text!r}; expected percent, such as 5%") from None
