"""Jobs done by Ray, on this machine or on a cluster (Moritz et al., OSDI 2018); an optional dependency."""

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

from dronevio.eval.benchmark.engines import Ended, Heard
from dronevio.eval.benchmark.jobs import Job
from dronevio.eval.benchmark.rows import Row
from dronevio.models.errors import ConfigError

_JOBS_A_CORE = 2  # handed out ahead, so that no core waits; more would only fill Ray's tables


@dataclass(frozen=True)
class RayEngine:
    """Does jobs as Ray tasks of one core each."""

    address: str | None = None
    """Of a running cluster, ``auto`` for the one that this machine belongs to; None starts one here, which listens on
    127.0.0.1 only (unless the program has imported Ray before: that settles where Ray listens)."""
    workers: int | None = None
    """How many cores the one here has."""

    def run(self, jobs: Sequence[Job]) -> Iterator[Heard]:
        """Yield the rows of all jobs as they come, and for each job its end.

        Raises:
            ConfigError: Ray is not installed, or there is no cluster at the address.
        """
        if self.address is None:
            # Ray's own name for "no cluster": all its servers then listen on 127.0.0.1 only. It reads it when imported.
            os.environ.setdefault("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "0")
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        ray = _ray()
        self._connect(ray)
        try:
            # A job that is lost with its machine is a row that says so, not a job done twice unseen.
            task = ray.remote(num_cpus=1, max_retries=0, num_returns="streaming")(_rows)
            waiting = iter(range(len(jobs)))
            running: dict[Any, int] = {}
            while True:
                room = _JOBS_A_CORE * max(1, int(ray.cluster_resources().get("CPU", 1))) - len(running)
                for number, _ in zip(waiting, range(room), strict=False):
                    running[task.remote(jobs[number])] = number
                if not running:
                    return
                ready, _ = ray.wait(list(running), num_returns=1, timeout=None, fetch_local=False)
                for rows in ready:
                    what = _next(ray, rows)
                    yield running[rows], what
                    if isinstance(what, Ended):
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
    """Be the task."""
    yield from job.carry_out()


def _next(ray: Any, rows: Any) -> Row | Ended:
    """Return the next row of a task that has one ready, or how it ended."""
    try:
        row: Row = ray.get(next(rows))
    except StopIteration:
        return Ended()
    except Exception as error:  # the task's own errors, and those of a machine that is gone
        return Ended(f"{type(error).__name__}: {' '.join(str(error).split())[:300]}")
    return row


def _ray() -> Any:
    """Return Ray.

    Raises:
        ConfigError: It is not installed.
    """
    try:
        import ray  # type: ignore[import-not-found, unused-ignore]
    except ImportError:
        raise ConfigError("the engine ray needs Ray; expected it installed: pip install 'dronevio[ray]'") from None
    return ray
