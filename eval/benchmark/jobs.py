"""Jobs: one recording and the estimators to run on it, the unit of work that an engine assigns to a machine.

A recording and its estimators stay together because images are large and scenarios are small: the machine that
estimates also renders.
"""

import json
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Protocol, Self

from dronevio.eval.benchmark.cache import RecordingCache
from dronevio.eval.benchmark.isolation import Outcome, call_in_process
from dronevio.eval.benchmark.metrics import OwnMetric
from dronevio.eval.benchmark.rows import Row
from dronevio.eval.provenance import machine_here, processor_here

USAGE_FILE = "usage.json"
"""Name of the file beside a cached recording with the `ResourceUsage` of making it."""
_ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "LP_NUM_THREADS"), "1")
"""Each run uses one core, so that its cost does not depend on the number of runs beside it."""


@dataclass(frozen=True)
class RecordingSpec:
    """A recording of a benchmark: a flight that is simulated first, or a recording that exists."""

    scenario: str
    """Name of the scenario, or of the existing recording."""
    world: str
    """World in which the scenario is flown; empty for an existing recording."""
    seed: int | None
    """Seed of the scenario; None for an existing recording."""
    recording_hash: str
    """Hash of the recording's content, or of everything that determines it."""
    source: object
    """The scenario from which the pipeline makes the recording; can be pickled. None for an existing recording."""
    path: Path | None = None
    """Path of an existing recording, which must be valid on every machine; None for a scenario."""
    start_s: float = 0.0
    """Time after the first frame of the recording at which estimators start [s]."""
    laps: int = 1
    """Number of times that the recording is repeated without a break."""
    images_of: Self | None = None
    """Flight that has the same images, since it differs in the IMU only; None if there is none."""


class BenchmarkPipeline(Protocol):
    """The steps of a run that the application supplies; can be pickled, and is called in processes of their own."""

    @property
    def versions(self) -> str:
        """Versions of all code on which results depend."""

    @property
    def own_metrics(self) -> tuple[OwnMetric, ...]:
        """Metrics of the user that are computed as well."""

    def config_hash(self, estimator: str) -> str:
        """Return a hash of an estimator's settings."""

    def record(self, spec: RecordingSpec, folder: Path, images: Path | None = None) -> None:
        """Simulate a scenario and write its recording into an empty folder.

        Args:
            spec: The flight.
            folder: The empty folder.
            images: Recording of ``spec.images_of``, whose images are used; None to render them.
        """

    def estimate(self, spec: RecordingSpec, recording: Path, estimator: str) -> dict[str, Any]:
        """Run an estimator on a recording, score it, and return the columns of `Row` with metrics.

        The peak memory is that of the process, unless it is among the columns.
        """


