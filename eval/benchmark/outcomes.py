"""Expected outcomes of flights with faults, and whether the runs of a benchmark have them.

A fault makes the estimate worse. What is acceptable is stated before the benchmark is run: an error within a factor of
that of the same flight without the fault, or a loss of tracking that the estimator reports and that ends in time. An
error beyond `MAX_SIGMAS` of its standard deviations while the estimator reports that it tracks is never acceptable.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from dronevio.eval.benchmark.rows import Row, run_name

MAX_SIGMAS = 5.0
"""Largest acceptable error of position in standard deviations while an estimator reports that it tracks."""


@dataclass(frozen=True)
class Expectation:
    """The expected outcome of a flight with a fault."""

    reference: str
    """Name of the scenario without the fault; that of the scenario itself if it has none."""
    max_error_ratio: float
    """Largest ratio of the ATE to that of the flight without the fault, of the same seed and estimator."""
    max_loss_s: float = 0.0
    """Longest reported loss of tracking that is acceptable instead, the duration of the fault included [s]."""

    @property
    def text(self) -> str:
        """The expectation in words."""
        error = f"error ≤ {self.max_error_ratio:g} ×"
        return f"{error}, or loss ≤ {self.max_loss_s:g} s" if self.max_loss_s else error


@dataclass(frozen=True)
class Verdict:
    """Whether a run has the expected outcome."""

    row: Row
    """The run with this outcome."""
    expectation: Expectation
    """What was expected."""
    error_ratio: float | None
    """Ratio of the ATE to that of the flight without the fault; None if one of them failed."""
    passed: bool
    """Whether the outcome is as expected."""
    outcome: str
    """The outcome in words."""

    @property
    def text(self) -> str:
        """Run, outcome and expectation in one line."""
        return f"{run_name(self.row.identity)}: {self.outcome}; expected: {self.expectation.text}"


def verdicts(rows: Iterable[Row], expectations: Mapping[str, Expectation]) -> tuple[Verdict, ...]:
    """Return the verdicts on all runs of scenarios with an expectation, in the order of the rows.

    A run whose flight without the fault was not run with the same seed and estimator has no error ratio. Flights
    without a fault have verdicts if there are runs with faults.

    Args:
        rows: Runs of a benchmark.
        expectations: Expected outcomes by name of the scenario.
    """
    by_identity = {row.identity: row for row in rows}
    expected_runs = [(row, expectations[row.scenario]) for row in by_identity.values() if row.scenario in expectations]
    if all(row.scenario == expected.reference for row, expected in expected_runs):
        return ()
    return tuple(
        _verdict(row, by_identity.get((expected.reference, row.seed, row.estimator)), expected)
        for row, expected in expected_runs
    )


def _verdict(row: Row, reference: Row | None, expectation: Expectation) -> Verdict:
    """Return the verdict on a run, given that of the flight without the fault."""
    ate_m, reference_m = row["ate_m"], None if reference is None else reference["ate_m"]
    if row.status != "ok" or ate_m is None:
        return Verdict(row, expectation, None, False, f"{row.status}, {row.reason}")
    ratio = ate_m / reference_m if reference_m else None
    outcome = f"error {ratio:.1f} ×" if ratio is not None else "error without a reference"
    lost_s, sigmas = row["longest_loss_s"], row["tracking_sigmas"]
    if lost_s:
        outcome += f", loss of {lost_s:.1f} s"
    if sigmas is not None and sigmas > MAX_SIGMAS:
        outcome += f", error of {sigmas:.1f} σ while tracking"
        return Verdict(row, expectation, ratio, False, outcome)
    bounded = ratio is not None and ratio <= expectation.max_error_ratio
    recovered = lost_s is not None and 0.0 < lost_s <= expectation.max_loss_s
    return Verdict(row, expectation, ratio, bounded or recovered, outcome)
