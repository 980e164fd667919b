"""``dronevio gate``: a check that fails where a benchmark is worse than an earlier one, or than expected."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from dronevio.cli.commands.compare import document, print_comparisons, read_pairs
from dronevio.cli.options import Printing, PrintOptions
from dronevio.cli.terminal import parse, print_json
from dronevio.models.errors import ConfigError
from dronevio.models.ranges import Range, Settings


@dataclass(frozen=True)
class GateCommand(Settings):
    """Fail if a benchmark is worse than an earlier one, as a check of every change.

    With a baseline, the exit code is 1 if, for any estimator, the median ratio of a metric to the baseline exceeds 1 +
    the limit, the share of failed runs has grown by more than the limit, or the mean coverage has fallen by more than
    the limit. Otherwise it is 0; it is 2 if the benchmarks cannot be compared, for example because runs are missing. A
    failed run counts as an infinite error.

    Without a baseline, the exit code is 1 if a run of the suite stress does not have its expected outcome: an error
    within 2, 4 or 8 times that of the flight without the fault, by the strength of the fault, or a loss of tracking
    that is reported and ends in time. An error beyond 5 standard deviations while the estimator reports that it tracks
    fails as well.

    Examples:
      dronevio gate benchmarks/stress
      dronevio gate benchmarks/now --baseline baseline/results.parquet
      dronevio gate results.parquet --baseline baseline.parquet --max-regression 2%
      dronevio gate results.parquet --baseline baseline.parquet --metrics ate_m rpe_m cpu_ms_mean
    """

    results: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RESULTS")]
    """Folder or results.parquet of the benchmark to check, or folder of a run."""
    baseline: Path | None = None
    """Folder or results.parquet of the earlier benchmark, or folder of a run. Without it, the outcomes of the suite
    stress are compared with the expected ones."""
    max_regression: str = "5%"
    """Limit in percent."""
    metrics: tuple[str, ...] = ()
    """Columns of errors or costs to check; ate_m and rpe_m by default."""
    allow_missing: bool = False
    """Leave out runs that only one of the benchmarks has. By default, such runs are an error."""
    seed: Annotated[int, Range(0, 2**32 - 1)] = 0
    """Seed of the bootstrap."""
    printing: Printing = field(default_factory=PrintOptions)
    """How results are printed."""


def main(arguments: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    command = parse(GateCommand, arguments, "gate")
    if command.baseline is None:
        return _check_outcomes(command)

    from dronevio.eval.compare import DEFAULT_METRICS, gate

    limit = _percent(command.max_regression)
    pairs = read_pairs(command.baseline, command.results, allow_missing=command.allow_missing)
    verdict = gate(pairs, limit, command.metrics or DEFAULT_METRICS, command.seed)
    if command.printing.json:
        result = {"passed": verdict.passed, "violations": list(verdict.violations)}
        print_json({**result, **document(verdict.comparisons)})
        return 0 if verdict.passed else 1
    for text in verdict.violations:
        print(f"failed: {text}")
    print_comparisons(f"{command.results} relative to {command.baseline}", verdict.comparisons)
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


def _check_outcomes(command: GateCommand) -> int:
    """Check that the runs of scenarios with an expected outcome have it, and return the exit code."""
    from dronevio.benchmark.expectations import EXPECTATIONS
    from dronevio.eval.benchmark.outcomes import verdicts
    from dronevio.eval.benchmark.rows import read_rows

    checked = verdicts(read_rows(command.results), EXPECTATIONS)
    if not checked:
        raise ConfigError(f"{command.results}: no run with an expected outcome; expected --baseline, or runs of stress")
    failed = [verdict for verdict in checked if not verdict.passed]
    if command.printing.json:
        print_json({"passed": not failed, "runs": len(checked), "violations": [verdict.text for verdict in failed]})
        return int(bool(failed))
    for verdict in failed:
        print(f"failed: {verdict.text}")
    print(f"gate {'failed' if failed else 'passed'}: {len(checked) - len(failed)} of {len(checked)} runs as expected")
    return int(bool(failed))
