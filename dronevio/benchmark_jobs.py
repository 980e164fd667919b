"""What a benchmark needs of the door: flights to estimate, how to make their recordings, how to run estimators."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import dronevio
from dronevio.eval.benchmark.cache import code_hash, content_hash, recording_hash
from dronevio.eval.benchmark.jobs import RecordingSpec
from dronevio.eval.benchmark.rows import score_columns
from dronevio.eval.provenance import versions_here
from dronevio.models.defects import defects_text
from dronevio.models.errors import ConfigError, InputError
from dronevio.models.serialization import to_jsonable
from dronevio.registry import NamedEstimator

if TYPE_CHECKING:
    from dronevio.sim.scenario import Scenario

_HOUSE = Path(dronevio.__file__).parent
_DRAWS = tuple(_HOUSE / name for name in ("sim", "models", "recorder.py"))
_ESTIMATES = tuple(
    _HOUSE / name
    for name in (
        "estimator",
        "eval/metrics",
        "eval/tracking.py",
        "driver.py",
        "external_program.py",
        "python_estimator.py",
        "registry.py",
    )
)
_DRAWING_PACKAGES = ("dronevio", "mujoco", "opencv-python-headless", "numpy")
_PACKAGES = (*_DRAWING_PACKAGES, "python", "gtsam")
"""Of all packages, those that can change a row."""


def versions() -> str:
    """Return what rows depend on besides settings: packages, and the house's own code, which may change in between."""
    found = versions_here()
    packages = [f"{name} {found[name]}" for name in _PACKAGES if name in found]
    return ", ".join([*packages, f"code {code_hash(*_DRAWS, *_ESTIMATES)}"])


@dataclass(frozen=True)
class Workbench:
    """Flies and estimates; implements `BenchmarkPipeline`."""

    estimators: tuple[NamedEstimator, ...]
    """The estimators of the benchmark."""
    versions: str
    """Versions of the machine that planned the benchmark; all machines must have the same."""
    strict: bool = False
    """Whether recordings with defects are refused."""

    def config_hash(self, estimator: str) -> str:
        """Return what tells an estimator's settings apart."""
        return content_hash(self._named(estimator).settings())

    def record(self, spec: RecordingSpec, folder: Path) -> None:
        """Fly a scenario and write its recording."""
        from dronevio.recorder import record_flight
        from dronevio.sim.scenario import Scenario

        self._check_here()
        assert isinstance(spec.source, Scenario)
        record_flight(spec.source, folder, workers=1)

    def estimate(self, spec: RecordingSpec, recording: Path, estimator: str) -> dict[str, Any]:
        """Run an estimator on a recording and score it."""
        from dronevio.eval.metrics.scores import score
        from dronevio.eval.tracking import longest_loss_s, tracking_sigmas
        from dronevio.models.recordings.open import open_recording

        self._check_here()
        opened = open_recording(recording, 1, repair=True)
        if opened.ground_truth is None:
            raise InputError(recording, "no ground truth", "a recording with the true motion")
        estimated = self._named(estimator).run(recording, self.strict)
        frames = opened.frame_times_ns
        return {
            **score_columns(score(opened.ground_truth, estimated.trajectory, frames)),
            "duration_s": float(np.ptp(frames)) * 1e-9,
            "cpu_ms_mean": estimated.cpu_ms_mean,
            "cpu_ms_p99": estimated.cpu_ms_p99,
            "real_time_factor": estimated.real_time_factor,
            "defects": defects_text(estimated.defects),
            "longest_loss_s": None if estimated.run is None else longest_loss_s(estimated.run),
            "tracking_sigmas": None if estimated.run is None else tracking_sigmas(estimated.run, opened.ground_truth),
        }

    def _named(self, label: str) -> NamedEstimator:
        return next(estimator for estimator in self.estimators if estimator.label == label)

    def _check_here(self) -> None:
        """Check that this machine would compute the same as the one that planned the benchmark."""
        here, there = versions().split(", "), self.versions.split(", ")
        if here != there:
            differing = "; expected ".join(
                ", ".join(p for p in a if p not in b) for a, b in ((here, there), (there, here))
            )
            raise ConfigError(f"what runs here is {differing}, as where and when the benchmark was started")


def scenario_flights(names: Iterable[str], seeds: Sequence[int], rig: str | None = None) -> tuple[RecordingSpec, ...]:
    """Return the flights of scenarios, every seed of each; the name of a suite stands for its scenarios.

    The first seed of all scenarios comes first, then the second, so that early results cover all scenarios.

    Args:
        names: Of scenarios and suites.
        seeds: Of the flights.
        rig: Other sensors than the scenarios': a name, or a file that says it; `flying.rig_of` tells more.

    Raises:
        ConfigError: There is no such scenario, suite or rig.
        InputError: The rig's file cannot be read.
    """
    from dronevio.sim.scenarios import SUITES, scenario_named

    found = {name: scenario_named(name) for given in names for name in SUITES.get(given, (given,))}
    unique = {flown.name: flown for flown in found.values()}
    if rig is not None:
        from dronevio.recorder import rig_of

        chosen = rig_of(rig)
        unique = {name: replace(flown, rig=chosen) for name, flown in unique.items()}
    return tuple(_flight(replace(flown, seed=seed)) for seed in seeds for flown in unique.values())


def recorded_flights(paths: Iterable[Path]) -> tuple[RecordingSpec, ...]:
    """Return the flights of recordings from elsewhere, named as their files or folders are.

    Raises:
        InputError: One is not there or has no ground truth.
        ConfigError: Two have the same name.
    """
    from dronevio.models.recordings.open import read_trajectory

    flights: dict[str, RecordingSpec] = {}
    for path in paths:
        whole = path.resolve().parent if path.resolve().name == "mav0" else path.resolve()
        digest = recording_hash(whole)
        read_trajectory(whole)  # raises where there is no truth: rather now than in every run
        name = whole.stem if whole.is_file() else whole.name
        if name in flights:
            raise ConfigError(f"{path} and {flights[name].path}, both named {name}; expected names of their own")
        flights[name] = RecordingSpec(name, "", None, digest, None, whole)
    return tuple(flights.values())


def _flight(flown: "Scenario") -> RecordingSpec:
    """Return a scenario's flight. Its recording's hash is that of all that draws it; a mere name does not."""
    installed = versions_here()
    settings = to_jsonable(replace(flown, name="", description=""))
    packages = {name: installed.get(name) for name in _DRAWING_PACKAGES}
    digest = content_hash({"scenario": settings, "packages": packages, "code": code_hash(*_DRAWS)})
    return RecordingSpec(flown.name, flown.world, flown.seed, digest, flown)
