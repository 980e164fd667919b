"""Engines execute jobs: `LocalEngine` on this machine, `dronevio.eval.benchmark.ray_engine.RayEngine` on a cluster."""

import os
import queue
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeAlias

from dronevio.eval.benchmark.isolation import failure_reason
from dronevio.eval.benchmark.jobs import Job
from dronevio.eval.benchmark.rows import Row


@dataclass(frozen=True)
class JobEnd:
    """The end of a job, after all of its rows."""

    reason: str = ""
    """Why the job ended before all of its runs were done; empty if it was completed."""


JobEvent: TypeAlias = tuple[int, Row | JobEnd]
"""The index of a job, and either a row that it produced or its end."""


class Engine(Protocol):
    """Executes jobs."""

    def run(self, jobs: Sequence[Job]) -> Iterator[JobEvent]:
        """Yield the rows of all jobs as they are produced, and the end of each job."""


def available_cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@dataclass(frozen=True)
class LocalEngine:
    """Executes jobs on this machine. Each run is a process of its own; the threads of this class only wait."""

    workers: int
    """Number of jobs that are executed at the same time."""

    def run(self, jobs: Sequence[Job]) -> Iterator[JobEvent]:
        """Yield the rows of all jobs as they are produced, and the end of each job."""
        waiting: queue.SimpleQueue[int] = queue.SimpleQueue()
        events: queue.SimpleQueue[JobEvent] = queue.SimpleQueue()
        stop = threading.Event()
        for index in range(len(jobs)):
            waiting.put(index)

        def work() -> None:
            while not stop.is_set():
                try:
                    index = waiting.get_nowait()
                except queue.Empty:
                    return
                events.put((index, _execute(index)))

        def _execute(index: int) -> JobEnd:
            try:
                for row in jobs[index].run():
                    events.put((index, row))
                    if stop.is_set():
                        break
            except Exception as error:  # a full disk, for example, ends this job and not the others
                return JobEnd(failure_reason(error))
            return JobEnd()

        # Daemon threads do not delay the end of an interrupted benchmark; their child processes end with this process.
        for _ in range(min(self.workers, len(jobs))):
            threading.Thread(target=work, daemon=True).start()
        try:
            open_jobs = len(jobs)
            while open_jobs:
                index, event = events.get()
                open_jobs -= isinstance(event, JobEnd)
                yield index, event
        finally:
            stop.set()
