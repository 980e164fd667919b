"""Runs a benchmark: finds what is missing, has it done, and keeps every row as it comes."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from dronevio.eval.benchmark.engines import Ended, Engine
from dronevio.eval.benchmark.jobs import Flight, Job, Workshop, lost
from dronevio.eval.benchmark.rows import Row
from dronevio.eval.benchmark.store import ResultStore

_JOIN_EVERY_S = 30.0


class Listener(Protocol):
    """Hears of every run that is done."""

    def __call__(self, done: int, total: int, row: Row | None) -> None:
        """Say that ``done`` of ``total`` missing runs are finished, the latest of them ``row``."""


def nobody(done: int, total: int, row: Row | None) -> None:
    """Listen to nothing."""


@dataclass(frozen=True)
class Benchmark:
    """Flights × estimators."""

    flights: tuple[Flight, ...]
    """What to estimate."""
    estimators: tuple[str, ...]
    """Who estimates."""
    workshop: Workshop
    """How that is done."""
    cache: Path
    """Folder of the recordings."""
    timeout_s: float
    """How long one run may take [s]."""
    keep: bool = True
    """Whether recordings stay in the cache."""

    @property
    def size(self) -> int:
        """How many runs it has."""
        return len(self.flights) * len(self.estimators)

    def jobs(self, store: ResultStore, retry: bool = False) -> list[Job]:
        """Return what is still to be done.

        Args:
            store: What has been done. A row counts while all that it depends on is the same.
            retry: Whether failed runs are to be done again.
        """
        jobs = []
        for flight in self.flights:
            missing = tuple(name for name in self.estimators if not self._done(store, flight, name, retry))
            # A recording that has to be made belongs to one job; on one that is there, estimators need not wait.
            shares = [missing] if flight.path is None else [(name,) for name in missing]
            jobs += [
                Job(flight, share, self.workshop, self.cache, self.timeout_s, self.keep) for share in shares if share
            ]
        return jobs

    def _done(self, store: ResultStore, flight: Flight, estimator: str, retry: bool) -> bool:
        row = store.find((flight.scenario, flight.seed, estimator))
        if row is None or (retry and row.status != "ok"):
            return False
        return row.dependencies == (flight.recording, self.workshop.config_hash(estimator), self.workshop.versions)


def run_benchmark(
    benchmark: Benchmark, store: ResultStore, engine: Engine, heard: Listener = nobody, retry: bool = False
) -> tuple[Row, ...]:
    """Do all runs of a benchmark that have not been done, and return the rows of all.

    Every row is on the disk before the listener hears of it, so that whatever ends this early, what is done stays done.
    The joined table is brought up to date every half minute, and in the end, also where that is an interruption.

    Args:
        benchmark: What to run.
        store: Where rows are kept.
        engine: Who does it.
        heard: Hears of every run.
        retry: Whether failed runs are to be done again.

    Raises:
        ConfigError: The engine cannot be used.
    """
    jobs = benchmark.jobs(store, retry)
    missing = {(number, name) for number, job in enumerate(jobs) for name in job.estimators}
    total = len(missing)
    store.join()  # rather now than later, if that is impossible
    joined = time.monotonic()
    heard(0, total, None)
    try:
        for number, what in engine.run(jobs) if jobs else ():
            rows: Sequence[Row] = [what] if isinstance(what, Row) else []
            if isinstance(what, Ended):
                left = sorted(name for other, name in missing if other == number)
                rows = lost(jobs[number], left, what.reason or "its job ended without it")
            for row in rows:
                store.add(row)
                missing.discard((number, row.estimator))
                heard(total - len(missing), total, row)
            if time.monotonic() - joined > _JOIN_EVERY_S:
                store.join()
                joined = time.monotonic()
    finally:
        store.join()
    wanted = {(flight.scenario, flight.seed, name) for flight in benchmark.flights for name in benchmark.estimators}
    return tuple(row for row in store.rows if row.identity in wanted)
