"""One recording and the estimators to be run on it: the unit of work that an engine hands to a machine.

Recording and estimators stay together because frames are large and scenarios are small: whoever estimates renders.
"""

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Protocol, Self

from dronevio.eval.benchmark.cache import RecordingCache
from dronevio.eval.benchmark.isolation import Outcome, isolated
from dronevio.eval.benchmark.rows import Row
from dronevio.eval.provenance import machine_here

COST_FILE = "cost.json"
"""Beside a recording in the cache: what making it cost."""
_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "LP_NUM_THREADS"), "1")
"""Each run has one core: what it costs must not depend on how many others run beside it."""


@dataclass(frozen=True)
class Flight:
    """What to estimate: a flight still to be simulated, or a recording from elsewhere."""

    scenario: str
    """Its name."""
    world: str
    """Where it is flown; empty for a recording from elsewhere."""
    seed: int | None
    """The scenario's seed; None for a recording from elsewhere."""
    recording: str
    """Content hash of the recording."""
    source: object
    """What the workshop makes the recording of; can be pickled."""
    path: Path | None = None
    """Where the recording lies that is from elsewhere; each machine needs it there."""


class Workshop(Protocol):
    """What only the door can do; can be pickled, and is called in processes of their own."""

    @property
    def versions(self) -> str:
        """All code that results depend on."""

    def config_hash(self, estimator: str) -> str:
        """Return what tells an estimator's settings apart."""

    def record(self, flight: Flight, folder: Path) -> None:
        """Make a flight's recording in an empty folder."""

    def estimate(self, flight: Flight, recording: Path, estimator: str) -> dict[str, Any]:
        """Run an estimator on a recording, score it, and return the columns of `Row` from ``coverage_percent`` on."""


@dataclass(frozen=True)
class Cost:
    """What one piece of work took."""

    cpu_s: float
    """Processor time [s]."""
    wall_s: float
    """By the clock on the wall [s]."""
    disk_mb: float
    """What it left on the disk [MB]."""

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read what was noted beside a recording."""
        return cls(**json.loads(path.read_text(encoding="utf-8")))


class RecordingFailedError(Exception):
    """A recording could not be made; holds how its process ended."""

    def __init__(self, outcome: Outcome) -> None:
        super().__init__(outcome.reason)
        self.outcome = outcome


@dataclass(frozen=True)
class Job:
    """The unit of work; can be pickled."""

    flight: Flight
    """What to estimate."""
    estimators: tuple[str, ...]
    """Who is to do it, one after the other."""
    workshop: Workshop
    """How that is done."""
    cache: Path
    """Folder of the recordings on the machine that does the job."""
    timeout_s: float
    """How long one run may take, and the making of the recording [s]."""
    keep: bool = True
    """Whether the recording stays in the cache."""

    def carry_out(self) -> Iterator[Row]:
        """Run the estimators and yield a row for each, however it ended."""
        try:
            with self.recording() as folder:
                for estimator in self.estimators:
                    yield self.row(estimator, self.estimate(folder, estimator))
        except RecordingFailedError as error:
            for estimator in self.estimators:
                yield self.row(estimator, error.outcome)
        if not self.keep and self.flight.path is None:
            RecordingCache(self.cache).drop(self.flight.recording)

    @contextmanager
    def recording(self) -> Iterator[Path]:
        """Give the recording's folder, made now where it is missing.

        Raises:
            RecordingFailedError: It cannot be made.
        """
        if self.flight.path is not None:
            yield self.flight.path
            return
        with RecordingCache(self.cache).borrow(self.flight.recording, self._record) as folder:
            yield folder

    def estimate(self, recording: Path, estimator: str) -> Outcome:
        """Run one estimator in a process of its own."""
        return isolated(
            self.workshop.estimate,
            replace(self.flight, source=None),  # the recording is there; a scenario brings half the simulator along
            recording,
            estimator,
            timeout_s=self.timeout_s,
            environment=_ONE_THREAD,
        )

    def row(self, estimator: str, outcome: Outcome) -> Row:
        """Return the row of a run that ended so."""
        return Row(
            self.flight.scenario,
            self.flight.world,
            self.flight.seed,
            estimator,
            self.workshop.config_hash(estimator),
            self.workshop.versions,
            outcome.status,
            outcome.reason,
            wall_s=outcome.wall_s,
            peak_mb=outcome.peak_mb,
            recording=self.flight.recording,
            machine="{processor}, {cores} cores, {system}".format(**machine_here()),
            **(outcome.value or {}),
        )

    def _record(self, folder: Path) -> None:
        """Make the recording in a process of its own, and note what it cost."""
        outcome = isolated(self.workshop.record, self.flight, folder, timeout_s=self.timeout_s, environment=_ONE_THREAD)
        if outcome.status != "ok":
            told = f"no recording to run on: {outcome.reason}"
            raise RecordingFailedError(
                Outcome(outcome.status, told, None, outcome.wall_s, outcome.cpu_s, outcome.peak_mb)
            )
        disk_mb = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()) * 1e-6
        cost = Cost(outcome.cpu_s, outcome.wall_s, disk_mb)
        (folder / COST_FILE).write_text(json.dumps(asdict(cost)) + "\n", encoding="utf-8")


def lost(job: Job, estimators: Sequence[str], reason: str) -> list[Row]:
    """Return the rows of runs of which no more is known than that the machine that did them is gone."""
    return [job.row(estimator, Outcome("crashed", reason, None, 0.0, 0.0, None)) for estimator in estimators]
