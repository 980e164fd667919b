"""Outcome of a flight by a policy."""

from dataclasses import dataclass


@dataclass(frozen=True)
class PolicyOutcome:
    """Outcome of a flight by a policy, judged by the true path."""

    environment: str
    """Id of the environment whose task is flown."""
    success: bool
    """Whether the task was accomplished."""
    duration_s: float
    """Time that the policy was in command [s]."""
    distance_m: float | None
    """Distance from the current goal at the end [m]; None if the policy was never in command."""
    end: str
    """Reason of the end: ``success``, ``time limit``, a failure of the environment such as ``collision`` or ``ground``
    (on the true path or, before it, on the estimated one), ``goals missed`` if the task was accomplished on the
    estimated path alone, or ``no take-off``."""
