"""An engine that executes jobs with Ray, on this machine or on a cluster (Moritz et al., OSDI 2018).

Ray is an optional dependency.
"""

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from dronevio.eval.benchmark.engines import JobEnd, JobEvent
from dronevio.eval.benchmark.jobs import Job
from dronevio.eval.benchmark.rows import Row
from dronevio.models.errors import ConfigError
from dronevio.models.extras import install_command

_JOBS_PER_CORE = 2  # submitted at a time, so that no core waits and Ray's tables stay small


@dataclass(frozen=True)
class RayEngine:
    """Executes jobs as Ray tasks of one core each.

    Raises:
        ConfigError: Ray is not installed.
    """

    address: str | None = None
    """Address of a running cluster, or ``auto`` for the one that this machine belongs to. None starts a cluster on this
    machine, which listens on 127.0.0.1 only unless the program has imported Ray before."""
    workers: int | None = None
    """Number of cores of a cluster that is started on this machine; None for all."""

    def __post_init__(self) -> None:
        if self.address is None:
            # Without cluster support, all of Ray's servers listen on 127.0.0.1 only. Ray reads this at its import.
            os.environ.setdefault("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "0")
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        _import_ray()

    def run(self, jobs: Sequence[Job]) -> Iterator[JobEvent]:
        """Yield the rows of all jobs as they are produced, and the end of each job.

        Raises:
            ConfigError: There is no cluster at the address.
        """
        ray = _import_ray()
        self._connect(ray)
        try:
            # A job that is lost with its machine becomes a row with that reason; it is not repeated silently.
            task = ray.remote(num_cpus=1, max_retries=0, num_returns="streaming")(_rows)
            waiting = iter(range(len(jobs)))
            running: dict[Any, int] = {}
            while True:
                free = _JOBS_PER_CORE * max(1, int(ray.cluster_resources().get("CPU", 1))) - len(running)
                for index, _ in zip(waiting, range(free), strict=False):
                    running[task.remote(jobs[index])] = index
                if not running:
                    return
                ready, _ = ray.wait(list(running), num_returns=1, timeout=None, fetch_local=False)
                for rows in ready:
                    event = _next_event(ray, rows)
                    yield running[rows], event
                    if isinstance(event, JobEnd):
                        del running[rows]
        finally:
            ray.shutdown()

    def _connect(self, ray: Any) -> None:
        quiet = {"log_to_driver": False, "include_dashboard": False, "configure_logging": False}
        try:
            if self.address is None:
                ray.init(num_cpus=self.workers, _node_ip_address="127.0.0.1", **quiet)
            else:
                ray.init(address=self.address, log_to_driver=False)
        except (ConnectionError, ValueError, RuntimeError) as error:
            raise ConfigError(f"no Ray at {self.address or 'this machine'}: {str(error).splitlines()[0]}") from error


def _rows(job: Job) -> Iterator[Row]:
    """Run a job; this is the function of the Ray task."""
    yield from job.run()


def _next_event(ray: Any, rows: Any) -> Row | JobEnd:
    """Return the next row of a task that has one ready, or the end of the task."""
    try:
        row: Row = ray.get(next(rows))
    except StopIteration:
        return JobEnd()
    except Exception as error:  # errors of the task, and those of a machine that is lost
        return JobEnd(f"{type(error).__name__}: {' '.join(str(error).split())[:300]}")
    return row


def _import_ray() -> Any:
    """Return the module of Ray.

    Raises:
        ConfigError: Ray is not installed.
    """
    try:
        import ray  # type: ignore[import-not-found, unused-ignore]
    except ImportError:
        raise ConfigError(f"the engine ray needs Ray; expected it installed: {install_command('ray')}") from None
    return ray
