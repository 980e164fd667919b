"""The resources of a large benchmark, extrapolated from one job that is measured."""

from dataclasses import dataclass

from dronevio.eval.benchmark.jobs import USAGE_FILE, Job, RecordingFailedError, ResourceUsage
from dronevio.models.errors import EvaluationError

ROW_KB = 10.2
"""Size of the file of one run [kB]; in the table of all rows, a row takes less than a kilobyte."""


@dataclass(frozen=True)
class JobUsage:
    """Resources of one job."""

    recording: ResourceUsage
    """Simulation, rendering and writing of the recording."""
    estimates: tuple[tuple[str, ResourceUsage], ...]
    """Label and resources of each estimator's run, with the start of its process and the scoring."""

    def scaled(self, recordings: int, cores: int) -> list[tuple[str, float, float, float]]:
        """Return name, CPU-hours, hours on some cores, and GB of each kind of work for many recordings."""
        work = [("recordings", self.recording), *self.estimates]
        rows = [
            (
                name,
                usage.cpu_s / 3600.0 * recordings,
                usage.cpu_s / 3600.0 * recordings / cores,
                usage.disk_mb / 1e3 * recordings,
            )
            for name, usage in work
        ]
        return [*rows, ("all", sum(row[1] for row in rows), sum(row[2] for row in rows), sum(row[3] for row in rows))]


def measure_job(job: Job) -> JobUsage:
    """Make the recording of a job, run its estimators, and return the resources that this took.

    Raises:
        EvaluationError: The recording cannot be made, or an estimator times out or crashes.
    """
    try:
        with job.recording() as folder:
            estimates: list[tuple[str, ResourceUsage]] = []
            for estimator in job.estimators:
                outcome = job.estimate(folder, estimator)
                if outcome.status in ("timeout", "crashed"):
                    raise EvaluationError(f"{estimator}: {outcome.reason}; expected a run that can be measured")
                estimates.append((estimator, ResourceUsage(outcome.cpu_s, outcome.wall_s, ROW_KB * 1e-3)))
            return JobUsage(ResourceUsage.read(folder / USAGE_FILE), tuple(estimates))
    except RecordingFailedError as error:
        raise EvaluationError(str(error)) from None