@dataclass(frozen=True)
class ResourceUsage:
    """Resources that an operation used."""

    cpu_s: float
    """Processor time [s]."""
    wall_s: float
    """Elapsed time [s]."""
    disk_mb: float
    """Size of the files that it wrote [MB]."""

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read the file that is stored beside a recording."""
        return cls(**json.loads(path.read_text(encoding="utf-8")))


class RecordingFailedError(Exception):
    """A recording cannot be made."""

    def __init__(self, outcome: Outcome) -> None:
        """Take the outcome of the process that was to make the recording."""
        super().__init__(outcome.reason)
        self.outcome = outcome


@dataclass(frozen=True)
class Job:
    """One recording and the estimators to run on it; can be pickled."""

    spec: RecordingSpec
    """The recording to estimate."""
    estimators: tuple[str, ...]
    """Labels of the estimators, which are run one after the other."""
    pipeline: BenchmarkPipeline
    """The steps of a run."""
    cache: Path
    """Folder of the recordings on the machine that executes the job."""
    timeout_s: float
    """Largest duration of one run, and of making the recording [s]."""
    keep_recording: bool = True
    """Whether the recording stays in the cache after the job."""

    def run(self) -> Iterator[Row]:
        """Run the estimators and yield a row for each run, however it ended."""
        try:
            with self.recording() as folder:
                for estimator in self.estimators:
                    yield self.row(estimator, self.estimate(folder, estimator))
        except RecordingFailedError as error:
            for estimator in self.estimators:
                yield self.row(estimator, error.outcome)
        if not self.keep_recording and self.spec.path is None:
            RecordingCache(self.cache).remove(self.spec.recording_hash)

    @contextmanager
    def recording(self) -> Iterator[Path]:
        """Yield the recording's folder, which is made first if it is missing.

        Raises:
            RecordingFailedError: The recording cannot be made.
        """
        if self.spec.path is not None:
            yield self.spec.path
            return
        with RecordingCache(self.cache).acquire(self.spec.recording_hash, self._record) as folder:
            yield folder

    def estimate(self, recording: Path, estimator: str) -> Outcome:
        """Run one estimator in a process of its own.

        Its temporary files are removed even if it is killed. Beside a cached recording, copies of it may share blocks.
        """
        with RecordingCache(self.cache).scratch() if self.spec.path is None else _temporary_folder() as scratch:
            return call_in_process(
                self.pipeline.estimate,
                replace(self.spec, source=None, images_of=None),  # a scenario would import the simulator
                recording,
                estimator,
                timeout_s=self.timeout_s,
                environment={**_ONE_THREAD, "TMPDIR": str(scratch)},
            )

    def row(self, estimator: str, outcome: Outcome) -> Row:
        """Return the row of a run with the given outcome."""
        run = {"scenario": self.spec.scenario, "world": self.spec.world, "seed": self.spec.seed, "estimator": estimator}
        inputs = {
            "config_hash": self.pipeline.config_hash(estimator),
            "versions": self.pipeline.versions,
            "recording_hash": self.spec.recording_hash,
            "machine": "{processor}, {cores} cores, {system}".format(**machine_here()),
            "processor": processor_here(),
        }
        ending = {"status": outcome.status, "reason": outcome.reason}
        metrics = {"peak_mb": outcome.peak_mb, **(outcome.value or {}), "wall_s": outcome.wall_s}
        return Row.from_columns({**run, **inputs, **ending, **metrics}, self.pipeline.own_metrics)

    def _record(self, folder: Path) -> None:
        """Make the recording in a process of its own, and store its resource usage."""
        with self._images() as images:
            outcome = call_in_process(
                self.pipeline.record, self.spec, folder, images, timeout_s=self.timeout_s, environment=_ONE_THREAD
            )
        if outcome.status != "ok":
            reason = f"the recording cannot be made: {outcome.reason}"
            raise RecordingFailedError(
                Outcome(outcome.status, reason, None, outcome.wall_s, outcome.cpu_s, outcome.peak_mb)
            )
        disk_mb = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()) * 1e-6
        usage = ResourceUsage(outcome.cpu_s, outcome.wall_s, disk_mb)
        (folder / USAGE_FILE).write_text(json.dumps(asdict(usage)) + "\n", encoding="utf-8")

    @contextmanager
    def _images(self) -> Iterator[Path | None]:
        """Yield the recording with the same images, made first if recordings are kept; None if there is none."""
        first = self.spec.images_of
        if first is None or not (self.keep_recording or RecordingCache(self.cache).find(first.recording_hash)):
            yield None
            return
        with replace(self, spec=first).recording() as folder:
            yield folder


def _temporary_folder() -> tempfile.TemporaryDirectory[str]:
    """Return a context of a folder for temporary files."""
    return tempfile.TemporaryDirectory(prefix="dronevio-", ignore_cleanup_errors=True)


def lost_rows(job: Job, estimators: Sequence[str], reason: str) -> list[Row]:
    """Return the rows of runs that were lost with the machine that executed them."""
    return [job.row(estimator, Outcome("crashed", reason, None, 0.0, 0.0, None)) for estimator in estimators]
