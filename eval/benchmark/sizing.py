"""What many flights would take, from one that was measured."""

from dataclasses import dataclass

from dronevio.eval.benchmark.jobs import COST_FILE, Cost, Job, RecordingFailedError
from dronevio.models.errors import EvaluationError

ROW_KB = 10.2
"""Of the small file of one run; joined, a row takes less than a kilobyte [kB]."""


@dataclass(frozen=True)
class Sizing:
    """What one flight took, and its estimates."""

    flight: Cost
    """Simulating, rendering and writing the recording."""
    estimates: tuple[tuple[str, Cost], ...]
    """Each estimator's run, the start of its process and the scoring included."""

    def scaled(self, flights: int, cores: int) -> list[tuple[str, float, float, float]]:
        """Return what many flights take: for each kind of work its name, CPU-hours, hours on some cores, and GB."""
        work = [("recordings", self.flight), *self.estimates]
        rows = [
            (name, cost.cpu_s / 3600.0 * flights, cost.cpu_s / 3600.0 * flights / cores, cost.disk_mb / 1e3 * flights)
            for name, cost in work
        ]
        return [*rows, ("all", sum(row[1] for row in rows), sum(row[2] for row in rows), sum(row[3] for row in rows))]


def measure(job: Job) -> Sizing:
    """Make one recording and run its estimators on it, and return what that took.

    Raises:
        EvaluationError: The recording cannot be made, or an estimator does not come to an end.
    """
    try:
        with job.recording() as folder:
            estimates: list[tuple[str, Cost]] = []
            for estimator in job.estimators:
                outcome = job.estimate(folder, estimator)
                if outcome.status in ("timeout", "crashed"):
                    raise EvaluationError(f"{estimator}: {outcome.reason}; expected a run that can be measured")
                estimates.append((estimator, Cost(outcome.cpu_s, outcome.wall_s, ROW_KB * 1e-3)))
            return Sizing(Cost.read(folder / COST_FILE), tuple(estimates))
    except RecordingFailedError as error:
        raise EvaluationError(str(error)) from None
