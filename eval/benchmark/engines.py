"""Who does the jobs: processes of this machine, or a cluster."""

import os
import queue
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol, TypeAlias

from dronevio.eval.benchmark.jobs import Job
from dronevio.eval.benchmark.rows import Row


@dataclass(frozen=True)
class Ended:
    """A job has ended; its rows have been heard of before."""

    reason: str = ""
    """Why, if it was not because all was done."""


Heard: TypeAlias = tuple[int, Row | Ended]
"""The number of a job, and what came of it: a row, or that there are no more."""


class Engine(Protocol):
    """Does jobs."""

    def run(self, jobs: Sequence[Job]) -> Iterator[Heard]:
        """Yield the rows of all jobs as they come, and for each job its end."""


def cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@dataclass(frozen=True)
class LocalEngine:
    """Does jobs on this machine, some at a time; each run is a process of its own, and the threads here only wait."""

    workers: int
    """How many at a time."""

    def run(self, jobs: Sequence[Job]) -> Iterator[Heard]:
        """Yield the rows of all jobs as they come, and for each job its end."""
        waiting: queue.SimpleQueue[int] = queue.SimpleQueue()
        heard: queue.SimpleQueue[Heard] = queue.SimpleQueue()
        stop = threading.Event()
        for number in range(len(jobs)):
            waiting.put(number)

        def work() -> None:
            while not stop.is_set():
                try:
                    number = waiting.get_nowait()
                except queue.Empty:
                    return
                heard.put((number, _followed(number)))

        def _followed(number: int) -> Ended:
            try:
                for row in jobs[number].carry_out():
                    heard.put((number, row))
                    if stop.is_set():
                        break
            except Exception as error:  # a full disk, say: it costs this job, not the others
                return Ended(f"{type(error).__name__}: {error}")
            return Ended()

        # Daemons: whoever interrupts the benchmark does not wait for them, and their processes end with this one.
        for _ in range(min(self.workers, len(jobs))):
            threading.Thread(target=work, daemon=True).start()
        try:
            open_jobs = len(jobs)
            while open_jobs:
                number, what = heard.get()
                open_jobs -= isinstance(what, Ended)
                yield number, what
        finally:
            stop.set()
