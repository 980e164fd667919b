"""Runs a benchmark: finds the runs that are missing, executes them, and stores every row as it is produced."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from dronevio.eval.benchmark.engines import Engine, JobEnd
from dronevio.eval.benchmark.jobs import BenchmarkPipeline, Job, RecordingSpec, lost_rows
from dronevio.eval.benchmark.rows import Row
from dronevio.eval.benchmark.store import ResultStore

_TABLE_INTERVAL_S = 30.0


class ProgressListener(Protocol):
    """Receives the progress of a benchmark."""

    def __call__(self, done: int, total: int, row: Row | None) -> None:
        """Report that ``done`` of ``total`` missing runs are finished, the latest of them ``row``."""


def ignore_progress(done: int, total: int, row: Row | None) -> None:
    """Do nothing with the progress."""


@dataclass(frozen=True)
class BenchmarkPlan:
    """The runs of a benchmark: every estimator on every recording."""

    recordings: tuple[RecordingSpec, ...]
    """The recordings to estimate."""
    estimators: tuple[str, ...]
    """Labels of the estimators."""
    pipeline: BenchmarkPipeline
    """The steps of a run."""
    cache: Path
    """Folder in which recordings are made and found again."""
    timeout_s: float
    """Largest duration of one run [s]."""
    keep_recordings: bool = True
    """Whether recordings stay in the cache."""
    processor: str | None = None
    """Kind of the processor of the machine that executes the runs, `Row.processor`. Rows of other kinds do not count as
    done. None if several machines execute them: rows of all kinds count then."""

    @property
    def size(self) -> int:
        """Number of runs."""
        return len(self.recordings) * len(self.estimators)

    def missing_jobs(self, store: ResultStore, retry: bool = False) -> list[Job]:
        """Return the jobs of the runs that have not been done.

        Args:
            store: Rows of earlier runs, which count while everything that they depend on is the same.
            retry: Whether failed runs are repeated.
        """
        jobs = []
        for spec in self.recordings:
            missing = tuple(name for name in self.estimators if not self._is_done(store, spec, name, retry))
            # A recording that must be made belongs to one job; estimators of an existing one need not wait.
            groups = [missing] if spec.path is None else [(name,) for name in missing]
            jobs += [
                Job(spec, group, self.pipeline, self.cache, self.timeout_s, self.keep_recordings)
                for group in groups
                if group
            ]
        return jobs

    def _is_done(self, store: ResultStore, spec: RecordingSpec, estimator: str, retry: bool) -> bool:
        row = store.find((spec.scenario, spec.seed, estimator))
        if row is None or (retry and row.status != "ok"):
            return False
        if self.processor is not None and row.processor != self.processor:
            return False
        if not {*self.pipeline.own_metrics} <= {*row.own_metrics}:
            return False
        return row.dependencies == (spec.recording_hash, self.pipeline.config_hash(estimator), self.pipeline.versions)


def run_benchmark(
    plan: BenchmarkPlan,
    store: ResultStore,
    engine: Engine,
    listener: ProgressListener = ignore_progress,
    retry: bool = False,
) -> tuple[Row, ...]:
    """Execute the missing runs of a benchmark and return the rows of all of its runs.

    Every row is on disk before the listener is called, so that an interruption loses no finished run. The table of all
    rows is written every half minute and at the end, also at an interruption.

    Args:
        plan: The runs.
        store: Stores the rows.
        engine: Executes the jobs.
        listener: Called after every run.
        retry: Whether failed runs are repeated.

    Raises:
        ConfigError: The engine cannot be used.
    """
    jobs = plan.missing_jobs(store, retry)
    missing = {(index, name) for index, job in enumerate(jobs) for name in job.estimators}
    total = len(missing)
    store.write_table()  # fails before the first run if it is impossible
    written = time.monotonic()
    listener(0, total, None)
    try:
        for index, event in engine.run(jobs) if jobs else ():
            rows: Sequence[Row] = [event] if isinstance(event, Row) else []
            if isinstance(event, JobEnd):
                unfinished = sorted(name for other, name in missing if other == index)
                rows = lost_rows(jobs[index], unfinished, event.reason or "the job ended without this run")
            for row in rows:
                store.add(row)
                missing.discard((index, row.estimator))
                listener(total - len(missing), total, row)
            if time.monotonic() - written > _TABLE_INTERVAL_S:
                store.write_table()
                written = time.monotonic()
    finally:
        store.write_table()
    planned = {(spec.scenario, spec.seed, name) for spec in plan.recordings for name in plan.estimators}
    return tuple(row for row in store.rows if row.identity in planned)
